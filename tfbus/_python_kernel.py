"""The kernel in Python: samples, edges and paths, and the plain judgement, commit and answer.

This is the definition. ``tfbus/_c_kernel/`` does the same, with the same bits, and runs in its place where it could be
built. Both hand back a case that is not plain: the caller then decides, and raises the errors.

The samples are stored by column: stamps for `bisect`, and one 64-byte record a sample (stamp, translation, rotation),
from which an interpolation unpacks two neighbours in a single call. Samples older than the horizon do not count. They
are cut off later, many at once, because each cut moves all remaining samples.
"""

import struct
import time
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from math import acos, inf, sin, sqrt
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from tfbus.rows import IDENTITY, RawColumns, Row, Vector, compose, invert, rotate
from tfbus.stamps import STAMP_MAX, STAMP_MIN, Latest, Place, Stamps

SampleT = TypeVar("SampleT", bound="Sample")


class Sample:
    """The fields of a stamped transform; the base of `TransformStamped`."""

    # One slot, because the hot paths read all six fields at once.
    __slots__ = ("_fields",)
    _fields: tuple[str, str, int, Row, str, bool]
    _is_plain = True
    """Whether the class knows nothing that Python has to note. The kernel hands other samples back."""

    @property
    def parent(self) -> str:
        """The frame that the transform maps into; the target, in an answer."""
        return self._fields[0]

    @property
    def child(self) -> str:
        """The frame that the transform maps from; the source, in an answer."""
        return self._fields[1]

    @property
    def stamp(self) -> int:
        """Nanoseconds; never `LATEST`."""
        return self._fields[2]

    @property
    def _row(self) -> Row:
        return self._fields[3]

    @property
    def _square(self) -> float:
        x, y, z, _, _, _, _ = self._fields[3]
        return x * x + y * y + z * z

    @property
    def authority(self) -> str:
        """The sender; empty in an answer."""
        return self._fields[4]

    @property
    def static(self) -> bool:
        """Whether it holds at every stamp."""
        return self._fields[5]


class Edge:
    """The part of a frame's newest edge that the judge needs.

    Attributes
    ----------
    parent : str
    trusted : str or None
        The authority whose moving samples under this parent need no judgement; None if there is none.
    newest : int or None
        The newest stamp, in ns.
    late : bool
        Whether its stamps were already reported as behind the clock, so that they need no judgement.
    """

    __slots__ = ("late", "newest", "parent", "trusted")
    parent: str
    trusted: str | None
    newest: int | None
    late: bool


class Judge:
    """The plain judgement of batches by the newest edges of a bus.

    Parameters
    ----------
    edges : dict of str to Edge
        By child.
    square : float
        The greatest square of a translation, in m^2.

    Attributes
    ----------
    earliest, horizon : int
        The oldest stamp, except for late edges, and the newest stamp that are accepted, in ns. At first both are the
        least stamp.
    behind : int
        Number of accepted stamps that were older than `earliest`.
    """

    __slots__ = ("_edges", "_square", "_until", "behind", "earliest", "horizon")

    def __init__(self, edges: Mapping[str, Edge], square: float) -> None:
        self._edges = edges
        self._square = square
        self.earliest: int = STAMP_MIN
        self.horizon: int = STAMP_MIN
        self._until = STAMP_MAX
        self.behind: int = 0

    def allow(self, earliest: int, horizon: int, lasting: int, /) -> None:
        """Set `earliest` and `horizon` for `lasting` ns of the machine's time; after that, no batch is plain."""
        self.earliest, self.horizon = earliest, horizon
        self._until = min(time.monotonic_ns() + lasting, STAMP_MAX)

    def accepts(self, batch: Sequence[Sample]) -> bool:
        """Whether a whole batch continues known edges. If so, note the newest stamps; otherwise note nothing."""
        if self._until != STAMP_MAX and time.monotonic_ns() >= self._until:
            return False
        edges, square, earliest, horizon = self._edges, self._square, self.earliest, self.horizon
        for sample in batch:
            parent, child, stamp, row, authority, static = sample._fields
            if child not in edges:
                return False
            known = edges[child]
            if known.parent != parent or known.trusted != authority or static or stamp > horizon:
                return False
            if stamp < earliest and not known.late:
                return False
            # Three picks take less than an unpacking of all seven. Not `>`, which is false for NaN.
            x, y, z = row[0], row[1], row[2]
            if not x * x + y * y + z * z <= square:
                return False
        if len(batch) == 1:
            # The usual case; looking `known` up again costs a quarter of the first time.
            self.behind += stamp < earliest
            if known.newest is None or stamp > known.newest:
                known.newest = stamp
            return True
        for sample in batch:
            fields = sample._fields
            known = edges[fields[1]]
            self.behind += fields[2] < earliest
            if known.newest is None or fields[2] > known.newest:
                known.newest = fields[2]
        return True


