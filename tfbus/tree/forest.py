"""All frames of a tree: the history of each, the names that are known, and the paths that have been found.

`Forest` stores samples and finds paths; `tfbus.tree.lookup` and its neighbours answer questions with it. One lock is
held for one lookup or one batch, so worker threads may read while the loop inserts.

A path climbs from the source to the lowest common ancestor, and from the target to the same frame, so no edge above
that frame can fail or slow a lookup. Runs of static edges are folded into one row. Paths are cached until the topology
changes.

The newest edges form no loop, but the edges that hold at an older stamp may (`tfbus.tree.cycles` draws one). Two ways
then lead round the loop. `path_at` chooses one by the stored samples, never by earlier questions.
"""

import threading
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import AbstractContextManager
from itertools import chain, islice
from typing import Any, NamedTuple, TypeVar
from weakref import WeakSet

import numpy as np
import numpy.typing as npt

from tfbus.errors import (
    MOST_NAMES,
    DisconnectedError,
    ExtrapolationError,
    FutureExtrapolationError,
    UnknownFrameError,
    error_of,
)
from tfbus.geometry.stamped import Batch, QualifiedTransform, TransformStamped
from tfbus.rows import IDENTITY, Row, compose, invert
from tfbus.stamps import LATEST, STAMP_MIN, Latest, as_stamp
from tfbus.tree.cycles import Frames, Loop, admit, past_loop
from tfbus.tree.history import FrameHistory, Outcome, SavedFrame, clear_samples, load_frame
from tfbus.which_kernel import Chain, Paths, commit


class KnownFrames:
    """Counts the samples that name each frame, so that a frame is forgotten with the last sample that names it.

    Attributes
    ----------
    frames : dict of str to None
        All names.
    changing : int
        The number of children whose samples name several parents.
    """

    __slots__ = ("_mentions", "_parents_of", "_some", "_sorted", "changing", "frames")

    def __init__(self) -> None:
        self._parents_of: dict[str, tuple[str, ...]] = {}
        self._mentions: dict[str, int] = {}
        self.frames: dict[str, None] = {}
        self.changing: int = 0
        self._sorted: tuple[str, ...] | None = None
        self._some: tuple[str, ...] | None = None

    def __len__(self) -> int:
        return len(self.frames)

    def __contains__(self, frame: object) -> bool:
        return frame in self.frames

    @property
    def parents(self) -> Collection[str]:
        """The frames that a sample names as a parent."""
        return self._mentions.keys()

    def update(self, child: str, parents: tuple[str, ...]) -> None:
        """Note that the samples of `child` name exactly these parents."""
        parents_of, mentions = self._parents_of, self._mentions
        before = parents_of.get(child)
        if before == parents:
            return
        for parent in parents:
            mentions[parent] = mentions.get(parent, 0) + 1
            self.frames[parent] = None
        self.changing += len(parents) > 1
        parents_of[child] = parents
        if before is None:
            self.frames[child] = None
        else:
            self._forget_mentions(before)
        self._sorted = self._some = None

    def remove(self, child: str) -> None:
        """Note that no sample of `child` is left."""
        parents = self._parents_of.pop(child)
        if child not in self._mentions:
            del self.frames[child]
        self._forget_mentions(parents)
        self._sorted = self._some = None

    def count_after(self, changes: Mapping[str, str]) -> int:
        """The number of names after `changes`, where the samples of each child name its new parent and no other."""
        more = Counter(changes.values())
        more.subtract(parent for child in changes for parent in self._parents_of.get(child, ()))
        new = [child for child in changes if child not in self._parents_of]
        count = len(self) + sum(child not in self.frames for child in new)
        for parent, difference in more.items():
            if parent not in self._parents_of and parent not in changes:
                before = self._mentions.get(parent, 0)
                count += (before + difference > 0) - (before > 0)
        return count

    def sorted(self) -> tuple[str, ...]:
        """All names in alphabetical order."""
        if self._sorted is None:
            self._sorted = tuple(sorted(self.frames))
        return self._sorted

    def some(self) -> tuple[str, ...]:
        """At most `MOST_NAMES` names for an error, unsorted."""
        if self._some is None:
            names = chain(self._mentions, self._parents_of)
            self._some = tuple(dict.fromkeys(islice(names, MOST_NAMES)))
        return self._some

    def copy(self) -> "KnownFrames":
        """An independent copy."""
        twin = KnownFrames()
        twin._parents_of = self._parents_of.copy()
        twin._mentions = self._mentions.copy()
        twin.frames = self.frames.copy()
        twin.changing = self.changing
        return twin

    def _forget_mentions(self, parents: tuple[str, ...]) -> None:
        self.changing -= len(parents) > 1
        for parent in parents:
            self._mentions[parent] -= 1
            if not self._mentions[parent]:
                del self._mentions[parent]
                if parent not in self._parents_of:
                    del self.frames[parent]


