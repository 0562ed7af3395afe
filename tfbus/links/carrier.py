"""The seam below a link to another world, such as ROS, and the queue of what comes from there.

A carrier writes and reads messages of its world; see `tfbus.links.wire` for the seam below links between buses of
tfbus, whose messages are the same over every network.
"""

import enum
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from tfbus.errors import InvalidTransformError
from tfbus.links.outbox import Turn
from tfbus.links.relay import ReceivedBatch
from tfbus.statistics import QueueStatistics

MANY = 100
"""Moving items that wait, beyond which an answer overtakes those of its own sender too."""
_MAX_BYTES = 64 * 2**20
_OVERHEAD = 256
"""Bytes that an item takes besides its content."""


class Presence(enum.Enum):
    """The content of an item that tells that a peer has come or gone."""

    JOINED = enum.auto()
    LEFT = enum.auto()


@dataclass(frozen=True, slots=True)
class Received:
    """One item that has come.

    Attributes
    ----------
    sender : str
        The id of the peer; empty if it is unknown.
    content : Any
        A `Presence`; a `MalformedMessageError` for a message that was refused; or a message, which is decoded on the
        event loop.
    size : int
        Bytes that the content keeps in memory.
    moving : bool
        Whether the item may be dropped under load, because newer data will follow.
    urgent : bool
        Whether it is read before all that is not.
    follows : bool
        Whether an urgent item is read after all that waits of its sender.
    """

    sender: str
    content: Any
    size: int = 0
    moving: bool = False
    urgent: bool = False
    follows: bool = False


@dataclass(slots=True)
class ReceivedMessage:
    """One message of another world, decoded.

    Attributes
    ----------
    batches : list of ReceivedBatch
        In the order in which they were published; they have no origin.
    errors : list of InvalidTransformError
        One for each sample that was refused; `batches` have the others.
    time : int or None
        The time of the sender's clock, in ns, if it tells that.
    continues : bool
        Whether it is a later part of a message that was counted.
    """

    batches: list[ReceivedBatch]
    errors: list[InvalidTransformError] = field(default_factory=list)
    time: int | None = None
    continues: bool = False


class SendReport:
    """Counts what a carrier has sent, and what it could not send; for the event loop only.

    Parameters
    ----------
    warn : callable
        Called with the error of everything that could not be sent.

    Attributes
    ----------
    messages, samples : int
        The messages and samples that were handed to the network.
    not_sent : Counter
        Samples and removals that no message can hold, by reason.
    """

    def __init__(self, warn: Callable[[Exception], object]) -> None:
        self._warn = warn
        self.messages = 0
        self.samples = 0
        self.not_sent: Counter[str] = Counter()

    def sent(self, samples: int) -> None:
        """Count one message with so many samples."""
        self.messages += 1
        self.samples += samples

    def refused(self, reason: str, error: Exception, count: int = 1) -> None:
        """Count samples and removals that the carrier's messages cannot hold."""
        self.not_sent[reason] += count
        self._warn(error)

    def failed(self, error: Exception) -> None:
        """Tell of a message that the network did not accept."""
        self._warn(error)


class Carrier(Protocol):
    """Carries what a link sends over one network, and brings what comes from there.

    The link decides what goes out, what is news and what is refused; a carrier decides how it is written, and keeps
    static frames for late joiners as its network allows. A carrier is used by one link, and opened once.

    The event loop calls everything here, in this order: `open`; then, while `run` runs as a task, `send` and `read`;
    when `run` has been cancelled, a last `send` may have come, and `close` is called.

    Attributes
    ----------
    id : str
        The name of this end for its peers.
    """

    id: str

    async def open(self, receive: Callable[[Received], object], report: SendReport) -> None:
        """Connect to the network.

        Parameters
        ----------
        receive : callable
            Takes an item that has come: a peer's message, that a peer has come or gone, or that a message was refused.
            Any thread may call it, from now until `close` has returned and later; it never blocks and never raises.
            Items are handled in the order of the calls, so a peer's `Presence.LEFT` has to be the last of its items. A
            carrier whose network tells nothing of presence leaves presence out.
        report : SendReport
            Counts what was sent and what could not be; for the event loop only.

        Raises
        ------
        OSError
            If there is no connection. After any error, also when cancelled, the link calls `close` next.
        """

    def send(self, turn: Turn) -> None:
        """Send what one turn of the event loop has published and removed; a turn is never empty.

        It must not block and must not raise: entries that the carrier's messages cannot hold, and messages that the
        network does not accept, go to the report. Entries leave in order; the changes of static frames go out behind
        the entries of the same turn and may be conflated with later ones.
        """

    def read(self, content: Any) -> ReceivedMessage:
        """Decode a message: the content of an item that the carrier has passed to `receive`.

        Its batches become this bus's own, and go out by the other links of the bus and never by this one. Samples that
        cannot be decoded are in the message's errors.

        Raises
        ------
        MalformedMessageError
            If nothing of it can be used; it is counted by its reason.
        """

    async def run(self) -> None:
        """Do what takes time, such as declaring what is kept for late joiners, until cancelled; may return early.

        An error that it raises ends the link's body, as that of any task does.
        """

    async def close(self) -> None:
        """Disconnect, also if `open` has failed or was cancelled; all that was sent before still goes out.

        The closing has to begin before the first checkpoint, because asyncio's own cancellation knows no shield, and
        has to return within about a second, whatever the network does.
        """


@runtime_checkable
class SplittingCarrier(Carrier, Protocol):
    """A carrier with messages that may be too large for one turn of the event loop."""

    def split(self, content: Any) -> Iterator[Any]:
        """The content of an item in parts, for `read` one by one; an item that is small is its only part.

        It may also yield None, where other tasks may have their turn before there is a part.

        Raises
        ------
        MalformedMessageError
            If the rest of the message cannot be used; the parts before it are.
        """


class ReceiveQueue:
    """Holds what threads have received until the event loop reads it.

    Items are read in order, but urgent ones, which bring two ends to agree, are read first: where nobody has time, the
    others may wait for seconds. All that waits of a peer is read before its end, for it was sent before that, and
    before its answer, which would else split batches. Only while more than `MANY` moving items wait, the answer does
    not wait for them.

    Parameters
    ----------
    capacity : int
        How many moving items may be pending, within 64 MiB for all items together; beyond that the oldest moving items
        are dropped, and when there are none, the oldest of the others. The items that are read first are dropped last.
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
            if item.urgent:
                if item.content is Presence.LEFT or (item.follows and self._moving <= MANY):
                    self._hurry(item.sender)
                self._urgent.append(item)
            else:
                self._pending.append(item)
            self._bytes += _footprint(item)
            self._moving += item.moving
            while self._moving > self._capacity or self._bytes > _MAX_BYTES:
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
