"""Publishing, authorities, the clock, threads, the end and the statistics of a bus."""

import asyncio
import gc
import logging
import sys
import tracemalloc
from collections.abc import Awaitable, Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import partial
from typing import Any

import anyio
import anyio.to_thread
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.asking import Asked, settle
from support.samples import any_samples, edges_of, latched, moving, static

from tfbus import (
    SECOND,
    Buffer,
    BufferStatistics,
    Bus,
    BusClosedError,
    InvalidTransformError,
    PastLoop,
    QueueStatistics,
    SimulatedClock,
    TooManyFramesError,
    Transform,
    TransformBroadcaster,
    TransformStamped,
    UnknownFrameError,
)
from tfbus.stamps import STAMP_MAX

pytestmark = pytest.mark.anyio

Run = Callable[[Callable[[], Awaitable[None]]], None]
Batch = tuple[TransformStamped, ...]


# Publishing


def test_frames_turned_round_at_the_last_stamp_leave_the_bus_as_it_was() -> None:
    bus = Bus(max_ahead=None)
    buffer = Buffer(bus, keep=None)
    bus.publish([moving("b", "a", 0), moving("c", "a", STAMP_MAX)])
    bus.publish(moving("a", "b", STAMP_MAX, 2.0))
    assert buffer.lookup_nowait("c", "b", STAMP_MAX).transform.translation == (2.0, 0.0, 0.0)
    for number in range(3):
        bus.publish(moving("map", f"new{number}", 7, 3.0))
        assert buffer.lookup_nowait("map", f"new{number}", 7).transform.translation == (3.0, 0.0, 0.0)


def test_a_frame_beyond_the_greatest_number_is_refused_with_its_whole_batch() -> None:
    bus = Bus(max_frames=3)
    buffer = Buffer(bus)
    bus.publish([moving("map", "a", 1), moving("map", "b", 1)])
    with pytest.raises(TooManyFramesError, match="names a new frame, but the bus has 3 frames and takes 3") as caught:
        bus.publish([moving("map", "a", 2), moving("map", "c", 2, authority="page")])
    error = caught.value
    assert (error.frames, error.max_frames, error.reason) == (3, 3, "too many frames")
    assert (error.parent, error.child, error.authority) == ("map", "c", "page")
    assert buffer.tree.frames() == ["a", "b", "map"]
    assert buffer.lookup_nowait("map", "a").stamp == 1
    assert bus.statistics().rejected == {"too many frames": 1}
    # Known frames go on, under any of the known parents.
    bus.publish([moving("map", "a", 3), moving("a", "b", 3), static("map", "a", stamp=4)])
    assert bus.max_frames == 3


def test_dropping_leaves_out_the_frames_without_a_place_and_logs_them_once(caplog: pytest.LogCaptureFixture) -> None:
    bus = Bus(max_frames=3)
    buffer = Buffer(bus)
    for number in range(100):
        bus.publish([moving("map", "a", number), moving("map", f"x{number}", number, authority=str(number))], "drop")
    assert buffer.tree.frames() == ["a", "map", "x0"]
    assert buffer.lookup_nowait("map", "a").stamp == 99
    assert bus.statistics().rejected == {"too many frames": 99}
    assert len([message for message in caplog.messages if "dropped" in message]) == 1


def test_a_frame_that_is_gone_gives_its_place_back() -> None:
    bus = Bus(SimulatedClock(100), max_frames=3)
    buffer = Buffer(bus)
    bus.publish([moving("map", "a", 1), static("map", "b")])
    bus.remove_frame("a")
    bus.publish(moving("map", "c", 1))
    # The parent that nothing hangs under any more goes, and another one comes.
    bus.publish([moving("odom", "c", 2), static("odom", "b")])
    with pytest.raises(TooManyFramesError):
        bus.publish(moving("odom", "d", 2))
    assert isinstance(bus.clock, SimulatedClock)
    bus.clock.set(10)
    bus.publish(moving("odom", "d", 2))
    assert buffer.tree.frames() == ["b", "c", "d", "odom"]


