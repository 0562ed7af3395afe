"""Alarms on a loop whose time stands still until the test moves it, and on the loops that there are."""

import asyncio
import gc
from contextlib import suppress
from functools import partial
from itertools import permutations, product
from typing import Any

import anyio
import anyio.lowlevel
import anyio.to_thread
import pytest
from anyio.abc import TaskGroup
from hypothesis import example, given
from hypothesis import strategies as st
from support.asking import Asked, driving, settle
from support.samples import any_samples, moving, static

from tfbus import (
    LATEST,
    SECOND,
    Buffer,
    Bus,
    Clock,
    FutureExtrapolationError,
    Hold,
    Latest,
    LookupTimeoutError,
    SimulatedClock,
    SystemClock,
    TransformLookupError,
    TransformStamped,
    UnknownFrameError,
    from_seconds,
    to_seconds,
)
from tfbus._aio.loops import running_loop
from tfbus.buffer.lookups import AlarmHeap, LoopAlarms
from tfbus.errors import MAY_COME


class HandLoop:
    """The part of an asyncio loop that a timer uses."""

    def __init__(self) -> None:
        self.now = 0.0
        self.handles: list[Handle] = []
        self.set = 0

    def time(self) -> float:
        return self.now

    def call_at(self, due: float, callback: Any) -> "Handle":
        self.set += 1
        self.handles.append(Handle(self, due, callback))
        return self.handles[-1]

    def move(self, seconds: float) -> None:
        end = self.now + seconds
        while due := [handle for handle in self.handles if handle.due <= end]:
            first = min(due, key=lambda handle: handle.due)
            self.handles.remove(first)
            self.now = max(self.now, first.due)
            first.callback()
        self.now = end


class Handle:
    def __init__(self, loop: HandLoop, due: float, callback: Any) -> None:
        self.loop, self.due, self.callback = loop, due, callback

    def cancel(self) -> None:
        self.loop.handles.remove(self)


SECONDS = st.integers(0, 8).map(float)
STEPS = st.one_of(
    st.tuples(st.just("add"), SECONDS), st.tuples(st.just("close"), SECONDS), st.tuples(st.just("move"), SECONDS)
)


@given(st.lists(STEPS))
def test_each_alarm_that_is_not_closed_rings_at_its_time_and_in_order(steps: list[tuple[str, float]]) -> None:
    loop = HandLoop()
    heap = AlarmHeap(loop)
    rung: list[tuple[float, int]] = []
    alarms: list[Any] = []
    waiting: dict[int, float] = {}
    for step, number in steps:
        if step == "add":
            place = len(alarms)
            waiting[place] = loop.now + number
            alarms.append(heap.add(number, partial(lambda place: rung.append((loop.now, place)), place)))
        elif step == "close" and alarms:
            place = int(number) % len(alarms)
            alarms[place]()
            alarms[place]()
            waiting.pop(place, None)
        elif step == "move":
            due = sorted((at, place) for place, at in waiting.items() if at <= loop.now + number)
            before = len(rung)
            loop.move(number)
            assert rung[before:] == due
            waiting = {place: at for place, at in waiting.items() if at > loop.now}
        assert len(loop.handles) <= 1


def test_one_timer_serves_all_alarms_that_follow_each_other() -> None:
    loop = HandLoop()
    heap = AlarmHeap(loop)
    for _ in range(10_000):
        heap.add(60.0, list)()
        heap.add(60.0, list)()
        loop.move(0.001)
    assert loop.set == 1
    assert len(heap) < 200


def test_an_alarm_that_raises_is_logged_and_keeps_the_later_ones(caplog: pytest.LogCaptureFixture) -> None:
    loop = HandLoop()
    heap = AlarmHeap(loop)
    rung: list[str] = []

    def fail() -> None:
        raise ValueError("broken")

    heap.add(1.0, fail)
    heap.add(2.0, partial(rung.append, "later"))
    loop.move(1.0)
    assert rung == []
    loop.move(1.0)
    assert rung == ["later"]
    assert caplog.messages == ["a timer raised"]


