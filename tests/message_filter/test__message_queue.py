from typing import Any

import pytest

from tfbus.message_filter.message_filter import MessageQueue, Order, PendingMessage
from tfbus.stamps import LATEST

Pending = PendingMessage[str, str]


def queue_of(order: Order, *stamps: int) -> tuple[MessageQueue[str, str], list[Pending]]:
    queue: MessageQueue[str, str] = MessageQueue(10, order)
    messages = [Pending(f"message {stamp}", "laser", stamp) for stamp in stamps]
    for message in messages:
        queue.append(message)
    return queue, messages


def popped(queue: MessageQueue[str, str]) -> list[int]:
    """The stamps of the messages that are ready, in the order of delivery."""
    stamps: list[int] = []
    while (ready := queue.pop_ready()) is not None:
        message, answer = ready
        assert answer == "there"
        stamps.append(int(message.removeprefix("message ")))
    return stamps


@pytest.mark.parametrize(("order", "expected"), [("ready", [2, 3]), ("stamp", []), ("arrival", [3])])
def test_a_waiting_message_holds_back_later_ones_in_the_order(order: Order, expected: list[int]) -> None:
    queue, (three, one, two) = queue_of(order, 3, 1, 2)
    queue.set_answer(two, "there", moment=1)
    queue.set_answer(three, "there", moment=2)
    assert popped(queue) == expected
    assert (len(queue), queue.unanswered) == (3 - len(expected), 1)
    queue.remove(one)
    assert popped(queue) == [stamp for stamp in ([3, 2] if order == "arrival" else [2, 3]) if stamp not in expected]
    assert (len(queue), queue.unanswered, queue.messages) == (0, 0, ())


def test_of_messages_that_become_ready_at_one_moment_the_first_to_arrive_is_delivered_first() -> None:
    queue, (first, second, third) = queue_of("ready", 7, 8, 9)
    queue.set_answer(third, "there", moment=4)
    queue.set_answer(second, "there", moment=5)
    queue.set_answer(first, "there", moment=5)
    assert popped(queue) == [9, 7, 8]


def test_equal_stamps_leave_in_the_order_of_arrival() -> None:
    queue, messages = queue_of("stamp", 5, 5, 4)
    for number in (2, 1, 0):
        queue.set_answer(messages[number], f"answer {number}", moment=1)
    ready = [queue.pop_ready() for _ in messages]
    assert ready == [("message 4", "answer 2"), ("message 5", "answer 0"), ("message 5", "answer 1")]


def test_a_message_stamped_latest_is_allowed_in_the_orders_ready_and_arrival() -> None:
    for order in ("ready", "arrival"):
        queue: MessageQueue[str, str] = MessageQueue(10, order)
        pending = Pending("now", "laser", LATEST)
        queue.append(pending)
        queue.set_answer(pending, "there", moment=0)
        assert queue.pop_ready() == ("now", "there")


def test_the_queue_lists_waiting_messages_and_the_oldest() -> None:
    queue, (first, second) = queue_of("ready", 1, 2)
    assert (queue.oldest, queue.waiting, queue.messages) == (first, (first, second), (first, second))
    queue.set_answer(first, "there", moment=1)
    assert (queue.is_waiting(first), queue.is_waiting(second), queue.waiting) == (False, True, (second,))
    queue.remove(second)
    assert (second in queue, queue.is_waiting(second), first in queue) == (False, False, True)


def test_ready_and_waiting_messages_count_for_the_capacity() -> None:
    queue: MessageQueue[str, str] = MessageQueue(2, "ready")
    first, second = Pending("first", "laser", 1), Pending("second", "laser", 2)
    queue.append(first)
    queue.set_answer(first, "there", moment=1)
    assert not queue.full
    queue.append(second)
    assert queue.full
    queue.pop_ready()
    assert not queue.full


@pytest.mark.parametrize(
    ("capacity", "order", "error"),
    [(0, "ready", ValueError), (True, "ready", TypeError), (1.0, "ready", TypeError), (1, "size", ValueError)],
)
def test_a_bad_capacity_or_order_is_an_error(capacity: Any, order: Any, error: type[Exception]) -> None:
    with pytest.raises(error):
        MessageQueue(capacity, order)
