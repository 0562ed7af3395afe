"""The events of a bus that a stream gives; `tests/stress/test_event_interleavings.py` has a model of all of them."""

import math
from collections.abc import Callable
from dataclasses import astuple

import anyio
import pytest
from support.asking import Asked, settle
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
    QueueStatistics,
    Reparented,
    SampleRejected,
    SimulatedClock,
    StampAhead,
)
from tfbus.bus.event_stream import EventQueue

pytestmark = pytest.mark.anyio

ENDS: list[Callable[[Bus, EventStream], None]] = [lambda bus, _: bus.close(), lambda _, events: events.close()]


async def test_events_that_a_slow_reader_misses_are_counted_in_the_statistics(bus: Bus) -> None:
    with bus.events(capacity=2) as events:
        bus.publish([static("map", name) for name in "abcde"])
        assert bus.statistics().queues == (QueueStatistics("events", "drop_oldest", 2, pending=2, dropped=3),)
        assert [str(await anext(events)) for _ in range(2)] == [
            f"0.000 s: static frame {name!r} is new under 'map', from ''" for name in "de"
        ]
        assert events.dropped == 3
    assert bus.statistics().queues == ()


# The beginning


async def test_the_first_events_tell_of_the_moment_at_which_the_stream_was_opened(bus: Bus) -> None:
    bus.publish([static("map", "a"), static("map", "b")])
    with bus.events() as events:
        bus.publish(static("odom", "a"))
        bus.remove_frame("b")
        assert bus.statistics().queues[0].pending == 4
        found = [await anext(events) for _ in range(4)]
    assert [(type(event), getattr(event, "frame", None), getattr(event, "parent", None)) for event in found] == [
        (FrameAdded, "a", "map"),
        (FrameAdded, "b", "map"),
        (Reparented, "a", "odom"),
        (FrameRemoved, "b", None),
    ]


# Stale and live


async def test_ten_thousand_frames_that_turn_stale_at_once_are_told_of_in_the_order_of_their_names() -> None:
    clock = SimulatedClock(10 * SECOND)
    bus = Bus(clock)
    names = [f"f{number:05}" for number in range(10_000)]
    bus.publish([moving("map", name, 9 * SECOND) for name in reversed(names)])
    with bus.events() as events:
        clock.set(10 * SECOND + 1)
        found = [await anext(events) for _ in range(2 * len(names))]
        assert [event.frame for event in found if isinstance(event, FrameAdded)] == names[::-1]
        assert [event.frame for event in found if isinstance(event, FrameStale)] == names
        bus.publish([moving("map", name, 10 * SECOND) for name in names])
        assert [await anext(events) for _ in names] == [
            FrameLive(clock.now(), name, clock.now() - 1, "") for name in names
        ]


# The end


async def test_the_error_of_a_rejection_event_has_no_traceback_into_the_sender(bus: Bus) -> None:
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


async def test_rejected_objects_that_are_no_samples_are_events(bus: Bus) -> None:
    with bus.events() as events:
        bus.publish(["noise", moving("map", "a", 1)], invalid="drop")  # type: ignore[list-item]
        rejected = await anext(events)
        assert isinstance(rejected, SampleRejected)
        assert (rejected.reason, rejected.frame) == ("not a sample", None)
        assert "'noise'" in str(rejected)


# Loops and threads


async def test_another_thread_may_not_touch_the_events_of_a_bus_in_use(bus: Bus) -> None:
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
def test_a_stream_with_a_bad_capacity_or_limit_is_not_registered(bus: Bus, bad: dict[str, float]) -> None:
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
    queue = EventQueue(10, [astuple(added("a"))], [ahead])
    queue.put(StampAhead(2, "a", 2 * 10**9, "x"))
    assert emptied(queue) == [added("a"), ahead]
    queue.put(StampAhead(3, "a", 10**9, "y"))
    assert emptied(queue) == [StampAhead(3, "a", 10**9, "y")]


def rejected(frame: str | None, authority: str | None, reason: str = "authority") -> SampleRejected:
    return SampleRejected(1, reason, frame, "map", authority, ValueError())


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
