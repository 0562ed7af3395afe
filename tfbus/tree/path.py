"""Paths between two frames.

A path climbs from the source to the lowest common ancestor and from the target to the same frame, so no edge above that
can fail or slow a lookup. Runs of static edges are folded into one row.
"""

from collections.abc import Mapping

from tfbus.errors import DisconnectedError, ExtrapolationError, PastExtrapolationError
from tfbus.geometry.rows import IDENTITY, Row, compose, invert
from tfbus.stamps import LATEST, STAMP_MIN
from tfbus.tree._kernel import Chain
from tfbus.tree.history import FrameHistory

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
    """

    __slots__ = ("_static", "frames", "moving", "permanent", "root")
    up: tuple[Step, ...]
    down: tuple[Step, ...]

    def __init__(self, ups: list[FrameHistory], downs: list[FrameHistory], root: str) -> None:
        super().__init__(_fold(ups), _fold(downs))
        edges = ups + downs
        self.root = root
        self.frames = (*(edge.child for edge in downs), root, *(edge.child for edge in reversed(ups)))
        self.moving = tuple(edge for edge in edges if not edge.static)
        self.permanent = not any(edge.mixed for edge in edges)
        self._static = tuple(edge for edge in edges if edge.static)

    @property
    def static_stamp(self) -> int:
        """The newest stamp among the static samples, in ns; sending one again changes it, but not the path."""
        return max((edge.static_stamp or 0 for edge in self._static), default=0)

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
        """The error of a stamp that is not covered: of an edge that has lost it, else of the one that lags most."""
        missing = [edge.extrapolation_error(at) for edge in self.moving if not edge.covers(at)]
        for error in missing:
            if isinstance(error, PastExtrapolationError):
                return error
        return min(missing, key=lambda error: STAMP_MIN if error.newest is None else error.newest)


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


def find_path(frames: Mapping[str, FrameHistory], target: str, source: str, at: int | None) -> Path:
    """The path that holds at a stamp, or by the newest parents.

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
        If the two ends do not meet, or one runs into a loop, which out-of-order samples can form in the past.
    """
    up, down = _Climber(frames, source, at), _Climber(frames, target, at)
    while True:
        for meeting in (up.here, down.here):
            if meeting in up.seen and meeting in down.seen:
                return Path(up.edges[: up.seen[meeting]], down.edges[: down.seen[meeting]], meeting)
        if up.ended and down.ended:
            raise DisconnectedError(
                target=target, source=source, roots=(down.here, up.here), stamp=at, loop=up.loop or down.loop
            )
        up.climb()
        down.climb()


class _Climber:
    """One end of a path search, which climbs towards the root."""

    __slots__ = ("_at", "_frames", "edges", "ended", "here", "loop", "seen")

    def __init__(self, frames: Mapping[str, FrameHistory], frame: str, at: int | None) -> None:
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
