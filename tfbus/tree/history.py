"""The samples of one frame: moving ones in its window, or a static one.

The kernel stores the moving samples, and appends those that only continue the others, as nearly all do. Everything else
is decided here: late samples, changes of the parent, static samples. Every sample may name its own parent, because a
frame may be reparented; the parents are stored as runs of samples with the same one.
"""

from bisect import bisect_right
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from operator import itemgetter
from typing import final

import numpy as np
import numpy.typing as npt

from tfbus.errors import ExtrapolationError, FutureExtrapolationError, PastExtrapolationError
from tfbus.geometry.rows import IDENTITY, Row, interpolate
from tfbus.stamps import SECOND, Latest, Stamps
from tfbus.tree._kernel import Columns, History

_stamp_of = itemgetter(0)


class Outcome(Enum):
    """The effect of an insertion."""

    INSERTED = "inserted"
    """A sample at a new stamp."""
    REPLACED = "replaced"
    """A sample at a stamp that already had one: the last one wins."""
    EXPIRED = "expired"
    """Nothing: it was older than the window."""


@dataclass(frozen=True, slots=True)
class Edge:
    """The newest edge of one frame; stamps in ns, None where there is no moving sample."""

    parent: str
    child: str
    static: bool
    samples: int
    oldest: int | None
    newest: int | None
    authority: str

    @property
    def rate(self) -> float | None:
        """Mean samples per second over the window; None for fewer than two samples."""
        if self.oldest is None or self.newest is None or self.newest == self.oldest:
            return None
        return (self.samples - 1) * SECOND / (self.newest - self.oldest)


class Samples:
    """Moving samples of one frame in stamp order, which no insertion changes.

    The arrays are made when they are read, because the lock that guards the history is not held for numpy.

    Parameters
    ----------
    columns : Columns
        The memory of the samples.
    runs : list of (int, str)
        The parent from a stamp (ns) on, in order; empty if all have the same.
    """

    def __init__(self, columns: Columns, runs: list[tuple[int, str]]) -> None:
        self._columns = columns
        self._runs = runs

    def __len__(self) -> int:
        return self._columns[-1]

    @cached_property
    def stamps(self) -> Stamps:
        """ns, shape (n,)."""
        memory, begin, _, _, _, count = self._columns
        return np.frombuffer(memory, np.int64, count, begin) if count else np.empty(0, np.int64)

    @cached_property
    def rows(self) -> npt.NDArray[np.float64]:
        """Shape (n, 7)."""
        _, _, memory, begin, width, count = self._columns
        if not count:
            return np.empty((0, 7))
        return np.frombuffer(memory, np.float64, width * count, begin).reshape(count, width)[:, -7:]

    @cached_property
    def parents(self) -> list[str] | None:
        """The parent of each sample; None if all have the same."""
        if not self._runs:
            return None
        begins = np.array([stamp for stamp, _ in self._runs], np.int64)
        numbers = np.maximum(begins.searchsorted(self.stamps, "right") - 1, 0)
        return [self._runs[number][1] for number in numbers]


