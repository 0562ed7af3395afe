"""The same library under plain ``asyncio.run``, beside asyncio's own timeouts, groups and cancellation."""

import asyncio
import threading
from collections.abc import Callable
from functools import partial

import pytest
from support.asking import HandClock, driving, settle
from support.samples import moving, static

from tfbus import (
    SECOND,
    Buffer,
    Bus,
    LookupTimeoutError,
    SimulatedClock,
    TransformBroadcaster,
    TransformStamped,
)


def make() -> tuple[SimulatedClock, Bus, Buffer]:
    clock = SimulatedClock()
    bus = Bus(clock)
    return clock, bus, Buffer(bus)


def test_a_broadcaster_and_a_listener_in_a_task_group() -> None:
    clock, bus, buffer = make()
    broadcaster = TransformBroadcaster(bus)

    async def broadcast() -> None:
        async for tick in clock.ticks(100):
            broadcaster.send("odom", "base", driving("odom", "base", tick / 100).transform)
            if tick == 300:
                return

    async def listen() -> list[float]:
        seen = []
        for second in range(1, 4):
            found = await buffer.lookup("odom", "base", second * SECOND)
            seen.append(found.transform.translation[0])
        return seen

    async def main() -> list[float]:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(broadcast())
            listener = tasks.create_task(listen())
            await clock.advance(3.0)
        return listener.result()

    assert asyncio.run(main()) == [1.0, 2.0, 3.0]


def test_what_can_be_answered_costs_one_turn_of_the_loop() -> None:
    _, bus, buffer = make()
    bus.publish(static("map", "a"))
    order: list[str] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        loop.call_soon(order.append, "next turn")
        await buffer.lookup("map", "a")
        order.append("answer")
        loop.call_soon(order.append, "turn after")
        await asyncio.sleep(0)

    asyncio.run(main())
    assert order == ["next turn", "answer", "turn after"]


def test_asyncio_timeout_ends_a_wait() -> None:
    _, _, buffer = make()

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


def test_wait_for_ends_a_wait_and_passes_an_answer_on() -> None:
    _, bus, buffer = make()

    async def main() -> None:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(buffer.lookup("map", "a"), 0.001)
        assert buffer.pending() == ()
        bus.publish(moving("map", "a", 7))
        assert (await asyncio.wait_for(buffer.lookup("map", "a"), 3600.0)).stamp == 7

    asyncio.run(main())


def test_our_own_timeout_goes_off_inside_asyncio_s() -> None:
    clock, _, buffer = make()

    async def ask() -> None:
        async with asyncio.timeout(3600.0):
            await buffer.lookup("map", "a", timeout=2.0)

    async def main() -> None:
        task = asyncio.create_task(ask())
        await clock.advance(2.0)
        with pytest.raises(LookupTimeoutError):
            await task

    asyncio.run(main())


def test_a_task_group_that_fails_takes_its_waits_with_it() -> None:
    _, _, buffer = make()

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


def test_a_cancelled_task_is_cancelled_and_leaves_nothing_behind() -> None:
    _, bus, buffer = make()

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


@pytest.mark.parametrize("data_first", [True, False])
def test_a_task_that_is_cancelled_and_woken_in_one_turn_is_cancelled(data_first: bool) -> None:
    _, bus, buffer = make()

    async def main() -> None:
        task = asyncio.create_task(buffer.lookup("map", "a", 5))
        other = asyncio.create_task(buffer.lookup("map", "a", 5))
        await settle()
        steps: list[Callable[[], object]] = [task.cancel, lambda: bus.publish(moving("map", "a", 5))]
        for step in reversed(steps) if data_first else steps:
            step()
        assert (await other).stamp == 5
        with pytest.raises(asyncio.CancelledError):
            await task
        assert buffer.pending() == ()

    asyncio.run(main())


@pytest.mark.parametrize("data", [True, False])
@pytest.mark.parametrize("timeout_first", [True, False])
def test_a_task_that_is_cancelled_as_its_time_runs_out_is_cancelled(timeout_first: bool, data: bool) -> None:
    clock = HandClock()
    bus = Bus(clock)
    buffer = Buffer(bus)

    async def main() -> None:
        task = asyncio.create_task(buffer.lookup("map", "a", 5, timeout=1.0))
        await settle()
        steps: list[Callable[[], object]] = [task.cancel, clock.scopes[-1].cancel]
        for step in reversed(steps) if timeout_first else steps:
            step()
        if data:
            bus.publish(moving("map", "a", 5))
        with pytest.raises(asyncio.CancelledError):
            await task
        assert buffer.pending() == ()

    asyncio.run(main())


def test_a_stream_is_read_by_a_task() -> None:
    _, bus, _ = make()

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


def test_a_callback_of_the_loop_may_publish() -> None:
    _, bus, buffer = make()

    async def main() -> None:
        asyncio.get_running_loop().call_soon(bus.publish, moving("map", "a", 5))
        assert (await buffer.lookup("map", "a", 5)).stamp == 5

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


def test_one_bus_outlives_its_loops() -> None:
    _, bus, buffer = make()

    async def main(stamp: int) -> int:
        task = asyncio.create_task(buffer.lookup("map", "a", stamp))
        await settle()
        bus.publish(moving("map", "a", stamp))
        return (await task).stamp

    assert [asyncio.run(partial(main, stamp)()) for stamp in (1, 2, 3)] == [1, 2, 3]
