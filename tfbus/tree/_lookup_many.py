"""Lookups at many stamps at once.

The samples are copied under the lock, and numpy works on the copies in chunks that stay in the cache. Where a stamp has
no answer, the lookup at one stamp is asked, so that both raise the same error.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from tfbus.data import PointCloud
from tfbus.errors import DisconnectedError, ExtrapolationError, TransformLookupError
from tfbus.geometry.rows import IDENTITY, Columns, Row, compose, invert
from tfbus.geometry.transform_array import TransformArray, from_columns, from_rows, move
from tfbus.stamps import LATEST, Stamps
from tfbus.tree._copied_paths import CopiedPath, PathsOverTime, Places, Query, copy_paths
from tfbus.tree._kernel import ONE_BY_ONE
from tfbus.tree._plain_columns import plain_columns
from tfbus.tree._segments import Floats, Segments
from tfbus.tree.extrapolation import read_stamps_at_many
from tfbus.tree.forest import Forest
from tfbus.tree.history import Samples
from tfbus.tree.lookup import answer, find, find_in_time_travel
from tfbus.tree.policy import Policy

_CHUNK = 2048

OutOfRange = Literal["raise", "nan"]


def lookup_many(
    forest: Forest,
    target: str,
    source: str,
    stamps: Stamps,
    source_stamps: Stamps | None,
    fixed: str | None,
    out_of_range: OutOfRange,
    policy: Policy | None,
) -> TransformArray:
    """The answers of `TransformTree.lookup_many`; `source_stamps` and `fixed` are given both or not at all."""
    check_out_of_range(out_of_range)
    queries = [Query(target, source, stamps)]
    if source_stamps is not None and fixed is not None:
        queries = [Query(target, fixed, stamps), Query(fixed, source, source_stamps)]
    for query in queries:
        forest.search(query.target, query.source)
    plain = plain_columns(forest, queries, out_of_range == "nan") if policy is None else None
    if plain is not None:
        return from_columns(plain[0] if len(plain) == 1 else np.stack(compose((*plain[0],), (*plain[1],))))
    if len(stamps) <= ONE_BY_ONE and policy is None:
        try:
            with forest.lock:
                rows = _rows_one_by_one(forest, target, source, stamps, source_stamps, fixed)
        except (ExtrapolationError, DisconnectedError):
            pass
        else:
            return from_rows(rows)

    def lookup_one(place: int) -> None:
        source_stamp = None if source_stamps is None else int(source_stamps[place])
        answer(forest, target, source, int(stamps[place]), source_stamp, fixed, None, policy)

    return _composed(_answers(forest, queries, lookup_one, policy, out_of_range))


def deskew(forest: Forest, cloud: PointCloud, target: str, fixed: str, out_of_range: OutOfRange) -> PointCloud:
    """The cloud of `TransformTree.deskew`."""
    if cloud.stamps is None:
        raise ValueError("the points of the cloud have no stamps")
    at = cloud.stamp
    if at is LATEST and len(cloud):
        at = int(cloud.stamps.max())
    check_out_of_range(out_of_range)
    target_from_fixed = answer(forest, target, fixed, at, None, None, None, None)
    query = Query(fixed, cloud.frame, cloud.stamps)
    plain = plain_columns(forest, [query], out_of_range == "nan")
    if plain is None:
        (answers,) = _answers(forest, [query], partial(_lookup_at, forest, query), None, out_of_range)
        chunks = answers.chunks()
    else:
        chunks = _chunks_of(plain[0])
    points = _applied(chunks, cloud.points, target_from_fixed.transform._row)
    return PointCloud(target, target_from_fixed.stamp, points, fields=cloud.fields)


def _chunks_of(columns: Floats) -> Iterator[tuple[Places, Columns]]:
    for start in range(0, columns.shape[1], _CHUNK):
        part = slice(start, start + _CHUNK)
        yield part, (*columns[:, part],)


def _applied(chunks: Iterable[tuple[Places, Columns]], points: npt.NDArray[Any], then: Row) -> npt.NDArray[Any]:
    """Points of shape (n, 3), each moved by the answer at its place and then by the transform `then`."""
    moved = np.full(points.shape, np.nan, points.dtype)
    # A sensor may send infinity where it saw nothing.
    with np.errstate(invalid="ignore"):
        for places, chunk in chunks:
            x, y, z = move(chunk, *points[places].T.astype(np.float64))
            if then != IDENTITY:
                x, y, z = move(then, x, y, z)
            for axis, values in enumerate((x, y, z)):
                moved[places, axis] = values
    return moved


def check_out_of_range(value: OutOfRange) -> None:
    """Raise `ValueError` unless the value is ``"raise"`` or ``"nan"``."""
    if value not in ("raise", "nan"):
        raise ValueError(f"out_of_range must be 'raise' or 'nan', not {value!r}")


def _rows_one_by_one(
    forest: Forest, target: str, source: str, stamps: Stamps, source_stamps: Stamps | None, fixed: str | None
) -> list[Row]:
    """The rows at a few stamps; errors as for the lookup at one stamp. The caller holds the lock."""
    path = forest.paths.find(target, source)
    if path is not None and source_stamps is None:
        return [path.row_at(at) for at in stamps.tolist()]
    for name in (target, source) if fixed is None else (target, source, fixed):
        forest.check_known(name)
    if source_stamps is None:
        return [find(forest, target, source, at, None)[1] for at in stamps.tolist()]
    both = zip(stamps.tolist(), source_stamps.tolist(), strict=True)
    return [find_in_time_travel(forest, target, source, at, then, fixed, None)[1] for at, then in both]


def _answers(
    forest: Forest,
    queries: list[Query],
    lookup_one: Callable[[int], object],
    policy: Policy | None,
    out_of_range: OutOfRange,
) -> list["Answers"]:
    """The answers of each query; `lookup_one` raises the error of a place without an answer."""
    spans = [query.span() for query in queries]
    while True:
        with forest.lock:
            copies = [copy_paths(forest, query, span) for query, span in zip(queries, spans, strict=True)]
        answers = [Answers(paths, query.stamps, policy) for paths, query in zip(copies, queries, strict=True)]
        missing = [found.first_missing for found in answers if found.first_missing is not None]
        if not missing:
            return answers
        unconnected = [query for found, query in zip(answers, queries, strict=True) if not found.connected]
        if out_of_range == "nan" and not unconnected:
            return answers
        first = min(missing)
        try:
            if out_of_range == "raise":
                lookup_one(first)
            else:
                _lookup_at(forest, unconnected[0], first)
        except TransformLookupError as error:
            error.index = first
            raise
        # The missing samples have arrived since the copies were made.


def _lookup_at(forest: Forest, query: Query, place: int) -> None:
    answer(forest, query.target, query.source, int(query.stamps[place]), None, None, None, None)


class Answers:
    """The answers at many stamps, computed chunk by chunk when they are read.

    Parameters
    ----------
    paths : PathsOverTime
    stamps : integer array of shape (n,)
        ns.
    policy : Policy or None

    Attributes
    ----------
    first_missing : int or None
        The first place without an answer.
    connected : bool
        Whether the frames are connected at any of the stamps, or there are no stamps.
    extrapolation : integer array of shape (2, n), or None
        `extrapolated_by` and `gap` of each answer, in ns; None without a policy.
    """

    def __init__(self, paths: PathsOverTime, stamps: Stamps, policy: Policy | None) -> None:
        self._count = len(stamps)
        self._parts: list[_Part] = []
        self.first_missing: int | None = None
        self.connected = not len(stamps)
        self.extrapolation = None if policy is None else np.zeros((2, len(stamps)), np.int64)
        for places, path in paths.split(stamps):
            here = stamps[places]
            if not len(here):
                continue
            if path is None:
                self._note_missing(places, np.zeros(len(here), np.bool_))
            else:
                self.connected = True
                self._add_part(places, here, path, policy)

    def columns(self) -> Floats:
        """All answers, shape (7, n); NaN where there is none."""
        columns = np.full((7, self._count), np.nan)
        for places, chunk in self.chunks():
            for column, values in zip(columns, chunk, strict=True):
                column[places] = values
        return columns

    def _add_part(self, places: Places, stamps: Stamps, path: CopiedPath, policy: Policy | None) -> None:
        """Note the answers along one path, and which of its stamps have none."""
        read_at = [stamps] * len(path.moving)
        if policy is None:
            answered = None if path.covers_all(stamps) else path.covered(stamps)
        else:
            answered, read_at, extrapolation = _read_with_policy(path, stamps, policy)
            assert self.extrapolation is not None
            self.extrapolation[:, places] = extrapolation
        if answered is not None and not answered.all():
            self._note_missing(places, answered)
            places = np.arange(self._count)[places][answered]
            read_at = [edge_stamps[answered] for edge_stamps in read_at]
            stamps = stamps[answered]
        if len(stamps):
            self._parts.append(_Part(places, len(stamps), path, read_at))

    def _note_missing(self, places: Places, answered: npt.NDArray[np.bool_]) -> None:
        first = int(np.arange(self._count)[places][answered.argmin()])
        self.first_missing = first if self.first_missing is None else min(first, self.first_missing)

    def chunks(self) -> Iterator[tuple[Places, Columns]]:
        """Places and the answers there, chunk by chunk."""
        for part in self._parts:
            yield from part.chunks()


class _Part:
    """The answers along one path.

    Parameters
    ----------
    places : Places
    count : int
    path : CopiedPath
    read_at : list of integer array of shape (count,)
        For each moving edge, the stamps at which it is read, in ns.
    """

    def __init__(self, places: Places, count: int, path: CopiedPath, read_at: list[Stamps]) -> None:
        self._places = places
        self._count = count
        self._path = path
        self._read_at = read_at

    def chunks(self) -> Iterator[tuple[Places, Columns]]:
        read_at = iter(self._read_at)
        up, down = (
            [Segments(step, next(read_at)) if isinstance(step, Samples) else step for step in steps]
            for steps in (self._path.up, self._path.down)
        )
        for start in range(0, self._count, _CHUNK):
            part = slice(start, min(start + _CHUNK, self._count))
            columns = _climb(up, part)
            if down:
                columns = compose(invert(_climb(down, part)), columns)
            yield part if isinstance(self._places, slice) else self._places[part], columns


def _climb(steps: Sequence[Segments | Row], part: slice) -> Columns:
    columns: Columns | None = None
    for step in steps:
        here = step.at(part) if isinstance(step, Segments) else step
        columns = here if columns is None else compose(here, columns)
    return IDENTITY if columns is None else columns


def _read_with_policy(
    path: CopiedPath, stamps: Stamps, policy: Policy
) -> tuple[npt.NDArray[np.bool_], list[Stamps], Stamps]:
    """A mask of the answered stamps, the stamps at which each edge is read, and (`extrapolated_by`, `gap`)."""
    answered = np.ones(len(stamps), np.bool_)
    read_at: list[Stamps] = []
    extrapolation = np.zeros((2, len(stamps)), np.int64)
    for samples in path.moving:
        edge_stamps, away, gap = read_stamps_at_many(samples, stamps, policy)
        read_at.append(edge_stamps)
        answered &= away >= 0
        np.maximum(extrapolation, (away, gap), out=extrapolation)
    extrapolation[:, ~answered] = 0
    return answered, read_at, extrapolation


def _composed(answers: list[Answers]) -> TransformArray:
    """The answers of one query, or of two that meet in a fixed frame."""
    columns = answers[0].columns()
    extrapolation = answers[0].extrapolation
    for found in answers[1:]:
        columns = np.stack(compose((*columns,), (*found.columns(),)))
        if extrapolation is not None and found.extrapolation is not None:
            extrapolation = np.maximum(extrapolation, found.extrapolation)
    return from_columns(columns, extrapolation)
