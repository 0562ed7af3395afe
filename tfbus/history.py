"""One frame's samples in stamp order.

Storage is by column: stamps for `bisect`, one 64-byte record a sample (stamp, translation, rotation) from which the
lookup unpacks two neighbours in a single call, and who sent it. Expired samples are skipped by an offset and cut off in
larger pieces, so pruning costs little. Every sample carries its own parent, because a frame may be reparented.
"""

from array import array
from bisect import bisect_left, bisect_right
from collections import Counter
from dataclasses import dataclass
from enum import Enum
from struct import Struct

from tfbus.errors import ExtrapolationError, FutureExtrapolationError, PastExtrapolationError
from tfbus.geometry import IDENTITY, Row
from tfbus.stamps import SECOND, Latest

RECORD = Struct("=q7d")
RECORD_SIZE = RECORD.size
_pack = RECORD.pack


class Outcome(Enum):
    """What an insertion did."""

    INSERTED = "inserted"
    """A sample at a new stamp."""
    REPLACED = "replaced"
    """A sample at a stamp that already had one: the last one wins."""
    EXPIRED = "expired"
    """Nothing: it was older than the window."""


@dataclass(frozen=True, slots=True)
class Edge:
    """What is known of one frame and its newest parent; stamps in ns, None where there is no moving sample."""

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


