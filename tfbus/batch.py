"""One question at many stamps.

While the tree is locked, `survey` finds the paths and copies the samples that they need, as blocks of memory. All
arithmetic comes after that, in numpy, in chunks that stay in the cache.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from tfbus.curve import Curve, Floats, Stamps
from tfbus.errors import DisconnectedError, ExtrapolationError, TransformLookupError
from tfbus.forest import Forest
from tfbus.geometry import IDENTITY, Columns, Row, compose, invert
from tfbus.history import FrameHistory, Samples
from tfbus.path import Path, Step
from tfbus.resolve import resolve, resolve_travel
from tfbus.transform_array import TransformArray, from_columns, move

OutOfRange = Literal["raise", "nan"]
Places = slice | npt.NDArray[np.intp]

FEW = 40
"""Up to so many stamps are answered faster one by one."""
_CHUNK = 2048
_MISSING: Row = (math.nan,) * 7


class Survey:
    """What the answers at many stamps are made of, taken from a forest.

    Attributes
    ----------
    fault : TransformLookupError or None
        Why the first of the stamps that have no answer has none, with its `index`.
    """

    def __init__(self, count: int) -> None:
        self.fault: TransformLookupError | None = None
        self._count = count
        self._stretches: list[_Stretch] = []

    def add(self, places: npt.NDArray[np.intp] | None, stamps: Stamps, path: Path) -> None:
        """Take what stamps on one path need, with their places unless they are all; without those it does not cover."""
        covered = _covered(path, stamps)
        if covered is not None:
            places = np.arange(len(stamps)) if places is None else places
            first = int(covered.argmin())
            self.report(int(places[first]), path.blocker(int(stamps[first])))
            places, stamps = places[covered], stamps[covered]
        if len(stamps):
            self._stretches.append(_Stretch(places, stamps, path))

    def report(self, place: int, error: TransformLookupError) -> None:
        """Take note that the stamp at this place has no answer."""
        error.index = place
        if self.fault is None or self.fault.index is None or place < self.fault.index:
            self.fault = error

    @property
    def empty(self) -> bool:
        """Whether there are no answers at all."""
        return not self._stretches

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
        for places, part in self._chunks():
            x, y, z = move(part, *points[places].T.astype(np.float64))
            if then != IDENTITY:
                x, y, z = move(then, x, y, z)
            for axis, values in enumerate((x, y, z)):
                moved[places, axis] = values
        return moved

    def _chunks(self) -> Iterator[tuple[Places, Columns]]:
        for stretch in self._stretches:
            yield from stretch.chunks()


class Answers(NamedTuple):
    """A few answers that are there already, as `Survey` gives them."""

    rows: list[Row]
    fault: TransformLookupError | None

    def columns(self) -> Floats:
        """All answers, shape (7, n); NaN where there is none."""
        return np.array(self.rows, np.float64).reshape(-1, 7).T


class Journey(NamedTuple):
    """Answers in two legs, through a fixed frame."""

    target_from_fixed: Survey
    fixed_from_source: Survey

    @property
    def fault(self) -> TransformLookupError | None:
        """As that of `Survey`: of the leg whose own comes first."""
        faults = [leg.fault for leg in self if leg.fault is not None]
        return min(faults, key=lambda fault: fault.index or 0, default=None)

    def columns(self) -> Floats:
        """All answers, shape (7, n); NaN where there is none."""
        first, second = (leg.columns() for leg in self)
        return np.stack(compose((*first,), (*second,)))


def take(
    forest: Forest, target: str, source: str, stamps: Stamps, source_stamps: Stamps | None, fixed: str | None
) -> Survey | Answers | Journey:
    """Take from a forest what the answers at many stamps need. The caller holds the lock.

    Raises
    ------
    UnknownFrameError
    """
    for name in (target, source) if fixed is None else (target, source, fixed):
        forest.check_known(name)
    if len(stamps) <= FEW:
        return _resolve_few(forest, target, source, stamps, source_stamps, fixed)
    if source_stamps is None or fixed is None:
        return survey(forest, target, source, stamps)
    return Journey(survey(forest, target, fixed, stamps), survey(forest, fixed, source, source_stamps))


def finish(taken: Survey | Answers | Journey, out_of_range: OutOfRange) -> TransformArray:
    """The answers. The lock is not needed any more.

    Raises
    ------
    TransformLookupError
        The fault, if there is one; for ``"nan"``, only if there is no path at any of the stamps.
    """
    _check_fault(taken.fault, out_of_range)
    columns = taken.columns()
    if isinstance(taken.fault, DisconnectedError) and np.isnan(columns[0]).all():
        raise taken.fault
    return from_columns(columns)


def finish_points(found: Survey, points: npt.NDArray[Any], then: Row, out_of_range: OutOfRange) -> npt.NDArray[Any]:
    """Points of shape (n, 3), each moved by its answer and then by another transform; errors as for `finish`."""
    _check_fault(found.fault, out_of_range)
    if isinstance(found.fault, DisconnectedError) and found.empty:
        raise found.fault
    return found.apply(points, then)


def _check_fault(fault: TransformLookupError | None, out_of_range: OutOfRange) -> None:
    if out_of_range not in ("raise", "nan"):
        raise ValueError(f"out_of_range must be 'raise' or 'nan', not {out_of_range!r}")
    if fault is not None and out_of_range == "raise":
        raise fault


def survey(forest: Forest, target: str, source: str, stamps: Stamps) -> Survey:
    """Take what the transforms from source to target at many stamps need. The caller holds the lock.

    Raises
    ------
    UnknownFrameError
    """
    found = Survey(len(stamps))
    path = forest.paths.get((target, source))
    if path is not None and len(stamps):
        found.add(None, stamps, path)
        return found
    changes = np.array(forest.parent_changes(), np.int64)
    _, firsts, periods = np.unique(changes.searchsorted(stamps, "right"), return_index=True, return_inverse=True)
    routes: dict[tuple[str, ...], tuple[Path, list[int]]] = {}
    for period, first in enumerate(firsts.tolist()):
        try:
            path = forest.find_path(target, source, int(stamps[first]))
        except DisconnectedError as error:
            found.report(first, error)
        else:
            routes.setdefault(path.frames, (path, []))[1].append(period)
    for path, its_periods in routes.values():
        places = np.flatnonzero(np.isin(periods, its_periods))
        found.add(places, stamps[places], path)
    return found


def _resolve_few(
    forest: Forest, target: str, source: str, stamps: Stamps, source_stamps: Stamps | None, fixed: str | None
) -> Answers:
    path = forest.paths.get((target, source))
    if path is not None and source_stamps is None:
        try:
            return Answers(path.rows(stamps.tolist()), None)
        except ExtrapolationError:
            pass
    rows: list[Row] = []
    fault: TransformLookupError | None = None
    for place, stamp in enumerate(stamps.tolist()):
        try:
            if source_stamps is None:
                row = resolve(forest, target, source, stamp, None)[1]
            else:
                row = resolve_travel(forest, target, source, stamp, int(source_stamps[place]), fixed, None)[1]
        except (ExtrapolationError, DisconnectedError) as error:
            row = _MISSING
            if fault is None:
                fault = error
                fault.index = place
        rows.append(row)
    return Answers(rows, fault)


def _covered(path: Path, stamps: Stamps) -> npt.NDArray[np.bool_] | None:
    """Which stamps every edge covers; None for all."""
    ends = int(stamps.min()), int(stamps.max())
    if all(edge.covers(end) for edge in path.moving for end in ends):
        return None
    covered = np.ones(len(stamps), np.bool_)
    for edge in path.moving:
        if edge.oldest is None or edge.newest is None:
            covered[:] = False
        else:
            covered &= (edge.oldest <= stamps) & (stamps <= edge.newest)
    return covered


class _Stretch:
    """Stamps that share one path, and copies of the samples that they need."""

    def __init__(self, places: npt.NDArray[np.intp] | None, stamps: Stamps, path: Path) -> None:
        self._places = places
        self._stamps = stamps
        low, high = int(stamps.min()), int(stamps.max())
        self._up = [_take(step, low, high) for step in path.up]
        self._down = [_take(step, low, high) for step in path.down]

    def chunks(self) -> Iterator[tuple[Places, Columns]]:
        up = [self._prepared(leg) for leg in self._up]
        down = [self._prepared(leg) for leg in self._down]
        for start in range(0, len(self._stamps), _CHUNK):
            part = slice(start, start + _CHUNK)
            columns = _climb(up, part)
            if down:
                columns = compose(invert(_climb(down, part)), columns)
            yield part if self._places is None else self._places[part], columns

    def _prepared(self, leg: Samples | Row) -> Curve | Row:
        return Curve(leg, self._stamps) if isinstance(leg, Samples) else leg


def _take(step: Step, low: int, high: int) -> Samples | Row:
    return step.between(low, high) if isinstance(step, FrameHistory) else step


def _climb(legs: Sequence[Curve | Row], part: slice) -> Columns:
    columns: Columns | None = None
    for leg in legs:
        here = leg.at(part) if isinstance(leg, Curve) else leg
        columns = here if columns is None else compose(here, columns)
    return IDENTITY if columns is None else columns
