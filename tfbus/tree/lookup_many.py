"""Lookups at many stamps at once.

While the forest is locked, `copy_paths` finds the paths that hold between the first stamp and the last, and copies the
samples on them: as blocks of memory, or only the samples next to a stamp where there are many more samples than stamps.
The compiled kernel copies nothing, because references to its blocks are enough. All other work in numpy comes after
that, in chunks that stay in the cache.

`Segments` interpolates one edge. It prepares each segment between two samples once, so that a stamp costs one search,
one sine and one cosine; with fewer stamps than samples it prepares only the segments that are needed.

If a stamp has no answer, a single lookup at that stamp raises the error, so both kinds of lookup raise the same error.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from tfbus.data import PointCloud
from tfbus.errors import DisconnectedError, TransformLookupError
from tfbus.geometry.transform_array import TransformArray, from_columns, move
from tfbus.rows import IDENTITY, Columns, Row, compose, invert
from tfbus.stamps import LATEST, Latest, Stamps
from tfbus.tree.cycles import edges_above
from tfbus.tree.forest import Forest, Path, Step
from tfbus.tree.history import FrameHistory, Samples
from tfbus.tree.lookup import Policy, answer, read_stamps_at_many
from tfbus.which_kernel import kernel

Floats = npt.NDArray[np.float64]

_STRAIGHT = 1e-9
"""Replaces an angle that rounds to zero. Its cosine is one to the last digit, so the arc is a straight line."""


class Segments:
    """The segments of one edge, prepared for interpolation at given stamps.

    A segment goes from one sample to the next: ``t(s) = t0 + s v`` and ``q(s) = q0 cos(s w) + p sin(s w)``, with s the
    ns since its first sample, and p the unit quaternion a right angle away from q0 on the shorter arc to the next
    rotation. That is slerp with its two sines resolved (Shoemake 1985, section 3.3). The segment that begins at the
    last sample, or at the last sample before a change of parent, is constant.
    """

    def __init__(self, samples: Samples, stamps: Stamps) -> None:
        own_stamps, rows = samples.stamps, samples.rows
        self._segments: npt.NDArray[np.intp] | None = own_stamps.searchsorted(stamps, "right") - 1
        self._elapsed = nanoseconds(own_stamps[self._segments], stamps)
        first = np.arange(len(own_stamps))
        if len(stamps) < len(own_stamps):
            first, self._segments = self._segments, None
        last = np.minimum(first + 1, len(own_stamps) - 1)
        if samples.parents is not None:
            parents = np.array(samples.parents, object)
            last = np.where(parents[first] == parents[last], last, first)
        a, b = rows[first].T, rows[last].T
        duration = nanoseconds(own_stamps[first], own_stamps[last])
        duration[first == last] = np.inf
        dot = (a[3:] * b[3:]).sum(axis=0)
        cosine = np.minimum(np.abs(dot), 1.0)
        angle = np.maximum(np.arccos(cosine), _STRAIGHT)
        sine = np.sin(angle)
        self._table = np.empty((15, len(first)))
        self._table[:7] = a
        self._table[7:10] = (b[:3] - a[:3]) / duration
        self._table[10:14] = (np.where(dot < 0.0, -b[3:], b[3:]) - cosine * a[3:]) / sine
        self._table[14] = angle / duration

    def at(self, part: slice) -> Columns:
        """The transforms at some of the stamps."""
        segments = self._segments
        table = self._table[:, part] if segments is None else self._table.take(segments[part], axis=1)
        elapsed = self._elapsed[part]
        angle = elapsed * table[14]
        moved = table[:3] + elapsed * table[7:10]
        turned = table[3:7] * np.cos(angle) + table[10:14] * np.sin(angle)
        return (*moved, *turned)


def nanoseconds(begin: Stamps, end: Stamps) -> Floats:
    """The time between two stamps; exact for differences that exceed a signed 64-bit integer."""
    return (end - begin).view(np.uint64).astype(np.float64)


Places = slice | npt.NDArray[np.intp]
"""Indices into the stamps that were asked for."""


class Query(NamedTuple):
    """The question where `source` is, seen from `target`, at many stamps."""

    target: str
    source: str
    stamps: Stamps

    def span(self) -> tuple[int, int] | None:
        """The first and the last stamp, in ns; None if there are none."""
        return (int(self.stamps.min()), int(self.stamps.max())) if len(self.stamps) else None


class CopiedPath(NamedTuple):
    """A path with copies of the samples on its moving edges, and one row for each run of static edges."""

    up: tuple[Samples | Row, ...]
    down: tuple[Samples | Row, ...]

    @property
    def moving(self) -> list[Samples]:
        """The moving edges, first the edges of `up`."""
        return [step for step in (*self.up, *self.down) if isinstance(step, Samples)]

    def covers_all(self, stamps: Stamps) -> bool:
        """Whether each edge covers every one of the stamps."""
        low, high = stamps.min(), stamps.max()
        return all(len(edge.stamps) and edge.stamps[0] <= low and high <= edge.stamps[-1] for edge in self.moving)

    def covered(self, stamps: Stamps) -> npt.NDArray[np.bool_]:
        """A mask of the stamps that all edges cover, shape (n,)."""
        covered = np.ones(len(stamps), np.bool_)
        for samples in self.moving:
            if not len(samples.stamps):
                covered[:] = False
            else:
                covered &= (samples.stamps[0] <= stamps) & (stamps <= samples.stamps[-1])
        return covered


class PathsOverTime(NamedTuple):
    """The paths between two frames over some time.

    Attributes
    ----------
    changes : list of int
        The stamps, in ns, at which the path may change.
    paths : list of (CopiedPath or None)
        The path before the first change, and the one from each change on; None where the frames are not connected.
    """

    changes: list[int]
    paths: list[CopiedPath | None]

    def split(self, stamps: Stamps) -> list[tuple[Places, CopiedPath | None]]:
        """The places of the stamps that each path answers."""
        if not self.changes:
            return [(slice(len(stamps)), self.paths[0])]
        different = list({id(path): path for path in self.paths}.values())
        number = np.array([next(i for i, other in enumerate(different) if other is path) for path in self.paths])
        numbers = number[np.array(self.changes, np.int64).searchsorted(stamps, "right")]
        return [(np.flatnonzero(numbers == i), path) for i, path in enumerate(different)]


def copy_paths(forest: Forest, query: Query, span: tuple[int, int] | None) -> PathsOverTime:
    """Copy the paths from source to target that hold at the stamps of a query. The caller holds the lock.

    Parameters
    ----------
    forest : Forest
    query : Query
    span : (int, int) or None
        The first and the last of its stamps, in ns; None if there are none.

    Raises
    ------
    UnknownFrameError
    """
    target, source = query.target, query.source
    forest.check_known(target)
    forest.check_known(source)
    if span is None:
        return PathsOverTime([], [None])
    low, high = span
    paths: list[Path | None] = [_path_at(forest, target, source, low)]
    changes = _changes(forest, target, source, paths[0], low, high)
    paths += [_path_at(forest, target, source, stamp) for stamp in changes]
    copies: dict[tuple[tuple[Step, ...], tuple[Step, ...]], CopiedPath] = {}
    for path in paths:
        if path is not None and (path.up, path.down) not in copies:
            up = tuple(_copy(step, query, low, high) for step in path.up)
            down = tuple(_copy(step, query, low, high) for step in path.down)
            copies[path.up, path.down] = CopiedPath(up, down)
    return PathsOverTime(changes, [None if path is None else copies[path.up, path.down] for path in paths])


def _changes(forest: Forest, target: str, source: str, path: Path | None, low: int, high: int) -> list[int]:
    """The stamps after `low`, up to `high`, at which the path may change."""
    if path is not None and path.permanent and path.root not in forest.frames:
        return []
    edges = edges_above(forest.frames, (target, source)).values()
    if not any(edge.mixed for edge in edges):
        return []
    # A loop of parents has two ways round: the way whose samples cover the stamp counts.
    changes = {stamp for edge in edges for stamp in edge.beginnings()}
    changes.update(edge.newest + 1 for edge in edges if edge.newest is not None)
    return sorted(stamp for stamp in changes if low < stamp <= high)


def _path_at(forest: Forest, target: str, source: str, at: int) -> Path | None:
    try:
        return forest.find_path(target, source, at)
    except DisconnectedError:
        return None


def _copy(step: Step, query: Query, low: int, high: int) -> Samples | Row:
    if not isinstance(step, FrameHistory):
        return step
    return step.samples_between(low, high, query.stamps)


def plain_columns(forest: Forest, queries: Sequence[Query], with_nan: bool) -> list[Floats] | None:
    """The answers of each query as columns of shape (7, n), with the bits of a lookup at each stamp.

    All are of one moment. The lock is held for no more than taking references to the samples.

    Parameters
    ----------
    forest : Forest
    queries : sequence of Query
    with_nan : bool
        Whether a stamp without an answer gives NaN.

    Returns
    -------
    list of array, or None
        None if the kernel cannot answer many stamps, an answer is not plain, or one is missing without `with_nan`.
    """
    if kernel == "python":
        # Its chains have no `hold`: do not search for the paths first.
        return None
    snapshots: list[Any] = []
    try:
        with forest.lock:
            for target, source, _ in queries:
                path = forest.find_path(target, source, LATEST)
                samples = path.hold() if path.permanent else None
                if samples is None:
                    return None
                # A stamp that this path does not cover may have an answer on another way round a loop of parents.
                with_nan = with_nan and path.root not in forest.frames
                snapshots.append(samples)
    except TransformLookupError:
        return None
    found: list[Floats] = []
    for samples, (_, _, stamps) in zip(snapshots, queries, strict=True):
        columns = np.empty((7, len(stamps)))
        missing = samples.rows(np.ascontiguousarray(stamps), columns)
        if missing is None or (missing >= 0 and not with_nan):
            return None
        found.append(columns)
    return found


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

    def lookup_one(place: int) -> None:
        source_stamp = None if source_stamps is None else int(source_stamps[place])
        answer(forest, target, source, int(stamps[place]), source_stamp, fixed, None, policy)

    return _composed(_answers(forest, queries, lookup_one, policy, out_of_range))


def deskew_stamps(cloud: PointCloud) -> tuple[int | Latest, Stamps]:
    """The stamp at which a cloud is put into the target, and the stamps of its points; in ns.

    Raises
    ------
    TypeError
        If it is no cloud.
    ValueError
        If the points have no stamps.
    """
    if not isinstance(cloud, PointCloud):
        hint = ": a scan becomes one by to_points()" if hasattr(cloud, "to_points") else ""
        raise TypeError(f"deskew takes a PointCloud, not a {type(cloud).__name__}{hint}")
    if cloud.stamps is None:
        raise ValueError("the points of the cloud have no stamps")
    at = cloud.stamp
    return (int(cloud.stamps.max()) if at is LATEST and len(cloud) else at), cloud.stamps


def deskew(
    forest: Forest, cloud: PointCloud, target: str, fixed: str, out_of_range: OutOfRange, policy: Policy | None
) -> PointCloud:
    """The cloud of `TransformTree.deskew`."""
    at, stamps = deskew_stamps(cloud)
    check_out_of_range(out_of_range)
    target_from_fixed = answer(forest, target, fixed, at, None, None, None, policy)
    query = Query(fixed, cloud.frame, stamps)
    plain = plain_columns(forest, [query], out_of_range == "nan") if policy is None else None
    if plain is None:
        (answers,) = _answers(forest, [query], partial(_lookup_at, forest, query, policy=policy), policy, out_of_range)
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


def _lookup_at(forest: Forest, query: Query, place: int, policy: Policy | None = None) -> None:
    answer(forest, query.target, query.source, int(query.stamps[place]), None, None, None, policy)


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
        self.connected: bool = not len(stamps)
        self.extrapolation: npt.NDArray[np.int64] | None = (
            None if policy is None else np.zeros((2, len(stamps)), np.int64)
        )
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