@given(st.lists(st.lists(any_samples("abcdef", last=3), min_size=1, max_size=4), max_size=12), st.integers(2, 6))
def test_there_are_never_more_frames_and_none_is_refused_that_has_a_place(
    batches: list[list[TransformStamped]], most: int
) -> None:
    with Bus(max_frames=most) as bus:
        stored: list[Batch] = []
        bus.subscribe(stored.append)
        for batch in batches:
            try:
                bus.publish(batch)
            except TooManyFramesError as error:
                assert error.frames == len(names_without_a_bound(stored))
                assert len(names_without_a_bound([*stored, tuple(batch)])) > most
                bus.publish(batch, invalid="drop")
            except InvalidTransformError:
                bus.publish(batch, invalid="drop")
            assert len(names_without_a_bound(stored)) <= most


def names_without_a_bound(batches: list[Batch]) -> set[str]:
    """The frames of a bus that takes what is sound of some batches."""
    with Bus() as bus:
        for batch in batches:
            bus.publish(batch, invalid="drop")
        return {name for edge in edges_of(bus) for name in (edge.frame, edge.parent)}


@pytest.mark.parametrize(
    ("most", "kind"), [(1, ValueError), (0, ValueError), (True, TypeError), (3.0, TypeError), ("3", TypeError)]
)
def test_the_greatest_number_of_frames_is_an_int_of_at_least_two(most: Any, kind: type[Exception]) -> None:
    with pytest.raises(kind, match="max_frames must be"):
        Bus(max_frames=most)


def test_a_batch_with_a_loop_of_parents_is_refused_whole_and_the_error_names_the_loop(bus: Bus, buffer: Buffer) -> None:
    got: list[Batch] = []
    bus.subscribe(got.append)
    bus.publish([moving("map", "odom", 1), moving("odom", "base", 1)])
    with pytest.raises(InvalidTransformError) as caught:
        bus.publish([moving("base", "laser", 2), moving("base", "map", 2, authority="rogue")])
    error = caught.value
    assert (error.reason, error.parent, error.child, error.authority) == ("cycle", "base", "map", "rogue")
    assert error.loop == ("map", "base", "odom", "map")
    assert "map -> base -> odom -> map" in str(error)
    assert len(got) == 1
    assert buffer.tree.frames() == ["base", "map", "odom"]
    assert bus.statistics().rejected == {"cycle": 1}
    bus.publish(moving("base", "laser", 1))
    assert buffer.can_transform("map", "laser", 1)


def test_drop_leaves_out_only_the_rejected_samples_and_logs_them_once(caplog: pytest.LogCaptureFixture) -> None:
    bus = Bus(SimulatedClock())
    got: list[Batch] = []
    bus.subscribe(got.append)
    bus.publish(moving("map", "a", 1))
    for stamp in (2, 3):
        bus.publish(
            [moving("a", "map", stamp, authority="rogue"), "noise", moving("map", "b", stamp)],  # type: ignore[list-item]
            invalid="drop",
        )
    assert got[1:] == [(moving("map", "b", 2),), (moving("map", "b", 3),)]
    assert bus.statistics().rejected == {"cycle": 2, "not a sample": 2}
    assert sum("loop" in message for message in caplog.messages) == 1


@pytest.mark.parametrize("nonsense", [None, 5, "", b"", "map", [moving("map", "a", 1), None], ["map"], {"map": 1}])
def test_a_batch_with_an_object_that_is_no_sample_is_refused_whole(bus: Bus, buffer: Buffer, nonsense: object) -> None:
    with pytest.raises(TypeError, match="TransformStamped"):
        bus.publish(nonsense)  # type: ignore[arg-type]
    assert buffer.tree.frames() == []
    bus.publish(moving("map", "a", 1))
    assert buffer.tree.frames() == ["a", "map"]


# Topology


def test_removing_a_frame_reads_no_other_frame(bus: Bus) -> None:
    with Buffer(bus), bus.stream(), bus.events():
        bus.publish(moving("map", f"frame {number}", 1) for number in range(2_000))
        visited = 0

        def count(*_: object) -> None:
            nonlocal visited
            visited += 1

        sys.setprofile(count)
        try:
            bus.remove_frame("frame 7")
        finally:
            sys.setprofile(None)
    assert visited < 1_000


