"""Messages that wait for an answer, or for somebody to read it, and the order in which they leave."""

from bisect import bisect_left, insort
from collections.abc import Callable
from itertools import count
from typing import Generic, Literal, TypeVar

from tfbus.stamps import Latest

MessageT = TypeVar("MessageT")
AnswerT = TypeVar("AnswerT")

Order = Literal["ready", "stamp", "arrival"]
"""As they become answerable; by stamp; or as they came."""


class PendingMessage(Generic[MessageT, AnswerT]):
    """One message, its frame and its stamp.

    Attributes
    ----------
    answers : list
        What is delivered with it, as its one element; empty while it waits.
    stop : callable
        Called when what it waits for is no longer wanted.
    number : int
        How many arrived before it.
    place : tuple of int or None
        Where it stands in line: its rank, then its number.
    """

    __slots__ = ("answers", "frame", "message", "number", "place", "stamp", "stop")

    def __init__(self, message: MessageT, frame: str, stamp: int | Latest) -> None:
        self.message = message
        self.frame = frame
        self.stamp = stamp
        self.answers: list[AnswerT] = []
        self.stop: Callable[[], object] = _nothing
        self.number = -1
        self.place: tuple[int, int] | None = None


class MessageQueue(Generic[MessageT, AnswerT]):
    """A bounded queue that only answered messages leave by themselves.

    Parameters
    ----------
    capacity : int
        How many may wait or be ready; at least one. Whoever adds one makes room first.
    order : {"ready", "stamp", "arrival"}
        With ``"stamp"`` and ``"arrival"``, a message that waits holds back those behind it.

    Raises
    ------
    TypeError, ValueError
        If `capacity` is not an integer of at least one, or `order` none of these.
    """

    def __init__(self, capacity: int, order: Order) -> None:
        if isinstance(capacity, bool) or not isinstance(capacity, int):
            raise TypeError(f"capacity must be an int, not {capacity!r}")
        if capacity < 1:
            raise ValueError(f"capacity must be at least 1, got {capacity}")
        if order not in ("ready", "stamp", "arrival"):
            raise ValueError(f"order must be 'ready', 'stamp' or 'arrival', not {order!r}")
        self.capacity = capacity
        self.order: Order = order
        self.unanswered = 0
        self._arrivals = count()
        self._pending: dict[int, PendingMessage[MessageT, AnswerT]] = {}
        # The places in the order of leaving; with "ready", of those that are answered.
        self._line: list[tuple[int, int]] = []

    def __len__(self) -> int:
        return len(self._pending)

    def __contains__(self, pending: PendingMessage[MessageT, AnswerT]) -> bool:
        return pending.number in self._pending

    @property
    def full(self) -> bool:
        """Whether one more would be too many."""
        return len(self._pending) >= self.capacity

    @property
    def everything(self) -> tuple[PendingMessage[MessageT, AnswerT], ...]:
        """All that are here, in the order of arrival."""
        return tuple(self._pending.values())

    @property
    def waiting(self) -> tuple[PendingMessage[MessageT, AnswerT], ...]:
        """Those without an answer, in the order of arrival."""
        return tuple(pending for pending in self._pending.values() if not pending.answers)

    @property
    def oldest(self) -> PendingMessage[MessageT, AnswerT]:
        """The one that arrived first."""
        return next(iter(self._pending.values()))

    def waits(self, pending: PendingMessage[MessageT, AnswerT]) -> bool:
        """Whether this one is here and has no answer."""
        return pending in self and not pending.answers

    def add(self, pending: PendingMessage[MessageT, AnswerT]) -> None:
        """Take in one that has just arrived and has no answer; where the order is by stamp, it has a stamp."""
        pending.number = next(self._arrivals)
        self._pending[pending.number] = pending
        self.unanswered += 1
        if self.order == "arrival":
            self._line_up(pending, pending.number)
        elif self.order == "stamp" and not isinstance(pending.stamp, Latest):
            self._line_up(pending, pending.stamp)

    def answer(self, pending: PendingMessage[MessageT, AnswerT], answer: AnswerT, moment: int) -> None:
        """Give one that waits its answer; of two at one moment, the first to arrive is ready first."""
        pending.answers.append(answer)
        self.unanswered -= 1
        if pending.place is None:
            self._line_up(pending, moment)

    def remove(self, pending: PendingMessage[MessageT, AnswerT]) -> None:
        """Take out one that is here, answered or not."""
        del self._pending[pending.number]
        self.unanswered -= not pending.answers
        if pending.place is not None:
            del self._line[bisect_left(self._line, pending.place)]

    def take(self) -> PendingMessage[MessageT, AnswerT] | None:
        """Take out the next one in line, if it has its answer."""
        if not self._line:
            return None
        pending = self._pending[self._line[0][1]]
        if not pending.answers:
            return None
        self.remove(pending)
        return pending

    def _line_up(self, pending: PendingMessage[MessageT, AnswerT], rank: int) -> None:
        pending.place = rank, pending.number
        insort(self._line, pending.place)


def _nothing() -> None:
    """Nothing has been started that could be stopped."""