def test_alarms_on_one_loop_ring_although_another_one_ran_meanwhile() -> None:
    alarms = LoopAlarms()
    rung: list[str] = []

    async def on_the_first() -> None:
        done = anyio.Event()

        def ring() -> None:
            rung.append("first")
            done.set()

        alarms.on(running_loop())(0.001, ring)
        await anyio.to_thread.run_sync(anyio.run, on_the_other)
        await done.wait()

    async def on_the_other() -> None:
        there = anyio.Event()
        alarms.on(running_loop())(60.0, partial(rung.append, "never"))()
        alarms.on(running_loop())(0.001, there.set)
        with anyio.fail_after(10.0):
            await there.wait()

    anyio.run(on_the_first)
    assert rung == ["first"]


NANO = 1e-9
Asking = tuple[str, str, int | Latest, dict[str, Any]]
POLICIES: list[dict[str, Any]] = [
    {},
    {"tolerance": 3 * NANO},
    {"max_gap": 4 * NANO},
    {"extrapolate": Hold(4 * NANO)},
    {"tolerance": 2 * NANO, "max_gap": 4 * NANO},
]
QUESTIONS: list[Asking] = [
    *((*ends, at, policy) for ends in permutations("abcd", 2) for at in (LATEST, 5, 15) for policy in POLICIES),
    *(
        (target, source, at, {"source_at": 10, "fixed": fixed})
        for target, source, fixed in product("abc", repeat=3)
        for at in (LATEST, 5)
    ),
]

CHAIN = [moving(parent, child, 1) for parent, child in ("ab", "bc", "cd")]
some_samples = any_samples("abcd", 20) | st.builds(
    lambda sample, stamp: sample.replace(stamp=stamp), st.sampled_from(CHAIN), st.integers(0, 20)
)


# A gap that is too wide while another edge lags, late samples that close it, and one that the window forgets.
GAP: list[list[TransformStamped] | str] = [[moving("a", "b", stamp)] for stamp in (9, 10, 11)]


@example(4, [*GAP, [moving("a", "b", 4), moving("a", "b", 6)], [moving("b", "c", 6)]], None, SimulatedClock)
@example(4, [*GAP, [moving("a", "b", 20)], [moving("b", "c", 6)]], 8 * NANO, SimulatedClock)
@given(
    st.integers(0, 5),
    st.lists(st.lists(some_samples, min_size=1, max_size=3) | st.sampled_from("bcd"), min_size=5, max_size=15),
    st.sampled_from([None, 8 * NANO]),
    st.sampled_from([SystemClock, SimulatedClock]),
)
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_a_lookup_waits_until_lookup_nowait_has_an_answer_or_an_error_that_waiting_cannot_help(
    sixth: int, happenings: list[list[TransformStamped] | str], keep: float | None, clock: type[Clock]
) -> None:
    with Bus(clock()) as bus, Buffer(bus, keep) as buffer:
        async with anyio.create_task_group() as tasks:
            waiting = [(asking, ask(tasks, buffer, asking)) for asking in QUESTIONS[sixth::6]]
            for happening in (CHAIN, *happenings):
                if isinstance(happening, list):
                    bus.publish(happening, invalid="drop")
                else:
                    with suppress(UnknownFrameError):
                        bus.remove_frame(happening)
                await settle()
                for (target, source, at, question), asked in waiting:
                    try:
                        expected = buffer.lookup_nowait(target, source, at, **question)
                    except MAY_COME:
                        assert not asked.ended
                    except TransformLookupError as error:
                        assert (type(asked.error), str(asked.error)) == (type(error), str(error))
                    else:
                        assert asked.answer == expected
                waiting = [(asking, asked) for asking, asked in waiting if not asked.ended]
                assert len(buffer.pending()) == len(waiting)
            tasks.cancel_scope.cancel()
        assert buffer.pending() == ()


def ask(tasks: TaskGroup, buffer: Buffer, asking: Asking) -> Asked[TransformStamped]:
    target, source, at, question = asking
    return Asked(tasks, partial(buffer.lookup, target, source, at, **question))