# Authorities


def test_under_reject_a_second_authority_on_a_child_gets_an_error() -> None:
    bus = Bus(SimulatedClock(), on_conflict="reject")
    buffer = Buffer(bus)
    bus.publish(moving("map", "odom", 1, 1.0, authority="slam"))
    with pytest.raises(
        InvalidTransformError, match="'slam', who was first: no sample of it is taken from ''"
    ) as caught:
        bus.publish([moving("map", "new", 2), moving("map", "odom", 2, 2.0)])
    assert (caught.value.reason, caught.value.owner, caught.value.authority) == ("authority", "slam", "")
    assert buffer.tree.frames() == ["map", "odom"]
    bus.publish([moving("map", "new", 2), moving("map", "odom", 2, 2.0)], invalid="drop")
    assert buffer.lookup_nowait("map", "odom").transform.translation == (1.0, 0.0, 0.0)
    assert buffer.can_transform("map", "new")
    assert bus.statistics().rejected == {"authority": 2}
    assert bus.statistics().authority_conflicts == 0


def test_a_long_conflict_of_authorities_fills_neither_the_log_nor_the_events(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    bus = Bus(SimulatedClock())
    with bus.events() as events:
        for stamp in range(1_000):
            parent, authority = (("map", "slam"), ("world", "gps"))[stamp % 2]
            bus.publish(moving(parent, "odom", stamp, authority=authority))
        assert len(events.queue) == 4, "a new frame, the conflict, and what each of the two claims"
    statistics = bus.statistics()
    assert (statistics.authority_conflicts, statistics.reparented) == (999, 999)
    assert len(caplog.messages) == 3
    assert "frame 'odom' comes from two authorities, 'gps' and 'slam'" in caplog.messages


# Clock jumps


def test_each_jump_back_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    clock = SimulatedClock(start=9)
    with Bus(clock), caplog.at_level("WARNING", "tfbus"):
        for stamp in (5, 8, 2):
            clock.set(stamp)
    assert caplog.messages == ["the clock jumped back: moving samples are dropped"] * 2


# The end


CALLS: list[Callable[[Bus], object]] = [
    lambda bus: bus.publish(moving("map", "a", 1)),
    lambda bus: bus.publish(moving("map", "a", 1), invalid="drop"),
    lambda bus: bus.remove_frame("s"),
    lambda bus: bus.subscribe(print),
    lambda bus: bus.stream(),
    lambda bus: bus.events(),
    lambda bus: bus.reserve("map", authority="slam"),
    lambda bus: Buffer(bus),
    lambda bus: TransformBroadcaster(bus).send_static("map", "a", moving("map", "a", 1).transform),
]


@pytest.mark.parametrize("call", [*CALLS, Bus.threadsafe])
def test_a_closed_bus_refuses_samples_and_registrations(
    call: Callable[[Bus], object], capsys: pytest.CaptureFixture[str]
) -> None:
    with Bus(SimulatedClock()) as bus:
        buffer = Buffer(bus)
        bus.publish(static("map", "s"))
    with pytest.raises(BusClosedError):
        call(bus)
    assert buffer.tree.frames() == ["map", "s"]
    assert capsys.readouterr().out == ""


# Loops


def test_bus_objects_may_be_made_before_a_loop_and_used_on_several_loops(
    clock: SimulatedClock, bus: Bus, buffer: Buffer, run: Run
) -> None:
    broadcaster = TransformBroadcaster(bus)
    got: list[Batch] = []
    bus.subscribe(got.append)
    publisher = bus.threadsafe()
    stream = bus.stream()

    async def wait_and_send() -> None:
        async with anyio.create_task_group() as tasks:
            await anext(stream)
            asked = Asked(tasks, partial(buffer.lookup, "map", "a", clock.now() + 1))
            reading = Asked(tasks, stream.__anext__)
            await clock.advance(1.0)
            broadcaster.send("map", "a", moving("map", "a", 1).transform)
            await settle()
            assert asked.answer.stamp == clock.now() - 999_999_999
            assert [sample.stamp for sample in reading.answer] == [clock.now()]
            broadcaster.send("map", "b", Transform())

    broadcaster.send("map", "a", moving("map", "a", 1).transform)
    for _ in range(3):
        run(wait_and_send)
    publisher.end()
    assert len(got) == 7


# Statistics and the long run


def test_statistics_count_everything_on_the_bus() -> None:
    bus = Bus(SimulatedClock())
    buffer = Buffer(bus)
    bus.publish([moving("map", "a", 1), static("map", "s")])
    with bus.stream(capacity=7), bus.subscribe(lambda _: None):
        bus.publish(moving("map", "a", 2))
        counted = bus.statistics()
    assert (counted.samples, counted.frames, counted.rejected) == (3, 2, {})
    assert counted.buffers == (BufferStatistics(offered=3, inserted=3, replaced=0, expired=0, waiting=0),)
    assert counted.queues == (QueueStatistics("stream", "conflate", capacity=7, pending=2, dropped=0),)
    buffer.close()
    assert bus.statistics().buffers == ()
    for again in (static("map", "a"), moving("map", "a", 3)):
        bus.publish(again)
    assert (bus.statistics().kind_changes, [*latched(bus)]) == (2, ["s"])


@pytest.mark.thorough
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_frames_that_come_and_go_keep_memory_flat(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("CRITICAL", logger="tfbus")
    bus = Bus(SimulatedClock())
    buffer = Buffer(bus)
    ours, theirs = TransformBroadcaster(bus, "tools"), TransformBroadcaster(bus, "rogue")
    ours.send_static("map", "hand", Transform())

    holds: list[Callable[[str], AbstractContextManager[object]]]
    holds = [ours.owning, lambda name: bus.reserve(name, "tools"), nullcontext]

    async def come_and_go(numbers: range) -> None:
        for number in numbers:
            name = f"object {number}"
            with holds[number % 3](name):
                send = ours.send if number % 3 == 1 else ours.send_static
                send("hand", name, Transform())
                if number % 3 == 2:
                    theirs.send("map", name, Transform())
                buffer.lookup_nowait("map", name)
                while len(read.queue):
                    await anext(read)
            with suppress(UnknownFrameError):
                bus.remove_frame(name)

    async def measured(numbers: range) -> int:
        await come_and_go(numbers)
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    with bus.stream(capacity=10, overflow="drop_oldest"), bus.stream(), bus.events(capacity=10), bus.events() as read:
        await come_and_go(range(1_000))
        tracemalloc.start()
        try:
            before = await measured(range(1_000, 2_000))
            after = await measured(range(2_000, 6_000))
        finally:
            tracemalloc.stop()
    assert after - before < 6_000, "not two bytes a name"
    assert bus.statistics().frames == 1
    assert buffer.tree.frames() == ["hand", "map"]


async def test_every_call_but_threadsafe_from_another_thread_is_an_error_while_a_loop_runs() -> None:
    clock = SimulatedClock(start=10)
    with Bus(clock) as bus, Buffer(bus) as buffer:
        bus.publish([moving("map", "base", 0), static("map", "s")])
        for touch in (*CALLS, lambda _: buffer.watch("map", "base"), lambda _: clock.set(0)):
            with pytest.raises(RuntimeError, match=r"bus\.threadsafe"):
                await anyio.to_thread.run_sync(touch, bus)
        assert bus.statistics().frames == 2
        assert not bus.closed
        assert await buffer.lookup("map", "base", 0)


def test_an_unknown_policy_for_invalid_samples_is_an_error() -> None:
    with Bus() as bus, pytest.raises(ValueError, match="invalid must be 'raise' or 'drop', not 'ignore'"):
        bus.publish(moving("map", "base", 0), invalid="ignore")  # type: ignore[arg-type]


async def test_the_bounds_of_queues_for_which_none_is_given_are_in_the_statistics() -> None:
    with Bus(SimulatedClock()) as bus, bus.stream(), bus.threadsafe(), bus.events():
        bounds = {queue.kind: queue.capacity for queue in bus.statistics().queues}
    assert bounds == {"stream": 1_000, "threadsafe": 10_000, "events": 1_000}


async def test_a_buffer_that_closes_another_at_the_end_still_wakes_every_waiter() -> None:
    bus = Bus()
    first, second, third = (Buffer(bus) for _ in range(3))
    first.on_close(second.close)
    first.on_close(lambda: 1 / 0)
    async with anyio.create_task_group() as tasks:
        asked: Asked[TransformStamped] = Asked(tasks, partial(third.lookup, "map", "a"))
        await settle()
        bus.close()
    assert isinstance(asked.error, BusClosedError)
    assert bus.closed


async def test_late_data_that_form_a_loop_in_the_past_are_stored_counted_logged_and_announced_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with Bus(SimulatedClock()) as bus, Buffer(bus) as early, Buffer(bus, keep=3e-9), bus.events() as events:
        bus.publish([moving("c", "a", 0), moving("c", "a", 9), moving("a", "b", 4), moving("a", "b", 9)])
        for stamp in (5, 6):
            bus.publish(moving("b", "a", stamp, authority="late"))
        bus.publish(moving("c", "a", 10))
        events.close()
        found = [event async for event in events if isinstance(event, PastLoop)]
        assert found == [PastLoop(0, "a", "b", "late", 5, ("a", "b", "a"))]
        assert [buffer.looped for buffer in bus.statistics().buffers] == [2, 0]
        assert early.lookup_nowait("b", "a", 5).stamp == 5
    (message,) = [message for message in caplog.messages if "loop" in message]
    assert message == "the frames a -> b -> a form a loop at 0.000000005 s, with late data of 'late'"


def test_an_interrupt_in_one_buffer_keeps_the_batch_from_no_other_nor_from_a_subscriber() -> None:
    def interrupt(_record: logging.LogRecord) -> bool:
        raise KeyboardInterrupt

    heard: list[object] = []
    late = moving("map", "a", SECOND)
    with Bus(SimulatedClock(9 * SECOND)) as bus, Buffer(bus, keep=1.0), Buffer(bus) as second:
        bus.publish(moving("map", "a", 9 * SECOND))
        bus.subscribe(heard.append)
        # The first buffer tells that the sample has expired.
        logging.getLogger("tfbus").addFilter(interrupt)
        try:
            with pytest.raises(KeyboardInterrupt):
                bus.publish(late)
        finally:
            logging.getLogger("tfbus").removeFilter(interrupt)
        assert second.can_transform("map", "a", SECOND)
        assert heard == [(late,)]


@pytest.mark.parametrize("place", [0, 1])
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_an_interrupt_of_a_wake_up_is_raised_as_it_is_and_every_buffer_has_the_batch(
    bus: Bus, monkeypatch: pytest.MonkeyPatch, place: int
) -> None:
    loop = asyncio.get_running_loop()
    call_soon = loop.call_soon

    def interrupted(*arguments: Any, **options: Any) -> None:
        call_soon(*arguments, **options)
        raise KeyboardInterrupt

    buffers = Buffer(bus), Buffer(bus)
    bus.publish(moving("map", "a", 1))
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, partial(buffers[place].lookup, "map", "a", 5))
        await settle()
        with monkeypatch.context() as patch:
            patch.setattr(loop, "call_soon", interrupted)
            with pytest.raises(KeyboardInterrupt):
                bus.publish(moving("map", "a", 5))
        assert [buffer.lookup_nowait("map", "a").stamp for buffer in buffers] == [5, 5]
    assert asked.answer.stamp == 5


def test_an_unknown_policy_for_conflicts_is_an_error() -> None:
    with pytest.raises(ValueError, match="on_conflict must be 'last' or 'reject', not 'first'"):
        Bus(on_conflict="first")  # type: ignore[arg-type]


def test_a_stranger_cannot_flood_the_log_with_names(caplog: pytest.LogCaptureFixture) -> None:
    with Bus() as bus:
        bus.publish([moving("map", f"frame{number}", 1) for number in range(2_000)])
        assert bus.statistics().behind == 2_000
    about = [message for message in caplog.messages if "behind the clock" in message]
    assert 0 < len(about) < 200
    assert sum("the others are left out" in message for message in caplog.messages) == 1
