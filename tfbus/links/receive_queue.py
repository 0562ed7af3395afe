"""What the threads of a network have received, until the event loop has time for it."""

import threading
from collections import deque
from dataclasses import dataclass
from typing import Any

from tfbus.statistics import QueueStatistics

MAX_BYTES = 64 * 2**20
_OWN_SIZE = 256


@dataclass(frozen=True, slots=True)
class Arrival:
    """One thing that came.

    Attributes
    ----------
    sender : str
        The id of the peer; empty if its key names none.
    content : Any
        A message; a bool, whether the peer is there now; or the error for which a message was refused.
    size : int
        Bytes that its content keeps in memory.
    moving : bool
        Whether it may be dropped when there is too much: newer data will come.
    """

    sender: str
    content: Any
    size: int = 0
    moving: bool = False


class Arrivals:
    """A queue between the threads that receive and the event loop, in order.

    Parameters
    ----------
    capacity : int
        How many moving messages may be pending, in at most 64 MiB with all others; then the oldest of them go, and at
        last those that do not move.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._lock = threading.Lock()
        self._kept: deque[Arrival] = deque()
        self._pending: deque[Arrival] = deque()
        self._bytes = 0
        self._moving = 0
        self._dropped = 0

    def __len__(self) -> int:
        return len(self._kept) + len(self._pending)

    def put(self, arrival: Arrival) -> None:
        """Add one, from any thread."""
        with self._lock:
            self._pending.append(arrival)
            self._bytes += _size(arrival)
            self._moving += arrival.moving
            while self._moving > self._capacity or self._bytes > MAX_BYTES:
                self._drop_one()

    def get(self) -> Arrival | None:
        """The next one; None when there is none."""
        with self._lock:
            for queue in (self._kept, self._pending):
                if queue:
                    arrival = queue.popleft()
                    self._bytes -= _size(arrival)
                    self._moving -= arrival.moving
                    return arrival
        return None

    def discard_moving(self) -> None:
        """Drop what moves, as when the clock jumps back."""
        with self._lock:
            kept = [arrival for arrival in (*self._kept, *self._pending) if not arrival.moving]
            self._dropped += self._moving
            self._kept, self._pending = deque(kept), deque()
            self._bytes = sum(map(_size, kept))
            self._moving = 0

    def statistics(self) -> QueueStatistics:
        """The queue's counters; they count messages."""
        with self._lock:
            return QueueStatistics("link", "drop_oldest", self._capacity, len(self), self._dropped)

    def _drop_one(self) -> None:
        while self._pending and not self._pending[0].moving:
            self._kept.append(self._pending.popleft())
        arrival = (self._pending or self._kept).popleft()
        self._bytes -= _size(arrival)
        self._moving -= arrival.moving
        self._dropped += 1


def _size(arrival: Arrival) -> int:
    # What has no content, as that a peer is there, takes memory too.
    return arrival.size + _OWN_SIZE
