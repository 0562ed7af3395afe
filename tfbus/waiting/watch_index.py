"""Who watches which path.

A watch that has an answer is kept under the frames that the answer is made of, so an insertion finds those that it
concerns without looking at the others. It only flags them: whoever reads a watch evaluates it.
"""

from collections.abc import Callable, Iterable

from tfbus.errors import ClockResetError
from tfbus.tree.forest import Forest
from tfbus.tree.path import Path, find_path


class Watched:
    """What has happened to a watch since somebody last looked.

    Parameters
    ----------
    target, source : str
    wake : callable
        Called when something happens to a watch that had no flag.

    Attributes
    ----------
    flagged : bool
        Whether the answer may be another one.
    updates : int
        How many batches have touched the answer's frames.
    reset : ClockResetError or None
        The last jump back of the clock.
    ended : bool
        Whether nothing more will happen.
    waiting : bool
        Whether a task waits to be woken.
    frames : frozenset of str
        What it is kept under.
    path : Path or None
        Where those frames come from, if it is a path that holds at every stamp.
    """

    __slots__ = ("ended", "flagged", "frames", "path", "reset", "source", "target", "updates", "waiting", "wake")

    def __init__(self, target: str, source: str, wake: Callable[[], object]) -> None:
        self.target = target
        self.source = source
        self.wake = wake
        self.flagged = True
        self.updates = 0
        self.reset: ClockResetError | None = None
        self.ended = False
        self.waiting = False
        self.frames: frozenset[str] = frozenset()
        self.path: Path | None = None


class WatchIndex:
    """The open watches of one buffer.

    Attributes
    ----------
    under : mapping
        The frames that some answer is made of. A sample of any other concerns nobody.
    """

    def __init__(self) -> None:
        self.under: dict[str, dict[Watched, None]] = {}
        self._open: dict[Watched, None] = {}

    def __len__(self) -> int:
        return len(self._open)

    @property
    def anyone_waits(self) -> bool:
        """Whether a task waits for one of them."""
        return any(watched.waiting for watched in self._open)

    def add(self, watched: Watched) -> None:
        """Take a watch in; it hears of nothing but resets and the end until it follows an answer."""
        self._open[watched] = None

    def remove(self, watched: Watched) -> None:
        """Take a watch out, if it is in."""
        self.forget(watched)
        self._open.pop(watched, None)

    def follow(self, watched: Watched, forest: Forest, stamp: int) -> None:
        """Keep an open watch under the frames that its answer at `stamp` (ns) was made of."""
        if watched not in self._open:
            return
        target, source = watched.target, watched.source
        path = forest.paths.get((target, source))
        if path is not None and path is watched.path:
            return
        watched.path = path
        if path is not None:
            frames = _frames_of(path)
        else:
            # The stamp was found on the newest path, and the answer along the one that held then.
            frames = _frames_of(find_path(forest.frames, target, source, None))
            frames |= _frames_of(find_path(forest.frames, target, source, stamp))
        if frames != watched.frames:
            self._put(watched, frames)

    def forget(self, watched: Watched) -> None:
        """Keep a watch under no frame: it has no answer."""
        watched.path = None
        self._put(watched, frozenset())

    def flag(self, frames: Iterable[str]) -> list[Watched]:
        """Flag the watches under these frames; those that had no flag before are to be woken."""
        touched: dict[Watched, None] = {}
        for frame in frames:
            watches = self.under.get(frame)
            if watches is not None:
                touched.update(watches)
        fresh = [watched for watched in touched if not watched.flagged]
        for watched in touched:
            watched.updates += 1
            watched.flagged = True
        return fresh

    def flag_asking(self, frames: set[str]) -> list[Watched]:
        """Flag the watches between these frames whose path is not that of every stamp; who had no flag is to be woken.

        Late samples can form a loop at the stamp of the answer: then an edge beyond the path may be another way.
        """
        fresh = [
            watched
            for watched in self._open
            if watched.path is None and not watched.flagged and (watched.target in frames or watched.source in frames)
        ]
        for watched in fresh:
            watched.flagged = True
        return fresh

    def reset(self, error: ClockResetError) -> list[Watched]:
        """Flag everybody, with the jump back of the clock; all are to be woken."""
        for watched in self._open:
            watched.reset = error
            watched.flagged = True
            self.forget(watched)
        return list(self._open)

    def end(self) -> list[Watched]:
        """Take everybody out, for good; all are to be woken."""
        ended = list(self._open)
        for watched in ended:
            watched.ended = True
            self.remove(watched)
        return ended

    def _put(self, watched: Watched, frames: frozenset[str]) -> None:
        for frame in watched.frames - frames:
            watches = self.under[frame]
            del watches[watched]
            if not watches:
                del self.under[frame]
        for frame in frames - watched.frames:
            self.under.setdefault(frame, {})[watched] = None
        watched.frames = frames


def _frames_of(path: Path) -> frozenset[str]:
    """The children whose edges make up a path; the frame itself where there is none."""
    return frozenset(path.frames) - {path.root} or frozenset(path.frames)