@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_a_thousand_lookups_that_hang_look_for_the_similar_names_of_three(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked_for: list[str] = []

    def close_matches(frame: str, known: list[str]) -> list[str]:
        looked_for.append(frame)
        return known[-1:]

    monkeypatch.setattr("difflib.get_close_matches", close_matches)
    clock = SimulatedClock()
    with Bus(clock) as bus, Buffer(bus) as buffer:
        bus.publish(moving("map", "base", 0))
        async with anyio.create_task_group() as tasks:
            asked = [
                Asked(tasks, partial(buffer.lookup, "map", f"wrong {number}", timeout=60.0)) for number in range(1_000)
            ]
            await settle()
            await clock.advance(30.0)
            (message,) = caplog.messages
            assert message.startswith("1000 lookups have waited for more than 5 s: ")
            assert message.endswith("; and 997 more, see Buffer.pending()")
            assert len(looked_for) == 3
            looked_for.clear()
            described = buffer.describe().splitlines()
            assert described[-1] == "waiting: 990 more lookups, see pending()"
            assert 0 < len(looked_for) <= 10
            looked_for.clear()
            await clock.advance(31.0)
    assert all("did you mean" not in repr(each.error.args) for each in asked if each.error is not None)
    assert looked_for == []
    assert "did you mean 'base'?" in str(asked[0].error)


pytestmark = [pytest.mark.anyio, pytest.mark.every_loop]


async def test_under_a_hold_a_recent_sample_of_one_edge_satisfies_max_age() -> None:
    clock = SimulatedClock(from_seconds(100.0))
    with Bus(clock) as bus, Buffer(bus) as buffer:
        bus.publish([driving("map", "odom", 99.0), driving("odom", "base", 99.2), driving("base", "arm", 99.4)])
        lookup = partial(buffer.lookup, "map", "arm", max_age=0.1, extrapolate=Hold(5.0))
        for last in ("odom", "base"):
            async with anyio.create_task_group() as tasks:
                asked: Asked[TransformStamped] = Asked(tasks, lookup)
                await settle()
                assert not asked.ended
                bus.publish(driving({"odom": "map", "base": "odom"}[last], last, to_seconds(clock.now())))
                await settle()
                assert asked.ended
            assert asked.answer.stamp == clock.now()
            await clock.advance(1.0)


async def test_a_timeout_names_the_slack_of_the_policy(clock: SimulatedClock, bus: Bus, buffer: Buffer) -> None:
    bus.publish(driving("map", "base", 9.0))
    async with anyio.create_task_group() as tasks:
        asked: Asked[TransformStamped] = Asked(
            tasks, partial(buffer.lookup, "map", "base", from_seconds(10.0), tolerance=0.2, timeout=1.0)
        )
        await clock.advance(1.0)
    assert isinstance(asked.error, LookupTimeoutError)
    assert isinstance(asked.error.__cause__, FutureExtrapolationError)
    assert "asked for 10.000 s within 200 ms, newest sample is 9.000 s (1 s short)" in str(asked.error)


async def test_a_long_wait_has_one_timer_for_the_next_log_line_however_often_its_cause_changes(
    clock: SimulatedClock, bus: Bus, buffer: Buffer, caplog: pytest.LogCaptureFixture
) -> None:
    bus.publish(driving("map", "base", 0.0))
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, partial(buffer.lookup, "map", "arm", timeout=60.0))
        await clock.advance(5.0)
        for parent, child in (("b", "arm"), ("c", "b"), ("d", "c")):
            bus.publish(driving(parent, child, 0.0))
            await clock.advance(1.0)
            assert "2 timers" in repr(clock)
        assert len(caplog.messages) == 1
        await clock.advance(3.0)
        assert len(caplog.messages) == 2
        asked.cancel()


async def test_a_log_line_tells_of_the_lookups_that_have_waited_so_long_and_the_next_comes_five_seconds_later(
    clock: SimulatedClock, bus: Bus, buffer: Buffer, caplog: pytest.LogCaptureFixture
) -> None:
    bus.publish(static("map", "base"))
    async with anyio.create_task_group() as tasks:
        asked = [Asked(tasks, partial(buffer.lookup, "map", name)) for name in ("a", "b")]
        await clock.advance(1.0)
        asked.append(Asked(tasks, partial(buffer.lookup, "map", "young")))
        await clock.advance(8.9)
        (message,) = caplog.messages
        assert message.startswith("2 lookups have waited for more than 5 s: ")
        assert "young" not in message
        await clock.advance(0.1)
        assert caplog.messages[1:] == [
            "a lookup of 'young' in 'map' has waited for more than 5 s: frame 'young' is not known"
        ]
        # A jump back delays no line.
        clock.set(SECOND)
        await settle()
        asked.append(Asked(tasks, partial(buffer.lookup, "map", "c")))
        await clock.advance(5.0)
        assert "'c'" in caplog.messages[-1]
        asked[-1].cancel()


