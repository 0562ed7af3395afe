"""The samples of one frame: moving ones in its window, or a static one.

The kernel stores the moving samples, and appends a sample that only continues the others, as nearly all do. Every other
case is decided here: late samples, changes of the parent, static samples. Every sample may name its own parent, because
a frame may be reparented; parents and authorities are stored as runs of samples with the same one.

A sample may have a covariance. It is kept beside the samples, by its stamp, and only for frames that have some. The
kernel leaves such a sample to this module, and never reads a covariance. So a plain sample costs nothing.
"""

from bisect import bisect_right
from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from enum import Enum
from itertools import groupby
from operator import itemgetter
from typing import Final, NamedTuple, final

import numpy as np
import numpy.typing as npt

from tfbus.errors import (
    ExtrapolationError,
    FutureExtrapolationError,
    PastExtrapolationError,
    error_of,
)
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import from_row
from tfbus.geometry.uncertain import Belief, UncertainSample, with_belief
from tfbus.rows import IDENTITY, RawColumns, Row, interpolate
from tfbus.stamps import SECOND, STAMP_MAX, STAMP_MIN, Latest, Stamps
from tfbus.which_kernel import History

_begin_of = itemgetter(0)


class Runs(list[tuple[int, str]]):
    """The parents, or the authorities, of the samples of a history: one name for each run of samples that share it.

    Each name stands behind the stamp from which it holds, in order. The first one holds from any earlier stamp as well.
    The list is empty while all samples have the same name. The history holds the name of its newest sample.

    Histories share one empty list, `NO_RUNS`. So `push` and `put` leave an empty list as it is, and return another.
    """

    __slots__ = ()

    def at(self, stamp: int) -> str:
        """The name that holds at a stamp; there are several."""
        return self[max(bisect_right(self, stamp, key=_begin_of) - 1, 0)][1]

    def at_all(self, stamps: Stamps) -> list[str]:
        """The names that hold at many stamps."""
        begins = np.array([begin for begin, _ in self], np.int64)
        numbers = np.maximum(begins.searchsorted(stamps, "right") - 1, 0)
        return [self[number][1] for number in numbers]

    def names(self) -> tuple[str, ...]:
        """Each name once, in the order in which they first hold."""
        return tuple(dict.fromkeys(name for _, name in self))

    def changes(self) -> list[int]:
        """The stamps at which another name begins to hold."""
        return [begin for begin, _ in self[1:]]

    def push(self, stamp: int, name: str, newest: str) -> "Runs":
        """The names after a sample newer than all others; the newest of those has the name `newest`."""
        if name == newest:
            return self
        runs = self or Runs([(STAMP_MIN, newest)])
        runs.append((stamp, name))
        return runs

    def put(self, stamp: int, name: str, before: int | None, after: int | None, newest: str) -> "Runs":
        """The names with that of a sample between two others; None for a side without one. `newest` is as in `push`."""
        if not self and name == newest:
            return self
        runs = self or Runs([(STAMP_MIN, newest)])
        low = 0 if before is None else bisect_right(runs, before, key=_begin_of)
        high = len(runs) if after is None else bisect_right(runs, after, key=_begin_of)
        fresh = [] if low and runs[low - 1][1] == name else [(stamp, name)]
        if after is not None and runs[high - 1][1] != name:
            fresh.append((after, runs[high - 1][1]))
        runs[low:high] = fresh
        runs._close()
        return runs

    def forget_before(self, oldest: int) -> bool:
        """Forget the names that only samples before a stamp carry; returns whether there were any."""
        old = 0
        while old + 1 < len(self) and self[old + 1][0] <= oldest:
            old += 1
        del self[:old]
        self._close()
        return old > 0

    def copy(self) -> "Runs":
        """An independent copy."""
        return Runs(self) if self else NO_RUNS

    def _close(self) -> None:
        if len(self) == 1:
            self.clear()


NO_RUNS: Final = Runs()

_FEW = 64
"""Up to this many covariances are kept although their samples may have left the window."""

_BLOCK = 64
"""Up to this many samples for each stamp, copying all samples is faster than picking some."""


class Outcome(Enum):
    """The effect of an insertion.

    Examples
    --------
    >>> tree = TransformTree(keep=1.0)
    >>> stamps = (from_seconds(5.0), from_seconds(5.0), 0)
    >>> [tree.insert(TransformStamped("map", "cart", stamp, Transform())).name for stamp in stamps]
    ['INSERTED', 'REPLACED', 'EXPIRED']
    """

    INSERTED = "inserted"
    """A sample at a new stamp."""
    REPLACED = "replaced"
    """A sample at a stamp that already had one: the last one wins."""
    EXPIRED = "expired"
    """Nothing: it was older than the window."""