@final
class FrameHistory(History):
    """The moving samples of one child frame inside its window, or its one static sample.

    Parameters
    ----------
    child : str
    parent : str
    static : bool
    keep : int or None
        Length of the window before the newest stamp, in ns; None keeps everything.

    Attributes
    ----------
    parent, authority : str
        Of the newest sample; they stay after `clear`.
    mixed : bool
        Whether samples in the window name several parents.
    static : bool
        Whether the one sample holds at every stamp; then `static_row` is its transform and `static_stamp` its stamp in
        ns.
    changed : bool
        Set by an insertion that may change the path of a lookup: another parent or kind, or a longer past. The forest
        clears it.
    """

    __slots__ = ("_runs", "changed", "child", "static", "static_row", "static_stamp")

    def __init__(self, child: str, parent: str, static: bool, keep: int | None) -> None:
        super().__init__(parent, keep)
        self.child = child
        self.static = static
        self.static_stamp: int | None = None
        self.static_row: Row = IDENTITY
        self.changed = False
        # The parent from a stamp on, in order; empty unless there are several.
        self._runs: list[tuple[int, str]] = []

    def __len__(self) -> int:
        return 1 if self.static else self.count

    @property
    def named_parents(self) -> tuple[str, ...]:
        """The parents that samples in the window name."""
        return tuple(dict.fromkeys(parent for _, parent in self._runs)) if self.mixed else (self.parent,)

    def insert(self, parent: str, stamp: int, row: Row, authority: str) -> Outcome:
        """Store a moving sample; the window ends at the newest. A static sample is dropped first."""
        if self.static:
            self.static = False
            self.static_stamp = None
            self.parent = parent
            self.changed = True
        oldest, newest = self.oldest, self.newest
        if newest is not None and stamp <= newest:
            return self._insert_late(parent, stamp, row, authority)
        if parent != self.parent:
            if oldest is not None:
                self._set_runs([*(self._runs or [(oldest, self.parent)]), (stamp, parent)])
            self.parent = parent
            self.changed = True
        self.authority = authority
        self.push(stamp, row)
        if self.mixed:
            self._forget_old_runs()
        return Outcome.INSERTED

    def insert_static(self, parent: str, stamp: int, row: Row, authority: str) -> Outcome:
        """Store the sample that holds at every stamp; moving samples are dropped."""
        fresh = self.static_stamp is None
        if not self.static or (not fresh and parent != self.parent):
            self.clear()
            self.changed = True
        self.static = True
        self.static_stamp = stamp
        self.parent = parent
        self.authority = authority
        self.static_row = row
        return Outcome.INSERTED if fresh else Outcome.REPLACED

    def clear(self) -> None:
        """Drop all moving samples; the newest parent is remembered."""
        super().clear()
        if self.mixed:
            self._set_runs([])
            self.changed = True

    def parent_at(self, stamp: int) -> str:
        """The parent that holds at `stamp`; outside the window, that of the nearest sample."""
        if not self.mixed:
            return self.parent
        return self._runs[max(bisect_right(self._runs, stamp, key=_stamp_of) - 1, 0)][1]

    def covers(self, stamp: int) -> bool:
        """Whether the samples surround `stamp`, or the edge is static."""
        if self.static:
            return True
        oldest, newest = self.oldest, self.newest
        return oldest is not None and newest is not None and oldest <= stamp <= newest

    def row_at(self, at: int) -> Row:
        """The row of the child in its parent at a stamp.

        Raises
        ------
        ExtrapolationError
            If the samples do not surround it.
        """
        if self.static:
            return self.static_row
        i = self.find(at)
        stamp, row = self.sample(i) if i < self.count else (None, IDENTITY)
        if stamp == at:
            return row
        if stamp is None or not i:
            raise self.extrapolation_error(at)
        before, row_before = self.sample(i - 1)
        if not self.is_segment(i):
            return row_before
        return interpolate(row_before, row, (at - before) / (stamp - before))

    def is_segment(self, i: int) -> bool:
        """Whether samples i - 1 and i are both in the window and have the same parent."""
        if not 0 < i < self.count:
            return False
        return not self.mixed or self.parent_at(self.stamp(i - 1)) == self.parent_at(self.stamp(i))

    def extrapolation_error(self, stamp: int | Latest, slack: int = 0) -> ExtrapolationError:
        """The error of a `stamp` that is not covered, and is further than `slack` ns from every sample."""
        oldest, newest = self.oldest, self.newest
        past = oldest is not None and isinstance(stamp, int) and stamp < oldest
        kind = PastExtrapolationError if past else FutureExtrapolationError
        return kind(child=self.child, stamp=stamp, oldest=oldest, newest=newest, authority=self.authority, slack=slack)

    def parent_changes(self) -> list[int]:
        """The stamps inside the window at which the parent changes."""
        return [stamp for stamp, _ in self._runs[1:]]

    def beginnings(self) -> list[int]:
        """The stamps inside the window at which a parent begins to hold: the oldest, and each change."""
        oldest = self.oldest
        return [] if oldest is None else [oldest, *self.parent_changes()]

    def begins_by(self, stamp: int) -> bool:
        """Whether the edge is static, or has a sample in the window at `stamp` or before."""
        oldest = self.oldest
        return self.static or (oldest is not None and oldest <= stamp)

    def around(self, stamp: int) -> tuple[int | None, int | None]:
        """The stamp of the last sample not after `stamp`, and that of the next one, in ns."""
        i, count = self.find(stamp), self.count
        if i < count and self.stamp(i) == stamp:
            i += 1
        return self.stamp(i - 1) if i else None, self.stamp(i) if i < count else None

    def neighbours(self, stamp: int) -> tuple[int | None, int | None]:
        """The stamps of the samples before and after `stamp`, in ns; twice the same if a sample has it."""
        i = self.find(stamp)
        after = self.stamp(i) if i < self.count else None
        if after == stamp:
            return after, after
        return self.stamp(i - 1) if i else None, after

    def samples_between(self, low: int, high: int, wanted: Stamps | None = None) -> Samples:
        """The samples from stamp `low` to `high`, and the next one on either side.

        Those that are next to none of the `wanted` stamps (ns) may be left out.
        """
        first = self.find(low)
        if first and (first == self.count or self.stamp(first) != low):
            first -= 1
        return Samples(self.columns(first, self.find(high) + 1, wanted), self._runs)

    def edge(self) -> Edge:
        """The newest edge as plain data."""
        return Edge(self.parent, self.child, self.static, len(self), self.oldest, self.newest, self.authority)

    def copy(self) -> "FrameHistory":
        """An independent copy."""
        twin = FrameHistory(self.child, self.parent, self.static, self.keep)
        twin.authority = self.authority
        twin.static_stamp = self.static_stamp
        twin.static_row = self.static_row
        twin.take(self)
        twin._set_runs(self._runs.copy())
        return twin

    def copy_within(self, keep: int | None) -> "FrameHistory":
        """An independent copy of the samples in the window, with a window of another length from now on."""
        twin = self.copy()
        twin.keep = keep
        if twin.mixed:
            twin._forget_old_runs()
            twin.changed = False
        return twin

    def _insert_late(self, parent: str, stamp: int, row: Row, authority: str) -> Outcome:
        """Store a sample that is not newer than the newest."""
        if stamp < self.horizon:
            return Outcome.EXPIRED
        at = self.find(stamp)
        replaces = self.stamp(at) == stamp
        if not at and not replaces:
            self.changed = True
        is_newest = replaces and at == self.count - 1
        if self.mixed or parent != self.parent:
            self._name_parent(parent, stamp, at, replaces)
            self.changed = True
        self.put(at, stamp, row)
        if is_newest:
            self.parent = parent
            self.authority = authority
        return Outcome.REPLACED if replaces else Outcome.INSERTED

    def _name_parent(self, parent: str, stamp: int, at: int, replaces: bool) -> None:
        """Note the parent of a late sample that will stand before the one at an index, or replace it."""
        first, behind = self.stamp(0), at + replaces
        runs = self._runs or [(first, self.parent)]
        low = bisect_right(runs, self.stamp(at - 1), key=_stamp_of) if at else 0
        after = self.stamp(behind) if behind < self.count else None
        high = len(runs) if after is None else bisect_right(runs, after, key=_stamp_of)
        fresh = [] if low and runs[low - 1][1] == parent else [(stamp, parent)]
        if after is not None and runs[high - 1][1] != parent:
            fresh.append((after, runs[high - 1][1]))
        self._set_runs([*runs[:low], *fresh, *runs[high:]])

    def _forget_old_runs(self) -> None:
        """Forget the parents that no sample in the window names any longer."""
        runs, oldest = self._runs, self.oldest
        old = 0
        while oldest is not None and old + 1 < len(runs) and runs[old + 1][0] <= oldest:
            old += 1
        if old:
            self._set_runs(runs[old:])
            self.changed = True

    def _set_runs(self, runs: list[tuple[int, str]]) -> None:
        self.mixed = len(runs) > 1
        self._runs = runs if self.mixed else []