class FrameHistory:
    """The samples of one child frame inside its window, or the one static sample that holds always.

    Parameters
    ----------
    child : str
    keep : int or None
        Length of the window before the newest stamp, in ns; None keeps everything.

    Attributes
    ----------
    parent, authority : str
        Of the newest sample; they stay after `clear`.
    static : bool
        Whether the one sample holds at every stamp; then `row` is its transform and `static_stamp` its stamp.
    parents : Counter or None
        How many samples name each parent, while there are several; None while all agree.
    changed : bool
        Set when an insertion may change the path of a lookup: another parent or kind, or a longer past. Whoever acts
        on it clears it.
    """

    __slots__ = (
        "_origin",
        "authority",
        "changed",
        "child",
        "keep",
        "origins",
        "parent",
        "parents",
        "records",
        "row",
        "stamps",
        "start",
        "static",
        "static_stamp",
    )

    def __init__(self, child: str, parent: str, keep: int | None) -> None:
        self.child = child
        self.keep = keep
        self.parent = parent
        self.authority = ""
        self.static = False
        self.static_stamp = 0
        self.row: Row = IDENTITY
        self.parents: Counter[str] | None = None
        self.changed = False
        self.stamps = array("q")
        self.records = bytearray()
        self.origins: list[tuple[str, str]] = []
        self.start = 0
        self._origin = (parent, "")

    def __len__(self) -> int:
        return 1 if self.static else len(self.stamps) - self.start

    @property
    def oldest(self) -> int | None:
        """The oldest stamp in the window; None when there is no moving sample."""
        return self.stamps[self.start] if self.stamps else None

    @property
    def newest(self) -> int | None:
        """The newest stamp; None when there is no moving sample."""
        return self.stamps[-1] if self.stamps else None

    @property
    def mentioned(self) -> tuple[str, ...]:
        """Every parent that a sample in the window names."""
        return (self.parent,) if self.parents is None else tuple(self.parents)

    def insert(self, parent: str, stamp: int, row: Row, authority: str) -> Outcome:
        """Store one moving sample, then drop what fell out of the window. A static sample is dropped first."""
        if self.static:
            self._become_moving(parent)
        stamps = self.stamps
        if stamps and stamp <= stamps[-1]:
            return self._insert_late(parent, stamp, row, authority)
        if parent != self.parent:
            self._reparent(parent, authority)
        elif authority != self.authority:
            self.authority = authority
            self._origin = (parent, authority)
        if self.parents is not None:
            self.parents[parent] += 1
        stamps.append(stamp)
        self.records += _pack(stamp, *row)
        self.origins.append(self._origin)
        if self.keep is not None and stamps[self.start] < stamp - self.keep:
            self._prune(stamp - self.keep)
        return Outcome.INSERTED

    def insert_static(self, parent: str, stamp: int, row: Row, authority: str) -> Outcome:
        """Store the sample that holds at every stamp; moving samples are dropped."""
        outcome = Outcome.REPLACED if self.static else Outcome.INSERTED
        if not self.static or parent != self.parent or row != self.row:
            self.clear()
            self.changed = True
        self.static = True
        self.static_stamp = stamp
        self.parent = parent
        self.authority = authority
        self.row = row
        return outcome

    def clear(self) -> None:
        """Drop all moving samples; the newest parent is remembered."""
        del self.stamps[:]
        del self.records[:]
        del self.origins[:]
        self.start = 0
        if self.parents is not None:
            self.parents = None
            self.changed = True

    def parent_at(self, stamp: int) -> str:
        """The parent that holds at `stamp`; outside the window, that of the nearest sample."""
        if self.parents is None:
            return self.parent
        return self.origins[max(bisect_right(self.stamps, stamp, self.start) - 1, self.start)][0]

    def since(self) -> int | None:
        """The stamp from which the newest parent has held without a break."""
        if self.parents is None:
            return self.oldest
        first = len(self.origins) - 1
        while first > self.start and self.origins[first - 1][0] == self.parent:
            first -= 1
        return self.stamps[first]

    def covers(self, stamp: int) -> bool:
        """Whether a lookup at `stamp` has an answer here."""
        return self.static or (bool(self.stamps) and self.stamps[self.start] <= stamp <= self.stamps[-1])

    def missing(self, stamp: int | Latest) -> ExtrapolationError:
        """The error that says why `stamp` is not covered."""
        oldest, newest = self.oldest, self.newest
        past = oldest is not None and isinstance(stamp, int) and stamp < oldest
        kind = PastExtrapolationError if past else FutureExtrapolationError
        return kind(child=self.child, stamp=stamp, oldest=oldest, newest=newest, authority=self.authority)

    def edge(self) -> Edge:
        """The facts of this frame's newest edge."""
        return Edge(self.parent, self.child, self.static, len(self), self.oldest, self.newest, self.authority)

    def copy(self) -> "FrameHistory":
        """An independent copy."""
        twin = FrameHistory(self.child, self.parent, self.keep)
        for name in ("authority", "static", "static_stamp", "row", "start", "_origin"):
            setattr(twin, name, getattr(self, name))
        twin.stamps = self.stamps[:]
        twin.records = self.records[:]
        twin.origins = self.origins[:]
        twin.parents = None if self.parents is None else self.parents.copy()
        return twin

    def _become_moving(self, parent: str) -> None:
        self.static = False
        self.parent = parent
        self.authority = ""
        self._origin = (parent, "")
        self.changed = True

    def _reparent(self, parent: str, authority: str) -> None:
        """Take note of a sample that is about to be stored as the newest and names another parent."""
        if self.stamps and self.parents is None:
            self.parents = Counter({self.parent: len(self)})
        self.parent = parent
        self.authority = authority
        self._origin = (parent, authority)
        self.changed = True

    def _insert_late(self, parent: str, stamp: int, row: Row, authority: str) -> Outcome:
        """Store a sample that is not newer than the newest."""
        stamps = self.stamps
        if self.keep is not None and stamp < stamps[-1] - self.keep:
            return Outcome.EXPIRED
        at = bisect_left(stamps, stamp, self.start)
        replaces = stamps[at] == stamp
        if at == self.start and not replaces:
            self.changed = True
        if self.parents is not None or parent != self.parent:
            self.parents = self.parents or Counter({self.parent: len(self)})
            self.parents[parent] += 1
            if replaces:
                self._forget(self.origins[at][0])
            self.changed = True
        width = RECORD_SIZE if replaces else 0
        self.records[at * RECORD_SIZE : at * RECORD_SIZE + width] = _pack(stamp, *row)
        if replaces:
            self.origins[at] = (parent, authority)
        else:
            stamps.insert(at, stamp)
            self.origins.insert(at, (parent, authority))
        if at == len(stamps) - 1:
            self.parent, self.authority = self._origin = self.origins[at]
        self._settle_parents()
        return Outcome.REPLACED if replaces else Outcome.INSERTED

    def _prune(self, horizon: int) -> None:
        """Drop the samples older than `horizon`."""
        stamps, first = self.stamps, self.start
        while stamps[self.start] < horizon:
            self.start += 1
        if self.parents is not None:
            for parent, _ in self.origins[first : self.start]:
                self._forget(parent)
            self._settle_parents()
        # One cut for many samples: moving the rest down costs as much for one as for a hundred.
        if self.start * 8 >= len(stamps) and self.start >= 16:
            del stamps[: self.start]
            del self.origins[: self.start]
            del self.records[: self.start * RECORD_SIZE]
            self.start = 0

    def _forget(self, parent: str) -> None:
        """One sample that named `parent` has gone."""
        assert self.parents is not None
        self.parents[parent] -= 1
        if not self.parents[parent]:
            del self.parents[parent]
            self.changed = True

    def _settle_parents(self) -> None:
        if self.parents is not None and len(self.parents) == 1:
            self.parents = None