Step = FrameHistory | Row
"""A moving edge, or the row of a run of static edges."""


class Path(Chain):
    """The edges from `source` to `target`, by the parents that hold at one stamp.

    Attributes
    ----------
    up, down : tuple of steps
        From source, and from target, to the common ancestor: moving edges, and one row for each run of static edges.
    frames : tuple of str
        From target to source, the common ancestor once.
    root : str
        The common ancestor.
    moving : tuple of FrameHistory
        The edges that are not static.
    permanent : bool
        Whether it holds at every stamp, because no frame on it changes its parent inside its window.
    rival : Path or None
        The other way round a loop, if the samples of neither way cover the stamp.
    """

    __slots__ = ("_changing", "frames", "moving", "permanent", "rival", "root")
    up: tuple[Step, ...]
    down: tuple[Step, ...]

    def __init__(self, ups: list[FrameHistory], downs: list[FrameHistory], root: str) -> None:
        edges = ups + downs
        super().__init__(_fold(ups), _fold(downs), tuple(edge for edge in edges if edge.static))
        self.root: str = root
        self.frames: tuple[str, ...] = (*(edge.child for edge in downs), root, *(edge.child for edge in reversed(ups)))
        self.moving: tuple[FrameHistory, ...] = tuple(edge for edge in edges if not edge.static)
        self._changing = tuple(edge for edge in edges if edge.mixed)
        self.permanent: bool = not self._changing
        self.rival: Path | None = None

    @property
    def children(self) -> list[str]:
        """The children of its edges, sorted."""
        return sorted(frame for frame in self.frames if frame != self.root)

    def holds(self, at: int) -> bool:
        """Whether the newest parents on this path also hold at a stamp."""
        return all(edge.parent_at(at) == edge.parent for edge in self._changing)

    def row_at(self, at: int) -> Row:
        """The row of source in target at a stamp, by the kernel, or step by step if the kernel hands it back.

        Raises
        ------
        ExtrapolationError
            If an edge does not cover it.
        """
        row = self.row(at)
        return self.product(lambda edge: edge.row_at(at)) if row is None else row

    def product(self, row_of: Callable[[FrameHistory], Row]) -> Row:
        """The row of source in target by the row of each moving edge, step by step."""
        row = _climb(self.up, row_of)
        return compose(invert(_climb(self.down, row_of)), row) if self.down else row

    def newest_common(self) -> tuple[int, FrameHistory]:
        """The newest stamp that every moving edge has reached, and the edge that lags most.

        Raises
        ------
        FutureExtrapolationError
            If an edge has no samples.
        """
        common = self.latest()
        if common is None:
            raise next(edge for edge in self.moving if not len(edge)).extrapolation_error(LATEST)
        return common, next(edge for edge in self.moving if edge.newest == common)

    def deciding_error(self, at: int) -> ExtrapolationError:
        """The error of a stamp that is not covered: of an edge that has dropped it, else of the edge that lags most.

        With a `rival`, it is the error of the way that waiting may help.
        """
        return self.with_rival(self._own_error(at), at)

    def with_rival(self, error: ExtrapolationError, at: int) -> ExtrapolationError:
        """The error of a stamp in view of the `rival`, if there is one: waiting helps if it helps on either way."""
        if self.rival is None:
            return error
        if not isinstance(error, FutureExtrapolationError):
            other = self.rival._own_error(at)
            if not isinstance(other, FutureExtrapolationError):
                return error
            error = other
        others = dict.fromkeys((*error.others, *(edge.child for edge in self.rival.moving)))
        error.others = tuple(child for child in others if child != error.child)
        return error

    def _own_error(self, at: int) -> ExtrapolationError:
        edge: Any = self.deciding(at)
        error: ExtrapolationError = edge.extrapolation_error(at)
        return error