async def test_on_the_loop_of_another_thread_a_lookup_has_an_answer_and_does_not_wait_for_one() -> None:
    with Bus() as bus, Buffer(bus) as buffer:

        async def ask() -> TransformStamped:
            return await buffer.lookup("map", "base", timeout=0.001)

        with pytest.raises(RuntimeError, match=r"anyio\.from_thread\.run"):
            await anyio.to_thread.run_sync(anyio.run, ask)
        assert buffer.pending() == ()
        bus.publish(driving("map", "base", 1.0))
        assert (await anyio.to_thread.run_sync(anyio.run, ask)).stamp == SECOND


def test_on_trio_inside_a_task_of_asyncio_a_lookup_waits_on_trio() -> None:
    """As in a cell of a notebook."""
    trio = pytest.importorskip("trio")

    async def ask() -> None:
        with Bus() as bus, Buffer(bus) as buffer:
            async with anyio.create_task_group() as tasks:
                asked = Asked(tasks, partial(buffer.lookup, "map", "base", SECOND, timeout=60.0))
                while not buffer.pending():
                    await anyio.lowlevel.checkpoint()
                bus.publish(driving("map", "base", 1.0))
            assert asked.answer.stamp == SECOND

    async def cell() -> None:
        trio.run(ask)

    asyncio.run(cell())


@pytest.mark.parametrize("ends", ["answered", "timed out", "cancelled", "closed"])
async def test_a_lookup_that_has_waited_leaves_no_timer_and_no_waiter(
    clock: SimulatedClock, bus: Bus, buffer: Buffer, ends: str
) -> None:
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, partial(buffer.lookup, "map", "base", timeout=60.0))
        await settle()
        assert "2 timers" in repr(clock), "one for the end, and one for the log line before it, which all lookups share"
        if ends == "answered":
            bus.publish(driving("map", "base", 0.0))
        elif ends == "timed out":
            await clock.advance(60.0)
        elif ends == "cancelled":
            asked.cancel()
        else:
            buffer.close()
    assert asked.ended
    assert "0 timers" in repr(clock) or "1 timer>" in repr(clock)
    await clock.advance(5.0)
    assert "0 timers" in repr(clock)
    assert buffer.pending() == ()
    assert bus.statistics().buffers == () or bus.statistics().buffers[0].waiting == 0


@pytest.mark.parametrize("source", ["base", "arm"])
@pytest.mark.thorough
async def test_a_lookup_that_has_waited_leaves_no_reference_cycles(source: str) -> None:
    with Bus() as bus, Buffer(bus, keep=None) as buffer:
        bus.publish([driving("map", "base", 0.0), driving("base", "arm", 0.0), driving("base", "arm", 90.0)])

        async def wait(seconds: float) -> None:
            async with anyio.create_task_group() as tasks:
                asked: Asked[TransformStamped] = Asked(
                    tasks, partial(buffer.lookup, "map", source, from_seconds(seconds), timeout=5.0)
                )
                while not buffer.pending():
                    await anyio.lowlevel.checkpoint()
                bus.publish(driving("map", "base", seconds))
            assert asked.answer.stamp == from_seconds(seconds)

        await wait(1.0)
        gc.collect()
        gc.disable()
        try:
            for seconds in range(2, 12):
                await wait(float(seconds))
            gc.set_debug(gc.DEBUG_SAVEALL)
            gc.collect()
            # The task groups and scopes of the test, and the loop's own, may leave some; the lookups must not.
            left = [thing for thing in gc.garbage if type(thing).__module__.startswith("tfbus")]
        finally:
            gc.set_debug(0)
            gc.garbage.clear()
            gc.enable()
        assert left == []


async def test_timeouts_by_the_clock_of_the_machine_end_in_their_order() -> None:
    ended: list[float] = []
    with Bus() as bus, Buffer(bus) as buffer, anyio.fail_after(30.0):

        async def ask(timeout: float) -> None:
            with pytest.raises(LookupTimeoutError):
                await buffer.lookup("map", "base", timeout=timeout)
            ended.append(timeout)
            if len(ended) == 2:
                tasks.cancel_scope.cancel()

        for _ in range(2):
            async with anyio.create_task_group() as tasks:
                for timeout in (60.0, 0.15, 0.002):
                    tasks.start_soon(ask, timeout)
            assert ended == [0.002, 0.15]
            ended.clear()
