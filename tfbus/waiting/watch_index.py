"""An index of the open watches by the frames of their answers.

A watch that has an answer is kept under the frames on the path of the answer, so an insertion looks only at the watches
that it concerns. It only marks them as outdated: the reader of a watch computes the new answer.
"""

from collections.abc import Callable, Iterable

from tfbus.errors import ClockResetError
from tfbus.stamps import LATEST
from tfbus.tree.forest import Forest, Path


class WatchState:
    """The changes that concern a watch since its last answer.

    Parameters
    ----------
    target, source : str
    wake : callable
        Called when an up-to-date watch becomes outdated.

    Attributes
    ----------
    outdated : bool
        Whether the answer may have changed.
    updates : int
        Number of batches that have touched the frames of the answer.
    reset : ClockResetError or None
        The last jump back of the clock.
    ended : bool
        Whether nothing more will happen.
    waiting : bool
        Whether a task waits to be woken.
    frames : frozenset of str
        The frames under which the index keeps this watch.
    path : Path or None
        The path of the answer, if it is a permanent one.
    share : object
        The buffer of the watch, as the one who adds it names it.
    """

    __slots__ = (
        "ended",
        "frames",
        "outdated",
        "path",
        "reset",
        "share",
        "source",
        "target",
        "updates",
        "waiting",
        "wake",
    )

    def __init__(self, target: str, source: str, wake: Callable[[], object]) -> None:
        self.target: str = target
        self.source: str = source
        self.wake: Callable[[], object] = wake
        self.outdated: bool = True
        self.updates: int = 0
        self.reset: ClockResetError | None = None
        self.ended: bool = False
        self.waiting: bool = False
        self.frames: frozenset[str] = frozenset()
        self.path: Path | None = None
        self.share: object = None


class WatchIndex:
    """The open watches of all buffers that share a tree.

    Attributes
    ----------
    by_frame : mapping
        The watches under each frame that some answer depends on.
    """

    def __init__(self) -> None:
        self.by_frame: dict[str, dict[WatchState, None]] = {}
        self._open: dict[WatchState, None] = {}

    def __len__(self) -> int:
        return len(self._open)

    def has_waiters(self, share: object) -> bool:
        """Whether a task waits for one of the watches of a buffer."""
        return any(state.waiting for state in self._open if state.share is share)

    def add(self, state: WatchState) -> None:
        """Add a watch without an answer; only resets and the end concern it."""
        self._open[state] = None

    def remove(self, state: WatchState) -> None:
        """Remove a watch, if it is open."""
        self.set_no_answer(state)
        self._open.pop(state, None)

    def set_answer(self, state: WatchState, forest: Forest, stamp: int) -> None:
        """Keep an open watch under the frames of its answer at `stamp` (ns)."""
        if state not in self._open:
            return
        target, source = state.target, state.source
        path = forest.paths.find(target, source)
        if path is not None and path is state.path:
            return
        state.path = path
        if path is not None:
            frames = _frames_of(path)
        else:
            # The newest path gives the stamp of the answer, and the path at that stamp gives the answer.
            frames = _frames_of(forest.find_path(target, source, LATEST))
            frames |= _frames_of(forest.find_path(target, source, stamp))
        if frames != state.frames:
            self._move(state, frames)

    def set_no_answer(self, state: WatchState) -> None:
        """Keep a watch that has no answer under no frame."""
        state.path = None
        self._move(state, frozenset())

    def mark(self, frames: Iterable[str]) -> list[WatchState]:
        """Mark the watches under some frames as outdated; return the newly outdated ones, to be woken."""
        touched: dict[WatchState, None] = {}
        for frame in frames:
            states = self.by_frame.get(frame)
            if states is not None:
                touched.update(states)
        fresh = [state for state in touched if not state.outdated]
        for state in touched:
            state.updates += 1
            state.outdated = True
        return fresh

    @property
    def changing_names(self) -> set[str]:
        """The frames of the watches that `mark_asking_for` may mark."""
        asking = [state for state in self._open if state.path is None]
        return {name for state in asking for name in (state.target, state.source)}

    def mark_asking_for(self, frames: set[str]) -> list[WatchState]:
        """Mark the watches of some frames that have no permanent path; return the newly outdated ones.

        Late samples can form a loop at the stamp of an answer. Then an edge beyond the path may open another path.
        """
        fresh = [
            state
            for state in self._open
            if state.path is None and not state.outdated and (state.target in frames or state.source in frames)
        ]
        for state in fresh:
            state.outdated = True
        return fresh

    def reset(self, error: ClockResetError) -> list[WatchState]:
        """Mark all watches with a jump back of the clock; return all, to be woken."""
        for state in self._open:
            state.reset = error
            state.outdated = True
            self.set_no_answer(state)
        return list(self._open)

    def end(self, share: object) -> list[WatchState]:
        """Remove all watches of a buffer for good; return them, to be woken."""
        ended = [state for state in self._open if state.share is share]
        for state in ended:
            state.ended = True
            self.remove(state)
        return ended

    def _move(self, state: WatchState, frames: frozenset[str]) -> None:
        for frame in state.frames - frames:
            states = self.by_frame[frame]
            del states[state]
            if not states:
                del self.by_frame[frame]
        for frame in frames - state.frames:
            self.by_frame.setdefault(frame, {})[state] = None
        state.frames = frames


def _frames_of(path: Path) -> frozenset[str]:
    """The children of the edges on a path; the frame itself if the path has no edges."""
    return frozenset(path.frames) - {path.root} or frozenset(path.frames)
