""""""

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import anyio
import pytest
from support.asking import Asked, settle

from tfbus._aio.task_groups import OneReader, OneReaderStream, close_task_group

pytestmark = [pytest.mark.anyio, pytest.mark.every_loop]


# OneReader


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


@pytest.mark.parametrize("end", [Numbers.end, Numbers.close])
async def test_the_iteration_ends_after_the_pending_items_and_stays_ended(end: Callable[[Numbers], None]) -> None:
    numbers = Numbers()
    numbers.put(1)
    numbers.put(2)
    end(numbers)
    assert await read(numbers) == [1, 2]
    with pytest.raises(StopAsyncIteration):
        await anext(numbers)


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


async def fail(error: BaseException) -> None:
    raise error


async def close_with(*errors: BaseException) -> None:
    """Close a group whose tasks raise these errors in one turn of the loop."""
    tasks = anyio.create_task_group()
    await tasks.__aenter__()
    for error in errors:
        tasks.start_soon(fail, error)
    await close_task_group(tasks)


@pytest.mark.parametrize("in_one_task", [True, False])
async def test_a_group_that_one_task_raises_and_the_errors_of_several_tasks_are_a_group(in_one_task: bool) -> None:
    errors = [KeyError("a"), ValueError("b")]
    with pytest.raises(ExceptionGroup) as caught:
        await close_with(*([ExceptionGroup("own", errors)] if in_one_task else errors))
    assert {*caught.value.exceptions} == {*errors}


async def test_the_error_of_a_task_keeps_its_cause_and_its_context() -> None:
    cause, context = KeyError("cause"), ValueError("context")

    async def work() -> None:
        try:
            raise context
        except ValueError:
            raise RuntimeError("work") from cause

    tasks = anyio.create_task_group()
    await tasks.__aenter__()
    tasks.start_soon(work)
    with pytest.raises(RuntimeError, match="work") as caught:
        try:
            raise KeyError("body")
        except KeyError:
            await close_task_group(tasks)
    assert caught.value.__cause__ is cause
    assert caught.value.__context__ is context
