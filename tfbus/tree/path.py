"""Paths between two frames.

A path climbs from the source to the lowest common ancestor and from the target to the same frame, so no edge above that
can fail or slow a lookup. Runs of static edges are folded into one row.

The newest edges form no loop, but the edges that hold at an older stamp may: late samples can form one, and an edge is
followed beyond its samples as well, so that an error can name it. Two ways then lead round the loop. `path_at` says
which of them counts, by what is stored and never by what was asked before.
"""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any

from tfbus.errors import DisconnectedError, ExtrapolationError, FutureExtrapolationError
from tfbus.geometry.stamped import TransformStamped
from tfbus.rows import IDENTITY, Row, compose, invert
from tfbus.stamps import LATEST, STAMP_MAX, STAMP_MIN
from tfbus.tree.history import FrameHistory
from tfbus.which_kernel import Chain, Paths

Frames = Mapping[str, FrameHistory]
"""By child."""

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
        The other way round a loop, if the samples cover the stamp on neither of them.
    """

    __slots__ = ("_changing", "_static", "frames", "moving", "permanent", "rival", "root")
    up: tuple[Step, ...]
    down: tuple[Step, ...]

    def __init__(self, ups: list[FrameHistory], downs: list[FrameHistory], root: str) -> None:
        super().__init__(_fold(ups), _fold(downs))
        edges = ups + downs
        self.root = root
        self.frames = (*(edge.child for edge in downs), root, *(edge.child for edge in reversed(ups)))
        self.moving = tuple(edge for edge in edges if not edge.static)
        self._changing = tuple(edge for edge in edges if edge.mixed)
        self.permanent = not self._changing
        self.rival: Path | None = None
        self._static = tuple(edge for edge in edges if edge.static)

    @property
    def children(self) -> list[str]:
        """The children of its edges, sorted."""
        return sorted(frame for frame in self.frames if frame != self.root)

    @property
    def static_stamp(self) -> int:
        """The newest stamp among the static samples, in ns; sending one again changes it, but not the path."""
        return max((edge.static_stamp or 0 for edge in self._static), default=0)

    def holds(self, at: int) -> bool:
        """Whether a path by the newest parents has the parents that hold at a stamp."""
        return all(edge.parent_at(at) == edge.parent for edge in self._changing)

    def covers(self, at: int) -> bool:
        """Whether the samples of every edge cover a stamp."""
        return all(edge.covers(at) for edge in self.moving)

    def row_at(self, at: int) -> Row:
        """The row of source in target at a stamp: that of the kernel or, if it is not plain, the same step by step.

        Raises
        ------
        ExtrapolationError
            If an edge does not cover it.
        """
        row = self.row(at)
        if row is None:
            row = _climb(self.up, at)
            if self.down:
                row = compose(invert(_climb(self.down, at)), row)
        return row

    def newest_common(self) -> tuple[int, FrameHistory]:
        """The newest stamp that every moving edge has reached, and the edge that has come no further.

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
        """The error of a stamp that is not covered: of an edge that has lost it, else of the one that lags most.

        With a `rival`, of the way that waiting may help.
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
        lagging, reached = self.moving[0], STAMP_MAX
        for edge in self.moving:
            oldest, newest = edge.oldest, edge.newest
            if oldest is not None and newest is not None and newest >= at:
                if oldest > at:
                    return edge.extrapolation_error(at)
            elif (came_to := STAMP_MIN if newest is None else newest) < reached:
                lagging, reached = edge, came_to
        return lagging.extrapolation_error(at)


def _climb(steps: tuple[Step, ...], at: int) -> Row:
    """The first step's child, seen from the last step's parent, at a stamp."""
    row: Row | None = None
    for step in steps:
        here = step.row_at(at) if isinstance(step, FrameHistory) else step
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
    """The edges of a path, from source and from target up to the common ancestor, and that.

    It reads nothing but parents, so that it may run while another thread inserts; whoever does so has to check whether
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

    That is the newest path if all its edges hold and cover the stamp. Otherwise it is the way by the parents that hold
    at the stamp; of two ways round a loop, the one whose samples cover the stamp. If neither does, it has a `rival`.

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
        If there is no way; or if the samples cover the stamp on two ways, and neither is the newest path.
    """
    if newest is not None and newest.holds(at):
        if newest.root not in frames or newest.covers(at):
            return newest
        way = newest
    else:
        way = find_path(frames, target, source, at)
    rival, loop = _other_way(frames, way, at)
    if rival is None:
        return way
    if rival.covers(at):
        if way.covers(at):
            raise DisconnectedError(target=target, source=source, roots=(way.root, rival.root), stamp=at, loop=loop)
        return rival
    if way.covers(at):
        return way
    if way is newest:
        # The newest path may be kept for other stamps, at which it has no rival.
        way = Path(*_edges(frames, way), way.root)
    elif rival.children < way.children:
        # The same one for both directions of the question.
        way, rival = rival, way
    way.rival = rival
    return way


def _other_way(frames: Frames, way: Path, at: int) -> tuple[Path | None, tuple[str, ...]]:
    """The other way round a loop at a stamp, if its top leads back to it, and the loop."""
    beyond: dict[str, FrameHistory] = {}
    here = way.root
    while (edge := frames.get(here)) is not None and here not in beyond:
        beyond[here] = edge
        here = edge.parent_at(at)
        if here not in way.frames:
            continue
        ups, downs = _edges(frames, way)
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


class PathCache(Paths):
    """The permanent paths that were asked for lately.

    When a generation of 10,000 is complete, those of the one before it that nobody has asked for since are forgotten:
    so up to 10,000 pairs in use stay known, and at most 20,000 are kept.

    Parameters
    ----------
    lock : threading.Lock
        That of the forest.
    """

    __slots__ = ("_count", "_older")

    def __init__(self, lock: AbstractContextManager[Any]) -> None:
        super().__init__(lock, LATEST, TransformStamped)
        self._count = 0
        self._older: dict[str, dict[str, Path]] = {}

    def __len__(self) -> int:
        return sum(len(by_source) for paths in (self.recent, self._older) for by_source in paths.values())

    def find(self, target: str, source: str) -> Path | None:
        """The path between two frames, if it is kept."""
        for paths in (self.recent, self._older):
            by_source = paths.get(target)
            path = None if by_source is None else by_source.get(source)
            if isinstance(path, Path):
                if paths is not self.recent:
                    self.keep(target, source, path)
                return path
        return None

    def holds(self, target: str, source: str) -> bool:
        """Whether the path between two frames is kept. May be asked without the lock."""
        return any(source in paths.get(target, ()) for paths in (self.recent, self._older))

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
        self.recent = {}
        self._older = {}
        self._count = 0
