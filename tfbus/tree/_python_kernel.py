"""The kernel in Python: the samples of an edge, the edges of a path, the plain answer and the plain commit.

This is the definition. ``tfbus/_kernel.c`` does the same, with the same bits, and runs in its place where it could be
built. Both hand back whatever is not plain: the caller then decides, and raises what is to be raised.

The samples are stored by column: stamps for `bisect`, and one 64-byte record a sample (stamp, translation, rotation),
from which an interpolation unpacks two neighbours in a single call. Samples older than the horizon do not count. They
are cut off later, many at once, because each cut moves all remaining samples.
"""

import struct
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Mapping
from contextlib import AbstractContextManager, suppress
from itertools import chain as chained
from math import acos, sin, sqrt
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from tfbus.geometry.rows import IDENTITY, Row, compose, invert
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.stamps import STAMP_MAX, STAMP_MIN, Latest, Stamps, StampsLike, as_stamps

_RECORD = struct.Struct("q7d")
_SIZE = _RECORD.size
_FOREVER = 2**64
ONE_BY_ONE = 40
"""Up to this many stamps are answered faster one by one than by numpy."""
_pack = _RECORD.pack
_unpack = _RECORD.unpack_from
_unpack_pair = struct.Struct("q7dq7d").unpack_from

Columns = tuple[Any, int, Any, int, int, int]
"""A buffer and the byte at which stamps begin in it; a buffer and the byte at which rows begin; their width, the number
of floats from one row to the next, of which the last seven are the row; and the number of samples."""


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
        Whether the samples name several parents. Then nothing about them is plain.
    horizon : int
        Samples with a stamp before this one, in ns, have left the window.
    stamps : array of int
    records : bytearray
        Those that were cut off are gone; those that have left the window may still be there.
    """

    __slots__ = ("_cut_after", "_keep", "authority", "horizon", "mixed", "parent", "records", "stamps")

    def __init__(self, parent: str, keep: int | None) -> None:
        self.parent = parent
        self.authority = ""
        self.mixed = False
        self.stamps = array("q")
        self.records = bytearray()
        self.horizon = STAMP_MIN
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
        """The newest stamp (int64, ns) and its row (seven float64), 64 bytes; none if there is no moving sample."""
        return bytes(self.records[-_SIZE:])

    def append(self, parent: str, stamp: int, row: Row, authority: str) -> bool:
        """Store a sample that is newer and has the same parent and authority, as nearly all; else do nothing."""
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
        """Store a sample before the one at an index, or in its place if it has the same stamp."""
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
        """The index of the last sample up to stamp `low`, and that behind the first sample from stamp `high` on.

        Where there is no such sample, the first sample and the end of all.
        """
        stamps, start = self.stamps, self._start
        first = bisect_right(stamps, low, start) - 1
        end = bisect_left(stamps, high, start) + 1
        return max(first - start, 0), min(end, len(stamps)) - start

    def stamp(self, index: int) -> int:
        """The stamp of a sample, in ns; the errors are those of `sample`."""
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

    def columns(self, first: int, end: int, wanted: Stamps | None = None) -> Columns:
        """The memory of the samples from one index to another, which nothing changes while it is held.

        Those that are next to none of the `wanted` stamps (ns) may be left out.
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
        """Have no more records than stamps, even if no memory or Ctrl-C came between, and the horizon of the newest."""
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

    It composes what each edge interpolates, by the formulas of `tfbus.geometry.rows` and with the same bits. One loop,
    because a function call or a small array for each edge would cost more than its arithmetic.
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
                # There is no pair round the first stamp, nor beyond the last.
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


class Held(Protocol):
    """The samples of a chain as they were at one moment."""

    def rows(self, stamps: Stamps, columns: npt.NDArray[Any]) -> int | None:
        """Fill columns of shape (7, n) with the rows at many stamps, which are those of `Chain.row` bit for bit.

        Returns
        -------
        int or None
            The first place without an answer, where the columns have NaN, or -1 if there is none. None if an answer is
            not plain; then the columns are of no use.
        """


