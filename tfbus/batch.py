"""One question at many stamps.

While the tree is locked, `survey` finds the paths and copies the samples that they need, as blocks of memory. All
arithmetic comes after that, in numpy, in chunks that stay in the cache.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import repeat
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from tfbus.curve import Curve, Floats, Stamps
from tfbus.errors import (
    DisconnectedError,
    ExtrapolationError,
    FutureExtrapolationError,
    TransformLookupError,
)
from tfbus.forest import Forest
from tfbus.geometry import IDENTITY, Columns, Row, compose, invert
from tfbus.history import FrameHistory, Samples
from tfbus.path import Path, Step
from tfbus.placement import place_all, place_path
from tfbus.policy import Policy
from tfbus.resolve import resolve, resolve_travel
from tfbus.transform_array import TransformArray, from_columns, move

OutOfRange = Literal["raise", "nan"]
Places = slice | npt.NDArray[np.intp]

FEW = 40
"""Up to so many stamps are answered faster one by one."""
_CHUNK = 2048


class Survey:
    """What the answers at many stamps are made of, taken from a forest.

    Attributes
    ----------
    fault : TransformLookupError or None
        Why the first of the stamps that have no answer has none, with its `index`.
    severed : TransformLookupError or None
        The fault, if there is no path at any of the stamps.
    done : integer array of shape (2, n), or None
        What the policy did at each stamp: `extrapolated_by` and `gap`, in ns.
    """

    def __init__(self, count: int, policy: Policy | None = None) -> None:
        self.fault: TransformLookupError | None = None
        self.severed: TransformLookupError | None = None
        self.done = None if policy is None else np.zeros((2, count), np.int64)
        self._policy = policy
        self._count = count
        self._stretches: list[_Stretch] = []

    def add(self, places: npt.NDArray[np.intp] | None, stamps: Stamps, path: Path) -> None:
        """Take what stamps on one path need, with their places unless they are all; without those it does not cover."""
        read_at: list[Stamps] | None = None
        if self._policy is None or self.done is None:
            covered = _covered(path, stamps)
        else:
            read_at, covered, done = place_path(path, stamps, self._policy)
            self.done[:, slice(None) if places is None else places] = done
        if covered is not None:
            places = np.arange(len(stamps)) if places is None else places
            first = int(covered.argmin())
            self.report(int(places[first]), self._why(path, int(stamps[first])))
            places, stamps = places[covered], stamps[covered]
            read_at = None if read_at is None else [its[covered] for its in read_at]
        if len(stamps):
            self._stretches.append(_Stretch(places, stamps, path, read_at))

    def _why(self, path: Path, at: int) -> ExtrapolationError:
        """What a lookup at a stamp that has no answer would raise."""
        if self._policy is None:
            return path.blocker(at)
        try:
            place_all(path.moving, at, self._policy)
        except ExtrapolationError as error:
            return error
        raise AssertionError(f"{at} has an answer")

    def report(self, place: int, error: TransformLookupError) -> None:
        """Take note that the stamp at this place has no answer."""
        error.index = place
        if self.fault is None or self.fault.index is None or place < self.fault.index:
            self.fault = error

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
        for stretch in self._stretches:
            yield from stretch.chunks()


class Answers(NamedTuple):
    """A few answers that are all there already; otherwise like a `Survey`."""

    rows: list[Row]
    fault: None = None
    severed: None = None
    done: None = None

    def columns(self) -> Floats:
        """All answers, shape (7, n)."""
        return np.array(self.rows, np.float64).reshape(-1, 7).T


class Journey(NamedTuple):
    """Answers in two legs, through a fixed frame."""

    target_from_fixed: Survey
    fixed_from_source: Survey

    @property
    def fault(self) -> TransformLookupError | None:
        """As that of `Survey`: of the leg whose own comes first; at the same stamp, as `resolve_travel` chooses."""
        first, second = (leg.fault for leg in self)
        if first is None or second is None or first.index != second.index:
            faults = [fault for fault in (first, second) if fault is not None]
            return min(faults, key=lambda fault: fault.index or 0, default=None)
        may_come = DisconnectedError, FutureExtrapolationError
        over = isinstance(first, DisconnectedError) and not isinstance(second, may_come)
        return second if over or isinstance(first, FutureExtrapolationError) else first

    @property
    def severed(self) -> TransformLookupError | None:
        """As that of `Survey`: of the first leg that has one."""
        return self.target_from_fixed.severed or self.fixed_from_source.severed

    @property
    def done(self) -> Stamps | None:
        """As that of `Survey`: of both legs the greater."""
        first, second = (leg.done for leg in self)
        return None if first is None or second is None else np.maximum(first, second)

    def columns(self) -> Floats:
        """All answers, shape (7, n); NaN where there is none."""
        first, second = (leg.columns() for leg in self)
        return np.stack(compose((*first,), (*second,)))


def take(
    forest: Forest,
    target: str,
    source: str,
    stamps: Stamps,
    source_stamps: Stamps | None,
    fixed: str | None,
    policy: Policy | None,
) -> Survey | Answers | Journey:
    """Take from a forest what the answers at many stamps need. The caller holds the lock.

    Raises
    ------
    UnknownFrameError
    """
    for name in (target, source) if fixed is None else (target, source, fixed):
        forest.check_known(name)
    if len(stamps) <= FEW and policy is None:
        with suppress(ExtrapolationError, DisconnectedError):
            return Answers(_resolve_few(forest, target, source, stamps, source_stamps, fixed))
    if source_stamps is None or fixed is None:
        return survey(forest, target, source, stamps, policy)
    return Journey(survey(forest, target, fixed, stamps, policy), survey(forest, fixed, source, source_stamps, policy))


def finish(taken: Survey | Answers | Journey, out_of_range: OutOfRange) -> TransformArray:
    """The answers. The lock is not needed any more.

    Raises
    ------
    TransformLookupError
        The fault, if there is one; for ``"nan"``, only if there is no path at any of the stamps.
    """
    _check(taken, out_of_range)
    return from_columns(taken.columns(), taken.done)


def finish_points(found: Survey, points: npt.NDArray[Any], then: Row, out_of_range: OutOfRange) -> npt.NDArray[Any]:
    """Points of shape (n, 3), each moved by its answer and then by another transform; errors as for `finish`."""
    _check(found, out_of_range)
    return found.apply(points, then)


def _check(taken: Survey | Answers | Journey, out_of_range: OutOfRange) -> None:
    if out_of_range not in ("raise", "nan"):
        raise ValueError(f"out_of_range must be 'raise' or 'nan', not {out_of_range!r}")
    fault = taken.fault if out_of_range == "raise" else taken.severed
    if fault is not None:
        raise fault


def survey(forest: Forest, target: str, source: str, stamps: Stamps, policy: Policy | None = None) -> Survey:
    """Take what the transforms from source to target at many stamps need. The caller holds the lock.

    Raises
    ------
    UnknownFrameError
    """
    found = Survey(len(stamps), policy)
    if not len(stamps):
        return found
    with suppress(DisconnectedError):
        path = forest.find_path(target, source, int(stamps[0]))
        if path.lasting:
            found.add(None, stamps, path)
            return found
    changes = np.array(forest.parent_changes(), np.int64)
    _, firsts, periods = np.unique(changes.searchsorted(stamps, "right"), return_index=True, return_inverse=True)
    routes: dict[tuple[tuple[Step, ...], tuple[Step, ...]], tuple[Path, list[int]]] = {}
    for period, first in enumerate(firsts.tolist()):
        try:
            path = forest.find_path(target, source, int(stamps[first]))
        except DisconnectedError as error:
            found.report(first, error)
        else:
            routes.setdefault((path.up, path.down), (path, []))[1].append(period)
    if not routes:
        found.severed = found.fault
    for path, its_periods in routes.values():
        places = np.flatnonzero(np.isin(periods, its_periods))
        found.add(places, stamps[places], path)
    return found


def _resolve_few(
    forest: Forest, target: str, source: str, stamps: Stamps, source_stamps: Stamps | None, fixed: str | None
) -> list[Row]:
    if source_stamps is not None:
        both = zip(stamps.tolist(), source_stamps.tolist(), strict=True)
        return [resolve_travel(forest, target, source, at, then, fixed, None)[1] for at, then in both]
    path = forest.paths.get((target, source))
    if path is not None:
        return path.rows(stamps.tolist())
    return [resolve(forest, target, source, at, None)[1] for at in stamps.tolist()]


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

    def __init__(
        self, places: npt.NDArray[np.intp] | None, stamps: Stamps, path: Path, read_at: list[Stamps] | None
    ) -> None:
        self._places = places
        self._count = len(stamps)
        reads = repeat(_Reading(stamps)) if read_at is None else map(_Reading, read_at)
        self._up = [_take(step, reads) for step in path.up]
        self._down = [_take(step, reads) for step in path.down]

    def chunks(self) -> Iterator[tuple[Places, Columns]]:
        up = [_prepared(leg) for leg in self._up]
        down = [_prepared(leg) for leg in self._down]
        for start in range(0, self._count, _CHUNK):
            part = slice(start, start + _CHUNK)
            columns = _climb(up, part)
            if down:
                columns = compose(invert(_climb(down, part)), columns)
            yield part if self._places is None else self._places[part], columns


class _Reading:
    """The stamps that an edge is read at, and their range."""

    def __init__(self, stamps: Stamps) -> None:
        self.stamps = stamps
        self.low, self.high = int(stamps.min()), int(stamps.max())


class _Leg(NamedTuple):
    """Samples of a moving edge, and the stamps that it is read at."""

    samples: Samples
    stamps: Stamps


def _take(step: Step, reads: Iterator[_Reading]) -> _Leg | Row:
    if not isinstance(step, FrameHistory):
        return step
    reading = next(reads)
    return _Leg(step.between(reading.low, reading.high), reading.stamps)


def _prepared(leg: _Leg | Row) -> Curve | Row:
    return Curve(leg.samples, leg.stamps) if isinstance(leg, _Leg) else leg


def _climb(legs: Sequence[Curve | Row], part: slice) -> Columns:
    columns: Columns | None = None
    for leg in legs:
        here = leg.at(part) if isinstance(leg, Curve) else leg
        columns = here if columns is None else compose(here, columns)
    return IDENTITY if columns is None else columns
