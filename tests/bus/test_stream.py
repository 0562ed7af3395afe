from collections.abc import Awaitable, Callable
from functools import partial

import anyio
import anyio.lowlevel
import pytest
from support.asking import Asked, driving, settle
from support.samples import moving, static

from tfbus import Bus, BusClosedError, SimulatedClock, Stream, TransformStamped
from tfbus.bus.queues import Overflow

pytestmark = pytest.mark.anyio

Batches = list[tuple[TransformStamped, ...]]
OVERFLOWS: list[Overflow] = ["conflate", "drop_oldest"]


async def read(stream: Stream, batches: Batches) -> None:
    async for batch in stream:
        batches.append(batch)


@pytest.mark.every_loop
async def test_a_stream_gives_whole_batches_in_order() -> None:
    bus = Bus(SimulatedClock())
    sent = [(moving("map", "a", k), moving("a", "b", k)) for k in range(20)]
    got: Batches = []
    async with anyio.create_task_group() as tasks:
        with bus.stream(overflow="drop_oldest") as stream:
            tasks.start_soon(read, stream, got)
            await settle()
            for batch in sent[:10]:
                bus.publish(batch)
                await settle()
            for batch in sent[10:]:
                bus.publish(batch)
            await settle()
            assert got == sent


async def test_a_slow_reader_of_a_conflating_stream_gets_the_newest_of_each_child() -> None:
    bus = Bus(SimulatedClock())
    with bus.stream(capacity=2) as stream:
        for k in range(100):
            bus.publish([moving("map", "a", k), moving("map", "b", k)])
        assert set(await anext(stream)) == {moving("map", "a", 99), moving("map", "b", 99)}
        assert stream.dropped == 0


async def test_samples_that_a_slow_reader_misses_are_counted() -> None:
    bus = Bus(SimulatedClock())
    with bus.stream(capacity=3, overflow="drop_oldest") as stream:
        for k in range(10):
            bus.publish(moving("map", "a", k))
        assert [await anext(stream) for _ in range(3)] == [(moving("map", "a", k),) for k in (7, 8, 9)]
        assert stream.dropped == 7
        assert [queue.dropped for queue in bus.statistics().queues] == [7]


@pytest.mark.parametrize("overflow", OVERFLOWS)
async def test_a_late_stream_gives_the_latched_static_samples_first(overflow: Overflow) -> None:
    bus = Bus(SimulatedClock())
    bus.publish([static("map", "a"), static("map", "b", x=1.0), moving("map", "c", 1)])
    bus.publish(static("map", "b", x=2.0))
    with bus.stream(overflow=overflow) as stream:
        assert set(await anext(stream)) == {static("map", "a"), static("map", "b", x=2.0)}
        bus.publish(moving("map", "c", 2))
        assert await anext(stream) == (moving("map", "c", 2),)


@pytest.mark.parametrize("overflow", OVERFLOWS)
async def test_a_full_stream_keeps_every_static_sample(overflow: Overflow) -> None:
    bus = Bus(SimulatedClock())
    with bus.stream(capacity=1, overflow=overflow) as stream:
        for k in range(10):
            bus.publish([static("map", f"sensor_{k}"), moving("map", f"joint_{k}", k)])
        bus.close()
        got = [sample async for batch in stream for sample in batch]
    assert {sample.child for sample in got if sample.static} == {f"sensor_{k}" for k in range(10)}
    assert [sample.child for sample in got if not sample.static] == ["joint_9"]


async def test_each_of_two_streams_gives_every_batch() -> None:
    bus = Bus(SimulatedClock())
    with bus.stream() as first, bus.stream() as second:
        bus.publish(moving("map", "a", 1))
        assert await anext(first) == await anext(second) == (moving("map", "a", 1),)


@pytest.mark.parametrize("overflow", OVERFLOWS)
@pytest.mark.parametrize("end", [lambda bus, _: bus.close(), lambda _, stream: stream.close()])
async def test_a_closed_stream_ends_after_the_pending_batches(
    end: Callable[[Bus, Stream], None], overflow: Overflow
) -> None:
    bus = Bus(SimulatedClock())
    stream = bus.stream(overflow=overflow)
    bus.publish(moving("map", "a", 1))
    end(bus, stream)
    got: Batches = []
    await read(stream, got)
    assert got == [(moving("map", "a", 1),)]
    with pytest.raises(StopAsyncIteration):
        await anext(stream)


async def test_a_closed_stream_gets_no_more_batches() -> None:
    bus = Bus(SimulatedClock())
    with bus.stream() as stream:
        assert len(bus.statistics().queues) == 1
    stream.close()
    bus.publish(moving("map", "a", 1))
    assert bus.statistics().queues == ()
    with pytest.raises(StopAsyncIteration):
        await anext(stream)


async def test_a_stream_may_be_closed_in_a_callback_of_the_bus() -> None:
    bus = Bus(SimulatedClock())
    with bus.stream() as closing, bus.stream() as staying, bus.subscribe(lambda _: closing.close()):
        bus.publish(moving("map", "a", 1))
        bus.publish(moving("map", "b", 2))
        assert set(await anext(staying)) == {moving("map", "a", 1), moving("map", "b", 2)}
        assert [batch async for batch in closing] == [(moving("map", "a", 1),)]
    assert bus.statistics().callbacks_failed == 0


@pytest.mark.parametrize("overflow", OVERFLOWS)
async def test_a_jump_back_discards_pending_moving_samples(overflow: Overflow) -> None:
    clock = SimulatedClock(start=10)
    bus = Bus(clock)
    with bus.stream(overflow=overflow) as stream:
        bus.publish([static("map", "a"), moving("map", "b", 10)])
        clock.set(5)
        bus.publish(moving("map", "b", 5))
        bus.close()
        got = [sample async for batch in stream for sample in batch]
        assert got == [static("map", "a"), moving("map", "b", 5)]
        assert stream.dropped == 1


@pytest.mark.parametrize("overflow", OVERFLOWS)
async def test_pending_samples_of_a_removed_frame_are_discarded(overflow: Overflow) -> None:
    bus = Bus(SimulatedClock())
    with bus.stream(overflow=overflow) as stream:
        bus.publish([moving("map", "a", 1), moving("a", "b", 1)])
        bus.remove_frame("a")
        assert await anext(stream) == (moving("a", "b", 1),)


def test_a_stream_may_be_made_before_a_loop_runs_and_read_on_several(
    run: Callable[[Callable[[], Awaitable[None]]], None],
) -> None:
    bus = Bus(SimulatedClock())
    stream = bus.stream()

    async def read_one(second: int) -> None:
        async with anyio.create_task_group() as tasks:
            asked = Asked(tasks, stream.__anext__)
            await settle()
            bus.publish(driving("map", "a", second))
            await settle()
            assert asked.answer == (driving("map", "a", second),)

    for second in range(3):
        run(partial(read_one, second))


@pytest.mark.parametrize(("capacity", "overflow"), [(0, "conflate"), (10, "block")])
def test_a_stream_with_a_bad_capacity_or_overflow_is_not_registered(capacity: int, overflow: Overflow) -> None:
    bus = Bus(SimulatedClock())
    with pytest.raises(ValueError, match=r"capacity|overflow"):
        bus.stream(capacity, overflow)
    bus.publish(moving("map", "a", 1))
    assert bus.statistics().queues == ()


def test_a_closed_bus_gives_no_stream() -> None:
    bus = Bus(SimulatedClock())
    bus.close()
    with pytest.raises(BusClosedError):
        bus.stream()
