import math
from collections.abc import Awaitable, Callable
from functools import partial

import anyio
import pytest
from support.asking import Asked, driving, settle
from support.samples import moving, static

from tfbus import (
    SECOND,
    AuthorityConflict,
    Bus,
    BusClosedError,
    ClockReset,
    Event,
    EventStream,
    FrameAdded,
    FrameLive,
    FrameRemoved,
    FrameStale,
    InvalidTransformError,
    QueueStatistics,
    SampleRejected,
    SimulatedClock,
    SubscriberFailed,
    to_seconds,
)

pytestmark = pytest.mark.anyio

Events = list[Event]
Run = Callable[[Callable[[], Awaitable[None]]], None]
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


async def test_a_stream_begins_with_an_event_for_each_frame_that_has_a_parent() -> None:
    clock = SimulatedClock()
    bus = Bus(clock)
    bus.publish([static("base", "laser", authority="urdf"), moving("map", "base", 1), moving("map", "gone", 1)])
    bus.remove_frame("gone")
    clock.set(9)
    with bus.events(capacity=1) as events:
        bus.publish(moving("base", "tool", 9))
        assert [await anext(events) for _ in range(3)] == [
            FrameAdded(9, "laser", "base", "urdf", static=True),
            FrameAdded(9, "base", "map", "", static=False),
            FrameAdded(9, "tool", "base", "", static=False),
        ]
        assert events.dropped == 0


async def test_each_of_two_streams_gives_every_event() -> None:
    bus = Bus(SimulatedClock())
    with bus.events() as first, bus.events() as second:
        bus.publish(static("map", "a"))
        assert await anext(first) == await anext(second) == FrameAdded(0, "a", "map", "", static=True)


async def test_a_late_stream_gives_a_conflict_of_authorities_within_two_samples() -> None:
    bus = Bus(SimulatedClock())
    for stamp in range(10):
        bus.publish(moving("map", "base", stamp, authority=("odometry", "slam")[stamp % 2]))
    with bus.events(stale_after=None) as events:
        for stamp in (10, 11):
            bus.publish(moving("map", "base", stamp, authority=("odometry", "slam")[stamp % 2]))
        assert isinstance(await anext(events), FrameAdded)
        assert await anext(events) == AuthorityConflict(0, "base", "odometry", "slam")
        assert len(events.queue) == 0


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


def test_only_the_removal_of_a_frame_that_has_a_parent_is_an_event() -> None:
    bus = Bus(SimulatedClock())
    bus.publish(static("map", "table"))
    with bus.events() as events:
        for frame in ("map", "table"):
            bus.remove_frame(frame)
        found = list(iter(events.queue.get, None))
    assert [event for event in found if isinstance(event, FrameRemoved)] == [FrameRemoved(0, "table")]


# Stale and live


