"""One question at many stamps.

While the tree is locked, `take` finds the paths that hold between the first stamp and the last, and copies the samples
on them, as blocks of memory. All that numpy does comes after that, in chunks that stay in the cache. Which error the
first stamp without an answer gets, the scalar lookup is asked afterwards.
"""

from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from tfbus.errors import DisconnectedError
from tfbus.geometry.rows import IDENTITY, Columns, Row, compose, invert
from tfbus.geometry.transform_array import TransformArray, from_columns, move
from tfbus.stamps import Stamps
from tfbus.tree._extrapolation import place_many
from tfbus.tree._lookup import resolve, resolve_travel
from tfbus.tree._python_kernel import Step
from tfbus.tree._segments import Floats, Segments
from tfbus.tree.forest import Forest
from tfbus.tree.history import FrameHistory, Samples
from tfbus.tree.path import Path
from tfbus.tree.policy import Policy

FEW = 40
"""Up to so many stamps are answered faster one by one."""
_CHUNK = 2048

OutOfRange = Literal["raise", "nan"]
Places = slice | npt.NDArray[np.intp]


class Leg(NamedTuple):
    """Where a source is, seen from a target, at many stamps."""

    target: str
    source: str
    stamps: Stamps

    def ends(self) -> tuple[int, int] | None:
        """The first and the last stamp; None if there are none."""
        return (int(self.stamps.min()), int(self.stamps.max())) if len(self.stamps) else None


class Route(NamedTuple):
    """A path with copies of the samples on its moving edges; of static ones, the row that they amount to."""

    up: tuple[Samples | Row, ...]
    down: tuple[Samples | Row, ...]

    @property
    def moving(self) -> list[Samples]:
        """The moving edges, in the order up, then down."""
        return [step for step in (*self.up, *self.down) if isinstance(step, Samples)]

    def covers(self, stamps: Stamps) -> bool:
        """Whether each edge covers all of some stamps."""
        low, high = stamps.min(), stamps.max()
        return all(edge.stamps and edge.stamps[0] <= low and high <= edge.stamps[-1] for edge in self.moving)


class Taken(NamedTuple):
    """What the answers between two stamps are made of."""

    changes: list[int]
    """The stamps, in ns, at which the path may change."""
    routes: list[Route | None]
    """One before the first change, and one from each on; None where the frames are not connected."""


def take(forest: Forest, target: str, source: str, stamps: tuple[int, int] | None) -> Taken:
    """Take what the transforms from source to target need, from a first stamp to a last; None for no stamps.

    The caller holds the lock.

    Raises
    ------
    UnknownFrameError
    """
    forest.check_known(target)
    forest.check_known(source)
    if stamps is None:
        return Taken([], [None])
    low, high = stamps
    paths: list[Path | None] = [_path(forest, target, source, low)]
    changes: list[int] = []
    if paths[0] is None or not paths[0].lasting:
        changes = [stamp for stamp in forest.parent_changes() if low < stamp <= high]
        paths += [_path(forest, target, source, stamp) for stamp in changes]
    routes: dict[tuple[tuple[Step, ...], tuple[Step, ...]], Route] = {}
    for path in paths:
        if path is not None and (path.up, path.down) not in routes:
            up = tuple(_copy(step, low, high) for step in path.up)
            down = tuple(_copy(step, low, high) for step in path.down)
            routes[path.up, path.down] = Route(up, down)
    return Taken(changes, [None if path is None else routes[path.up, path.down] for path in paths])


def _path(forest: Forest, target: str, source: str, at: int) -> Path | None:
    try:
        return forest.find_path(target, source, at)
    except DisconnectedError:
        return None


def _copy(step: Step, low: int, high: int) -> Samples | Row:
    return step.between(low, high) if isinstance(step, FrameHistory) else step


