"""All frames of a tree: the history of each, the names that are known, and the paths that have been found.

`Forest` stores samples and finds paths; `tfbus.tree.lookup` and its neighbours answer questions with it. One lock is
held for one lookup or one batch, so worker threads may read while the loop inserts.
"""

import threading

from tfbus.errors import UnknownFrameError
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.stamps import Latest, as_stamp
from tfbus.tree._kernel import commit
from tfbus.tree._known_frames import KnownFrames
from tfbus.tree._path_cache import PathCache
from tfbus.tree.cycles import admit
from tfbus.tree.history import FrameHistory, Outcome
from tfbus.tree.path import Path, find_path


class Forest:
    """The histories of all frames that have a parent.

    `insert`, `commit`, `remove`, `clear`, `known_frames`, `copy` and `copy_within` take the lock themselves. The caller
    of every other method holds it.

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
        The permanent paths that have been found. A change that could make one wrong empties it.
    changed : set of str
        Frames with another parent or kind, or a longer past, since `forget_changes`: a lookup from a frame below one of
        them may have another answer.
    new_parents : set of str
        Frames that have become a parent since `forget_changes`, so that they may have become known.
    inserted, replaced, expired : int
        Number of samples that had each `Outcome`.
    """

    __slots__ = (
        "changed",
        "expired",
        "frames",
        "inserted",
        "lock",
        "names",
        "new_parents",
        "paths",
        "replaced",
        "window",
    )

    def __init__(self, window: int | None) -> None:
        self.lock = threading.Lock()
        self.window = window
        self.frames: dict[str, FrameHistory] = {}
        self.names = KnownFrames()
        self.paths = PathCache(self.lock)
        self.changed: set[str] = set()
        self.new_parents: set[str] = set()
        self.inserted = 0
        self.replaced = 0
        self.expired = 0

    # Changes

    def insert(self, batch: Batch) -> list[Outcome]:
        """Store a batch, all of it or nothing.

        Raises
        ------
        InvalidTransformError
            If a sample would close a loop of parents, judged after the whole batch.
        """
        with self.lock:
            _, refused = admit(self.frames, batch)
            if refused:
                raise refused[0]
            outcomes = [self.insert_judged(sample) for sample in batch]
            self.forget_changes()
            return outcomes

    def commit(self, batch: Batch) -> bool:
        """Store a batch that the bus has judged already.

        Returns
        -------
        bool
            Whether every sample was the next one of its frame, so that nothing but stamps has changed.
        """
        count = len(batch)
        with self.lock:
            stored = commit(self.frames, batch, 0)
            self.inserted += stored
            if stored == count:
                return True
            while stored < count:
                self.insert_judged(batch[stored])
                end = commit(self.frames, batch, stored + 1)
                self.inserted += end - stored - 1
                stored = end
        return False

    def insert_judged(self, sample: TransformStamped) -> Outcome:
        """Store one sample that closes no loop."""
        parent, child, stamp, row, authority, static = sample._fields
        history = self.frames.get(child)
        if history is None:
            history = self._add_frame(child, parent, static)
        if static:
            if row != history.static_row:
                # The paths hold the rows of static edges.
                self.paths.clear()
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

    def remove(self, frame: str) -> None:
        """Take a frame off its parent, if it has one, and forget its samples.

        Raises
        ------
        UnknownFrameError
            If no sample names the frame.
        """
        with self.lock:
            self.check_known(frame)
            self._remove(frame)

    def clear(self) -> None:
        """Drop all moving samples. Static ones and names stay."""
        with self.lock:
            for history in self.frames.values():
                history.clear()
                history.changed = False
                self.names.update(history.child, history.named_parents)
            self.paths.clear()

    def forget_changes(self) -> None:
        """Empty `changed` and `new_parents`."""
        self.changed.clear()
        self.new_parents.clear()

    # Questions

    def find_path(self, target: str, source: str, at: int | Latest) -> Path:
        """The path between two frames at a stamp, or by the newest parents. A permanent path is kept.

        Raises
        ------
        UnknownFrameError, DisconnectedError
        ValueError
            If the stamp does not fit 64 bits.
        """
        path = self.paths.find(target, source)
        if path is not None:
            return path
        instant = None if isinstance(at, Latest) else as_stamp(at)
        self.check_known(target)
        self.check_known(source)
        path = find_path(self.frames, target, source, instant)
        if path.permanent:
            self.paths.keep(target, source, path)
        return path

    def parent_changes(self) -> list[int]:
        """The stamps at which some frame changes its parent, in order. Between two of them all paths stay."""
        return sorted({stamp for history in self.frames.values() for stamp in history.parent_changes()})

    def known_frames(self) -> tuple[str, ...]:
        """Every frame that a sample names, sorted. Takes the lock."""
        with self.lock:
            return self.names.sorted()

    def check_known(self, frame: str) -> None:
        """Raise `UnknownFrameError` unless a sample names the frame, `TypeError` unless it is a string."""
        if frame not in self.names:
            if not isinstance(frame, str):
                raise TypeError(f"a frame name must be a str, not {frame!r}")
            raise UnknownFrameError(frame=frame, known=self.names.sorted())

    def with_descendants(self, frames: set[str]) -> set[str]:
        """These frames and all below them, by any parent that a sample in the window names."""
        children: dict[str, list[str]] = {}
        for child, history in self.frames.items():
            for parent in history.named_parents:
                children.setdefault(parent, []).append(child)
        found = set(frames)
        ahead = list(frames)
        while ahead:
            new = [child for child in children.get(ahead.pop(), ()) if child not in found]
            found.update(new)
            ahead += new
        return found

    def copy(self) -> "Forest":
        """An independent copy of the samples; its counters start at zero."""
        twin = Forest(self.window)
        with self.lock:
            twin.frames = {child: history.copy() for child, history in self.frames.items()}
            twin.names = self.names.copy()
        return twin

    def copy_within(self, window: int | None) -> "Forest":
        """An independent copy of the samples in the windows, with windows of another length (ns) from now on."""
        twin = Forest(window)
        with self.lock:
            for child, history in self.frames.items():
                short = twin.frames[child] = history.copy_within(window)
                twin.names.update(child, short.named_parents)
        return twin

    # Bookkeeping

    def _add_frame(self, child: str, parent: str, static: bool) -> FrameHistory:
        has_children = child in self.names
        history = self.frames[child] = FrameHistory(child, parent, static, self.window)
        self.names.update(child, history.named_parents)
        self.new_parents.add(parent)
        if has_children:
            # A root that gets a parent leaves the paths below it as they are, unless late samples formed a loop there.
            self.paths.clear()
            self.changed.add(child)
            self._drop_emptied_loop(history)
        return history

    def _restructure(self, history: FrameHistory) -> None:
        """Forget the paths that an insertion may have made wrong, and note the change for waiting lookups."""
        history.changed = False
        self.paths.clear()
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

    def _remove(self, frame: str) -> None:
        if self.frames.pop(frame, None) is not None:
            self.names.remove(frame)
            self.paths.clear()
