"""The events of a bus that a stream gives; `tests/stress/test_event_interleavings.py` has a model of all of them."""

import math
from collections.abc import Callable

import anyio
import pytest
from support.asking import Asked, driving, settle
from support.samples import moving, static

from tfbus import (
    SECOND,
    Bus,
    Event,
    EventStream,
    FrameAdded,
    FrameLive,
    FrameRemoved,
    FrameStale,
    InvalidTransformError,
    PastLoop,
    QueueStatistics,
    SampleRejected,
    SimulatedClock,
    StampAhead,
)
from tfbus.bus.event_stream import EventQueue

pytestmark = pytest.mark.anyio

Events = list[Event]
ENDS: list[Callable[[Bus, EventStream], None]] = [lambda bus, _: bus.close(), lambda _, events: events.close()]


async def read(events: EventStream, got: Events) -> None:
    async for event in events:
        got.append(event)


@pytest.mark.every_loop
async def test_a_waiting_reader_gets_each_event_of_the_bus() -> None:
    bus = Bus(SimulatedClock(start=5))
    got: Events = []
    async with anyio.create_task_group() as tasks:
        with bus.events() as events:
            tasks.start_soon(read, events, got)
            await settle()
            bus.publish(moving("map", "base", 5, authority="odometry"))
            await settle()
            assert got == [FrameAdded(5, "base", "map", "odometry", static=False)]
            bus.remove_frame("base")
            await settle()
            assert got[1:] == [FrameRemoved(5, "base")]


async def test_events_that_a_slow_reader_misses_are_counted_in_the_statistics() -> None:
    bus = Bus(SimulatedClock())
    with bus.events(capacity=2) as events:
        bus.publish([static("map", name) for name in "abcde"])
        assert bus.statistics().queues == (QueueStatistics("events", "drop_oldest", 2, pending=2, dropped=3),)
        assert [str(await anext(events)) for _ in range(2)] == [
            f"0.000 s: static frame {name!r} is new under 'map', from ''" for name in "de"
        ]
        assert events.dropped == 3
    assert bus.statistics().queues == ()


# Stale and live


