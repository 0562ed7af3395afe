"""A bounded queue of events, which says of a quarrel once what would otherwise come with every sample."""

from collections import deque
from collections.abc import Hashable, Iterable

from tfbus.events import AuthorityConflict, ClockReset, Event, FrameAdded, FrameRemoved, KindChanged, Reparented
from tfbus.once import Once
from tfbus.sample_queue import check_capacity
from tfbus.statistics import QueueStatistics

_QUARRELS = 100


class EventQueue:
    """Events in the order in which they happened; when there are too many, the oldest go.

    A conflict of authorities is told once for each frame and pair of them. From then on a new parent or kind of that
    frame is told once for each authority that says so. Removing the frame ends that.

    Parameters
    ----------
    capacity : int
        How many events may be pending, at least one; those of `known` do not count, and are never dropped.
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
        self._known = deque(known)
        self._events: deque[Event] = deque()
        self._quarrels: dict[str, Once] = {}

    def __len__(self) -> int:
        return len(self._known) + len(self._events)

    def put(self, event: Event) -> None:
        """Add an event, unless it has been told."""
        if isinstance(event, FrameRemoved):
            self._quarrels.pop(event.frame, None)
        elif isinstance(event, ClockReset):
            self._quarrels.clear()
        elif self._told(event):
            return
        self._events.append(event)
        if len(self._events) > self.capacity:
            self._events.popleft()
            self.dropped += 1

    def get(self) -> Event | None:
        """The next event; None when there is none."""
        if self._known:
            return self._known.popleft()
        return self._events.popleft() if self._events else None

    def statistics(self) -> QueueStatistics:
        """The queue's counters."""
        return QueueStatistics("events", "drop_oldest", self.capacity, len(self), self.dropped)

    def _told(self, event: Event) -> bool:
        key: Hashable
        if isinstance(event, AuthorityConflict):
            quarrel = self._quarrels.setdefault(event.frame, Once(_QUARRELS))
            key = frozenset((event.authority, event.other))
        elif isinstance(event, Reparented) and event.frame in self._quarrels:
            quarrel = self._quarrels[event.frame]
            key = (event.authority, event.parent)
        elif isinstance(event, KindChanged) and event.frame in self._quarrels:
            quarrel = self._quarrels[event.frame]
            key = (event.authority, event.static)
        else:
            return False
        return not quarrel.first(key)
