"""The same library under plain ``asyncio.run``, beside asyncio's own timeouts, groups and cancellation."""

import asyncio
import threading
from collections.abc import Callable

import pytest
from support.asking import HandClock, settle
from support.samples import moving

from tfbus import Buffer, Bus, LookupTimeoutError, TransformStamped


def test_asyncio_timeout_ends_a_wait(buffer: Buffer) -> None:
    async def main() -> None:
        with pytest.raises(TimeoutError) as caught:
            async with asyncio.timeout(0.001):
                await buffer.lookup("map", "a")
        assert not isinstance(caught.value, LookupTimeoutError)
        assert buffer.pending() == ()
        task = asyncio.current_task()
        assert task is not None
        assert task.cancelling() == 0
        await asyncio.sleep(0)

    asyncio.run(main())


def test_wait_for_ends_a_wait_and_passes_an_answer_on(bus: Bus, buffer: Buffer) -> None:
    async def main() -> None:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(buffer.lookup("map", "a"), 0.001)
        assert buffer.pending() == ()
        bus.publish(moving("map", "a", 7))
        assert (await asyncio.wait_for(buffer.lookup("map", "a"), 3600.0)).stamp == 7

    asyncio.run(main())


def test_a_task_group_that_fails_takes_its_waits_with_it(buffer: Buffer) -> None:
    async def fail() -> None:
        await settle()
        assert len(buffer.pending()) == 3
        raise ZeroDivisionError

    async def main() -> None:
        with pytest.raises(ExceptionGroup) as caught:
            async with asyncio.TaskGroup() as tasks:
                for _ in range(3):
                    tasks.create_task(buffer.lookup("map", "a"))
                tasks.create_task(fail())
        assert [type(error) for error in caught.value.exceptions] == [ZeroDivisionError]
        assert buffer.pending() == ()

    asyncio.run(main())


def test_a_cancelled_task_is_cancelled_and_leaves_nothing_behind(bus: Bus, buffer: Buffer) -> None:
    async def main() -> None:
        tasks = [asyncio.create_task(buffer.lookup("map", "a")) for _ in range(3)]
        await settle()
        tasks[1].cancel("enough")
        await settle()
        assert tasks[1].cancelled()
        assert len(buffer.pending()) == 2
        bus.publish(moving("map", "a", 1))
        assert (await tasks[0]) == (await tasks[2])

    asyncio.run(main())


@pytest.mark.parametrize(
    "order",
    ["cancel data", "data cancel", "cancel timeout", "timeout cancel", "cancel timeout data", "timeout cancel data"],
)
def test_a_task_that_is_cancelled_in_the_turn_of_its_answer_or_its_timeout_is_cancelled(order: str) -> None:
    clock = HandClock()
    bus = Bus(clock)
    buffer = Buffer(bus)

    async def main() -> None:
        task = asyncio.create_task(buffer.lookup("map", "a", 5, timeout=1.0))
        await settle()
        steps: dict[str, Callable[[], object]] = {
            "cancel": task.cancel,
            "data": lambda: bus.publish(moving("map", "a", 5)),
            "timeout": clock.scopes[-1].cancel,
        }
        for step in order.split():
            steps[step]()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert buffer.pending() == ()

    asyncio.run(main())


def test_a_stream_is_read_by_a_task(bus: Bus) -> None:
    async def main() -> None:
        with bus.stream(overflow="drop_oldest") as stream:
            task = asyncio.create_task(anext(stream))
            await settle()
            task.cancel()
            bus.publish(moving("map", "a", 1))
            with pytest.raises(asyncio.CancelledError):
                await task
            assert await asyncio.wait_for(anext(stream), 3600.0) == (moving("map", "a", 1),)

    asyncio.run(main())


def test_a_callback_of_a_loop_may_publish_to_a_bus_that_was_made_in_another_thread() -> None:
    bus = Bus()
    buffer = Buffer(bus)
    found: list[TransformStamped] = []

    async def main() -> None:
        asyncio.get_running_loop().call_soon(bus.publish, moving("map", "a", 5))
        found.append(await asyncio.wait_for(buffer.lookup("map", "a", 5), 30.0))

    thread = threading.Thread(target=lambda: asyncio.run(main()))
    thread.start()
    thread.join(60.0)
    assert [answer.stamp for answer in found] == [5]
