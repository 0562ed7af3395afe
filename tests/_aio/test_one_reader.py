from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import anyio
import pytest
from support.asking import Asked, settle

from tfbus._aio.task_groups import OneReader, OneReaderStream

pytestmark = [pytest.mark.anyio, pytest.mark.every_loop]


# OneReader


async def test_a_wait_ends_with_the_next_wake_and_not_with_one_before_it() -> None:
    reader = OneReader()
    reader.wake()
    async with anyio.create_task_group() as tasks:
        for _ in range(2):
            waiting = Asked(tasks, reader.wait)
            await settle()
            assert not waiting.ended
            assert reader.waiting
            reader.wake()
            reader.wake()
            await settle()
            assert waiting.ended
            assert not reader.waiting
            assert reader.was_woken


@pytest.mark.parametrize(("wakes", "was_woken"), [("before", True), ("after", True), ("never", False)])
async def test_was_woken_tells_of_a_wake_in_the_turn_in_which_the_wait_was_cancelled(
    wakes: str, was_woken: bool
) -> None:
    reader = OneReader()
    async with anyio.create_task_group() as tasks:
        waiting = Asked(tasks, reader.wait)
        await settle()
        if wakes == "before":
            reader.wake()
        waiting.cancel()
        if wakes == "after":
            reader.wake()
        await settle()
        assert waiting.ended
    assert reader.was_woken is was_woken
    assert not reader.waiting


async def test_was_woken_is_about_the_last_wait_only() -> None:
    reader = OneReader()
    assert not reader.was_woken
    async with anyio.create_task_group() as tasks:
        for wake in (True, False):
            waiting = Asked(tasks, reader.wait)
            await settle()
            (reader.wake if wake else waiting.cancel)()
            await settle()
            assert reader.was_woken is wake


# OneReaderStream


class Numbers(OneReaderStream[int]):
    """A stream of the numbers that a test puts into it."""

    def __init__(self, check_thread: Callable[[], object] = lambda: None) -> None:
        self.detached: list[Any] = []
        super().__init__(check_thread, self.detached.append)
        self.pending: deque[int] = deque()

    def put(self, number: int) -> None:
        self.pending.append(number)
        self.wake()

    def _next(self) -> int | None:
        return self.pending.popleft() if self.pending else None


async def read(numbers: Numbers) -> list[int]:
    return [number async for number in numbers]


async def test_a_reader_gets_each_item_in_order_whether_it_waits_or_not() -> None:
    numbers = Numbers()
    numbers.put(0)
    async with anyio.create_task_group() as tasks:
        reader = Asked(tasks, partial(read, numbers))
        for number in (1, 2, 3):
            await settle()
            assert numbers.waiting
            numbers.put(number)
        numbers.put(4)
        numbers.end()
    assert reader.answer == [0, 1, 2, 3, 4]
    assert not numbers.waiting


async def test_a_wake_without_an_item_leaves_the_reader_waiting() -> None:
    numbers = Numbers()
    async with anyio.create_task_group() as tasks:
        reader = Asked(tasks, numbers.__anext__)
        await settle()
        numbers.wake()
        await settle()
        assert not reader.ended
        assert numbers.waiting
        numbers.put(7)
    assert reader.answer == 7


async def test_an_item_that_is_false_is_an_item() -> None:
    numbers = Numbers()
    numbers.put(0)
    assert await anext(numbers) == 0


@pytest.mark.parametrize("end", [Numbers.end, Numbers.close])
async def test_the_iteration_ends_after_the_pending_items_and_stays_ended(end: Callable[[Numbers], None]) -> None:
    numbers = Numbers()
    numbers.put(1)
    numbers.put(2)
    end(numbers)
    assert await read(numbers) == [1, 2]
    with pytest.raises(StopAsyncIteration):
        await anext(numbers)


@pytest.mark.parametrize("end", [Numbers.end, Numbers.close])
async def test_the_end_wakes_a_waiting_reader(end: Callable[[Numbers], None]) -> None:
    numbers = Numbers()
    async with anyio.create_task_group() as tasks:
        reader = Asked(tasks, partial(read, numbers))
        await settle()
        end(numbers)
    assert reader.answer == []


async def test_close_and_the_end_of_a_with_detach_the_stream_and_end_does_not() -> None:
    with Numbers() as numbers:
        numbers.end()
        assert numbers.detached == []
    assert numbers.detached == [numbers]
    numbers.close()
    assert numbers.detached == [numbers, numbers]


@pytest.mark.parametrize("item_is_there", [True, False])
async def test_a_second_reader_is_busy_and_the_first_goes_on(item_is_there: bool) -> None:
    numbers = Numbers()
    if item_is_there:
        numbers.put(1)
    async with anyio.create_task_group() as tasks:
        readers = [Asked(tasks, numbers.__anext__) for _ in range(2)]
        if not item_is_there:
            await settle()
            numbers.put(1)
    errors = [reader.error for reader in readers if reader.error is not None]
    assert [type(error) for error in errors] == [anyio.BusyResourceError]
    (first,) = [reader for reader in readers if reader.error is None]
    assert first.answer == 1


async def test_an_item_that_is_there_still_passes_a_checkpoint_and_a_cancelled_reader_loses_none() -> None:
    numbers = Numbers()
    numbers.put(1)
    with anyio.CancelScope() as scope:
        scope.cancel()
        await anext(numbers)
    assert scope.cancelled_caught
    assert await anext(numbers) == 1


async def test_an_item_that_comes_in_the_turn_of_a_cancellation_is_not_lost() -> None:
    for item_first in (True, False):
        numbers = Numbers()
        async with anyio.create_task_group() as tasks:
            reader = Asked(tasks, numbers.__anext__)
            await settle()
            steps: list[Callable[[], object]] = [partial(numbers.put, 1), reader.cancel]
            for step in steps if item_first else reversed(steps):
                step()
        if reader.cancelled:
            assert await anext(numbers) == 1
        else:
            assert reader.answer == 1


async def test_an_error_of_check_thread_refuses_the_reader_before_it_takes_an_item() -> None:
    def refuse() -> None:
        raise RuntimeError("another thread")

    numbers = Numbers(refuse)
    numbers.put(1)
    with pytest.raises(RuntimeError, match="another thread"):
        await anext(numbers)
    assert list(numbers.pending) == [1]
