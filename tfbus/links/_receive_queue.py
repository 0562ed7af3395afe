"""The queue between the threads of a network and the event loop."""

import enum
import threading
from collections import deque
from dataclasses import dataclass
from typing import Any

from tfbus.statistics import QueueStatistics

MAX_BYTES = 64 * 2**20
MANY = 100
"""Moving items that wait, beyond which an answer overtakes those of its own sender too."""
_OVERHEAD = 256
"""Bytes that an item takes besides its content."""


class Presence(enum.Enum):
    """The content of an item that tells that a peer has come or gone."""

    JOINED = enum.auto()
    LEFT = enum.auto()


@dataclass(frozen=True, slots=True)
class Question:
    """The content of an item that asks for the changes of this link's state behind a number.

    `handle` is what the carrier needs to answer.
    """

    since: int
    handle: Any


@dataclass(frozen=True, slots=True)
class Answer:
    """The content of an item that answers a question to the sender; `message` is None if there was no answer."""

    message: Any


@dataclass(frozen=True, slots=True)
class HistoryQuestion:
    """The content of an item that asks for the last seconds of the moving frames whose names come after `after`."""

    seconds: float
    after: str
    handle: Any


@dataclass(frozen=True, slots=True)
class HistoryAnswer:
    """The content of an item that answers such a question; `message` is None if there was no answer."""

    message: Any


@dataclass(frozen=True, slots=True)
class Received:
    """One item that a carrier has received.

    Attributes
    ----------
    sender : str
        The id of the peer; empty if it is unknown.
    content : Any
        A `Presence`; a `MalformedMessageError`, for which the carrier has refused a message; a `Question` or an
        `Answer`; or a message, which the carrier's `read` decodes on the event loop.
    size : int
        Bytes that the content keeps in memory.
    moving : bool
        Whether the item may be dropped under load, because newer data will follow.
    """

    sender: str
    content: Any
    size: int = 0
    moving: bool = False


class ReceiveQueue:
    """Holds what threads have received until the event loop reads it.

    Items are read in order, but what brings two ends to agree (questions, answers, and that a peer has come or gone) is
    read first: where nobody has time, what waits may take seconds. All that waits of a peer is read before its end, for
    it was sent before that, and before its answer, which would else split batches. Only while more than `MANY` moving
    items wait, the answer does not wait for them.

    Parameters
    ----------
    capacity : int
        How many moving items may be pending, within 64 MiB for all items together; beyond that the oldest moving items
        are dropped, and when there are none, the oldest of the others. What is to be read first is dropped last.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._lock = threading.Lock()
        self._urgent: deque[Received] = deque()
        # Items that do not move and were passed over in a search for the oldest moving one.
        self._kept: deque[Received] = deque()
        self._pending: deque[Received] = deque()
        self._bytes = 0
        self._moving = 0
        self._dropped = 0

    def __len__(self) -> int:
        return len(self._urgent) + len(self._kept) + len(self._pending)

    def put(self, item: Received) -> None:
        """Append an item, from any thread."""
        with self._lock:
            if isinstance(item.content, Presence | Question | Answer):
                few = self._moving <= MANY
                if item.content is Presence.LEFT or (few and isinstance(item.content, Answer)):
                    self._hurry(item.sender)
                self._urgent.append(item)
            else:
                self._pending.append(item)
            self._bytes += _footprint(item)
            self._moving += item.moving
            while self._moving > self._capacity or self._bytes > MAX_BYTES:
                self._drop_oldest()

    def get(self) -> Received | None:
        """Remove and return the oldest item; None if the queue is empty."""
        with self._lock:
            for queue in (self._urgent, self._kept, self._pending):
                if queue:
                    return self._pop(queue)
        return None

    def discard_moving(self) -> None:
        """Drop all moving items, because the clock has jumped back."""
        with self._lock:
            for queue in (self._urgent, self._kept, self._pending):
                kept = [item for item in queue if not item.moving]
                queue.clear()
                queue.extend(kept)
            self._dropped += self._moving
            self._bytes = sum(map(_footprint, (*self._urgent, *self._kept, *self._pending)))
            self._moving = 0

    def statistics(self) -> QueueStatistics:
        """The queue's counters, in items."""
        with self._lock:
            return QueueStatistics("link", "drop_oldest", self._capacity, len(self), self._dropped)

    def _drop_oldest(self) -> None:
        while self._pending and not self._pending[0].moving:
            self._kept.append(self._pending.popleft())
        if self._moving and not self._pending:
            self._pop(self._urgent, next(place for place, item in enumerate(self._urgent) if item.moving))
        else:
            self._pop(self._pending or self._kept or self._urgent)
        self._dropped += 1

    def _pop(self, queue: deque[Received], place: int = 0) -> Received:
        item = queue[place]
        del queue[place]
        self._bytes -= _footprint(item)
        self._moving -= item.moving
        return item

    def _hurry(self, sender: str) -> None:
        """Have all that waits of a peer read before what waits of others."""
        for queue in (self._kept, self._pending):
            waiting = list(queue)
            queue.clear()
            for item in waiting:
                (self._urgent if item.sender == sender else queue).append(item)


def _footprint(item: Received) -> int:
    return item.size + _OVERHEAD
