"""A bounded queue of events that gives a lasting conflict or refusal once, not with every sample."""

from collections import deque
from collections.abc import Hashable, Iterable

from tfbus.bus.once_logger import SeenKeys
from tfbus.bus.sample_queue import check_capacity
from tfbus.events import (
    AuthorityConflict,
    ClockReset,
    Event,
    FrameAdded,
    FrameLive,
    FrameRemoved,
    FrameStale,
    KindChanged,
    PastLoop,
    Reparented,
    SampleRejected,
    StampAhead,
    StampBehind,
)
from tfbus.statistics import QueueStatistics

_CLAIMS = 100
_REFUSED_FRAMES = 1_000


class EventQueue:
    """Events in the order in which they happened; when there are too many, the oldest are dropped.

    A conflict of authorities is given once for each frame and pair of them. From then on a new parent or kind of that
    frame is given once for each authority that claims it. A rejected sample is given once for each frame, authority and
    reason; a stamp ahead of the clock, or behind it, for each frame and authority; and a loop of parents in the past,
    for each frame, authority and parent. All of this begins anew when the frame is removed or added, and when the clock
    jumps back.

    If one authority moves a frame to and fro, every move is an event, because that may be intended. If the queue is
    full, such a frame pushes out its own events and no others.

    Parameters
    ----------
    capacity : int
        How many events may be pending, at least one; those of `known` and of `put_staleness` do not count,
        and are never dropped.
    known : iterable of FrameAdded, StampAhead or StampBehind
        An event for each frame that has a parent at the beginning, and for each of them that is ahead of the clock, or
        behind it.

    Attributes
    ----------
    dropped : int
        Number of events lost to the capacity.
    """

    def __init__(self, capacity: int, known: Iterable[FrameAdded | StampAhead | StampBehind] = ()) -> None:
        check_capacity(capacity)
        self.capacity = capacity
        self.dropped = 0
        self._kept: deque[Event] = deque(known)
        self._events: deque[Event] = deque()
        self._conflicts: dict[str, SeenKeys] = {}
        self._refusals: dict[str | None, SeenKeys] = {}
        for event in self._kept:
            self._is_repetition(event)

    def __len__(self) -> int:
        return len(self._kept) + len(self._events)

    def put(self, event: Event) -> None:
        """Add an event, unless the queue has given an equal conflict or refusal before."""
        if isinstance(event, (FrameAdded, FrameRemoved)):
            self._conflicts.pop(event.frame, None)
            self._refusals.pop(event.frame, None)
        elif isinstance(event, ClockReset):
            self._conflicts.clear()
            self._refusals.clear()
        elif self._is_repetition(event):
            return
        if len(self._events) == self.capacity:
            del self._events[self._place_to_drop(event)]
            self.dropped += 1
        self._events.append(event)

    def put_staleness(self, changes: Iterable[FrameStale | FrameLive]) -> None:
        """Add the changes of staleness that were found while the queue was empty: at most one event a frame."""
        self._kept.extend(changes)

    def get(self) -> Event | None:
        """The next event; None when there is none."""
        if self._kept:
            return self._kept.popleft()
        return self._events.popleft() if self._events else None

    def statistics(self) -> QueueStatistics:
        """The queue's counters."""
        return QueueStatistics("events", "drop_oldest", self.capacity, len(self), self.dropped)

    def _place_to_drop(self, newest: Event) -> int:
        if isinstance(newest, (Reparented, KindChanged)):
            for place, event in enumerate(self._events):
                if isinstance(event, (Reparented, KindChanged)) and event.frame == newest.frame:
                    return place
        return 0

    def _is_repetition(self, event: Event) -> bool:
        key: Hashable
        if isinstance(event, AuthorityConflict):
            seen = self._conflicts.setdefault(event.frame, SeenKeys(_CLAIMS))
            key = frozenset((event.authority, event.other))
        elif isinstance(event, (SampleRejected, StampAhead, StampBehind, PastLoop)):
            seen = self._refusals.setdefault(event.frame, SeenKeys(_CLAIMS))
            key = (type(event), event.authority, _what(event))
            if len(self._refusals) > _REFUSED_FRAMES:
                del self._refusals[next(iter(self._refusals))]
        elif isinstance(event, Reparented) and event.frame in self._conflicts:
            seen = self._conflicts[event.frame]
            key = (event.authority, event.parent)
        elif isinstance(event, KindChanged) and event.frame in self._conflicts:
            seen = self._conflicts[event.frame]
            key = (event.authority, event.static)
        else:
            return False
        return not seen.add(key)


def _what(event: SampleRejected | StampAhead | StampBehind | PastLoop) -> str | None:
    """That of which an event tells once, beside its frame and authority."""
    if isinstance(event, SampleRejected):
        return event.reason
    return event.parent if isinstance(event, PastLoop) else None
