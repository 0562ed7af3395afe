"""All frames: who hangs on whom, and where one is, seen from another.

`TransformTree` has no clock, no event loop and no I/O: it answers or it raises. One lock is held for one lookup or one
batch, so worker threads may read while the loop inserts.
"""

import math
import threading
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

from tfbus.errors import (
    DisconnectedError,
    ExtrapolationError,
    FutureExtrapolationError,
    TransformLookupError,
)
from tfbus.forest import Forest
from tfbus.geometry import Row, compose
from tfbus.history import Edge, Outcome
from tfbus.path import Path, climb, find_path
from tfbus.picture import describe, to_dot, to_yaml
from tfbus.stamped import Batch, TransformStamped, answer_of, as_batch
from tfbus.stamps import LATEST, Latest, as_duration, as_stamp, from_seconds
from tfbus.topology import admit

At = int | Latest
_Answer = tuple[int, Row, bool]


class TransformTree:
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
        self._lock = threading.Lock()
        self.forest = Forest(None if seconds is None or seconds == math.inf else from_seconds(seconds))
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

    # Lookup

    def lookup(
        self,
        target: str,
        source: str,
        at: At = LATEST,
        *,
        source_at: At | None = None,
        fixed: str | None = None,
        not_before: int | None = None,
    ) -> TransformStamped:
        """Where `source` is, seen from `target`: the transform that maps source's data into target.

        Parameters
        ----------
        target, source : str
        at : int or LATEST
            ns. `LATEST` is the newest stamp that every moving edge on the path can answer.
        source_at : int or LATEST, optional
            Take source at this stamp instead, and carry it to `at` through `fixed`.
        fixed : str, optional
            The frame that is held still between the two stamps.
        not_before : int, optional
            Count a `LATEST` answer older than this (ns) as not yet arrived.

        Returns
        -------
        TransformStamped
            Parent is target and child is source; its stamp is `at`, or the one that `LATEST` found. An answer whose
            whole path is static has ``static=True`` and, for `LATEST`, the newest stamp among its samples. In time
            travel, a `LATEST` that only static edges answer takes the stamp of source's leg.

        Raises
        ------
        UnknownFrameError, DisconnectedError, FutureExtrapolationError
            If it cannot be answered now, but may be later.
        PastExtrapolationError
            If it is older than an edge's window.
        TypeError
            If a stamp is a float, a frame is not a string, only one of `source_at` and `fixed` is given, or
            `not_before` comes without a `LATEST`.
        """
        return self.answer(target, source, at, source_at, fixed, not_before)

    def answer(
        self, target: str, source: str, at: At, source_at: At | None, fixed: str | None, not_before: int | None
    ) -> TransformStamped:
        """As `lookup`, without keywords: every one of them would cost a twentieth of a lookup."""
        if not_before is not None and at is not LATEST and source_at is not LATEST:
            raise TypeError("not_before goes with LATEST: an answer at a given stamp never gets newer")
        if type(at) is not int and at is not LATEST:
            at = as_stamp(at)
        with self._lock:
            if source_at is None and fixed is None:
                stamp, row, static = self._answer(target, source, at, not_before)
            else:
                stamp, row, static = self._travel(target, source, at, source_at, fixed, not_before)
        return answer_of(target, source, stamp, row, static)

    def _travel(
        self, target: str, source: str, at: At, source_at: At | None, fixed: str | None, not_before: int | None
    ) -> _Answer:
        """As `_answer`, with source at its own stamp, carried through the fixed frame."""
        if source_at is None or fixed is None:
            raise TypeError("source_at and fixed go together: source at its stamp, carried through the fixed frame")
        if source_at is not LATEST:
            source_at = as_stamp(source_at)
        for name in (target, source, fixed):
            self.forest.check_known(name)
        try:
            stamp, target_from_fixed, static = self._answer(target, fixed, at, not_before)
        except FutureExtrapolationError:
            # Waiting for this leg is no use if it cannot help the other one.
            self._answer(fixed, source, source_at, not_before)
            raise
        except DisconnectedError:
            with suppress(DisconnectedError, FutureExtrapolationError):
                self._answer(fixed, source, source_at, not_before)
            raise
        source_stamp, fixed_from_source, still = self._answer(fixed, source, source_at, not_before)
        if at is LATEST and static and not still:
            stamp = source_stamp
        return stamp, compose(target_from_fixed, fixed_from_source), static and still

    def _answer(self, target: str, source: str, at: At, not_before: int | None) -> _Answer:
        """Stamp, row and whether it is static. The lock is held."""
        path = self.forest.paths.get((target, source))
        if path is None:
            path = self.forest.find_path(target, source, at)
        if not path.moving:
            if isinstance(at, Latest):
                at = path.static_stamp if len(path.frames) > 1 else self._newest_of(target)
            return as_stamp(at), path.row(0), True
        if at is LATEST:
            return self._latest(path, target, source, not_before)
        try:
            return at, climb(path.up, at) if not path.down else path.row(at), False
        except ExtrapolationError:
            raise path.blocker(as_stamp(at)) from None

    def _latest(self, path: Path, target: str, source: str, not_before: int | None) -> _Answer:
        """As `_answer`, at the newest stamp that every moving edge has reached."""
        common, lagging = path.newest_common()
        if not_before is not None and common < not_before:
            raise lagging.missing(not_before)
        try:
            there = path if path.lasting else find_path(self.forest.frames, target, source, common)
            return common, there.row(common), False
        except TransformLookupError as error:
            # The lagging edge has to come as far as the others still reach back; where a parent has changed, each step
            # of it may do.
            needed = common + 1
            if path.lasting:
                needed = max(common if edge.oldest is None else edge.oldest for edge in path.moving)
            raise lagging.missing(needed) from error

    def _newest_of(self, frame: str) -> int:
        history = self.forest.frames.get(frame)
        return 0 if history is None else history.static_stamp or history.newest or 0

    def can_transform(self, target: str, source: str, at: At = LATEST, **question: Any) -> bool:
        """Whether `lookup` with the same arguments has an answer now."""
        try:
            self.lookup(target, source, at, **question)
        except TransformLookupError:
            return False
        return True

    # Questions about the tree itself

    def latest_common_stamp(self, target: str, source: str) -> int | None:
        """The stamp that `LATEST` means for these two frames, in ns; None where the whole path is static.

        Raises
        ------
        UnknownFrameError, DisconnectedError, FutureExtrapolationError
            As `lookup`.
        """
        with self._lock:
            path = self.forest.find_path(target, source, LATEST)
            return path.newest_common()[0] if path.moving else None

    def chain(self, target: str, source: str, at: At = LATEST) -> list[str]:
        """The frames on the path, from target to source, both included.

        Raises
        ------
        UnknownFrameError, DisconnectedError
        """
        if at is not LATEST:
            at = as_stamp(at)
        with self._lock:
            return list(self.forest.find_path(target, source, at).frames)

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
