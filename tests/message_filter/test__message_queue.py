from typing import Any

import pytest

from tfbus.message_filter._message_queue import MessageQueue, Order, PendingMessage
from tfbus.stamps import LATEST

Pending = PendingMessage[str, str]


def queue_of(order: Order, *stamps: int) -> tuple[MessageQueue[str, str], list[Pending]]:
    queue: MessageQueue[str, str] = MessageQueue(10, order)
    messages = [Pending(f"message {stamp}", "laser", stamp) for stamp in stamps]
    for message in messages:
        queue.add(message)
    return queue, messages


def taken(queue: MessageQueue[str, str]) -> list[object]:
    """The stamps of all that can leave."""
    stamps: list[object] = []
    while (pending := queue.take()) is not None:
        stamps.append(pending.stamp)
    return stamps


@pytest.mark.parametrize(("order", "expected"), [("ready", [2, 3]), ("stamp", []), ("arrival", [3])])
def test_what_waits_holds_back_what_comes_after_it_in_the_order(order: Order, expected: list[int]) -> None:
    queue, (three, one, two) = queue_of(order, 3, 1, 2)
    queue.answer(two, "there", moment=1)
    queue.answer(three, "there", moment=2)
    assert taken(queue) == expected
    assert (len(queue), queue.unanswered) == (3 - len(expected), 1)
    queue.remove(one)
    assert taken(queue) == [stamp for stamp in ([3, 2] if order == "arrival" else [2, 3]) if stamp not in expected]
    assert (len(queue), queue.unanswered, queue.everything) == (0, 0, ())


def test_of_those_that_are_ready_at_one_moment_the_first_to_arrive_leaves_first() -> None:
    queue, (first, second, third) = queue_of("ready", 7, 8, 9)
    queue.answer(third, "there", moment=4)
    queue.answer(second, "there", moment=5)
    queue.answer(first, "there", moment=5)
    assert taken(queue) == [9, 7, 8]


def test_equal_stamps_leave_in_the_order_of_arrival() -> None:
    queue, messages = queue_of("stamp", 5, 5, 4)
    for message in reversed(messages):
        queue.answer(message, "there", moment=1)
    assert [queue.take() for _ in messages] == [messages[2], messages[0], messages[1]]


def test_latest_may_stand_in_any_order_but_that_of_stamps() -> None:
    for order in ("ready", "arrival"):
        queue: MessageQueue[str, str] = MessageQueue(10, order)
        pending = Pending("now", "laser", LATEST)
        queue.add(pending)
        queue.answer(pending, "there", moment=0)
        assert queue.take() is pending


def test_the_queue_knows_who_waits_and_who_came_first() -> None:
    queue, (first, second) = queue_of("ready", 1, 2)
    assert (queue.oldest, queue.waiting, queue.everything) == (first, (first, second), (first, second))
    queue.answer(first, "there", moment=1)
    assert (queue.waits(first), queue.waits(second), queue.waiting) == (False, True, (second,))
    queue.remove(second)
    assert (second in queue, queue.waits(second), first in queue) == (False, False, True)


def test_the_queue_is_full_at_its_capacity_answered_or_not() -> None:
    queue: MessageQueue[str, str] = MessageQueue(2, "ready")
    first, second = Pending("first", "laser", 1), Pending("second", "laser", 2)
    queue.add(first)
    queue.answer(first, "there", moment=1)
    assert not queue.full
    queue.add(second)
    assert queue.full
    queue.take()
    assert not queue.full


@pytest.mark.parametrize(
    ("capacity", "order", "error"),
    [(0, "ready", ValueError), (True, "ready", TypeError), (1.0, "ready", TypeError), (1, "size", ValueError)],
)
def test_a_queue_without_a_bound_or_an_order_is_refused(capacity: Any, order: Any, error: type[Exception]) -> None:
    with pytest.raises(error):
        MessageQueue(capacity, order)