class Chain:
    """The edges between two frames.

    Attributes
    ----------
    up, down : tuple of steps
        From source, and from target, to their common ancestor: moving edges, and one row for each run of static edges.
    """

    __slots__ = ("_edges", "down", "up")

    def __init__(self, up: tuple[Step, ...], down: tuple[Step, ...]) -> None:
        self.up = up
        self.down = down
        self._edges = tuple(step for step in (*up, *down) if isinstance(step, History))

    def row(self, at: int) -> Row | None:
        """The row of source in target at a stamp; None if it is not plain."""
        up = climb(self.up, at)
        if not self.down or up is None:
            return up
        down = climb(self.down, at)
        return None if down is None else compose(invert(down), up)

    def latest(self) -> int | None:
        """The newest stamp that all edges have reached, in ns; None if one has no samples, or nothing moves."""
        common = STAMP_MAX
        for edge in self._edges:
            if not edge.stamps:
                return None
            if edge.stamps[-1] < common:
                common = edge.stamps[-1]
        return common if self._edges else None

    def hold(self) -> Held | None:
        """The samples of all edges as they are now, for many answers; None if the kernel gives no many answers.

        The one in Python gives none: numpy does, from copies; see `tfbus.tree._lookup_many`.
        """
        return None


class Paths:
    """The paths that were asked for lately, and their plain answers.

    Parameters
    ----------
    lock : threading.Lock
        Whoever changes a history or a path holds it.
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
        Another number after each change.
    """

    __slots__ = ("_changes", "_kind", "_latest", "_lock", "inserted", "recent")

    def __init__(self, lock: AbstractContextManager[Any], latest: Latest, kind: type[TransformStamped]) -> None:
        self._lock = lock
        self._latest = latest
        self._kind = kind
        self.recent: dict[str, dict[str, Chain]] = {}
        self.inserted = 0
        self._changes = 0

    @property
    def version(self) -> int:
        """Not counted by itself, because every sample takes the time of that, and only a woken waiter reads it."""
        return self.inserted + self._changes

    @version.setter
    def version(self, version: int) -> None:
        self._changes = version - self.inserted

    def answer(self, target: str, source: str, at: object) -> TransformStamped | None:
        """The answer of a lookup, if it needs nothing but a path of `recent` that covers the stamp; else None."""
        with self._lock:
            by_source = self.recent.get(target)
            chain = None if by_source is None else by_source.get(source)
            if chain is None or not chain._edges:
                return None
            stamp = chain.latest() if at is self._latest else at
            if type(stamp) is not int:
                return None
            row = chain.row(stamp) if chain.down else climb(chain.up, stamp)
            if row is None:
                return None
        kind = self._kind
        sample = kind.__new__(kind)
        sample._fields = target, source, stamp, row, "", False
        return sample

    def answer_many(self, target: str, source: str, stamps: StampsLike) -> bytes | None:
        """The answers at many stamps, if they need nothing but a path of `recent` that covers them all; else None.

        Here only a few stamps have an answer; for more there is numpy, see `tfbus.tree._lookup_many`.

        Returns
        -------
        bytes or None
            Seven columns of floats, of shape (7, n), and behind them the stamps as int64.
        """
        asked = as_stamps(stamps)
        with self._lock:
            chain = self.recent.get(target, {}).get(source) if len(asked) <= ONE_BY_ONE else None
            rows: Any = [] if chain is None else [chain.row(at) for at in asked.tolist()]
        if not rows or None in rows:
            return None
        return array("d", chained.from_iterable(zip(*rows, strict=True))).tobytes() + asked.tobytes()

    def commit(self, frames: Mapping[str, History], readers: Mapping[int, Any], batch: Batch) -> bool:
        """Store a batch if all of it continues its histories and there are no readers to be told; else do nothing.

        Here only a batch of one sample is stored.
        """
        if len(batch) != 1:
            return False
        parent, child, stamp, row, authority, static = batch[0]._fields
        with self._lock:
            if readers or static or child not in frames or not frames[child].append(parent, stamp, row, authority):
                return False
            self.inserted += 1
        return True


def commit(frames: Mapping[str, History], batch: Batch, first: int) -> int:
    """Store the samples of a batch from the index `first` on, up to the first that does not continue its history.

    Returns
    -------
    int
        Its index; the length of the batch if all were stored.
    """
    for i in range(first, len(batch)):
        parent, child, stamp, row, authority, static = batch[i]._fields
        if static or child not in frames or not frames[child].append(parent, stamp, row, authority):
            return i
    return len(batch)