@dataclass(frozen=True, slots=True)
class Edge:
    """The newest edge of one frame; stamps in ns, None where there is no moving sample.

    Examples
    --------
    >>> tree = TransformTree()
    >>> _ = tree.insert(TransformStamped("map", "cart", 10, Transform()))
    >>> tree.edges()[0].newest
    10
    """

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
    columns : RawColumns
        The memory of the samples.
    parents, authorities : Runs or None
    """

    def __init__(self, columns: RawColumns, parents: Runs | None, authorities: Runs | None) -> None:
        self._columns = columns
        self._parents = parents
        self._authorities = authorities
        self._stamps: Stamps | None = None

    def __len__(self) -> int:
        return self._columns[-1]

    @property
    def stamps(self) -> Stamps:
        """ns, shape (n,)."""
        if self._stamps is None:
            memory, begin, _, _, _, count = self._columns
            self._stamps = np.frombuffer(memory, np.int64, count, begin) if count else np.empty(0, np.int64)
        return self._stamps

    @property
    def rows(self) -> npt.NDArray[np.float64]:
        """Shape (n, 7)."""
        _, _, memory, begin, width, count = self._columns
        if not count:
            return np.empty((0, 7))
        return np.frombuffer(memory, np.float64, width * count, begin).reshape(count, width)[:, -7:]

    @property
    def parents(self) -> list[str] | None:
        """The parent of each sample; None if all have the same."""
        return self._parents.at_all(self.stamps) if self._parents else None

    @property
    def authorities(self) -> list[str] | None:
        """The authority of each sample; None if all have the same."""
        return self._authorities.at_all(self.stamps) if self._authorities else None


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
    shared : bool
        Whether several forests hold this static history. They only read it, and insert into a copy of their own.
    beliefs : dict of int to Belief, or None
        The covariances of samples by their stamps; None if there never was one. A stamp that has left the window may
        still be in it.
    """

    __slots__ = ("_authorities", "_parents", "beliefs", "changed", "child", "shared", "static", "static_row")

    def __init__(self, child: str, parent: str, static: bool, keep: int | None) -> None:
        super().__init__(parent, keep)
        self.child: str = child
        self.static: bool = static
        self.static_row: Row = IDENTITY
        self.changed: bool = False
        self.shared: bool = False
        self.beliefs: dict[int, Belief] | None = None
        self._parents = NO_RUNS
        self._authorities = NO_RUNS

    def __len__(self) -> int:
        return 1 if self.static else self.count

    @property
    def named_parents(self) -> tuple[str, ...]:
        """The parents that samples in the window name."""
        return self._parents.names() if self.mixed else (self.parent,)

    def can_append(self, parent: str, authority: str, oldest: int) -> bool:
        """Whether moving samples from a stamp on are newer, and have the parent and the authority of the others."""
        newest = self.newest
        return (
            newest is not None
            and newest < oldest
            and (self.parent, self.authority) == (parent, authority)
            and not self.mixed
        )

    def append_many(self, stamps: npt.NDArray[np.int64], rows: npt.NDArray[np.float64]) -> None:
        """Store moving samples that `can_append` has approved; their stamps ascend. The rows have shape (n, 7)."""
        self.push_many(np.ascontiguousarray(stamps), np.ascontiguousarray(rows))

    def insert(self, parent: str, stamp: int, row: Row, authority: str) -> Outcome:
        """Store a moving sample; the window ends at the newest. A static sample is dropped first."""
        newest = self.newest
        if newest is not None and stamp <= newest:
            return self._insert_late(parent, stamp, row, authority)
        self.push(stamp, row)
        if self.static:
            self.static = False
            self.static_stamp = None
            self.beliefs = None
            self.changed = True
        if newest is not None:
            self._parents = self._parents.push(stamp, parent, self.parent)
            self._authorities = self._authorities.push(stamp, authority, self.authority)
            if self._parents or self._authorities:
                self._forget_old_names()
        if parent != self.parent:
            self.parent: str = parent
            self.changed = True
        self.authority: str = authority
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

    def note(self, sample: TransformStamped) -> None:
        """Note the covariance of a sample that was stored, or that the one at its stamp has none any more."""
        if isinstance(sample, UncertainSample):
            if self.beliefs is None or self.static:
                self.beliefs = {}
            elif len(self.beliefs) > 2 * self.count + _FEW and self.oldest is not None:
                oldest = self.oldest
                self.beliefs = {stamp: belief for stamp, belief in self.beliefs.items() if stamp >= oldest}
            self.beliefs[sample.stamp] = sample.belief
        elif self.beliefs is not None:
            self.beliefs.pop(sample.stamp, None)

    def clear(self) -> None:
        """Drop all moving samples; the newest parent is remembered."""
        super().clear()
        self.beliefs = None
        self._parents = self._authorities = NO_RUNS
        if self.mixed:
            self.mixed: bool = False
            self.changed = True

    def parent_at(self, stamp: int) -> str:
        """The parent that holds at `stamp`; outside of the window, the parent of the nearest sample."""
        return self._parents.at(stamp) if self.mixed else self.parent

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
        plain = self.row(at)
        if plain is not None:
            return plain
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
        return error_of(
            kind,
            {
                "child": self.child,
                "stamp": stamp,
                "oldest": oldest,
                "newest": newest,
                "authority": self.authority,
                "slack": slack,
            },
        )

    def parent_changes(self) -> list[int]:
        """The stamps inside the window at which the parent changes."""
        return self._parents.changes()

    def beginnings(self) -> list[int]:
        """The stamps inside the window at which a parent begins to hold: the oldest, and each change."""
        oldest = self.oldest
        return [] if oldest is None else [oldest, *self.parent_changes()]

    def begins_by(self, stamp: int) -> bool:
        """Whether the edge is static, or has a sample in the window at `stamp` or before."""
        oldest = self.oldest
        return self.static or (oldest is not None and oldest <= stamp)

    def around(self, stamp: int) -> tuple[int | None, int | None]:
        """The stamps of the last sample not after `stamp`, and of the next sample, in ns."""
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

        Samples that are next to none of the `wanted` stamps (ns) may be left out.
        """
        first, end = self.between(low, high)
        if wanted is not None and end - first <= _BLOCK * len(wanted):
            wanted = None
        parents, authorities = self._parents, self._authorities
        return Samples(
            self.columns(first, end, wanted),
            parents.copy() if parents else None,
            authorities.copy() if authorities else None,
        )

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
        twin._parents = self._parents.copy()
        twin._authorities = self._authorities.copy()
        twin.mixed = self.mixed
        twin.beliefs = None if self.beliefs is None else self.beliefs.copy()
        return twin

    def copy_within(self, keep: int | None) -> "FrameHistory":
        """An independent copy of the samples in the window, with a window of another length from now on."""
        twin = self.copy()
        twin.keep = keep
        twin._forget_old_names()
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
        before = self.stamp(at - 1) if at else None
        behind = at + replaces
        after = self.stamp(behind) if behind < self.count else None
        self.put(at, stamp, row)
        self._authorities = self._authorities.put(stamp, authority, before, after, self.authority)
        if self.mixed or parent != self.parent:
            self._parents = self._parents.put(stamp, parent, before, after, self.parent)
            self.mixed = bool(self._parents)
            self.changed = True
        if is_newest:
            self.parent = parent
            self.authority = authority
        return Outcome.REPLACED if replaces else Outcome.INSERTED

    def _forget_old_names(self) -> None:
        """Forget the parents and authorities that no sample in the window names any longer."""
        oldest = self.oldest
        if oldest is not None:
            self._authorities.forget_before(oldest)
            if self._parents.forget_before(oldest):
                self.changed = True
        self.mixed = bool(self._parents)


def clear_samples(histories: Collection[FrameHistory]) -> list[FrameHistory]:
    """Drop the moving samples of many histories; return the ones that need `clear` yet, for their samples' many names.

    A clock that jumps back clears all frames in one turn of the event loop, so the usual ones are cleared without
    calling a method in Python.
    """
    deque(map(History.clear, histories), maxlen=0)
    return [
        history
        for history in histories
        if history.mixed or history._authorities or (history.beliefs is not None and not history.static)
    ]


STALE_AFTER = 1.0
"""In s: the default of the age from which pictures show a moving frame as stale."""


class EdgeState(Enum):
    """A state, and the colour of its edges in every picture.

    The colours come from M. Okabe and K. Ito, "Color Universal Design" (2008). People with any kind of colour vision
    can tell them apart.
    """

    STATIC = "#0072b2"
    """It holds at every stamp."""
    MOVING = "#009e73"
    """It has a sample that is recent enough."""
    STALE = "#d55e00"
    """Its newest sample is too old."""
    SILENT = "#767676"
    """It has no sample."""


def state_of(edge: Edge, now: int, stale_after: float = STALE_AFTER) -> EdgeState:
    """The state of an edge at the stamp `now` (ns); moving edges are stale after `stale_after` s."""
    if edge.static:
        return EdgeState.STATIC
    if edge.newest is None:
        return EdgeState.SILENT
    return EdgeState.STALE if now - edge.newest > stale_after * SECOND else EdgeState.MOVING


class SavedFrame(NamedTuple):
    """All samples of one frame, in types of Python and numpy."""

    child: str
    parent: str
    """Of the newest sample; it stays when a frame has none."""
    authority: str
    static: tuple[int, Row] | None
    """The stamp and the transform of a frame that is static."""
    stamps: Stamps
    """ns, ascending."""
    rows: npt.NDArray[np.float64]
    """Translation (m) and quaternion (x, y, z, w) of each sample; shape (n, 7)."""
    runs: list[tuple[str, str, int]]
    """Parent, authority and length of each run of samples that share both."""
    beliefs: dict[int, Belief] | None = None
    """The covariances of samples by their stamps."""


def save_frame(history: FrameHistory, oldest: int = STAMP_MIN) -> SavedFrame:
    """The samples of a frame from the stamp `oldest` (ns) on; a static sample is always among them."""
    stamps, rows, origins = _columns(history, oldest, STAMP_MAX)
    first = int(np.searchsorted(stamps, oldest))
    runs = [(parent, authority, len(list(run))) for (parent, authority), run in groupby(origins[first:])]
    static = None
    if history.static and history.static_stamp is not None:
        static = history.static_stamp, history.static_row
    beliefs = None if history.beliefs is None else history.beliefs.copy()
    return SavedFrame(
        history.child, history.parent, history.authority, static, stamps[first:], rows[first:], runs, beliefs
    )


def load_frame(saved: SavedFrame, window: int | None) -> FrameHistory:
    """A history with the samples that were saved, and a window in ns before the newest."""
    history = FrameHistory(saved.child, saved.parent, saved.static is not None, window)
    history.authority = saved.authority
    if saved.static is not None:
        stamp, row = saved.static
        history.insert_static(saved.parent, stamp, row, saved.authority)
    first = 0
    for parent, authority, count in saved.runs:
        end = first + count
        history.insert(parent, int(saved.stamps[first]), _row(saved.rows[first]), authority)
        if history.can_append(parent, authority, STAMP_MAX):
            if count > 1:
                history.append_many(saved.stamps[first + 1 : end], saved.rows[first + 1 : end])
        else:
            for at in range(first + 1, end):
                history.insert(parent, int(saved.stamps[at]), _row(saved.rows[at]), authority)
        first = end
    history.changed = False
    history.beliefs = saved.beliefs
    return history


def samples_of(history: FrameHistory, low: int, high: int) -> Iterator[TransformStamped]:
    """The moving samples from stamp `low` to `high`, and the next one on either side; or the static one."""
    beliefs = history.beliefs or {}
    if history.static:
        stamp = history.static_stamp or 0
        sample = TransformStamped(
            history.parent, history.child, stamp, from_row(history.static_row), history.authority, static=True
        )
        yield with_belief(sample, beliefs[stamp]) if stamp in beliefs else sample
        return
    stamps, rows, origins = _columns(history, low, high)
    for stamp, row, (parent, authority) in zip(stamps.tolist(), rows, origins, strict=True):
        sample = TransformStamped(parent, history.child, stamp, from_row(_row(row)), authority)
        yield with_belief(sample, beliefs[stamp]) if stamp in beliefs else sample


def _columns(
    history: FrameHistory, low: int, high: int
) -> tuple[Stamps, npt.NDArray[np.float64], list[tuple[str, str]]]:
    """Stamps, rows, parents and authorities of the samples from `low` to `high`, and of the next one on either side."""
    samples = history.samples_between(low, high)
    count = len(samples)
    parents = samples.parents or [history.parent] * count
    authorities = samples.authorities or [history.authority] * count
    return samples.stamps, np.ascontiguousarray(samples.rows), list(zip(parents, authorities, strict=True))


def _row(row: npt.NDArray[np.float64]) -> Row:
    x, y, z, qx, qy, qz, qw = row.tolist()
    return x, y, z, qx, qy, qz, qw
