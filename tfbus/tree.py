"""All frames: who hangs on whom, and where one is, seen from another.

`TransformTree` has no clock, no event loop and no I/O: it answers or it raises. One lock is held for one lookup or one
batch, so worker threads may read while the loop inserts.
"""

import math
import threading
from collections.abc import Iterable
from typing import Any

from tfbus.errors import ExtrapolationError, FutureExtrapolationError, TransformLookupError, UnknownFrameError
from tfbus.geometry import Row, compose
from tfbus.history import Edge, FrameHistory, Outcome
from tfbus.names import FrameNames
from tfbus.path import Path, find_path
from tfbus.picture import describe, to_dot, to_yaml
from tfbus.stamped import Batch, TransformStamped, answer, as_batch
from tfbus.stamps import LATEST, Latest, as_duration, as_stamp, from_seconds
from tfbus.topology import admit

_PATHS_KEPT = 10_000

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
    structure_version : int
        Grows whenever an existing frame gets another parent or kind, a longer past, or is removed: then any lookup may
        have another answer.
    edges_version : int
        Grows whenever a frame gets its first parent: then frames may have become known, and trees joined.

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
        self._window = None if seconds is None or seconds == math.inf else from_seconds(seconds)
        self._lock = threading.Lock()
        # Called in every lookup and insertion, where `with` would cost as much as a dozen multiplications.
        self._acquire, self._release = self._lock.acquire, self._lock.release
        self._frames: dict[str, FrameHistory] = {}
        self._names = FrameNames()
        self._paths: dict[tuple[str, str], Path] = {}
        self.structure_version = 0
        self.edges_version = 0
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
            _, refused = admit(self._frames, batch)
            if refused:
                raise refused[0]
            return [self._store(sample) for sample in batch]

    def commit(self, batch: Batch) -> None:
        """Store a batch that somebody has judged already, such as the bus; what is too old expires."""
        frames = self._frames
        self._acquire()
        try:
            for sample in batch:
                parent, child, stamp, row, authority, static = sample._fields
                history = frames.get(child)
                if history is not None and not static and history.append(parent, stamp, row, authority):
                    self.inserted += 1
                else:
                    self._store(sample)
        finally:
            self._release()

    def _store(self, sample: TransformStamped) -> Outcome:
        parent, child, stamp, row, authority, static = sample._fields
        history = self._frames.get(child)
        if history is None:
            history = self._add(child, parent, static)
        if static:
            outcome = history.insert_static(parent, stamp, row, authority)
        else:
            outcome = history.insert(parent, stamp, row, authority)
        if history.changed:
            self._restructure(history)
        if outcome is Outcome.INSERTED:
            self.inserted += 1
        elif outcome is Outcome.REPLACED:
            self.replaced += 1
        else:
            self.expired += 1
        return outcome

    def _add(self, child: str, parent: str, static: bool) -> FrameHistory:
        # A new edge hangs a whole tree under another one, so every path that there was is still the path.
        has_children = child in self._names
        history = self._frames[child] = FrameHistory(child, parent, static, self._window)
        self._names.update(child, history.mentioned)
        self.edges_version += 1
        if has_children:
            self._forget_empty_loop(history)
        return history

    def _restructure(self, history: FrameHistory) -> None:
        """Forget what an insertion may have made stale."""
        history.changed = False
        self._paths.clear()
        self.structure_version += 1
        self._names.update(history.child, history.mentioned)
        self._forget_empty_loop(history)

    def _forget_empty_loop(self, history: FrameHistory) -> None:
        """Drop emptied frames that now stand in a loop: their last parent is no longer the truth."""
        walk = {history: None}
        here = history
        while (above := self._frames.get(here.parent)) is not None and above not in walk:
            walk[above] = None
            here = above
        if above is history:
            for edge in walk:
                if edge is not history and not len(edge):
                    self._remove(edge.child)

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
            whole path is static has ``static=True`` and, for `LATEST`, the newest stamp among its samples.

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
        if not_before is not None and at is not LATEST and source_at is not LATEST:
            raise TypeError("not_before goes with LATEST: an answer at a given stamp never gets newer")
        if type(at) is not int and at is not LATEST:
            at = as_stamp(at)
        self._acquire()
        try:
            if source_at is None and fixed is None:
                stamp, row, static = self._answer(target, source, at, not_before)
            else:
                stamp, row, static = self._travel(target, source, at, source_at, fixed, not_before)
        finally:
            self._release()
        return answer(target, source, stamp, row, static)

    def _travel(
        self, target: str, source: str, at: At, source_at: At | None, fixed: str | None, not_before: int | None
    ) -> _Answer:
        """As `_answer`, with source at its own stamp, carried through the fixed frame."""
        if source_at is None or fixed is None:
            raise TypeError("source_at and fixed go together: source at its stamp, carried through the fixed frame")
        if source_at is not LATEST:
            source_at = as_stamp(source_at)
        for name in (target, source, fixed):
            self._check_known(name)
        try:
            stamp, target_from_fixed, static = self._answer(target, fixed, at, not_before)
        except FutureExtrapolationError:
            # Waiting for this leg is no use if it cannot help the other one.
            self._answer(fixed, source, source_at, not_before)
            raise
        _, fixed_from_source, still = self._answer(fixed, source, source_at, not_before)
        return stamp, compose(target_from_fixed, fixed_from_source), static and still

    def _answer(self, target: str, source: str, at: At, not_before: int | None) -> _Answer:
        """Stamp, row and whether it is static. The lock is held."""
        path = self._paths.get((target, source))
        if path is None:
            path = self._find_path(target, source, at)
        if not path.moving:
            if isinstance(at, Latest):
                at = path.static_stamp if len(path.frames) > 1 else self._newest_of(target)
            return as_stamp(at), path.row(0), True
        if at is LATEST:
            return self._latest(path, target, source, not_before)
        try:
            return at, path.row(at), False
        except ExtrapolationError:
            raise path.blocker(as_stamp(at)) from None

    def _latest(self, path: Path, target: str, source: str, not_before: int | None) -> _Answer:
        """As `_answer`, at the newest stamp that every moving edge has reached."""
        common, lagging = path.newest_common()
        if not_before is not None and common < not_before:
            raise lagging.missing(not_before)
        try:
            there = path if path.lasting else find_path(self._frames, target, source, common)
            return common, there.row(common), False
        except TransformLookupError as error:
            # The lagging edge has to come as far as the others still reach back.
            needed = max(common if (since := edge.since()) is None else since for edge in path.moving)
            if needed <= common:
                raise
            raise lagging.missing(needed) from error

    def _newest_of(self, frame: str) -> int:
        history = self._frames.get(frame)
        return 0 if history is None else history.static_stamp or history.newest or 0

    def _find_path(self, target: str, source: str, at: At) -> Path:
        """The path for a question, remembered if it is that of every stamp. The lock is held."""
        self._check_known(target)
        self._check_known(source)
        path = find_path(self._frames, target, source, None if isinstance(at, Latest) else at)
        if path.lasting:
            if len(self._paths) >= _PATHS_KEPT:
                self._paths.clear()
            self._paths[target, source] = path
        return path

    def _check_known(self, frame: str) -> None:
        if frame not in self._names:
            if not isinstance(frame, str):
                raise TypeError(f"a frame name must be a str, not {frame!r}")
            raise UnknownFrameError(frame=frame, known=self._names.sorted())

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
            path = self._paths.get((target, source)) or self._find_path(target, source, LATEST)
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
            return list((self._paths.get((target, source)) or self._find_path(target, source, at)).frames)

    def frames(self) -> list[str]:
        """Every frame that a sample in the tree names, sorted."""
        with self._lock:
            return list(self._names.sorted())

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
            self._check_known(frame)
            history = self._frames.get(frame)
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
            return [self._frames[child].edge() for child in sorted(self._frames)]

    def __contains__(self, frame: object) -> bool:
        with self._lock:
            return frame in self._names

    # Changes other than samples

    def remove_frame(self, frame: str) -> None:
        """Take a frame off its parent and forget its samples; frames below it stay, as a tree of their own.

        Raises
        ------
        UnknownFrameError
        """
        with self._lock:
            self._check_known(frame)
            self._remove(frame)

    def _remove(self, frame: str) -> None:
        if self._frames.pop(frame, None) is not None:
            self._names.remove(frame)
            self._paths.clear()
            self.structure_version += 1

    def clear(self) -> None:
        """Drop all moving samples. Static ones and the frames' names stay."""
        with self._lock:
            for history in self._frames.values():
                history.clear()
                history.changed = False
                self._names.update(history.child, history.mentioned)
            self._paths.clear()
            self.structure_version += 1

    def copy(self) -> "TransformTree":
        """An independent copy with the same samples, such as a snapshot to analyse elsewhere."""
        twin = TransformTree(self.keep)
        with self._lock:
            twin._frames = {child: history.copy() for child, history in self._frames.items()}
            twin._names = self._names.copy()
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
