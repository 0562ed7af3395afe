"""What a tree is made of: each frame's history, the names that are known, and the paths that have been found.

No lock and no questions: `tfbus.tree` has those.
"""

from tfbus.errors import UnknownFrameError
from tfbus.geometry.stamped import TransformStamped
from tfbus.stamps import Latest, as_stamp
from tfbus.tree._known_frames import KnownFrames
from tfbus.tree.history import FrameHistory, Outcome
from tfbus.tree.path import Path, find_path

_PATHS_KEPT = 10_000


class Forest:
    """All frames that have a parent.

    Parameters
    ----------
    window : int or None
        How much history to keep for each frame, in ns; None keeps everything.

    Attributes
    ----------
    window : int or None
    frames : dict of str to FrameHistory
        By child.
    names : FrameNames
    paths : dict of (target, source) to Path
        Those that hold at every stamp. Whatever could make one stale empties it.
    changed : set of str
        Frames that got another parent or kind, or a longer past: then a lookup from `below` them may have another
        answer. Whoever acts on it clears it.
    joined : set of str
        Frames that became somebody's parent: then they may have become known. Cleared likewise.
    """

    __slots__ = ("changed", "frames", "joined", "names", "paths", "window")

    def __init__(self, window: int | None) -> None:
        self.window = window
        self.frames: dict[str, FrameHistory] = {}
        self.names = KnownFrames()
        self.paths: dict[tuple[str, str], Path] = {}
        self.changed: set[str] = set()
        self.joined: set[str] = set()

    def store(self, sample: TransformStamped) -> Outcome:
        """Put a sample into its frame's history."""
        parent, child, stamp, row, authority, static = sample._fields
        history = self.frames.get(child)
        if history is None:
            history = self._add(child, parent, static)
        if static:
            if row != history.row:
                # The paths hold what static edges amount to.
                self.paths.clear()
            outcome = history.insert_static(parent, stamp, row, authority)
        else:
            outcome = history.insert(parent, stamp, row, authority)
        if history.changed:
            self._restructure(history)
        return outcome

    def find_path(self, target: str, source: str, at: int | Latest) -> Path:
        """The path between two frames at a stamp, or with the newest parents; remembered if it is that of every stamp.

        Raises
        ------
        UnknownFrameError, DisconnectedError
        ValueError
            If the stamp does not fit 64 bits.
        """
        path = self.paths.get((target, source))
        if path is not None:
            return path
        instant = None if isinstance(at, Latest) else as_stamp(at)
        self.check_known(target)
        self.check_known(source)
        path = find_path(self.frames, target, source, instant)
        if path.lasting:
            if len(self.paths) >= _PATHS_KEPT:
                self.paths.clear()
            self.paths[target, source] = path
        return path

    def parent_changes(self) -> list[int]:
        """Every stamp at which some frame changes its parent, in order: between two of them all paths stay."""
        return sorted({stamp for history in self.frames.values() for stamp in history.parent_changes()})

    def check_known(self, frame: str) -> None:
        """Raise `UnknownFrameError` unless a sample names the frame."""
        if frame not in self.names:
            if not isinstance(frame, str):
                raise TypeError(f"a frame name must be a str, not {frame!r}")
            raise UnknownFrameError(frame=frame, known=self.names.sorted())

    def remove(self, frame: str) -> None:
        """Take a frame off its parent, if it has one, and forget its samples."""
        if self.frames.pop(frame, None) is not None:
            self.names.remove(frame)
            self.paths.clear()

    def clear(self) -> None:
        """Drop all moving samples; static ones and names stay."""
        for history in self.frames.values():
            history.clear()
            history.changed = False
            self.names.update(history.child, history.mentioned)
        self.paths.clear()

    def forget_changes(self) -> None:
        """Clear what was noted for whoever waits."""
        self.changed.clear()
        self.joined.clear()

    def below(self, frames: set[str]) -> set[str]:
        """These frames and all that hang below them, by any parent that a sample in the window names."""
        children: dict[str, list[str]] = {}
        for child, history in self.frames.items():
            for parent in history.mentioned:
                children.setdefault(parent, []).append(child)
        found = set(frames)
        ahead = list(frames)
        while ahead:
            new = [child for child in children.get(ahead.pop(), ()) if child not in found]
            found.update(new)
            ahead += new
        return found

    def copy(self) -> "Forest":
        """An independent copy."""
        twin = Forest(self.window)
        twin.frames = {child: history.copy() for child, history in self.frames.items()}
        twin.names = self.names.copy()
        return twin

    def within(self, window: int | None) -> "Forest":
        """An independent copy of what the windows hold, with windows of this length from now on."""
        twin = Forest(window)
        for child, history in self.frames.items():
            short = twin.frames[child] = history.within(window)
            twin.names.update(child, short.mentioned)
        return twin

    def _add(self, child: str, parent: str, static: bool) -> FrameHistory:
        has_children = child in self.names
        history = self.frames[child] = FrameHistory(child, parent, static, self.window)
        self.names.update(child, history.mentioned)
        self.joined.add(parent)
        if has_children:
            # A root that gets a parent leaves the paths below it as they are, unless late samples formed a loop there.
            self.paths.clear()
            self.changed.add(child)
            self._forget_empty_loop(history)
        return history

    def _restructure(self, history: FrameHistory) -> None:
        """Forget what an insertion may have made stale."""
        history.changed = False
        self.paths.clear()
        self.changed.add(history.child)
        self.joined.update(history.mentioned)
        self.names.update(history.child, history.mentioned)
        self._forget_empty_loop(history)

    def _forget_empty_loop(self, history: FrameHistory) -> None:
        """Drop emptied frames that now stand in a loop: their last parent is no longer the truth."""
        walk = {history: None}
        here = history
        while (above := self.frames.get(here.parent)) is not None and above not in walk:
            walk[above] = None
            here = above
        if above is history:
            for edge in walk:
                if edge is not history and not len(edge):
                    self.changed.add(edge.child)
                    self.remove(edge.child)
