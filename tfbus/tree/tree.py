"""All frames: who hangs on whom, and where one is, seen from another.

`TransformTree` has no clock, no event loop and no I/O: it answers or it raises. One lock is held for one lookup or one
batch, so worker threads may read while the loop inserts.
"""

import math
from collections.abc import Iterable

from tfbus.geometry.stamped import Batch, TransformStamped, as_batch
from tfbus.stamps import LATEST, Latest, as_duration, as_stamp, from_seconds
from tfbus.tree._lookup import At
from tfbus.tree.cycles import admit
from tfbus.tree.forest import Forest
from tfbus.tree.history import Edge, Outcome
from tfbus.tree.reader import TreeReader
from tfbus.tree.rendering import describe, to_dot, to_yaml


class TransformTree(TreeReader):
    """The transforms between any two frames, over the last few seconds.

    Parameters
    ----------
    keep : float or None
        How much history to keep for each frame, in s before that frame's newest stamp; None keeps everything.

    Raises
    ------
    ValueError
        If `keep` is negative or NaN.

    Attributes
    ----------
    keep : float or None
    inserted, replaced, expired : int
        How many samples had each `Outcome`.
    forest : Forest
        What the tree is made of. For the rest of the package: reading it is not covered by the lock.

    Examples
    --------
    >>> tree = TransformTree()
    >>> tree.insert(TransformStamped("base_link", "base_laser", 0, Transform((0.1, 0.0, 0.2))))
    <Outcome.INSERTED: 'inserted'>
    >>> tree.lookup("base_link", "base_laser", 0).transform.translation
    (0.1, 0.0, 0.2)
    """

    def __init__(self, keep: float | None = 10.0) -> None:
        seconds = None if keep is None else as_duration(keep, "keep")
        self.keep = keep
        super().__init__(Forest(None if seconds is None or seconds == math.inf else from_seconds(seconds)))
        self.inserted = 0
        self.replaced = 0
        self.expired = 0

    # Insertion

    def insert(self, sample: TransformStamped) -> Outcome:
        """Store one sample.

        Raises
        ------
        InvalidTransformError
            If it would close a loop of parents. Nothing is stored.
        TypeError
            If it is not a `TransformStamped`.
        """
        return self.insert_many((sample,))[0]

    def insert_many(self, samples: Iterable[TransformStamped]) -> list[Outcome]:
        """Store a batch, all of it or nothing: loops are judged after the whole batch.

        Raises
        ------
        InvalidTransformError
            If a sample would close a loop of parents.
        TypeError
            If something in it is not a `TransformStamped`.
        """
        batch = as_batch(samples)
        with self._lock:
            _, refused = admit(self.forest.frames, batch)
            if refused:
                raise refused[0]
            outcomes = [self._store(sample) for sample in batch]
            self.forest.forget_changes()
            return outcomes

    def _store(self, sample: TransformStamped) -> Outcome:
        outcome = self.forest.store(sample)
        if outcome is Outcome.INSERTED:
            self.inserted += 1
        elif outcome is Outcome.REPLACED:
            self.replaced += 1
        else:
            self.expired += 1
        return outcome

    def commit(self, batch: Batch) -> bool:
        """Store a batch that somebody has judged already, such as the bus; what is too old expires.

        Returns
        -------
        bool
            Whether every sample was just the next one of its frame, so that nothing but stamps has changed.
        """
        frames = self.forest.frames
        plain = True
        with self._lock:
            for sample in batch:
                parent, child, stamp, row, authority, static = sample._fields
                history = frames.get(child)
                if history is not None and not static and history.append(parent, stamp, row, authority):
                    self.inserted += 1
                else:
                    plain = False
                    self._store(sample)
        return plain

    # Questions about the tree itself

    def frames(self) -> list[str]:
        """Every frame that a sample in the tree names, sorted."""
        with self._lock:
            return list(self.forest.names.sorted())

    def parent(self, frame: str, at: At = LATEST) -> str | None:
        """The frame's parent: at a stamp, or the newest one. None for a root.

        Raises
        ------
        UnknownFrameError
        ExtrapolationError
            If the stamp is outside the frame's window.
        """
        if at is not LATEST:
            at = as_stamp(at)
        with self._lock:
            self.forest.check_known(frame)
            history = self.forest.frames.get(frame)
            if history is None:
                return None
            if isinstance(at, Latest):
                return history.parent
            if not history.covers(at):
                raise history.missing(at)
            return history.parent_at(at)

    def edges(self) -> list[Edge]:
        """Every frame that has a parent, with its newest edge, sorted by name."""
        with self._lock:
            return [self.forest.frames[child].edge() for child in sorted(self.forest.frames)]

    def __contains__(self, frame: object) -> bool:
        with self._lock:
            return frame in self.forest.names

    # Changes other than samples

    def remove_frame(self, frame: str) -> None:
        """Take a frame off its parent and forget its samples; frames below it stay, as a tree of their own.

        Raises
        ------
        UnknownFrameError
        """
        with self._lock:
            self.forest.check_known(frame)
            self.forest.remove(frame)

    def clear(self) -> None:
        """Drop all moving samples. Static ones and the frames' names stay."""
        with self._lock:
            self.forest.clear()

    def copy(self) -> "TransformTree":
        """An independent copy with the same samples, such as a snapshot to analyse elsewhere."""
        twin = TransformTree(self.keep)
        with self._lock:
            twin.forest = self.forest.copy()
        return twin

    def adopt(self, other: "TransformTree") -> None:
        """Hold a copy of what another tree holds, as far back as this one keeps it, instead of its own samples."""
        with other._lock:
            forest = other.forest.within(self.forest.window)
        with self._lock:
            self.forest = forest

    # Pictures

    def describe(self, now: int | None = None) -> str:
        """The tree as text, with each edge's rate, age, span and authority.

        Parameters
        ----------
        now : int, optional
            The stamp that ages are counted from, in ns; by default the newest in the tree.
        """
        return describe(self.edges(), now)

    def to_dot(self) -> str:
        """The tree in Graphviz's language; static edges are dashed."""
        return to_dot(self.edges())

    def to_yaml(self) -> str:
        """The tree as YAML with tf2's keys; stamps in s."""
        return to_yaml(self.edges())
