"""The samples of one frame in the order of their stamps.

Storage is by column: stamps for `bisect`; one 64-byte record a sample (stamp, translation, rotation), from which the
lookup unpacks two neighbours in a single call; and the parent and authority of each sample. Samples older than the
horizon do not count. They are cut off later, many at once, because each cut moves all remaining samples. Every sample
carries its own parent, because a frame may be reparented.
"""

from array import array
from bisect import bisect_left, bisect_right
from collections import Counter
from dataclasses import dataclass
from enum import Enum
from struct import Struct
from typing import NamedTuple, final

from tfbus.errors import ExtrapolationError, FutureExtrapolationError, PastExtrapolationError
from tfbus.geometry.rows import IDENTITY, Row
from tfbus.stamps import SECOND, STAMP_MIN, Latest

RECORD = Struct("q7d")
RECORD_SIZE = RECORD.size
FOREVER = 2**64
_pack = RECORD.pack


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


class Samples(NamedTuple):
    """Copies of moving samples of one frame, in stamp order; numpy reads them without another copy."""

    stamps: "array[int]"
    """ns."""
    records: bytearray
    """64 bytes each: the stamp, then the seven floats of the row."""
    parents: list[str] | None
    """The parent of each sample; None if all have the same."""


@final
class FrameHistory:
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
    static : bool
        Whether the one sample holds at every stamp; then `row` is its transform and `static_stamp` its stamp in ns.
    parents : Counter or None
        How many samples name each parent, while there are several; None while all agree.
    horizon : int
        Samples with a stamp before this one, in ns, have left the window.
    changed : bool
        Set by an insertion that may change the path of a lookup: another parent or kind, or a longer past. The forest
        clears it.
    """

    __slots__ = (
        "_cut_after",
        "_keep",
        "_origin",
        "authority",
        "changed",
        "child",
        "horizon",
        "origins",
        "parent",
        "parents",
        "records",
        "row",
        "stamps",
        "static",
        "static_stamp",
    )

    def __init__(self, child: str, parent: str, static: bool, keep: int | None) -> None:
        self.child = child
        self._keep = FOREVER if keep is None else keep
        self.parent = parent
        self.authority = ""
        self.static = static
        self.static_stamp: int | None = None
        self.row: Row = IDENTITY
        self.parents: Counter[str] | None = None
        self.changed = False
        self.stamps = array("q")
        self.records = bytearray()
        self.origins: list[tuple[str, str]] = []
        self.horizon = -FOREVER
        self._cut_after = STAMP_MIN
        self._origin = (parent, "")

    def __len__(self) -> int:
        return 1 if self.static else len(self.stamps) - self.start

    @property
    def start(self) -> int:
        """The index of the oldest sample in the window."""
        return bisect_left(self.stamps, self.horizon)

    @property
    def oldest(self) -> int | None:
        """The oldest stamp in the window; None when there is no moving sample."""
        return self.stamps[self.start] if self.stamps else None

    @property
    def newest(self) -> int | None:
        """The newest stamp; None when there is no moving sample."""
        return self.stamps[-1] if self.stamps else None

    @property
    def named_parents(self) -> tuple[str, ...]:
        """The parents that samples in the window name."""
        return (self.parent,) if self.parents is None else tuple(self.parents)

    def append(self, parent: str, stamp: int, row: Row, authority: str) -> bool:
        """Store a moving sample that is newer and has the same parent and authority, as nearly all; else do nothing."""
        stamps = self.stamps
        origin = self._origin
        if (
            not stamps
            or stamp <= stamps[-1]
            or parent != origin[0]
            or authority != origin[1]
            or self.parents is not None
        ):
            return False
        # Spelt out, because `*row` would build a list of the arguments first.
        x, y, z, qx, qy, qz, qw = row
        record = _pack(stamp, x, y, z, qx, qy, qz, qw)
        # No call before the last of the three, so that Ctrl-C cannot come between them.
        self.records += record
        self.origins += (origin,)
        stamps.append(stamp)
        self.horizon = stamp - self._keep
        if stamp > self._cut_after:
            self._cut()
        return True

    def insert(self, parent: str, stamp: int, row: Row, authority: str) -> Outcome:
        """Store a moving sample; the window ends at the newest. A static sample is dropped first."""
        if self.static:
            self._become_moving(parent)
        if self.stamps and stamp <= self.stamps[-1]:
            return self._insert_late(parent, stamp, row, authority)
        if parent != self.parent:
            self._reparent(parent)
        self.authority = authority
        self._origin = self._shared(parent, authority)
        if self.parents is not None:
            self.parents[parent] += 1
        record = _pack(stamp, *row)
        self.records += record
        self.origins += (self._origin,)
        self.stamps.append(stamp)
        self.horizon = stamp - self._keep
        if stamp > self._cut_after:
            self._cut()
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
        self.row = row
        return Outcome.INSERTED if fresh else Outcome.REPLACED

    def clear(self) -> None:
        """Drop all moving samples; the newest parent is remembered."""
        del self.stamps[:]
        del self.records[:]
        del self.origins[:]
        self.horizon = -FOREVER
        self._cut_after = STAMP_MIN
        if self.parents is not None:
            self.parents = None
            self.changed = True

    def parent_at(self, stamp: int) -> str:
        """The parent that holds at `stamp`; outside the window, that of the nearest sample."""
        if self.parents is None:
            return self.parent
        start = self.start
        return self.origins[max(bisect_right(self.stamps, stamp, start) - 1, start)][0]

    def covers(self, stamp: int) -> bool:
        """Whether the samples surround `stamp`, or the edge is static."""
        return self.static or (bool(self.stamps) and self.stamps[self.start] <= stamp <= self.stamps[-1])

    def extrapolation_error(self, stamp: int | Latest, slack: int = 0) -> ExtrapolationError:
        """The error of a `stamp` that is not covered, and is further than `slack` ns from every sample."""
        oldest, newest = self.oldest, self.newest
        past = oldest is not None and isinstance(stamp, int) and stamp < oldest
        kind = PastExtrapolationError if past else FutureExtrapolationError
        return kind(child=self.child, stamp=stamp, oldest=oldest, newest=newest, authority=self.authority, slack=slack)

    def parent_changes(self) -> list[int]:
        """The stamps inside the window at which the parent changes."""
        if self.parents is None:
            return []
        parents = [parent for parent, _ in self.origins[self.start :]]
        stamps = self.stamps[self.start :]
        return [stamp for stamp, old, new in zip(stamps[1:], parents, parents[1:], strict=False) if new != old]

    def beginnings(self) -> list[int]:
        """The stamps inside the window at which a parent begins to hold: the oldest, and each change."""
        return [self.stamps[self.start], *self.parent_changes()] if self.stamps else []

    def begins_by(self, stamp: int) -> bool:
        """Whether the edge is static, or has a sample in the window at `stamp` or before."""
        return self.static or (bool(self.stamps) and self.stamps[self.start] <= stamp)

    def neighbours(self, stamp: int) -> tuple[int | None, int | None]:
        """The stamps of the samples before and after `stamp`, in ns; twice the same if a sample has it."""
        stamps, start = self.stamps, self.start
        i = bisect_left(stamps, stamp, start)
        after = stamps[i] if i < len(stamps) else None
        if after == stamp:
            return after, after
        return stamps[i - 1] if i > start else None, after

    def samples_between(self, low: int, high: int) -> Samples:
        """Copies of the samples from stamp `low` to `high`, and of the next one on either side."""
        start = self.start
        first = max(bisect_right(self.stamps, low) - 1, start)
        end = max(bisect_left(self.stamps, high), start) + 1
        parents = None if self.parents is None else [parent for parent, _ in self.origins[first:end]]
        return Samples(self.stamps[first:end], self.records[first * RECORD_SIZE : end * RECORD_SIZE], parents)

    def edge(self) -> Edge:
        """The newest edge as plain data."""
        return Edge(self.parent, self.child, self.static, len(self), self.oldest, self.newest, self.authority)

    def copy(self) -> "FrameHistory":
        """An independent copy."""
        twin = FrameHistory(self.child, self.parent, self.static, self._keep)
        for name in ("authority", "static_stamp", "row", "horizon", "_origin", "_cut_after"):
            setattr(twin, name, getattr(self, name))
        twin.stamps = self.stamps[:]
        twin.records = self.records[:]
        twin.origins = self.origins[:]
        twin.parents = None if self.parents is None else self.parents.copy()
        return twin

    def copy_within(self, keep: int | None) -> "FrameHistory":
        """An independent copy of the samples in the window, with a window of another length from now on."""
        twin = self.copy()
        twin._keep = FOREVER if keep is None else keep
        if twin.stamps:
            horizon = twin.stamps[-1] - twin._keep
            twin.horizon = max(self.horizon, horizon)
            twin._cut()
            twin.horizon = horizon
            twin.changed = False
        return twin

    def _become_moving(self, parent: str) -> None:
        self.static = False
        self.static_stamp = None
        self.parent = parent
        self.changed = True

    def _reparent(self, parent: str) -> None:
        """Note that the next sample, which will be the newest, names another parent."""
        if self.stamps and self.parents is None:
            self._cut()
            self.parents = Counter({self.parent: len(self)})
        self.parent = parent
        self._cut_after = STAMP_MIN
        self.changed = True

    def _insert_late(self, parent: str, stamp: int, row: Row, authority: str) -> Outcome:
        """Store a sample that is not newer than the newest."""
        stamps = self.stamps
        if stamp < self.horizon:
            return Outcome.EXPIRED
        at = bisect_left(stamps, stamp)
        replaces = stamps[at] == stamp
        if at == self.start and not replaces:
            self.changed = True
        if self.parents is not None or parent != self.parent:
            self._cut()
            self._cut_after = STAMP_MIN
            at = bisect_left(stamps, stamp)
            self.parents = self.parents or Counter({self.parent: len(self)})
            self.parents[parent] += 1
            if replaces:
                self._forget(self.origins[at][0])
            self.changed = True
        record = _pack(stamp, *row)
        end = at + 1 if replaces else at
        self.records[at * RECORD_SIZE : end * RECORD_SIZE] = record
        self.origins[at:end] = (self._shared(parent, authority),)
        if not replaces:
            stamps.insert(at, stamp)
        if at == len(stamps) - 1:
            self.parent, self.authority = self._origin = self.origins[at]
        self._settle_parents()
        return Outcome.REPLACED if replaces else Outcome.INSERTED

    def _shared(self, parent: str, authority: str) -> tuple[str, str]:
        """A parent and an authority. Equal ones share one tuple, because one for each sample would take 56 bytes."""
        origin = parent, authority
        return self._origin if self._origin == origin else origin

    def _cut(self) -> None:
        """Cut off samples that have left the window; with only one parent, not again before 1/16 of it has passed."""
        start = self.start
        if self.parents is not None:
            for parent, _ in self.origins[:start]:
                self._forget(parent)
            self._settle_parents()
        del self.stamps[:start]
        del self.origins[:start]
        del self.records[: start * RECORD_SIZE]
        self._cut_after = self.stamps[0] + self._keep + (0 if self.parents is not None else self._keep // 16)

    def _forget(self, parent: str) -> None:
        """Note that a sample that names `parent` has gone."""
        assert self.parents is not None
        self.parents[parent] -= 1
        if not self.parents[parent]:
            del self.parents[parent]
            self.changed = True

    def _settle_parents(self) -> None:
        if self.parents is not None and len(self.parents) == 1:
            self.parents = None