async def test_a_waiting_reader_gets_a_stale_frame_at_the_very_time_of_the_limit() -> None:
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
            await clock.advance(2.0)
            assert got[3:] == [FrameStale(13 * SECOND + 1, "base", 23 * SECOND // 2, "odometry")]


async def test_samples_in_time_do_not_wake_the_reader() -> None:
    clock = SimulatedClock()
    bus = Bus(clock)
    got: Events = []
    async with anyio.create_task_group() as tasks:
        with bus.events() as events:
            tasks.start_soon(read, events, got)
            for tenth in range(100):
                bus.publish(driving("map", "base", tenth / 10))
                await clock.advance(0.1)
            assert [type(event) for event in got] == [FrameAdded]


async def test_staleness_is_not_computed_while_no_task_reads() -> None:
    clock = SimulatedClock()
    bus = Bus(clock)
    with bus.events() as events:
        bus.publish(driving("map", "base", 0.0))
        await clock.advance(100.0)
        bus.publish(driving("map", "base", 100.0))
        assert isinstance(await anext(events), FrameAdded)
        with clock.move_on_after(0.0) as scope:
            await anext(events)
        assert scope.cancelled_caught, "it was quiet for 100 s, but it is not stale now"
        await clock.advance(50.0)
        assert await anext(events) == FrameStale(150 * SECOND, "base", 100 * SECOND, "")


@pytest.mark.parametrize("stale_after", [None, math.inf])
async def test_without_stale_after_no_frame_turns_stale(stale_after: float | None) -> None:
    clock = SimulatedClock()
    bus = Bus(clock)
    got: Events = []
    async with anyio.create_task_group() as tasks:
        with bus.events(stale_after=stale_after) as events:
            tasks.start_soon(read, events, got)
            bus.publish(driving("map", "base", 0.0))
            await clock.advance(1e6)
            assert [type(event) for event in got] == [FrameAdded]


async def test_a_frame_that_is_stale_before_the_first_read_comes_after_the_pending_events() -> None:
    clock = SimulatedClock()
    bus = Bus(clock)
    bus.publish(driving("map", "base", 0.0))
    await clock.advance(5.0)
    with bus.events() as events:
        bus.publish(static("map", "table"))
        assert [type(await anext(events)) for _ in range(3)] == [FrameAdded, FrameAdded, FrameStale]


async def test_no_stale_event_is_dropped_however_many_frames_turn_stale_together() -> None:
    clock = SimulatedClock()
    bus = Bus(clock)
    names = [f"frame {number}" for number in range(100)]
    got: Events = []
    async with anyio.create_task_group() as tasks:
        with bus.events(capacity=10) as events:
            for name in names:
                bus.publish(driving("map", name, 0.0))
                assert isinstance(await anext(events), FrameAdded)
            tasks.start_soon(read, events, got)
            await clock.advance(2.0)
            assert got == [FrameStale(SECOND + 1, name, 0, "") for name in sorted(names)]
            got.clear()
            bus.publish(driving("map", name, 2.0) for name in names)
            await settle()
            assert got == [FrameLive(2 * SECOND, name, 2 * SECOND, "") for name in names]
            assert events.dropped == 0


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


async def test_a_jump_forward_makes_frames_stale_at_once() -> None:
    clock = SimulatedClock()
    bus = Bus(clock)
    got: Events = []
    async with anyio.create_task_group() as tasks:
        with bus.events() as events:
            tasks.start_soon(read, events, got)
            bus.publish(driving("map", "base", 0.0))
            await settle()
            clock.set(60 * SECOND)
            await settle()
            assert got[1:] == [FrameStale(60 * SECOND, "base", 0, "")]


async def test_a_jump_back_is_an_event_and_pending_events_stay() -> None:
    clock = SimulatedClock(start=10 * SECOND)
    bus = Bus(clock)
    with bus.events() as events:
        bus.publish([driving("map", "base", 5.0), static("base", "laser")])
        clock.set(2 * SECOND)
        bus.publish(driving("map", "base", 2.0))
        bus.close()
        got: Events = []
        await read(events, got)
        assert got == [
            FrameAdded(10 * SECOND, "base", "map", "", static=False),
            FrameAdded(10 * SECOND, "laser", "base", "", static=True),
            ClockReset(2 * SECOND, 10 * SECOND),
            FrameAdded(2 * SECOND, "base", "map", "", static=False),
        ], "a moving frame is forgotten by a jump back, so it is new"


@pytest.mark.parametrize("end", [ClockReset, FrameRemoved])
async def test_a_stale_frame_that_was_forgotten_is_new_and_not_live_again(end: type) -> None:
    clock = SimulatedClock(start=10 * SECOND)
    bus = Bus(clock)
    got: Events = []
    async with anyio.create_task_group() as tasks:
        with bus.events(stale_after=1.0) as events:
            tasks.start_soon(read, events, got)
            bus.publish(driving("map", "base", 5.0))
            await settle()
            if end is ClockReset:
                clock.set(2 * SECOND)
            else:
                bus.remove_frame("base")
            bus.publish(driving("map", "base", to_seconds(clock.now())))
            await settle()
    assert [type(event) for event in got] == [FrameAdded, FrameStale, end, FrameAdded]


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


async def test_a_closed_stream_gets_no_more_events() -> None:
    bus = Bus(SimulatedClock())
    with bus.events() as events:
        pass
    events.close()
    bus.publish(static("map", "a"))
    assert len(events.queue) == 0


async def test_a_reader_cancelled_while_it_waits_for_a_stale_frame_loses_no_event() -> None:
    clock = SimulatedClock()
    bus = Bus(clock)
    bus.publish(driving("map", "base", 0.0))
    events = bus.events(stale_after=20.0)
    assert isinstance(await anext(events), FrameAdded)
    async with anyio.create_task_group() as tasks:
        before = Asked(tasks, events.__anext__)
        await settle()
        before.cancel()
        bus.remove_frame("base")
        await settle()
        assert before.cancelled
    await clock.advance(10.0)
    assert await anext(events) == FrameRemoved(0, "base")


async def test_each_failure_of_a_subscriber_is_an_event_with_its_name_and_error() -> None:
    bus = Bus(SimulatedClock(start=3))
    errors = [ValueError("first"), OSError("second")]

    def fragile(_: object) -> None:
        raise errors[len(events.queue) - 1]

    with bus.events() as events, bus.subscribe(fragile):
        bus.publish(moving("map", "a", 1))
        bus.publish(moving("map", "a", 2))
        await anext(events)
        name = fragile.__qualname__
        assert [await anext(events), await anext(events)] == [SubscriberFailed(3, name, error) for error in errors]


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


async def test_rejected_samples_of_threads_are_events() -> None:
    bus = Bus(SimulatedClock(), on_conflict="reject")
    bus.publish(moving("map", "base", 1, authority="odometry"))
    with bus.events() as events:
        with bus.threadsafe() as publish:
            await anyio.to_thread.run_sync(publish, moving("map", "base", 2, authority="driver"))
        await anext(events)
        rejected = await anext(events)
        assert isinstance(rejected, SampleRejected)
        assert (rejected.reason, rejected.authority) == ("authority", "driver")


async def test_rejected_objects_that_are_no_samples_are_events() -> None:
    bus = Bus(SimulatedClock())
    with bus.events() as events:
        bus.publish(["noise", moving("map", "a", 1)], invalid="drop")  # type: ignore[list-item]
        rejected = await anext(events)
        assert isinstance(rejected, SampleRejected)
        assert (rejected.reason, rejected.frame) == ("not a sample", None)
        assert "'noise'" in str(rejected)


# Loops and threads


def test_a_stream_may_be_made_before_a_loop_runs_and_read_on_several(run: Run) -> None:
    bus = Bus(SimulatedClock())
    events = bus.events()

    async def read_one(name: str) -> None:
        async with anyio.create_task_group() as tasks:
            asked = Asked(tasks, events.__anext__)
            await settle()
            bus.publish(static("map", name))
            await settle()
            assert asked.answer == FrameAdded(0, name, "map", "", static=True)

    for name in "abc":
        run(partial(read_one, name))


async def test_another_thread_may_not_touch_the_events_of_a_bus_in_use() -> None:
    bus = Bus(SimulatedClock())
    bus._check_thread()
    with pytest.raises(RuntimeError, match=r"bus\.threadsafe"):
        await anyio.to_thread.run_sync(bus.events)
    with pytest.raises(RuntimeError, match=r"bus\.threadsafe"):
        await anyio.to_thread.run_sync(bus.reserve, "odom", "slam")
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


def test_a_closed_bus_gives_no_events() -> None:
    bus = Bus(SimulatedClock())
    bus.close()
    with pytest.raises(BusClosedError):
        bus.events()
