"""A bounded queue of events, which says once what a quarrel or a refusal would otherwise say with every sample."""

from collections import deque
from collections.abc import Hashable, Iterable

from tfbus._log import SeenKeys
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
    Reparented,
    SampleRejected,
)
from tfbus.statistics import QueueStatistics

_CLAIMS = 100
_REFUSED_FRAMES = 1_000


class EventQueue:
    """Events in the order in which they happened; when there are too many, the oldest go.

    A conflict of authorities is told once for each frame and pair of them. From then on a new parent or kind of that
    frame is told once for each authority that says so. A rejected sample is told once for each frame, authority and
    reason. All of this begins anew when the frame is removed or added, and when the clock jumps back.

    One authority that moves a frame to and fro is told of each time, because that may be what it is for. If the queue
    is full, such a frame pushes out what it said itself, and nobody else's events.

    Parameters
    ----------
    capacity : int
        How many events may be pending, at least one; those of `known` and of `put_news` do not count,
        and are never dropped.
    known : iterable of FrameAdded
        What was there at the beginning.

    Attributes
    ----------
    dropped : int
        Events lost to the capacity.
    """

    def __init__(self, capacity: int, known: Iterable[FrameAdded] = ()) -> None:
        check_capacity(capacity)
        self.capacity = capacity
        self.dropped = 0
        self._kept: deque[Event] = deque(known)
        self._events: deque[Event] = deque()
        self._quarrels: dict[str, SeenKeys] = {}
        self._refusals: dict[str | None, SeenKeys] = {}

    def __len__(self) -> int:
        return len(self._kept) + len(self._events)

    def put(self, event: Event) -> None:
        """Add an event, unless it has been told."""
        if isinstance(event, (FrameAdded, FrameRemoved)):
            self._quarrels.pop(event.frame, None)
            self._refusals.pop(event.frame, None)
        elif isinstance(event, ClockReset):
            self._quarrels.clear()
            self._refusals.clear()
        elif self._told(event):
            return
        if len(self._events) == self.capacity:
            del self._events[self._place_to_drop(event)]
            self.dropped += 1
        self._events.append(event)

    def put_news(self, news: Iterable[FrameStale | FrameLive]) -> None:
        """Add what was worked out for the reader while nothing was pending: at most one event a frame."""
        self._kept.extend(news)

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

    def _told(self, event: Event) -> bool:
        key: Hashable
        if isinstance(event, AuthorityConflict):
            once = self._quarrels.setdefault(event.frame, SeenKeys(_CLAIMS))
            key = frozenset((event.authority, event.other))
        elif isinstance(event, SampleRejected):
            once = self._refusals.setdefault(event.frame, SeenKeys(_CLAIMS))
            key = (event.authority, event.reason)
            if len(self._refusals) > _REFUSED_FRAMES:
                del self._refusals[next(iter(self._refusals))]
        elif isinstance(event, Reparented) and event.frame in self._quarrels:
            once = self._quarrels[event.frame]
            key = (event.authority, event.parent)
        elif isinstance(event, KindChanged) and event.frame in self._quarrels:
            once = self._quarrels[event.frame]
            key = (event.authority, event.static)
        else:
            return False
        return not once.first(key)