def _climb(steps: tuple[Step, ...], row_of: Callable[[FrameHistory], Row]) -> Row:
    """The first step's child, seen from the last step's parent."""
    row: Row | None = None
    for step in steps:
        here = row_of(step) if isinstance(step, FrameHistory) else step
        row = here if row is None else compose(here, row)
    return IDENTITY if row is None else row


def _fold(edges: list[FrameHistory]) -> tuple[Step, ...]:
    steps: list[Step] = []
    for edge in edges:
        if not edge.static:
            steps.append(edge)
        elif steps and isinstance(steps[-1], tuple):
            steps[-1] = compose(edge.static_row, steps[-1])
        else:
            steps.append(edge.static_row)
    return tuple(steps)


def find_path(frames: Frames, target: str, source: str, at: int | None) -> Path:
    """A path by the parents that hold at a stamp, or the one by the newest parents: see `find_edges`."""
    return Path(*find_edges(frames, target, source, at))


def find_edges(
    frames: Frames, target: str, source: str, at: int | None
) -> tuple[list[FrameHistory], list[FrameHistory], str]:
    """The edges from source and from target up to the common ancestor, and that ancestor.

    It reads nothing but parents, so that it may run while another thread inserts; the caller then has to check whether
    the edges still hold.

    Both ends climb in turn, so the search stops at most one side's length beyond the common ancestor.

    Parameters
    ----------
    frames : mapping of child to its history
    target, source : str
    at : int or None
        ns; None for the newest parents.

    Raises
    ------
    DisconnectedError
        If the two ends do not meet.
    """
    up, down = _Climber(frames, source, at), _Climber(frames, target, at)
    while True:
        for meeting in (up.here, down.here):
            if meeting in up.seen and meeting in down.seen:
                return up.edges[: up.seen[meeting]], down.edges[: down.seen[meeting]], meeting
        if up.ended and down.ended:
            raise DisconnectedError(
                target=target, source=source, roots=(down.here, up.here), stamp=at, loop=up.loop or down.loop
            )
        up.climb()
        down.climb()


def path_at(frames: Frames, target: str, source: str, at: int, newest: Path | None) -> Path:
    """The path that counts at a stamp.

    The newest path counts if all its edges hold and cover the stamp. Otherwise the parents at the stamp make the path.
    If they form a loop, the path whose samples cover the stamp counts; if neither is covered, the path has the other
    path as its `rival`.

    Parameters
    ----------
    frames : mapping of child to its history
    target, source : str
    at : int
        ns.
    newest : Path or None
        The path by the newest parents; None if there is none.

    Raises
    ------
    DisconnectedError
        If there is no path; or if the samples cover the stamp on two paths, and neither is the newest path.
    """
    if newest is not None and newest.holds(at):
        if newest.root not in frames or newest.covers(at):
            return newest
        path = newest
    else:
        path = find_path(frames, target, source, at)
    rival, loop = _other_path(frames, path, at)
    if rival is None:
        return path
    if rival.covers(at):
        if path.covers(at):
            raise DisconnectedError(target=target, source=source, roots=(path.root, rival.root), stamp=at, loop=loop)
        return rival
    if path.covers(at):
        return path
    if path is newest:
        # The newest path may be kept for other stamps, at which it has no rival.
        path = Path(*_edges(frames, path), path.root)
    elif rival.children < path.children:
        # The same one for both directions of the question.
        path, rival = rival, path
    path.rival = rival
    return path


