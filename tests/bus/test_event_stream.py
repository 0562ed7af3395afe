""""""

import math
import random
from collections.abc import Callable
from dataclasses import dataclass

import anyio
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.asking import Asked, driving, settle
from support.samples import moving, static
from support.wires import size_of

from tfbus import (
    SECOND,
    AuthorityConflict,
    Bus,
    ClockReset,
    Event,
    EventStream,
    FrameAdded,
    FrameLive,
    FrameRemoved,
    FrameStale,
    InvalidTransformError,
    KindChanged,
    PastLoop,
    QueueStatistics,
    Reparented,
    SampleRejected,
    SimulatedClock,
    StampAhead,
    SubscriberFailed,
    to_seconds,
)
from tfbus.bus.event_stream import EventQueue, Staleness

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


def test_a_conflict_of_two_authorities_is_given_once_for_a_frame_until_it_is_removed() -> None:
    queue = EventQueue(100)
    one, two = AuthorityConflict(1, "a", "x", "y"), AuthorityConflict(1, "a", "y", "x")
    third, elsewhere = AuthorityConflict(2, "a", "x", "z"), AuthorityConflict(3, "b", "x", "y")
    for event in (one, two, one, third, one, third, elsewhere, elsewhere):
        queue.put(event)
    assert emptied(queue) == [one, third, elsewhere]
    queue.put(FrameRemoved(4, "a"))
    for event in (one, elsewhere):
        queue.put(event)
    assert emptied(queue) == [FrameRemoved(4, "a"), one]
    queue.put(ClockReset(0, 5))
    queue.put(elsewhere)
    assert emptied(queue) == [ClockReset(0, 5), elsewhere]


def test_in_a_conflict_each_parent_and_kind_of_an_authority_is_given_once() -> None:
    queue = EventQueue(100)
    queue.put(AuthorityConflict(0, "a", "x", "y"))
    to_p, to_q = Reparented(1, "a", "p", "q", "x"), Reparented(1, "a", "q", "p", "y")
    still, moves = KindChanged(1, "a", static=True, authority="x"), KindChanged(1, "a", static=False, authority="y")
    for _ in range(5):
        for event in (to_p, to_q, still, moves):
            queue.put(event)
    new = Reparented(2, "a", "r", "q", "x")
    queue.put(new)
    assert emptied(queue)[1:] == [to_p, to_q, still, moves, new]


def test_every_change_of_parent_by_a_single_authority_is_given() -> None:
    queue = EventQueue(100)
    queue.put(AuthorityConflict(0, "elsewhere", "x", "y"))
    taken, put_down = Reparented(1, "cup", "hand", "table", "x"), Reparented(2, "cup", "table", "hand", "x")
    froze = KindChanged(3, "cup", static=True, authority="x")
    for event in (taken, put_down, taken, put_down, froze, froze):
        queue.put(event)
    assert emptied(queue)[1:] == [taken, put_down, taken, put_down, froze, froze]


def rejected(frame: str | None, authority: str | None, reason: str = "authority") -> SampleRejected:
    return SampleRejected(1, reason, frame, "map", authority, ValueError())


def test_a_rejection_is_given_once_for_a_frame_authority_and_reason_until_the_frame_is_removed_added_or_reset() -> None:
    queue = EventQueue(100)
    different: list[Event] = [
        rejected("a", "x"),
        rejected("b", "x"),
        rejected("a", "y"),
        rejected("a", "x", "cycle"),
        rejected(None, None, "not a sample"),
    ]
    for event in different * 3:
        queue.put(event)
    assert emptied(queue) == different
    for end, again in (
        (FrameRemoved(2, "a"), [rejected("a", "x")]),
        (added("a"), [rejected("a", "x")]),
        (ClockReset(2, 3), [rejected("a", "x"), rejected("b", "x")]),
    ):
        for event in (end, *[rejected("a", "x"), rejected("b", "x")] * 2):
            queue.put(event)
        assert emptied(queue) == [end, *again]


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