async def test_a_waiting_reader_gets_a_stale_frame_at_the_very_time_of_the_limit_also_after_a_jump() -> None:
    clock = SimulatedClock()
    bus = Bus(clock)
    got: Events = []
    async with anyio.create_task_group() as tasks:
        with bus.events(stale_after=1.5) as events:
            tasks.start_soon(read, events, got)
            bus.publish(driving("map", "base", 0.0, "odometry"))
            await clock.advance(1.5)
            assert len(got) == 1
            await clock.advance(10.0)
            stale = SECOND * 3 // 2 + 1
            assert got[1:] == [FrameStale(stale, "base", 0, "odometry")]
            bus.publish(driving("map", "base", 11.5, "odometry"))
            await settle()
            assert got[2:] == [FrameLive(23 * SECOND // 2, "base", 23 * SECOND // 2, "odometry")]
            clock.set(60 * SECOND)
            await settle()
            assert got[3:] == [FrameStale(60 * SECOND, "base", 23 * SECOND // 2, "odometry")]


async def test_events_during_the_reading_of_stale_events_come_after_them_and_displace_none() -> None:
    clock = SimulatedClock()
    bus = Bus(clock)
    bus.publish(driving("map", name, 0.0) for name in "abc")
    with bus.events(capacity=1) as events:
        for _ in "abc":
            assert isinstance(await anext(events), FrameAdded)
        await clock.advance(5.0)
        assert await anext(events) == FrameStale(5 * SECOND, "a", 0, "")
        bus.remove_frame("b")
        bus.publish(driving("map", "c", 5.0))
        assert [await anext(events) for _ in range(4)] == [
            FrameStale(5 * SECOND, "b", 0, ""),
            FrameStale(5 * SECOND, "c", 0, ""),
            FrameRemoved(5 * SECOND, "b"),
            FrameLive(5 * SECOND, "c", 5 * SECOND, ""),
        ]


# The end


@pytest.mark.parametrize("end", ENDS)
async def test_a_closed_stream_ends_after_the_pending_events(end: Callable[[Bus, EventStream], None]) -> None:
    clock = SimulatedClock()
    bus = Bus(clock)
    events = bus.events()
    bus.publish(driving("map", "base", 0.0))
    end(bus, events)
    await clock.advance(100.0)
    got: Events = []
    await read(events, got)
    assert [type(event) for event in got] == [FrameAdded]
    with pytest.raises(StopAsyncIteration):
        await anext(events)


async def test_the_error_of_a_rejection_event_has_no_traceback_into_the_sender() -> None:
    bus = Bus(SimulatedClock())
    bus.publish(static("a", "b"))
    with bus.events() as events:
        with pytest.raises(InvalidTransformError) as caught:
            bus.publish(static("b", "a", authority="rogue"))
        await anext(events)
        rejected = await anext(events)
        assert isinstance(rejected, SampleRejected)
        assert (rejected.reason, rejected.frame, rejected.parent, rejected.authority) == ("cycle", "a", "b", "rogue")
        assert str(rejected.error) == str(caught.value)
        assert rejected.error.__traceback__ is None


async def test_rejected_objects_that_are_no_samples_are_events() -> None:
    bus = Bus(SimulatedClock())
    with bus.events() as events:
        bus.publish(["noise", moving("map", "a", 1)], invalid="drop")  # type: ignore[list-item]
        rejected = await anext(events)
        assert isinstance(rejected, SampleRejected)
        assert (rejected.reason, rejected.frame) == ("not a sample", None)
        assert "'noise'" in str(rejected)


# Loops and threads


async def test_another_thread_may_not_touch_the_events_of_a_bus_in_use() -> None:
    bus = Bus(SimulatedClock())
    bus.publish(static("map", "a"))
    with pytest.raises(RuntimeError, match=r"bus\.threadsafe"):
        await anyio.to_thread.run_sync(anyio.run, bus.events().__anext__)
    async with anyio.create_task_group() as tasks:
        events = bus.events()
        await anext(events)
        asked = Asked(tasks, events.__anext__)
        await settle()
        with pytest.raises(RuntimeError, match=r"bus\.threadsafe"):
            await anyio.to_thread.run_sync(bus.close)
        asked.cancel()


@pytest.mark.parametrize("bad", [{"capacity": 0}, {"stale_after": -1.0}, {"stale_after": math.nan}])
def test_a_stream_with_a_bad_capacity_or_limit_is_not_registered(bad: dict[str, float]) -> None:
    bus = Bus(SimulatedClock())
    with pytest.raises(ValueError, match=r"capacity|stale_after"):
        bus.events(**bad)  # type: ignore[arg-type]
    assert bus.statistics().queues == ()


def emptied(queue: EventQueue) -> list[Event]:
    events = []
    while (event := queue.get()) is not None:
        events.append(event)
    return events


def added(frame: str) -> FrameAdded:
    return FrameAdded(0, frame, "map", "", static=False)


def test_an_initial_event_of_a_frame_ahead_of_the_clock_is_given_once() -> None:
    ahead = StampAhead(1, "a", 10**9, "x")
    queue = EventQueue(10, [added("a"), ahead])
    queue.put(StampAhead(2, "a", 2 * 10**9, "x"))
    assert emptied(queue) == [added("a"), ahead]
    queue.put(StampAhead(3, "a", 10**9, "y"))
    assert emptied(queue) == [StampAhead(3, "a", 10**9, "y")]


def rejected(frame: str | None, authority: str | None, reason: str = "authority") -> SampleRejected:
    return SampleRejected(1, reason, frame, "map", authority, ValueError())


def test_a_loop_in_the_past_is_given_once_for_a_frame_authority_and_parent() -> None:
    queue = EventQueue(100)
    loops: list[Event] = [
        PastLoop(1, frame, parent, authority, 0, (frame, parent, frame))
        for frame, parent, authority in (("a", "b", "x"), ("a", "c", "x"), ("a", "b", "y"), ("d", "b", "x"))
    ]
    for event in (*loops, *loops, rejected("a", "x", "b")):
        queue.put(event)
    assert emptied(queue) == [*loops, rejected("a", "x", "b")]


def test_memory_is_bounded_for_rejections_of_new_frames_and_authorities() -> None:
    queue = EventQueue(1)
    for number in range(3_000):
        queue.put(rejected(f"frame {number}", "x"))
        queue.put(rejected("frame 0", f"process {number}"))
    dropped = queue.dropped
    queue.put(rejected("frame 2999", "x"))
    queue.put(rejected("frame 2500", "x"))
    assert queue.dropped == dropped, "still remembered"
    queue.put(rejected("frame 1", "x"))
    assert queue.dropped == dropped + 1, "forgotten in favour of later ones"