def _other_path(frames: Frames, path: Path, at: int) -> tuple[Path | None, tuple[str, ...]]:
    """The other path round a loop at a stamp, if its top leads back to it, and the loop."""
    beyond: dict[str, FrameHistory] = {}
    here = path.root
    while (edge := frames.get(here)) is not None and here not in beyond:
        beyond[here] = edge
        here = edge.parent_at(at)
        if here not in path.frames:
            continue
        ups, downs = _edges(frames, path)
        for side, other in ((ups, downs), (downs, ups)):
            below = [edge.child for edge in side]
            if here in below:
                loop = (*below[below.index(here) :], *beyond, here)
                del side[below.index(here) :]
                other += beyond.values()
                return Path(ups, downs, here), loop
    return None, ()


def _edges(frames: Frames, path: Path) -> tuple[list[FrameHistory], list[FrameHistory]]:
    """The edges of a path from source up to its root, and from target."""
    top = path.frames.index(path.root)
    return [frames[child] for child in path.frames[:top:-1]], [frames[child] for child in path.frames[:top]]


class _Climber:
    """One end of a path search, which climbs towards the root."""

    __slots__ = ("_at", "_frames", "edges", "ended", "here", "loop", "seen")

    def __init__(self, frames: Frames, frame: str, at: int | None) -> None:
        self._frames = frames
        self._at = at
        self.here = frame
        self.edges: list[FrameHistory] = []
        self.seen = {frame: 0}
        self.ended = False
        self.loop: tuple[str, ...] = ()

    def climb(self) -> None:
        """Go one edge up, unless this is the root."""
        edge = self._frames.get(self.here)
        if edge is None or self.ended:
            self.ended = True
            return
        self.here = edge.parent if self._at is None else edge.parent_at(self._at)
        self.edges.append(edge)
        if self.here in self.seen:
            self.loop = (*[edge.child for edge in self.edges[self.seen[self.here] :]], self.here)
            self.ended = True
        else:
            self.seen[self.here] = len(self.edges)


_GENERATION = 10_000
_NO_PATHS: Mapping[str, Chain] = {}


class PathCache(Paths):
    """The permanent paths that were asked for lately.

    When a generation of 10,000 paths is complete, the cache forgets the paths of the generation before it that nobody
    has asked for since: up to 10,000 pairs in use stay known, and at most 20,000 are kept.

    Parameters
    ----------
    lock : threading.Lock
        The lock of the forest.
    """

    __slots__ = ("__weakref__", "_count", "_older")

    def __init__(self, lock: AbstractContextManager[Any]) -> None:
        super().__init__(lock, LATEST, TransformStamped)
        self.qualified = QualifiedTransform
        self._count = 0
        self._older: dict[str, dict[str, Path]] = {}

    def __len__(self) -> int:
        return sum(len(by_source) for paths in (self.recent, self._older) for by_source in paths.values())

    def find(self, target: str, source: str) -> Path | None:
        """The path between two frames, if it is kept."""
        # Only `keep` fills them.
        path: Path | None = self.recent.get(target, _NO_PATHS).get(source)  # type: ignore[assignment]
        if path is None:
            path = self._older.get(target, _NO_PATHS).get(source)  # type: ignore[assignment]
            if path is not None:
                self.keep(target, source, path)
        return path

    def holds(self, target: str, source: str) -> bool:
        """Whether the path between two frames is kept. May be asked without the lock."""
        return source in self.recent.get(target, _NO_PATHS) or source in self._older.get(target, _NO_PATHS)

    def keep(self, target: str, source: str, path: Path) -> None:
        """Keep a permanent path."""
        if type(target) is not str or type(source) is not str:
            # A comparison of names must run no code of others.
            return
        if self._count >= _GENERATION:
            self._older, self.recent, self._count = self.recent, {}, 0  # type: ignore[assignment]
        self.recent.setdefault(target, {})[source] = path
        self._count += 1

    def clear(self) -> None:
        """Forget all paths."""
        self.recent: dict[str, dict[str, Chain]] = {}
        self._older = {}
        self._count = 0


AT_A_TIME = 100
"""The number of frames that are read before the lock is released, for questions about all of them."""

_ROUNDS = 3

_CHANGING_PATHS_KEPT = 5_000

T = TypeVar("T")


