"""A queue of messages that wait for their transforms, and then for the reader."""

from bisect import bisect_left, insort
from collections.abc import Callable
from itertools import count
from typing import Generic, Literal, TypeVar

from tfbus.bus.sample_queue import check_capacity
from tfbus.stamps import Latest

MessageT = TypeVar("MessageT")
AnswerT = TypeVar("AnswerT")

Order = Literal["ready", "stamp", "arrival"]
"""The order of delivery: as messages become ready, by stamp, or by arrival."""


class PendingMessage(Generic[MessageT, AnswerT]):
    """One message, its frame and its stamp.

    Attributes
    ----------
    answer : transform or tuple of transforms, or None
        Delivered with the message; None while it waits.
    stop_waiting : callable
        Ends the wait for the answer.
    number : int
        Number of messages that arrived before it.
    place : tuple of int or None
        Its place in the order of delivery: its rank, then its number.
    """

    __slots__ = ("answer", "frame", "message", "number", "place", "stamp", "stop_waiting")

    def __init__(self, message: MessageT, frame: str, stamp: int | Latest) -> None:
        self.message = message
        self.frame = frame
        self.stamp = stamp
        self.answer: AnswerT | None = None
        self.stop_waiting: Callable[[], object] = _nothing
        self.number = -1
        self.place: tuple[int, int] | None = None


class MessageQueue(Generic[MessageT, AnswerT]):
    """A bounded queue from which the reader gets only answered messages.

    Parameters
    ----------
    capacity : int
        How many may wait or be ready; at least one. The caller of `append` makes room first.
    order : {"ready", "stamp", "arrival"}
        With ``"stamp"`` and ``"arrival"``, a message that waits holds back those behind it.

    Raises
    ------
    TypeError, ValueError
        If `capacity` is not an integer of at least one, or `order` none of these.
    """

    def __init__(self, capacity: int, order: Order) -> None:
        check_capacity(capacity)
        if order not in ("ready", "stamp", "arrival"):
            raise ValueError(f"order must be 'ready', 'stamp' or 'arrival', not {order!r}")
        self.capacity = capacity
        self.order: Order = order
        self.unanswered = 0
        self._arrivals = count()
        self._pending: dict[int, PendingMessage[MessageT, AnswerT]] = {}
        # The places in the order of delivery; with "ready", only those of answered messages.
        self._line: list[tuple[int, int]] = []

    def __len__(self) -> int:
        return len(self._pending)

    def __contains__(self, pending: PendingMessage[MessageT, AnswerT]) -> bool:
        return pending.number in self._pending

    @property
    def full(self) -> bool:
        """Whether there is no room for another message."""
        return len(self._pending) >= self.capacity

    @property
    def messages(self) -> tuple[PendingMessage[MessageT, AnswerT], ...]:
        """All messages, in the order of arrival."""
        return tuple(self._pending.values())

    @property
    def waiting(self) -> tuple[PendingMessage[MessageT, AnswerT], ...]:
        """The messages without an answer, in the order of arrival."""
        return tuple(pending for pending in self._pending.values() if pending.answer is None)

    @property
    def oldest(self) -> PendingMessage[MessageT, AnswerT]:
        """The message that arrived first."""
        return next(iter(self._pending.values()))

    def is_waiting(self, pending: PendingMessage[MessageT, AnswerT]) -> bool:
        """Whether a message is in the queue and has no answer."""
        return pending in self and pending.answer is None

    def append(self, pending: PendingMessage[MessageT, AnswerT]) -> None:
        """Add a message without an answer; with the order "stamp" it must have a stamp."""
        pending.number = next(self._arrivals)
        self._pending[pending.number] = pending
        self.unanswered += 1
        if self.order == "arrival":
            self._line_up(pending, pending.number)
        elif self.order == "stamp" and not isinstance(pending.stamp, Latest):
            self._line_up(pending, pending.stamp)

    def set_answer(self, pending: PendingMessage[MessageT, AnswerT], answer: AnswerT, moment: int) -> None:
        """Give a waiting message its answer. Of two at one moment, the one that arrived first is ready first."""
        pending.answer = answer
        self.unanswered -= 1
        if pending.place is None:
            self._line_up(pending, moment)

    def remove(self, pending: PendingMessage[MessageT, AnswerT]) -> None:
        """Remove a message, answered or not."""
        del self._pending[pending.number]
        self.unanswered -= pending.answer is None
        if pending.place is not None:
            del self._line[bisect_left(self._line, pending.place)]

    def pop_ready(self) -> tuple[MessageT, AnswerT] | None:
        """Remove the next message in the order of delivery if it has its answer, and return both."""
        if not self._line:
            return None
        pending = self._pending[self._line[0][1]]
        if pending.answer is None:
            return None
        self.remove(pending)
        return pending.message, pending.answer

    def _line_up(self, pending: PendingMessage[MessageT, AnswerT], rank: int) -> None:
        pending.place = rank, pending.number
        insort(self._line, pending.place)


def _nothing() -> None:
    """Do nothing: no wait has been started."""