class Answers:
    """The answers at many stamps, worked out piece by piece when they are read.

    Parameters
    ----------
    taken : Taken
    leg : Leg
    policy : Policy or None

    Attributes
    ----------
    first_missing : int or None
        The first place without an answer.
    connected : bool
        Whether the frames are connected at any of the stamps, or there are none.
    done : integer array of shape (2, n), or None
        What the policy did at each stamp, `extrapolated_by` and `gap` in ns; None without one.
    """

    def __init__(self, taken: Taken, leg: Leg, policy: Policy | None) -> None:
        stamps = leg.stamps
        self._count = len(stamps)
        self._pieces: list[_Piece] = []
        self.first_missing: int | None = None
        self.connected = not len(stamps)
        self.done = None if policy is None else np.zeros((2, len(stamps)), np.int64)
        for places, route in _by_route(taken, stamps):
            its_stamps = stamps[places]
            if not len(its_stamps):
                continue
            if route is None:
                self._miss(places, np.zeros(len(its_stamps), np.bool_))
            else:
                self.connected = True
                self._add(places, its_stamps, route, policy)

    def _add(self, places: Places, stamps: Stamps, route: Route, policy: Policy | None) -> None:
        read_at = [stamps] * len(route.moving)
        if policy is None:
            known = None if route.covers(stamps) else _covered(route, stamps)
        else:
            known, read_at, done = _placed(route, stamps, policy)
            assert self.done is not None
            self.done[:, places] = done
        if known is not None and not known.all():
            self._miss(places, known)
            places = np.arange(self._count)[places][known]
            read_at = [its[known] for its in read_at]
            stamps = stamps[known]
        if len(stamps):
            self._pieces.append(_Piece(places, len(stamps), route, read_at))

    def _miss(self, places: Places, known: npt.NDArray[np.bool_]) -> None:
        first = int(np.arange(self._count)[places][known.argmin()])
        self.first_missing = first if self.first_missing is None else min(first, self.first_missing)

    def columns(self) -> Floats:
        """All answers, shape (7, n); NaN where there is none."""
        columns = np.full((7, self._count), np.nan)
        for places, part in self._chunks():
            for column, values in zip(columns, part, strict=True):
                column[places] = values
        return columns

    def apply(self, points: npt.NDArray[Any], then: Row) -> npt.NDArray[Any]:
        """Points of shape (n, 3), each moved by the answer at its place and then by another transform."""
        moved = np.full(points.shape, np.nan, points.dtype)
        # What a sensor sends for "nothing there" may be infinite.
        with np.errstate(invalid="ignore"):
            for places, part in self._chunks():
                x, y, z = move(part, *points[places].T.astype(np.float64))
                if then != IDENTITY:
                    x, y, z = move(then, x, y, z)
                for axis, values in enumerate((x, y, z)):
                    moved[places, axis] = values
        return moved

    def _chunks(self) -> Iterator[tuple[Places, Columns]]:
        for piece in self._pieces:
            yield from piece.chunks()


def resolve_few(
    forest: Forest, target: str, source: str, stamps: Stamps, source_stamps: Stamps | None, fixed: str | None
) -> list[Row]:
    """The answers, one by one; errors as for the scalar lookup. The caller holds the lock."""
    path = forest.paths.get((target, source))
    if path is not None and source_stamps is None:
        return path.rows(stamps.tolist())
    for name in (target, source) if fixed is None else (target, source, fixed):
        forest.check_known(name)
    if source_stamps is None:
        return [resolve(forest, target, source, at, None)[1] for at in stamps.tolist()]
    both = zip(stamps.tolist(), source_stamps.tolist(), strict=True)
    return [resolve_travel(forest, target, source, at, then, fixed, None)[1] for at, then in both]


def join(legs: list[Answers]) -> TransformArray:
    """The answers of one leg, or of two that meet in a fixed frame."""
    columns = legs[0].columns()
    done = legs[0].done
    for leg in legs[1:]:
        columns = np.stack(compose((*columns,), (*leg.columns(),)))
        done = None if done is None or leg.done is None else np.maximum(done, leg.done)
    return from_columns(columns, done)


def _by_route(taken: Taken, stamps: Stamps) -> list[tuple[Places, Route | None]]:
    """The places of the stamps that each route is for."""
    if not taken.changes:
        return [(slice(len(stamps)), taken.routes[0])]
    different = list({id(route): route for route in taken.routes}.values())
    which = np.array([next(i for i, its in enumerate(different) if its is route) for route in taken.routes])
    its_route = which[np.array(taken.changes, np.int64).searchsorted(stamps, "right")]
    return [(np.flatnonzero(its_route == i), route) for i, route in enumerate(different)]


def _covered(route: Route, stamps: Stamps) -> npt.NDArray[np.bool_]:
    covered = np.ones(len(stamps), np.bool_)
    for samples in route.moving:
        if not samples.stamps:
            covered[:] = False
        else:
            covered &= (samples.stamps[0] <= stamps) & (stamps <= samples.stamps[-1])
    return covered


def _placed(route: Route, stamps: Stamps, policy: Policy) -> tuple[npt.NDArray[np.bool_], list[Stamps], Stamps]:
    """Which stamps have an answer, where to read each edge for them, and what that takes."""
    known = np.ones(len(stamps), np.bool_)
    read_at: list[Stamps] = []
    done = np.zeros((2, len(stamps)), np.int64)
    for samples in route.moving:
        here, away, gap = place_many(samples, stamps, policy)
        read_at.append(here)
        known &= away >= 0
        np.maximum(done, (away, gap), out=done)
    done[:, ~known] = 0
    return known, read_at, done


class _Piece:
    """The answers that share one route."""

    def __init__(self, places: Places, count: int, route: Route, read_at: list[Stamps]) -> None:
        self._places = places
        self._count = count
        self._route = route
        self._read_at = read_at

    def chunks(self) -> Iterator[tuple[Places, Columns]]:
        ahead = iter(self._read_at)
        up, down = (
            [Segments(step, next(ahead)) if isinstance(step, Samples) else step for step in steps]
            for steps in (self._route.up, self._route.down)
        )
        for start in range(0, self._count, _CHUNK):
            part = slice(start, min(start + _CHUNK, self._count))
            columns = _climb(up, part)
            if down:
                columns = compose(invert(_climb(down, part)), columns)
            yield part if isinstance(self._places, slice) else self._places[part], columns


def _climb(legs: Sequence[Segments | Row], part: slice) -> Columns:
    columns: Columns | None = None
    for leg in legs:
        here = leg.at(part) if isinstance(leg, Segments) else leg
        columns = here if columns is None else compose(here, columns)
    return IDENTITY if columns is None else columns