class StaticFrames:
    """The static edges of a bus, without a loop. All forests that begin with them share their histories.

    Attributes
    ----------
    samples : dict of str to TransformStamped
        By child.
    histories : dict of str to FrameHistory
        Each is replaced rather than changed.
    names : KnownFrames
        The frames that the samples name.
    """

    def __init__(self) -> None:
        self.samples: dict[str, TransformStamped] = {}
        self.histories: dict[str, FrameHistory] = {}
        self.names: KnownFrames = KnownFrames()

    def put(self, sample: TransformStamped) -> None:
        """Add a sample, or replace the one of its child."""
        parent, child, stamp, row, authority, _ = sample._fields
        self.samples[child] = sample
        self.histories[child] = history = FrameHistory(child, parent, True, None)
        history.static_stamp = stamp
        history.static_row = row
        history.authority = authority
        history.note(sample)
        history.shared = True
        self.names.update(child, (parent,))

    def remove(self, child: str) -> None:
        """Forget a child, if it is static."""
        if self.samples.pop(child, None) is not None:
            del self.histories[child]
            self.names.remove(child)


class LoopingSample(NamedTuple):
    """A sample that is part of a loop of parents at a past stamp."""

    sample: TransformStamped
    loop: Loop


class Forest:
    """The histories of all frames that have a parent.

    `insert`, `commit`, `remove`, `clear`, `search`, `local_paths`, `keep_locally`, `known_frames`, `some_frames`,
    `read_all`, `copy` and `copy_within` take the lock themselves. The caller of every other method holds it.

    Parameters
    ----------
    window : int or None
        Length of the history of each frame, in ns; None keeps everything.

    Attributes
    ----------
    lock : threading.Lock
        Guards everything below.
    window : int or None
    frames : dict of str to FrameHistory
        By child.
    names : KnownFrames
    paths : PathCache
        The newest paths that have been found and are permanent. A change that could make one wrong empties it. Its
        `version` is another number after each change, and its `inserted` the number of samples that were `INSERTED`.
    changing_paths : dict of (target, source) to Path
        The newest paths that have been found and are not permanent.
    changed : set of str
        Frames with another parent or kind, or a longer past, since `forget_changes`: a lookup from a frame below one of
        them may have another answer.
    new_parents : set of str
        Frames that have become a parent since `forget_changes`, so that they may have become known.
    looping : list of LoopingSample
        Samples since `forget_changes` that are part of a loop of parents at a past stamp.
    readers : dict
        For each running `read_all`, the frames that have changed since it began.
    expired_samples : list of TransformStamped
        The samples that expired since `forget_changes`.
    replaced, expired : int
        Number of samples that had each of these outcomes.
    looped : int
        Number of samples that have been in `looping`.
    structure : int
        The number of changes that may have made a path wrong.
    """

    def __init__(self, window: int | None) -> None:
        self.lock: threading.Lock = threading.Lock()
        self.window = window
        self.frames: dict[str, FrameHistory] = {}
        self.names: KnownFrames = KnownFrames()
        self.paths: PathCache = PathCache(self.lock)
        self._local_paths: WeakSet[PathCache] = WeakSet()
        self.changing_paths: dict[tuple[str, str], Path] = {}
        self.changed: set[str] = set()
        self.new_parents: set[str] = set()
        self.looping: list[LoopingSample] = []
        self._suspects: list[TransformStamped] = []
        self.readers: dict[int, set[str]] = {}
        self.expired_samples: list[TransformStamped] = []
        self.replaced: int = 0
        self.expired: int = 0
        self.looped: int = 0
        self.structure: int = 0

    # Changes

    def insert(self, batch: Batch) -> list[Outcome]:
        """Store a batch, all of it or nothing.

        Raises
        ------
        InvalidTransformError
            If a sample would close a loop of parents, judged after the whole batch.
        """
        if self.paths.commit(self.frames, self.readers, batch):
            # The usual case: samples that only continue their histories close no loop and change no path.
            return [Outcome.INSERTED] * len(batch)
        with self.lock:
            self.paths.version += 1
            _, refused = admit(self.frames, batch, self.names.parents)
            if refused:
                raise refused[0]
            outcomes = [self.insert_judged(sample) for sample in batch]
            self.find_past_loops()
            self.forget_changes()
            self._tell_readers([sample.child for sample in batch])
            return outcomes

    def commit(self, batch: Batch) -> bool:
        """Store a batch that the bus has judged already.

        Returns
        -------
        bool
            Whether every sample was the next one of its frame, so that nothing but stamps has changed.
        """
        if self.paths.commit(self.frames, self.readers, batch):
            return True
        count, paths = len(batch), self.paths
        with self.lock:
            paths.version += 1
            stored = commit(self.frames, batch, 0)
            paths.inserted += stored
            plain = stored == count
            while stored < count:
                self.insert_judged(batch[stored])
                end = commit(self.frames, batch, stored + 1)
                paths.inserted += end - stored - 1
                stored = end
            if self._suspects:
                self.find_past_loops()
            if self.readers:
                self._tell_readers([sample.child for sample in batch])
        return plain

    def can_append(self, parent: str, child: str, authority: str, stamps: npt.NDArray[np.int64]) -> bool:
        """Whether moving samples of a frame are its next ones, so that inserting them changes nothing but stamps.

        Parameters
        ----------
        parent, child, authority : str
        stamps : int64 array of shape (n,)
            ns; n is at least one.
        """
        history = self.frames.get(child)
        return (
            history is not None
            and history.can_append(parent, authority, int(stamps[0]))
            and bool((stamps[1:] > stamps[:-1]).all())
        )

    def append(self, child: str, stamps: npt.NDArray[np.int64], rows: npt.NDArray[np.float64]) -> None:
        """Store the samples that `can_append` has approved; the rows have shape (n, 7)."""
        with self.lock:
            self.paths.version += 1
            self.frames[child].append_many(stamps, rows)
            self.paths.inserted += len(stamps)
            if self.readers:
                self._tell_readers([child])

    def insert_judged(self, sample: TransformStamped) -> Outcome:
        """Store one sample that closes no loop."""
        parent, child, stamp, row, authority, static = sample._fields
        history = self.frames.get(child)
        if history is None:
            history = self._add_frame(child, parent, static)
            if child in self.changed:
                self._suspects.append(sample)
        elif history.shared:
            history = self.frames[child] = history.copy_within(self.window)
            # The paths hold the shared one.
            self.forget_paths()
        if static:
            if history.static_stamp is not None and row != history.static_row:
                # The paths hold the rows of static edges.
                self.forget_paths()
            outcome = history.insert_static(parent, stamp, row, authority)
        else:
            outcome = history.insert(parent, stamp, row, authority)
        if history.changed:
            self._restructure(history)
            self._suspects.append(sample)
        if outcome is Outcome.INSERTED:
            self.paths.inserted += 1
        elif outcome is Outcome.REPLACED:
            self.replaced += 1
        else:
            self.expired += 1
            self.expired_samples.append(sample)
            return outcome
        if type(sample) is not TransformStamped or history.beliefs is not None:
            history.note(sample)
        return outcome

    def remove(self, frame: str) -> None:
        """Take a frame off its parent, if it has one, and forget its samples.

        Raises
        ------
        UnknownFrameError
            If no sample names the frame.
        """
        with self.lock:
            self.paths.version += 1
            self.check_known(frame)
            self._remove(frame)

    def clear(self) -> None:
        """Drop all moving samples. Static ones and names stay."""
        with self.lock:
            self.paths.version += 1
            for history in clear_samples(self.frames.values()):
                history.clear()
                history.changed = False
                self.names.update(history.child, history.named_parents)
            self.forget_paths()
            self._tell_readers(self.frames)

    def share(self, static: "StaticFrames") -> None:
        """Hold the static edges of a bus; this forest is empty."""
        with self.lock:
            self.paths.version += 1
            self.frames.update(static.histories)
            self.names = static.names.copy()
            self.paths.inserted += len(static.histories)

    def find_past_loops(self) -> None:
        """Note which of the samples since the last call are part of a loop of parents at a past stamp.

        The samples of a whole batch are judged after the last, because one batch may turn an edge round.
        """
        # Emptied first: after an error, no sample may be judged again and again.
        suspects, self._suspects = self._suspects, []
        for sample in suspects:
            child = sample.child
            # A loop consists of parents.
            if child in self.frames and child in self.names.parents:
                loop = past_loop(self.frames, child, STAMP_MIN if sample.static else sample.stamp)
                if loop is not None:
                    self.looping.append(LoopingSample(sample, loop))
                    self.looped += 1

    def forget_changes(self) -> None:
        """Empty `changed`, `new_parents`, `looping` and `expired_samples`."""
        self.changed.clear()
        self.new_parents.clear()
        self.looping.clear()
        self.expired_samples.clear()

    def forget_paths(self) -> None:
        """Empty `paths`, the caches of `local_paths` and `changing_paths`."""
        self.structure += 1
        self.paths.clear()
        for local in self._local_paths:
            local.clear()
        self.changing_paths.clear()

    # Questions

    def search(self, target: str, source: str) -> bool:
        """Find the newest path and keep it. The climb may take long, and runs without the lock.

        If a change may have made the path wrong meanwhile, or there is no path, nothing is kept: the lookup that
        follows finds the path, or the error, under the lock.

        Returns
        -------
        bool
            Whether both frames were known.
        """
        if self.paths.holds(target, source) or (target, source) in self.changing_paths:
            return True
        structure = self.structure
        names = self.names.frames
        if target not in names or source not in names:
            return False
        try:
            edges = find_edges(self.frames, target, source, None)
        except DisconnectedError:
            return True
        with self.lock:
            if self.structure == structure:
                self._keep(target, source, Path(*edges))
        return True

    def find_path(self, target: str, source: str, at: int | Latest) -> Path:
        """The path between two frames that counts at a stamp (see `path_at`), or the one by the newest parents.

        Raises
        ------
        UnknownFrameError, DisconnectedError
        ValueError
            If the stamp does not fit 64 bits.
        """
        if isinstance(at, Latest):
            return self._newest_path(target, source)
        instant = as_stamp(at)
        newest: Path | None
        try:
            newest = self._newest_path(target, source)
        except DisconnectedError:
            newest = None
        return path_at(self.frames, target, source, instant, newest)

    def _newest_path(self, target: str, source: str) -> Path:
        """The path by the newest parents; it is kept until a change may make it wrong."""
        path = self.paths.find(target, source) or self.changing_paths.get((target, source))
        if path is not None:
            return path
        self.check_known(target)
        self.check_known(source)
        path = find_path(self.frames, target, source, None)
        self._keep(target, source, path)
        return path

    def _keep(self, target: str, source: str, path: Path) -> None:
        if path.permanent:
            # A loop at a past stamp needs a frame that changes its parent. One that begins to do so empties the cache.
            path.alone = path.root not in self.frames or not self.names.changing
            self.paths.keep(target, source, path)
        else:
            if len(self.changing_paths) >= _CHANGING_PATHS_KEPT:
                self.changing_paths.clear()
            self.changing_paths[target, source] = path

    def local_paths(self) -> PathCache:
        """A new cache for `keep_locally`; it is emptied with `paths`."""
        local = PathCache(self.lock)
        with self.lock:
            self._local_paths.add(local)
        return local

    def keep_locally(self, paths: PathCache, local: tuple[str, str], target: str, source: str) -> None:
        """Keep a path that was found in a cache of `local_paths`, under local names of its ends. Takes the lock."""
        if paths.holds(*local):
            return
        with self.lock:
            path = self.paths.find(target, source)
            if path is not None:
                paths.keep(*local, path)

    def known_frames(self) -> tuple[str, ...]:
        """Every frame that a sample names, sorted. Takes the lock."""
        with self.lock:
            return self.names.sorted()

    def some_frames(self) -> tuple[str, ...]:
        """The known frames that `UnknownFrameError` keeps; see `KnownFrames.some`. Takes the lock."""
        with self.lock:
            return self.names.some()

    def check_known(self, frame: str) -> None:
        """Raise `UnknownFrameError` unless a sample names the frame, `TypeError` unless it is a string."""
        if frame not in self.names.frames:
            if not isinstance(frame, str):
                raise TypeError(f"a frame name must be a str, not {frame!r}")
            raise error_of(UnknownFrameError, {"frame": frame, "_known": self.names.some()})

    def read_all(self, read: Callable[[FrameHistory], T]) -> dict[str, T]:
        """The result of `read` for each frame, all of one moment.

        Some frames are read at a time, so that insertions by another thread need not wait for all. Frames that have
        changed meanwhile are read again.
        """
        found: dict[str, T] = {}
        changed: set[str] = set()
        with self.lock:
            ahead = list(self.frames)
            self.readers[id(changed)] = changed
        try:
            for _ in range(_ROUNDS):
                for first in range(0, len(ahead), AT_A_TIME):
                    with self.lock:
                        self._read(ahead[first : first + AT_A_TIME], read, found, changed)
                if len(changed) <= AT_A_TIME:
                    break
                with self.lock:
                    ahead = list(changed)
            with self.lock:
                self._read(list(changed), read, found, changed)
                # Later changes do not belong to this moment.
                del self.readers[id(changed)]
        finally:
            self.readers.pop(id(changed), None)
        return found

    def _read(
        self, frames: list[str], read: Callable[[FrameHistory], T], found: dict[str, T], changed: set[str]
    ) -> None:
        for frame in frames:
            history = self.frames.get(frame)
            if history is None:
                found.pop(frame, None)
            else:
                found[frame] = read(history)
            changed.discard(frame)

    def copy(self) -> "Forest":
        """An independent copy of the samples; its counters start at zero."""
        return self._copy_of(self.window, FrameHistory.copy)

    def copy_within(self, window: int | None) -> "Forest":
        """An independent copy of the samples in the windows, with windows of another length (ns) from now on."""
        return self._copy_of(window, lambda history: history.copy_within(window))

    def add_saved(self, saved: SavedFrame) -> None:
        """Add a frame that `save_frame` has read from a forest without loops. This forest has no frame of its name."""
        with self.lock:
            history = self.frames[saved.child] = load_frame(saved, self.window)
            self.names.update(saved.child, history.named_parents)

    def rebuild(self, save: Callable[[FrameHistory], SavedFrame]) -> None:
        """Replace the history of each frame by its saved copy."""
        with self.lock:
            for child, history in self.frames.items():
                self.frames[child] = load_frame(save(history), self.window)
                self.names.update(child, self.frames[child].named_parents)
            self.forget_paths()
            self._tell_readers(self.frames)

    def _copy_of(self, window: int | None, copied: Callable[[FrameHistory], FrameHistory]) -> "Forest":
        twin = Forest(window)
        twin.frames = self.read_all(copied)
        for child, history in twin.frames.items():
            twin.names.update(child, history.named_parents)
        return twin

    # Bookkeeping

    def _add_frame(self, child: str, parent: str, static: bool) -> FrameHistory:
        has_children = child in self.names
        history = self.frames[child] = FrameHistory(child, parent, static, self.window)
        self.names.update(child, history.named_parents)
        self.new_parents.add(parent)
        if has_children:
            # A root that gets a parent leaves the paths below it as they are, unless late samples formed a loop there.
            self.forget_paths()
            self.changed.add(child)
            self._drop_emptied_loop(history)
        return history

    def _restructure(self, history: FrameHistory) -> None:
        """Forget the paths that an insertion may have made wrong, and note the change for waiting lookups."""
        history.changed = False
        self.forget_paths()
        self.changed.add(history.child)
        self.new_parents.update(history.named_parents)
        self.names.update(history.child, history.named_parents)
        self._drop_emptied_loop(history)

    def _drop_emptied_loop(self, history: FrameHistory) -> None:
        """Drop frames without samples that are now in a loop: their last parent no longer holds."""
        if history.child not in self.names.parents:
            return
        walk = {history: None}
        here = history
        while (above := self.frames.get(here.parent)) is not None and above not in walk:
            walk[above] = None
            here = above
        if above is history:
            for edge in walk:
                if edge is not history and not len(edge):
                    self.changed.add(edge.child)
                    self._remove(edge.child)

    def _tell_readers(self, frames: Iterable[str]) -> None:
        """Tell every running `read_all` which frames have changed."""
        for changed in self.readers.values():
            changed.update(frames)

    def _remove(self, frame: str) -> None:
        self._tell_readers((frame,))
        if self.frames.pop(frame, None) is not None:
            self.names.remove(frame)
            self.forget_paths()