class Parked:
    """The part of a parked lookup that a wake-up needs.

    Parameters
    ----------
    asked : tuple
        Target, source and stamp, and options. If all options are None, it is plain: the kernel may answer it.
    since : int
        The stamp at which the lookup began to wait, in ns.
    wake : callable
        Called once, without arguments, after it was taken out of its line.

    Attributes
    ----------
    names : tuple of str or None
        The frames that block it.
    place : tuple or None
        Its place in the line of the frame that blocks it, if it has one.
    limit : tuple or None
        Its place among the first limits of all lookups, if it has one.
    answer : TransformStamped or None
        The plain answer that the insertion found when it woke the lookup, if there was one.
    version : int
        The version of the paths that gave this answer.
    share : Share or None
        The part of the buffer that asks.
    patience : float
        How long it waits at most, in s.
    cancel_end : callable or None
        Cancels the alarm of its end, if it has one.
    elsewhere : bool
        Whether its wake-up has to remove it from more than its line, these limits and the dict of all parked lookups.
    """

    names: tuple[str, ...] | None = None
    place: Place | None = None
    limit: Place | None = None
    answer: Any = None
    version: int = 0
    share: Any = None
    patience: float = inf
    cancel_end: Callable[[], object] | None = None
    elsewhere: bool = False

    def __init__(self, asked: Any, since: int, wake: Callable[[], object]) -> None:
        self.asked = asked
        self.since = since
        self.wake = wake


class Line:
    """The parked lookups under one frame.

    Attributes
    ----------
    places : list of (-stamp, -order, Parked)
        The lookups that wait until the edge of the frame reaches a stamp (ns), sorted: the next one due is the last.
    for_any : dict of Parked to None
        The lookups that any sample wakes.
    limits : list of (-stamp, -order, Parked)
        The lookups that a sample beyond a stamp wakes, sorted.
    """

    __slots__ = ("for_any", "limits", "places")

    def __init__(self) -> None:
        self.places: list[Place] = []
        self.for_any: dict[Any, None] = {}
        self.limits: list[Place] = []


def compose_paths(rows: npt.NDArray[np.float64], origins: npt.NDArray[np.int64]) -> None:
    """Make every pose relative to the first one.

    Parameters
    ----------
    rows : contiguous array of shape (n, 7)
        Each pose relative to the pose at its origin; changed in place.
    origins : int64 array of shape (n,)
        The place of each origin, which comes before; 0 leaves a row as it is.

    Raises
    ------
    ValueError
        If an origin does not come before its row, or there is not one for each.
    """
    if len(rows) != len(origins):
        raise ValueError("each row of seven floats needs an origin before it")
    composed: list[Row] = list(map(tuple, rows.tolist()))
    for place, origin in enumerate(origins.tolist()):
        if origin and not 0 < origin < place:
            raise ValueError("each row of seven floats needs an origin before it")
        if origin:
            composed[place] = compose(composed[origin], composed[place])
    rows[:] = composed


compose_rows = compose
invert_row = invert


