"""All frames of a tree: the history of each, the names that are known, and the paths that have been found.

`Forest` stores samples and finds paths; `tfbus.tree.lookup` and its neighbours answer questions with it. One lock is
held for one lookup or one batch, so worker threads may read while the loop inserts.
"""

import threading
from collections.abc import Callable, Iterable
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from tfbus.errors import DisconnectedError, UnknownFrameError
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.stamps import STAMP_MIN, Latest, as_stamp
from tfbus.tree._ancestry import Loop, edges_above, names_below, past_loop
from tfbus.tree._kernel import commit
from tfbus.tree._path_cache import PathCache
from tfbus.tree._saved_frames import SavedFrame, load_frame
from tfbus.tree.cycles import admit
from tfbus.tree.history import FrameHistory, Outcome
from tfbus.tree.known_frames import KnownFrames
from tfbus.tree.path import Path, find_edges, find_path, path_at

AT_A_TIME = 100
"""The number of frames that are read before the lock is released, for questions about all of them."""

_ROUNDS = 3

_CHANGING_PATHS_KEPT = 5_000

T = TypeVar("T")


class LoopingSample(NamedTuple):
    """A sample that is part of a loop of parents at a past stamp."""

    sample: TransformStamped
    loop: Loop


class Forest:
    """The histories of all frames that have a parent.

    `insert`, `commit`, `remove`, `clear`, `search`, `known_frames`, `some_frames`, `read_all`, `copy` and `copy_within`
    take the lock themselves. The caller of every other method holds it.

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
        The newest paths that have been found and are permanent. A change that could make one wrong empties it.
    changing_paths : dict of (target, source) to Path
        The same of newest paths that are not permanent.
    changed : set of str
        Frames with another parent or kind, or a longer past, since `forget_changes`: a lookup from a frame below one of
        them may have another answer.
    new_parents : set of str
        Frames that have become a parent since `forget_changes`, so that they may have become known.
    looping : list of LoopingSample
        Samples since `forget_changes` that are part of a loop of parents at a past stamp.
    readers : dict
        The frames that have changed, for each `read_all` that goes on.
    expired_samples : list of TransformStamped
        The samples that expired since `forget_changes`.
    replaced, expired : int
        Number of samples that had each of these outcomes.
    looped : int
        Number of samples that have been in `looping`.
    structure : int
        Another number after each change that may make a path wrong.
    """

    def __init__(self, window: int | None) -> None:
        self.lock = threading.Lock()
        self.window = window
        self.frames: dict[str, FrameHistory] = {}
        self.names = KnownFrames()
        self.paths = PathCache(self.lock)
        self.changing_paths: dict[tuple[str, str], Path] = {}
        self.changed: set[str] = set()
        self.new_parents: set[str] = set()
        self.looping: list[LoopingSample] = []
        self._suspects: list[TransformStamped] = []
        self.readers: dict[int, set[str]] = {}
        self.expired_samples: list[TransformStamped] = []
        self.replaced = 0
        self.expired = 0
        self.looped = 0
        self.structure = 0

    @property
    def inserted(self) -> int:
        """The number of samples that were `INSERTED`."""
        return self.paths.inserted

    @inserted.setter
    def inserted(self, inserted: int) -> None:
        self.paths.inserted = inserted

    @property
    def version(self) -> int:
        """Another number after each change."""
        return self.paths.version

    @version.setter
    def version(self, version: int) -> None:
        self.paths.version = version

    # Changes

    def insert(self, batch: Batch) -> list[Outcome]:
        """Store a batch, all of it or nothing.

        Raises
        ------
        InvalidTransformError
            If a sample would close a loop of parents, judged after the whole batch.
        """
        if self.paths.commit(self.frames, self.readers, batch):
            # Nearly always so: samples that only continue their histories close no loop and change no path.
            return [Outcome.INSERTED] * len(batch)
        with self.lock:
            self.version += 1
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
            self.version += 1
            self.frames[child].append_many(stamps, rows)
            self.inserted += len(stamps)
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
        if static:
            if row != history.static_row:
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

    def remove(self, frame: str) -> None:
        """Take a frame off its parent, if it has one, and forget its samples.

        Raises
        ------
        UnknownFrameError
            If no sample names the frame.
        """
        with self.lock:
            self.version += 1
            self.check_known(frame)
            self._remove(frame)

    def clear(self) -> None:
        """Drop all moving samples. Static ones and names stay."""
        with self.lock:
            self.version += 1
            for history in self.frames.values():
                history.clear()
                history.changed = False
                self.names.update(history.child, history.named_parents)
            self.forget_paths()
            self._tell_readers(self.frames)

    def find_past_loops(self) -> None:
        """Note which of the samples since the last call are part of a loop of parents at a past stamp.

        The samples of a whole batch are judged after the last, because one batch may turn an edge round.
        """
        # Taken before they are judged, so that an error leaves none to be judged again and again.
        suspects, self._suspects = self._suspects, []
        for sample in suspects:
            child = sample.child
            if child in self.frames:
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
        """Empty `paths` and `changing_paths`."""
        self.structure += 1
        self.paths.clear()
        self.changing_paths.clear()

    # Questions

    def search(self, target: str, source: str) -> None:
        """Find the newest path and keep it, without the lock while it climbs, which may take long.

        If a change may have made it wrong meanwhile, or there is none, nothing is kept: whoever asks then finds it, or
        the error, under the lock.
        """
        if self.paths.holds(target, source) or (target, source) in self.changing_paths:
            return
        structure = self.structure
        if target not in self.names or source not in self.names:
            return
        try:
            edges = find_edges(self.frames, target, source, None)
        except DisconnectedError:
            return
        with self.lock:
            if self.structure == structure:
                self._keep(target, source, Path(*edges))

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
            self.paths.keep(target, source, path)
        else:
            if len(self.changing_paths) >= _CHANGING_PATHS_KEPT:
                self.changing_paths.clear()
            self.changing_paths[target, source] = path

    def known_frames(self) -> tuple[str, ...]:
        """Every frame that a sample names, sorted. Takes the lock."""
        with self.lock:
            return self.names.sorted()

    def some_frames(self) -> tuple[str, ...]:
        """The frames that an error about an unknown one keeps; see `KnownFrames.some`. Takes the lock."""
        with self.lock:
            return self.names.some()

    def check_known(self, frame: str) -> None:
        """Raise `UnknownFrameError` unless a sample names the frame, `TypeError` unless it is a string."""
        if frame not in self.names:
            if not isinstance(frame, str):
                raise TypeError(f"a frame name must be a str, not {frame!r}")
            raise UnknownFrameError(frame=frame, known=self.names.some())

    def edges_above(self, *names: str) -> list[FrameHistory]:
        """The edges of some frames and of all above them, by any parent that a sample in the window names."""
        return list(edges_above(self.frames, names).values())

    def names_below(self, names: Iterable[str], above: set[str]) -> set[str]:
        """Those of `names` that are in `above`, or below one of these by any parent in the window."""
        return names_below(self.frames, names, above)

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
                # A later change is no longer of this moment.
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
        """Take in a frame that `save_frame` has made of another forest without loops; none of that name is here."""
        with self.lock:
            history = self.frames[saved.child] = load_frame(saved, self.window)
            self.names.update(saved.child, history.named_parents)

    def rebuild(self, save: Callable[[FrameHistory], SavedFrame]) -> None:
        """Replace the history of each frame by what is saved of it."""
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
        """Drop frames without samples that now stand in a loop: their last parent holds no longer."""
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
        """Tell the threads that read all frames which have changed."""
        for changed in self.readers.values():
            changed.update(frames)

    def _remove(self, frame: str) -> None:
        self._tell_readers((frame,))
        if self.frames.pop(frame, None) is not None:
            self.names.remove(frame)
            self.forget_paths()