def test_a_frame_that_changes_its_parent_all_the_time_does_not_displace_events_of_others() -> None:
    queue = EventQueue(5)
    others: list[Event] = [added("a"), Reparented(0, "b", "map", "odom", "x"), FrameRemoved(0, "a")]
    for event in others:
        queue.put(event)
    moves: list[Event] = []
    for stamp in range(100):
        moves += [Reparented(stamp, "cup", "hand", "table", ""), KindChanged(stamp, "cup", stamp % 2 == 0, "")]
    for event in moves:
        queue.put(event)
    assert queue.dropped == len(moves) - 2
    assert emptied(queue) == [*others, *moves[-2:]]


LIMIT = 10


@dataclass(frozen=True)
class Known:
    newest: int | None
    authority: str = ""
    parent: str = "map"

    @property
    def static(self) -> bool:
        return self.newest is None


class World:
    """A stand-in for the frames of a bus, and for those who watch them."""

    def __init__(self) -> None:
        self.edges: dict[str, Known] = {}
        self.staleness = Staleness(LIMIT, self.edges.get)

    def send(self, frame: str, stamp: int | None) -> bool:
        known = self.edges.get(frame)
        if known is None or known.static != (stamp is None):
            # The bus announces new frames and other kinds.
            self.staleness.note(frame)
        before = None if known is None else known.newest
        newest = stamp if stamp is None or before is None else max(stamp, before)
        self.edges[frame] = Known(newest)
        sample = static("map", frame) if stamp is None else moving("map", frame, stamp)
        return self.staleness.arrived((sample,))

    def remove(self, frame: str) -> None:
        self.edges.pop(frame, None)
        self.staleness.forget(frame)


def test_memory_is_bounded_for_frames_that_are_added_and_removed() -> None:
    world = World()
    world.send("base", 100)
    for number in range(10_000):
        world.send(f"object {number}", 101 + number)
        world.staleness.changes(100)
        world.remove(f"object {number}")
    assert size_of(world.staleness) < 200
    assert world.staleness.changes(111) == [FrameStale(111, "base", 100, "")]


def test_frames_turn_stale_in_order_when_most_others_were_removed() -> None:
    world = World()
    stamps = random.Random(1).sample(range(1_000), 500)
    for stamp in stamps:
        world.send(f"frame {stamp}", stamp)
    world.staleness.changes(0)
    kept = stamps[::10]
    for stamp in set(stamps) - set(kept):
        world.remove(f"frame {stamp}")
    stale = [event.frame for now in range(0, 1_100, 100) for event in world.staleness.changes(now + LIMIT)]
    assert stale == [f"frame {stamp}" for stamp in sorted(kept)]


STEPS = st.one_of(
    st.tuples(st.just("send"), st.sampled_from("abc"), st.integers(0, 60) | st.none()),
    st.tuples(st.just("remove"), st.sampled_from("abc"), st.none()),
    st.tuples(st.just("look"), st.just(""), st.integers(0, 8)),
)


@given(st.lists(STEPS, max_size=30))
def test_the_events_add_up_to_the_set_of_stale_frames(steps: list[tuple[str, str, int | None]]) -> None:
    world = World()
    announced: set[str] = set()
    now = 0
    for kind, frame, number in steps:
        if kind == "send":
            world.send(frame, number)
        elif kind == "remove":
            world.remove(frame)
            announced.discard(frame)
        else:
            events = world.staleness.changes(now)
            due = world.staleness.due()
            now += number or 0
            later = world.staleness.changes(now)
            assert not later or (due is not None and due <= now), "nothing changes before the announced time"
            events += later
            for event in events:
                assert (event.frame in announced) == isinstance(event, FrameLive)
                announced ^= {event.frame}
            stale = {
                name for name, known in world.edges.items() if known.newest is not None and known.newest + LIMIT < now
            }
            assert announced == stale


def test_a_stale_frame_is_live_again_with_a_sample_that_is_recent_enough() -> None:
    world = World()
    world.send("a", 100)
    world.staleness.changes(200)
    assert world.send("a", 189)
    assert world.staleness.changes(200) == [], "newer, but still too old"
    assert world.send("a", 190)
    assert world.staleness.changes(200) == [FrameLive(200, "a", 190, "")]
    assert world.staleness.due() == 201
    assert not world.send("a", 195)
    assert world.staleness.changes(205) == []
    assert world.staleness.changes(206) == [FrameStale(206, "a", 195, "")]