def move_point(row: Row, point: Any) -> Vector | None:
    """A point, as a tuple of three numbers, moved by a transform; None if it is not plain.

    It is plain as a tuple of ``float`` and ``int``, because numbers of numpy have their own arithmetic.
    """
    if type(point) is not tuple or len(point) != 3 or not {*map(type, point)} <= {float, int}:
        return None
    try:
        x, y, z = map(float, point)
    except OverflowError:
        return None
    rx, ry, rz = rotate(row[3:], x, y, z)
    return row[0] + rx, row[1] + ry, row[2] + rz


def fill_matrix(row: Row, out: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Write the homogeneous matrix of a row into an array of shape (4, 4), and return it: transforms3d's `quat2mat`."""
    tx, ty, tz, x, y, z, w = row
    s = 2.0 / (w * w + x * x + y * y + z * z)
    sx, sy, sz = x * s, y * s, z * s
    wx, wy, wz, xx, xy, xz = w * sx, w * sy, w * sz, x * sx, x * sy, x * sz
    yy, yz, zz = y * sy, y * sz, z * sz
    out[:] = (
        (1.0 - (yy + zz), xy - wz, xz + wy, tx),
        (xy + wz, 1.0 - (xx + zz), yz - wx, ty),
        (xz - wy, yz + wx, 1.0 - (xx + yy), tz),
        (0.0, 0.0, 0.0, 1.0),
    )
    return out


def move_points(row: Row, points: npt.NDArray[Any], out: npt.NDArray[Any]) -> bool:
    """Move points of shape (..., 3), which are contiguous and of the same float type as `out`.

    Returns
    -------
    bool
        Whether they were plain; here, they all are. The compiled kernel takes float64 and float32.
    """
    matrix = fill_matrix(row, np.empty((4, 4))).astype(out.dtype)
    x, y, z = np.moveaxis(points, -1, 0)
    with np.errstate(all="ignore"):
        for column, (mx, my, mz, shift) in enumerate(matrix[:3]):
            out[..., column] = x * mx + y * my + z * mz + shift
    return True


_NEARLY_RIGID = 1e-14


def row_of_matrix(matrix: npt.NDArray[np.float64]) -> Row | None:
    """The row of a contiguous homogeneous matrix, with qw >= 0; None if it is not finite and rigid but for rounding.

    Read as by Shepperd, "Quaternion from rotation matrix", 1978: the part of the quaternion with the greatest square
    comes first.
    """
    if matrix.shape != (4, 4) or not matrix.flags.c_contiguous:
        return None
    (a, b, c, x), (d, e, f, y), (g, h, i, z), last = rows = matrix.tolist()
    if last != [0.0, 0.0, 0.0, 1.0] or (x + y + z) * 0.0 != 0.0:
        return None
    for k in range(3):
        for n in range(k, 3):
            one, other = rows[k], rows[n]
            off = one[0] * other[0] + one[1] * other[1] + one[2] * other[2] - (1.0 if k == n else 0.0)
            if not -_NEARLY_RIGID <= off <= _NEARLY_RIGID:
                return None
    if not a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0.0:
        return None
    squares = 1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i, 1.0 + a + e + i
    first = max(3, 0, 1, 2, key=squares.__getitem__)
    xy, xz, yz, xw, yw, zw = d + b, g + c, h + f, h - f, c - g, d - b
    products = (
        (squares[0], xy, xz, xw),
        (xy, squares[1], yz, yw),
        (xz, yz, squares[2], zw),
        (xw, yw, zw, squares[3]),
    )
    i, j, k, w = products[first]
    length = sqrt(i * i + j * j + k * k + w * w)
    scale = -length if w < 0.0 else length
    return x, y, z, i / scale, j / scale, k / scale, w / scale


_RECORD = struct.Struct("q7d")
_SIZE = _RECORD.size
_FOREVER = 2**64
_pack = _RECORD.pack
_unpack = _RECORD.unpack_from
_unpack_pair = struct.Struct("q7dq7d").unpack_from


class History:
    """The moving samples of one edge in its window, in the order of their stamps. The oldest has the index 0.

    Parameters
    ----------
    parent : str
    keep : int or None
        Length of the window before the newest stamp, in ns; None keeps everything.

    Attributes
    ----------
    parent, authority : str
        Of the newest sample.
    mixed : bool
        Whether the samples name several parents. Then no answer is plain.
    static_stamp : int or None
        The stamp of the sample that holds at every stamp, in ns; None if there is none.
    horizon : int
        Samples with a stamp before this one, in ns, have left the window.
    stamps : array of int
    records : bytearray
        Samples that have left the window stay until the next cut.
    """

    __slots__ = ("_cut_after", "_keep", "authority", "horizon", "mixed", "parent", "records", "stamps", "static_stamp")

    def __init__(self, parent: str, keep: int | None) -> None:
        self.parent: str = parent
        self.authority: str = ""
        self.mixed: bool = False
        self.static_stamp: int | None = None
        self.stamps: array[int] = array("q")
        self.records: bytearray = bytearray()
        self.horizon: int = STAMP_MIN
        self._keep = _FOREVER if keep is None else keep
        self._cut_after = STAMP_MIN

    @property
    def _start(self) -> int:
        return bisect_left(self.stamps, self.horizon)

    @property
    def keep(self) -> int | None:
        """Length of the window in ns, or None."""
        return None if self._keep == _FOREVER else self._keep

    @keep.setter
    def keep(self, keep: int | None) -> None:
        self._cut()
        self._keep = _FOREVER if keep is None else keep
        self._settle()
        self._cut()

    @property
    def count(self) -> int:
        """The number of samples in the window."""
        return len(self.stamps) - self._start

    @property
    def oldest(self) -> int | None:
        """The oldest stamp in the window, in ns; None if there is no moving sample."""
        return self.stamps[self._start] if self.stamps else None

    @property
    def newest(self) -> int | None:
        """The newest stamp, in ns; None if there is no moving sample."""
        return self.stamps[-1] if self.stamps else None

    @property
    def newest_record(self) -> bytes:
        """The newest stamp (int64, ns) and its row (seven float64), 64 bytes; empty if there is no moving sample."""
        return bytes(self.records[-_SIZE:])

    def append(self, parent: str, stamp: int, row: Row, authority: str) -> bool:
        """Store a sample if it is newer and has the same parent and authority, as usual; otherwise do nothing."""
        stamps = self.stamps
        # The horizon goes with the newest stamp, which takes longer to read.
        horizon = stamp - self._keep
        if not stamps or horizon <= self.horizon or parent != self.parent or authority != self.authority or self.mixed:
            return False
        # Spelt out, because `*row` would build a list of the arguments first.
        x, y, z, qx, qy, qz, qw = row
        record = _pack(stamp, x, y, z, qx, qy, qz, qw)
        self.records += record
        try:
            stamps.append(stamp)
        except BaseException:
            self._settle()
            raise
        self.horizon = horizon
        if stamp > self._cut_after:
            self._cut()
        return True

    def push(self, stamp: int, row: Row) -> None:
        """Store a sample that is newer than all others."""
        self._add(_pack(stamp, *row), array("q", (stamp,)).tobytes())

    def push_many(self, stamps: Stamps, rows: npt.NDArray[np.float64]) -> None:
        """Store samples that are newer than all others, from contiguous arrays of shape (n,) and (n, 7).

        Raises
        ------
        ValueError
            If their stamps do not ascend, or there is not one row for each.
        """
        if rows.size != 7 * len(stamps):
            raise ValueError("each stamp needs a row of seven floats")
        if not len(stamps):
            return
        if (self.stamps and self.stamps[-1] >= stamps[0]) or not (stamps[1:] > stamps[:-1]).all():
            raise ValueError("pushed samples must be newer than all others, and in order")
        records = np.empty((len(stamps), 8))
        records[:, 0] = stamps.view(np.float64)
        records[:, 1:] = rows
        self._add(records.data.cast("B"), stamps.tobytes())

    def put(self, index: int, stamp: int, row: Row) -> None:
        """Store a sample before the sample at an index, or in its place if both have the same stamp."""
        record = _pack(stamp, *row)
        at = self._start + index
        replaces = self.stamps[at] == stamp
        self.records[at * _SIZE : (at + replaces) * _SIZE] = record
        if not replaces:
            try:
                self.stamps.insert(at, stamp)
            except BaseException:
                if len(self.records) > len(self.stamps) * _SIZE:
                    del self.records[at * _SIZE : (at + 1) * _SIZE]
                raise

    def find(self, stamp: int) -> int:
        """The index of the first sample that is not before a stamp; `count` if there is none."""
        start = self._start
        return bisect_left(self.stamps, stamp, start) - start

    def between(self, low: int, high: int) -> tuple[int, int]:
        """The index of the last sample up to stamp `low`, and the index behind the first sample from stamp `high` on.

        If there is no such sample, the index of the first sample, and the end of all.
        """
        stamps, start = self.stamps, self._start
        first = bisect_right(stamps, low, start) - 1
        end = bisect_left(stamps, high, start) + 1
        return max(first - start, 0), min(end, len(stamps)) - start

    def stamp(self, index: int) -> int:
        """The stamp of a sample, in ns; raises as `sample` does."""
        at = self._start + index
        if index < 0 or at >= len(self.stamps):
            raise IndexError("no sample has this index")
        return self.stamps[at]

    def sample(self, index: int) -> tuple[int, Row]:
        """The stamp and the row of a sample.

        Raises
        ------
        IndexError
            If there is no sample with this index.
        """
        stamp = self.stamp(index)
        _, x, y, z, qx, qy, qz, qw = _unpack(self.records, (self._start + index) * _SIZE)
        return stamp, (x, y, z, qx, qy, qz, qw)

    def row(self, at: int) -> Row | None:
        """The row at a stamp; None if it is not plain."""
        return climb((self,), at)

    def clear(self) -> None:
        """Forget all samples."""
        self.stamps, self.records = array("q"), bytearray()
        self.horizon = STAMP_MIN
        self._cut_after = STAMP_MIN

    def take(self, other: "History") -> None:
        """Hold a copy of the samples in the window of another history."""
        start = other._start
        self.stamps, self.records = other.stamps[start:], other.records[start * _SIZE :]
        self._settle()
        self._cut_after = other._cut_after

    def columns(self, first: int, end: int, wanted: Stamps | None = None) -> RawColumns:
        """The memory of the samples from one index to another, which nothing changes while it is held.

        Samples that are not next to a `wanted` stamp (ns) may be left out.
        """
        start = self._start
        begin, end = start + first, min(start + end, len(self.stamps))
        if wanted is None:
            stamps, records = self.stamps[begin:end], self.records[begin * _SIZE : end * _SIZE]
            return stamps, 0, records, 0, 8, len(stamps)
        # The views on the history end with each line, because a history that is being viewed cannot grow.
        after = np.frombuffer(self.stamps, np.int64)[begin:end].searchsorted(wanted, "right")
        places = begin + np.unique(np.concatenate((after - 1, after)).clip(0, end - begin - 1))
        own = np.frombuffer(self.stamps, np.int64)[places]
        rows = np.frombuffer(self.records, np.uint8).reshape(-1, _SIZE)[places]
        return own, 0, rows, 0, 8, len(places)

    def _add(self, records: bytes | memoryview, stamps: bytes) -> None:
        """Store samples that are newer than all others, from the memory of both."""
        self.records += records
        try:
            self.stamps.frombytes(stamps)
        finally:
            self._settle()
        if self.stamps[-1] > self._cut_after:
            self._cut()

    def _settle(self) -> None:
        """Set the horizon, and drop surplus records, which a lack of memory or Ctrl-C may have left without a stamp."""
        del self.records[len(self.stamps) * _SIZE :]
        self.horizon = self.stamps[-1] - self._keep if self.stamps else STAMP_MIN

    def _cut(self) -> None:
        """Cut off the samples that have left the window, and not again before 1/16 of it has passed."""
        start = self._start
        # Without memory the samples count as before, and the next one tries again.
        with suppress(MemoryError):
            self.stamps, self.records = self.stamps[start:], self.records[start * _SIZE :]
        if self.stamps:
            self._cut_after = self.stamps[0] + self._keep + self._keep // 16


Step = History | Row
"""A moving edge, or the row of a run of static edges."""


def climb(steps: tuple[Step, ...], at: int) -> Row | None:
    """The first step's child, seen from the last step's parent, at a stamp; None if an edge has no plain answer.

    It interpolates each edge and composes the results, by the formulas of `tfbus.rows` and with the same bits. It is
    one loop, because a function call or a small array for each edge would cost more than its arithmetic.
    """
    if not steps:
        return IDENTITY
    first = True
    step: Any
    for step in steps:
        # Not by `isinstance`, which takes longer.
        if type(step) is not tuple:
            stamps = step.stamps
            i = bisect_left(stamps, at)
            try:
                s0, ax, ay, az, ai, aj, ak, aw, s1, bx, by, bz, bi, bj, bk, bw = _unpack_pair(
                    step.records, i * _SIZE - _SIZE
                )
            except struct.error:
                # No two samples surround the first stamp, or a stamp beyond the last.
                if i or not stamps or at != stamps[0] or at < step.horizon or step.mixed:
                    return None
                _, ax, ay, az, ai, aj, ak, aw = _unpack(step.records)
            else:
                if step.mixed or (s0 < step.horizon and not at == s1 >= step.horizon):
                    return None
                if at == s1:
                    ax, ay, az, ai, aj, ak, aw = bx, by, bz, bi, bj, bk, bw
                else:
                    f = (at - s0) / (s1 - s0)
                    ax += f * (bx - ax)
                    ay += f * (by - ay)
                    az += f * (bz - az)
                    dot = ai * bi + aj * bj + ak * bk + aw * bw
                    if -1.0 < dot < 1.0:
                        angle = acos(dot if dot > 0.0 else -dot)
                        scale = 1.0 / sqrt((1.0 - dot) * (1.0 + dot))
                        keep = sin(angle - f * angle) * scale
                        turn = sin(f * angle) * scale
                    else:
                        keep = 1.0 - f
                        turn = f
                    if dot < 0.0:
                        turn = -turn
                    ai = keep * ai + turn * bi
                    aj = keep * aj + turn * bj
                    ak = keep * ak + turn * bk
                    aw = keep * aw + turn * bw
        else:
            ax, ay, az, ai, aj, ak, aw = step
        if first:
            x, y, z, qx, qy, qz, qw = ax, ay, az, ai, aj, ak, aw
            first = False
        else:
            tx = 2.0 * (aj * z - ak * y)
            ty = 2.0 * (ak * x - ai * z)
            tz = 2.0 * (ai * y - aj * x)
            x = ax + (x + aw * tx + aj * tz - ak * ty)
            y = ay + (y + aw * ty + ak * tx - ai * tz)
            z = az + (z + aw * tz + ai * ty - aj * tx)
            turned_x = aw * qx + ai * qw + aj * qz - ak * qy
            turned_y = aw * qy - ai * qz + aj * qw + ak * qx
            turned_z = aw * qz + ai * qy - aj * qx + ak * qw
            qw = aw * qw - ai * qx - aj * qy - ak * qz
            qx = turned_x
            qy = turned_y
            qz = turned_z
    return x, y, z, qx, qy, qz, qw


class Chain:
    """The edges between two frames.

    Attributes
    ----------
    up, down : tuple of steps
        From source, and from target, to their common ancestor: moving edges, and one row for each run of static edges.
    alone : bool
        Whether no other way between the two frames counts at any stamp, as the forest has found out.

    Parameters
    ----------
    up, down
    statics : tuple of History
        The static edges.
    """

    __slots__ = ("_edges", "_statics", "alone", "down", "up")

    def __init__(self, up: tuple[Step, ...], down: tuple[Step, ...], statics: tuple[History, ...]) -> None:
        self.up: tuple[Step, ...] = up
        self.down: tuple[Step, ...] = down
        self._statics = statics
        self.alone: bool = False
        self._edges = tuple(step for step in (*up, *down) if isinstance(step, History))

    def row(self, at: int) -> Row | None:
        """The row of source in target at a stamp; None if it is not plain."""
        up = climb(self.up, at)
        if not self.down or up is None:
            return up
        down = climb(self.down, at)
        return None if down is None else compose(invert(down), up)

    def latest(self) -> int | None:
        """The stamp that `LATEST` means, in ns; None if a moving edge has no samples, or there is no edge.

        It is the newest one that all moving edges have reached; if nothing moves, the newest of the static samples.
        """
        if not self._edges:
            return max((edge.static_stamp or 0 for edge in self._statics), default=None)
        common = STAMP_MAX
        for edge in self._edges:
            if not edge.stamps:
                return None
            if edge.stamps[-1] < common:
                common = edge.stamps[-1]
        return common

    def covers(self, at: int) -> bool:
        """Whether the samples of every moving edge cover a stamp."""
        return all(edge.stamps and edge.stamps[edge._start] <= at <= edge.stamps[-1] for edge in self._edges)

    def deciding(self, at: int) -> History | None:
        """The edge whose error counts at a stamp that is not covered; None if nothing moves.

        It is the first edge that has dropped the stamp, else the one that lags most.
        """
        lagging, reached = (self._edges[0] if self._edges else None), STAMP_MAX
        for edge in self._edges:
            oldest, newest = edge.oldest, edge.newest
            if oldest is not None and newest is not None and newest >= at:
                if oldest > at:
                    return edge
            elif (came_to := STAMP_MIN if newest is None else newest) < reached:
                lagging, reached = edge, came_to
        return lagging

    def hold(self) -> Any:
        """The present samples of all edges, for answers at many stamps. Here None: numpy reads copies."""
        return None


class Paths:
    """The paths that were asked for lately, and their plain answers.

    Parameters
    ----------
    lock : threading.Lock
        The code that changes a history or a path holds it.
    latest : Latest
    kind : type
        The class of an answer.

    Attributes
    ----------
    recent : dict
        ``{target: {source: Chain}}``. Each chain must hold at every stamp that it covers.
    inserted : int
        Number of samples at new stamps.
    version : int
        A number that differs after each change.
    now : callable or None
        The clock that ages are counted from, which gives a stamp in ns.
    qualified : type or None
        The class of an answer with a policy. Only the compiled kernel gives such answers, and answers by age.
    clock_namers : list or None
        The `_clock_namers` of the errors that the compiled kernel raises.
    """

    __slots__ = ("_changes", "_kind", "_latest", "_lock", "clock_namers", "inserted", "now", "qualified", "recent")

    def __init__(self, lock: AbstractContextManager[Any], latest: Latest, kind: Any) -> None:
        self._lock = lock
        self._latest = latest
        self._kind = kind
        self.recent: dict[str, dict[str, Chain]] = {}
        self.inserted: int = 0
        self.now: Any = None
        self.qualified: Any = None
        self.clock_namers: Any = None
        self._changes = 0

    @property
    def version(self) -> int:
        """Computed when read: counting would cost every sample time, and only a woken waiter reads it."""
        return self.inserted + self._changes

    @version.setter
    def version(self, version: int) -> None:
        self._changes = version - self.inserted

    def _chain(self, target: str, source: str) -> Chain | None:
        """The chain of `recent` between two frames, if it has edges."""
        by_source = self.recent.get(target)
        chain = None if by_source is None else by_source.get(source)
        return chain if chain is not None and (chain.up or chain.down) else None

    def answer(self, target: str, source: str, at: object) -> Any:
        """The answer of a lookup, if it needs nothing but a path of `recent` that covers the stamp; else None."""
        with self._lock:
            chain = self._chain(target, source)
            if chain is None:
                return None
            stamp = chain.latest() if at is self._latest else at
            if type(stamp) is not int or not (chain._edges or STAMP_MIN <= stamp <= STAMP_MAX):
                return None
            row = chain.row(stamp) if chain.down else climb(chain.up, stamp)
            if row is None:
                return None
        kind = self._kind
        sample = kind.__new__(kind)
        sample._fields = target, source, stamp, row, "", not chain._edges
        return sample

    def can_answer(self, target: str, source: str, at: object) -> bool | None:
        """Whether a lookup has an answer, if a path of `recent` tells; else None."""
        with self._lock:
            chain = self._chain(target, source)
            if chain is None:
                return None
            stamp = chain.latest() if at is self._latest else at
            if stamp is None and at is not None:
                return False
            if type(stamp) is not int or not STAMP_MIN <= stamp <= STAMP_MAX:
                return None
            covered = chain.covers(stamp)
            return covered if covered or chain.alone else None

    def commit(self, frames: Mapping[str, History], readers: Mapping[int, Any], batch: Sequence[Sample]) -> bool:
        """Store a batch if all of it continues its histories and there are no readers to notify; else do nothing.

        Here only a batch of one sample is stored.
        """
        if len(batch) != 1:
            return False
        parent, child, stamp, row, authority, static = batch[0]._fields
        with self._lock:
            if readers or static or child not in frames or not batch[0]._is_plain:
                return False
            if not frames[child].append(parent, stamp, row, authority):
                return False
            self.inserted += 1
        return True


def decode(
    body: bytes,  # noqa: ARG001
    at: int,
    tags: tuple[tuple[str, bool], ...],  # noqa: ARG001
    names: Mapping[bytes, tuple[str, str]],  # noqa: ARG001
    kind: type[SampleT],  # noqa: ARG001
) -> tuple[list[SampleT], int]:
    """The samples of a little endian message from an offset on, up to the first that is not plain, and its offset.

    A sample is plain if its names are known and its numbers need no correction. Here none is: `tfbus.tf_message`
    decodes them all.
    """
    return [], at


def decode_whole(
    tags: tuple[tuple[str, bool]],  # noqa: ARG001
    names: Mapping[bytes, tuple[str, str]],  # noqa: ARG001
    kind: type[SampleT],  # noqa: ARG001
    most: int,  # noqa: ARG001
    payload: bytes,  # noqa: ARG001
) -> tuple[SampleT, ...] | None:
    """The samples of a little endian message of at most `most` bytes with its header, if all are plain; else None.

    There is one tag for all. Here none is plain, as in `decode`.
    """
    return None


def columns(
    parents: str | tuple[str, ...],  # noqa: ARG001
    children: str | tuple[str, ...],  # noqa: ARG001
    stamps: Stamps,  # noqa: ARG001
    rows: npt.NDArray[np.float64],  # noqa: ARG001
    authority: str,  # noqa: ARG001
    static: bool,  # noqa: ARG001
    square: float,  # noqa: ARG001
) -> Any:
    """The rows of some columns as a batch, if all are plain; their quaternions are normalised in place.

    A row is plain if its names can name two frames, its quaternion is a unit quaternion within 1 %, and the square of
    its translation, in m^2, is at most `square`. Here none is: `tfbus.geometry.columns` makes a sample of each.
    """
    return None


def commit(frames: Mapping[str, History], batch: Sequence[Sample], first: int) -> int:
    """Store the samples of a batch from the index `first` on, up to the first that does not continue its history.

    Returns
    -------
    int
        Its index; the length of the batch if all were stored.
    """
    for i in range(first, len(batch)):
        parent, child, stamp, row, authority, static = batch[i]._fields
        if static or child not in frames or not batch[i]._is_plain:
            return i
        if not frames[child].append(parent, stamp, row, authority):
            return i
    return len(batch)
