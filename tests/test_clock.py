"""Simulated time, the clock of the machine, and ticks."""

import math
from collections.abc import Awaitable, Callable, Coroutine
from fractions import Fraction
from functools import partial
from itertools import count, pairwise
from typing import Any, TypeVar

import anyio
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.asking import Asked, settle

from tfbus import (
    SECOND,
    Clock,
    ClockResetError,
    SimulatedClock,
    SystemClock,
    Ticks,
    Transform,
    TransformStamped,
    from_seconds,
)
from tfbus.stamps import STAMP_MAX

pytestmark = [pytest.mark.anyio, pytest.mark.every_loop]

Run = Callable[[Callable[[], Awaitable[list[str]]]], list[str]]

CLOCKS = [pytest.param(SystemClock, id="system"), pytest.param(SimulatedClock, id="simulated")]
BEYOND_STAMPS = 1e11
"""A duration in s that is longer than stamps last."""


async def test_simulated_time_stays_at_the_last_stamp_and_sleeps_go_on() -> None:
    clock = SimulatedClock(start=STAMP_MAX - 1)
    slept = []

    async def sleep() -> None:
        await clock.sleep(2.0)
        slept.append(clock.now())

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(sleep)
        await clock.advance(3.0)
    assert slept == [STAMP_MAX]
    TransformStamped("map", "base", clock.now(), Transform())


async def test_tasks_that_have_just_been_started_fall_asleep_before_time_moves(clock: SimulatedClock) -> None:
    async with anyio.create_task_group() as tasks:
        asked = [Asked(tasks, partial(clock.sleep_until, k * SECOND)) for k in range(1, 4)]
        await clock.advance(3.0)
        assert all(sleeper.ended for sleeper in asked)


async def test_what_a_timed_task_sets_off_over_a_hundred_tasks_ends_before_the_next_one_wakes() -> None:
    clock = SimulatedClock()
    log: list[str] = []

    async def pass_on(name: str, hop: int, chain: list[anyio.Event]) -> None:
        await chain[hop].wait()
        log.append(f"{name}{hop}")
        chain[hop + 1].set()

    async def begin(chain: list[anyio.Event]) -> None:
        await clock.sleep(1.0)
        chain[0].set()

    async with anyio.create_task_group() as tasks:
        for name in "ab":
            chain = [anyio.Event() for _ in range(101)]
            for hop in range(100):
                tasks.start_soon(pass_on, name, hop, chain)
            tasks.start_soon(begin, chain)
            await settle()
        await clock.advance(1.0)
    assert log == [f"{name}{hop}" for name in "ab" for hop in range(100)]


Naps = list[list[float]]


async def _sleep_in_turn(naps: Naps) -> list[str]:
    clock = SimulatedClock()
    log = []

    async def sleep(name: int, seconds: list[float]) -> None:
        for nap in seconds:
            await clock.sleep(nap)
            log.append(f"{name} {clock.now()}")

    async with anyio.create_task_group() as tasks:
        for name, seconds in enumerate(naps):
            tasks.start_soon(sleep, name, seconds)
            await settle()
        await clock.advance(10.0)
    return log


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(naps=st.lists(st.lists(st.sampled_from([0.01, 0.02, 0.03, 0.1]), max_size=8), max_size=5))
def test_any_tasks_that_only_sleep_run_in_the_order_of_an_obvious_model(run: Run, naps: Naps) -> None:
    # One sleeper at a time: the one whose nap ends first, and of those the one that lay down first.
    order = count()
    sleepers = [
        (from_seconds(seconds[0]), next(order), name, seconds[1:]) for name, seconds in enumerate(naps) if seconds
    ]
    expected = []
    while sleepers:
        woken = min(sleepers)
        sleepers.remove(woken)
        now, _, name, rest = woken
        expected.append(f"{name} {now}")
        if rest:
            sleepers.append((now + from_seconds(rest[0]), next(order), name, rest[1:]))
    assert run(partial(_sleep_in_turn, naps)) == expected


async def test_a_sleep_is_a_duration_and_survives_jumps(clock: SimulatedClock) -> None:
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, partial(clock.sleep, 2.0))
        await clock.advance(1.0)
        clock.set(1_000 * SECOND)
        clock.set(50 * SECOND)
        await clock.advance(0.999)
        assert not asked.ended
        await clock.advance(0.001)
        assert asked.ended
        assert asked.error is None
        assert clock.now() == 51 * SECOND


async def test_sleep_until_ends_when_a_jump_passes_its_stamp(clock: SimulatedClock) -> None:
    async with anyio.create_task_group() as tasks:
        on_the_stamp = Asked(tasks, partial(clock.sleep_until, 5 * SECOND))
        later = Asked(tasks, partial(clock.sleep_until, 8 * SECOND))
        await settle()
        clock.set(5 * SECOND)
        await settle()
        assert on_the_stamp.ended
        assert not later.ended
        assert repr(clock) == "<SimulatedClock at 5.000 s, 1 timer>", "the jump has put another in its place"
        await clock.advance(2.999)
        assert not later.ended
        await clock.advance(0.001)
        assert later.ended


async def test_move_on_after_counts_simulated_time_across_jumps(clock: SimulatedClock) -> None:

    async def wait() -> int:
        with clock.move_on_after(3.0) as scope:
            await anyio.sleep_forever()
        assert scope.cancelled_caught
        return clock.now()

    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, wait)
        await clock.advance(2.0)
        clock.set(0)
        await clock.advance(2.0)
        assert asked.answer == 1 * SECOND


async def test_call_after_calls_once_after_a_simulated_duration_across_jumps_unless_it_is_closed() -> None:
    clock = SimulatedClock()
    calls: list[tuple[str, int]] = []
    for name, seconds in (("late", 2.0), ("soon", 1.0), ("closed", 1.5), ("never", math.inf), ("late too", 2.0)):
        registration = clock.call_after(seconds, partial(lambda name: calls.append((name, clock.now())), name))
        if name in ("closed", "never"):
            registration.close()
    clock.call_after(BEYOND_STAMPS, list).close()
    clock.set(5 * SECOND)
    assert not calls
    await clock.advance(10.0)
    assert calls == [("soon", 6 * SECOND), ("late", 7 * SECOND), ("late too", 7 * SECOND)]
    with pytest.raises(ValueError, match="seconds"):
        clock.call_after(-1.0, list)


@pytest.mark.parametrize("make", CLOCKS)
async def test_move_on_after_zero_ends_at_the_first_checkpoint(make: Callable[[], Clock]) -> None:
    with make().move_on_after(0) as scope:
        await anyio.lowlevel.checkpoint()
    assert scope.cancelled_caught


@pytest.mark.parametrize("seconds", [math.inf, BEYOND_STAMPS])
@pytest.mark.parametrize("make", CLOCKS)
async def test_sleeping_for_ever_is_allowed(make: Callable[[], Clock], seconds: float) -> None:
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, partial(make().sleep, seconds))
        await settle()
        assert not asked.ended
        asked.cancel()


@pytest.mark.parametrize("make", CLOCKS)
@pytest.mark.parametrize("sleep", [lambda clock: clock.sleep(0), lambda clock: clock.sleep_until(0)])
async def test_sleeping_for_zero_seconds_passes_a_checkpoint(
    make: Callable[[], Clock], sleep: Callable[[Clock], Awaitable[None]]
) -> None:
    clock = make()
    await sleep(clock)
    with anyio.CancelScope() as scope:
        scope.cancel()
        await sleep(clock)
    assert scope.cancelled_caught


async def test_only_one_task_may_advance_a_clock_at_a_time(clock: SimulatedClock) -> None:
    async with anyio.create_task_group() as tasks:
        second = Asked(tasks, partial(clock.advance, 1.0))
        sleeper = Asked(tasks, partial(clock.sleep, 2.0))
        await clock.advance(5.0)
        assert isinstance(second.error, RuntimeError)
        assert sleeper.ended
    assert clock.now() == 5 * SECOND


async def test_a_cancelled_advance_stops_at_its_current_time_and_can_be_resumed(clock: SimulatedClock) -> None:

    async def cancel_after_a_second() -> None:
        await clock.sleep(1.0)
        scope.cancel()

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(cancel_after_a_second)
        with anyio.CancelScope() as scope:
            await clock.advance(10.0)
        assert clock.now() == 1 * SECOND
        await clock.advance(1.0)
        assert clock.now() == 2 * SECOND


async def test_a_cancelled_sleeper_leaves_no_timer(clock: SimulatedClock) -> None:
    async with anyio.create_task_group() as tasks:
        cancelled = [Asked(tasks, partial(clock.sleep, 1.0)), Asked(tasks, partial(clock.sleep_until, SECOND))]
        stays = Asked(tasks, partial(clock.sleep, 1.0))
        await settle()
        for asked in cancelled:
            asked.cancel()
        await settle()
        assert ", 1 timer>" in repr(clock), "that of the one who stays"
        clock.set(10 * SECOND)
        await clock.advance(1.0)
        assert all(asked.cancelled for asked in cancelled)
        assert stays.ended


def test_a_clock_can_be_made_and_set_without_an_event_loop() -> None:
    clock = SimulatedClock(start=-5)
    clock.set(2**63 - 1)
    assert clock.now() == 2**63 - 1
    with pytest.raises(ValueError, match="64-bit"):
        clock.set(2**63)
    with pytest.raises(TypeError, match="from_seconds"):
        SimulatedClock(start=0.5)  # type: ignore[arg-type]
    assert clock.now() == 2**63 - 1


async def test_the_system_clock_sleeps_until_a_stamp_that_is_still_to_come() -> None:
    clock = SystemClock()
    await clock.sleep_until(clock.now() - SECOND)
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, partial(clock.sleep_until, clock.now() + 3600 * SECOND))
        await settle()
        assert not asked.ended
        asked.cancel()


async def test_the_system_clock_ticks_in_real_time() -> None:
    ticks = SystemClock().ticks(1_000)
    began = anyio.current_time()
    seen = [await anext(ticks) for _ in range(3)]
    assert anyio.current_time() - began >= 0.0019
    assert seen[0] == 0
    assert seen == sorted(set(seen))
    assert seen[-1] == 2 + ticks.skipped


T = TypeVar("T")


class Watch:
    """A clock without an event loop, which any sleep moves at once."""

    def __init__(self) -> None:
        self.elapsed = 1_000

    async def sleep_until(self, elapsed: int) -> None:
        self.elapsed = max(self.elapsed, elapsed)

    def ticks(self, hz: float) -> Ticks:
        return Ticks(hz, lambda: self.elapsed, self.sleep_until)


def now(coroutine: Coroutine[Any, Any, T]) -> T:
    """The result of a coroutine that never really waits."""
    try:
        coroutine.send(None)
    except StopIteration as stop:
        result: T = stop.value
        return result
    raise AssertionError("it waits")


@pytest.mark.parametrize("hz", [3, 29.97, 100, 1e9])
def test_tick_k_is_due_at_start_plus_k_periods_without_drift(hz: float) -> None:
    watch = Watch()
    ticks = watch.ticks(hz)
    for k in range(10_000):
        assert now(ticks.__anext__()) == k
        assert watch.elapsed == 1_000 + round(k * SECOND / Fraction(hz))
    assert ticks.skipped == 0


def test_ticks_start_at_the_first_iteration() -> None:
    watch = Watch()
    ticks = watch.ticks(10)
    watch.elapsed += 5 * SECOND
    assert now(ticks.__anext__()) == 0
    assert watch.elapsed == 1_000 + 5 * SECOND


def test_the_first_tick_is_0_however_much_time_passes_meanwhile() -> None:
    watch = Watch()
    readings = count(0, SECOND)
    ticks = Ticks(10, lambda: next(readings), watch.sleep_until)
    assert (now(ticks.__anext__()), ticks.skipped) == (0, 0)


@given(
    hz=st.one_of(st.integers(1, 1_000), st.floats(0.01, 1_000.0)),
    busy=st.lists(st.integers(0, 30 * SECOND), max_size=30),
)
def test_the_newest_due_tick_comes_at_once_and_older_ones_count_as_skipped(hz: float, busy: list[int]) -> None:
    watch = Watch()
    ticks = watch.ticks(hz)
    period = SECOND / Fraction(hz)
    seen = [now(ticks.__anext__())]
    for held_up in busy:
        watch.elapsed += held_up
        before = watch.elapsed
        seen.append(now(ticks.__anext__()))
        assert watch.elapsed == max(before, 1_000 + round(seen[-1] * period))
        assert watch.elapsed - 1_000 - seen[-1] * period < period + 1  # ns
    assert all(later > sooner for sooner, later in pairwise(seen))
    assert ticks.skipped == seen[-1] + 1 - len(seen)


async def test_jumps_do_not_change_the_times_of_ticks(clock: SimulatedClock) -> None:
    beats = []

    async def beat() -> None:
        async for number in clock.ticks(2):
            beats.append((number, clock.now()))  # noqa: PERF401 - the ticks never end

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(beat)
        await clock.advance(1.25)
        clock.set(0)
        await clock.advance(0.5)
        clock.set(100 * SECOND)
        await clock.advance(0.5)
        tasks.cancel_scope.cancel()
    assert beats == [(0, 0), (1, SECOND // 2), (2, SECOND), (3, SECOND // 4), (4, 100 * SECOND + SECOND // 4)]


@pytest.mark.parametrize("make", [SystemClock, SimulatedClock])
@pytest.mark.parametrize(
    ("hz", "error"),
    [(0, ValueError), (-1.0, ValueError), (math.inf, ValueError), (math.nan, ValueError), ("10", TypeError)],
)
def test_a_bad_rate_raises_when_the_ticks_are_made(
    make: Callable[[], Clock], hz: float, error: type[Exception]
) -> None:
    with pytest.raises(error, match="rate"):
        make().ticks(hz)


async def test_of_two_jumps_in_one_turn_the_first_decides_for_a_sleeper(clock: SimulatedClock) -> None:
    for first, second in ((0, 30), (30, 0)):
        clock.set(10 * SECOND)
        async with anyio.create_task_group() as tasks:
            asked = Asked(tasks, partial(clock.sleep_until, 20 * SECOND))
            await settle()
            clock.set(first * SECOND)
            clock.set(second * SECOND)
        if first < second:
            assert isinstance(asked.error, ClockResetError)
            assert (asked.error.before, asked.error.after) == (10 * SECOND, 0)
        else:
            assert asked.error is None


async def test_listeners_get_each_new_stamp_and_both_stamps_of_a_jump_until_they_are_closed() -> None:
    clock = SimulatedClock(start=SECOND)
    stamps: list[int] = []
    jumps: list[tuple[int, int]] = []
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(clock.sleep, 0.5)
        with clock.on_move(stamps.append), clock.on_jump(lambda before, after: jumps.append((before, after))):
            await clock.advance(0.0)
            assert stamps == []
            await clock.advance(1.0)
            clock.set(SECOND)
            clock.set(9 * SECOND)
        clock.set(2 * SECOND)
    assert stamps == [3 * SECOND // 2, 2 * SECOND, SECOND, 9 * SECOND]
    assert jumps == [(2 * SECOND, SECOND), (SECOND, 9 * SECOND)]


async def test_a_bad_duration_or_stamp_is_an_error_at_the_call() -> None:
    simulated = SimulatedClock(start=3)
    for clock in (SystemClock(), simulated):
        for seconds, error in ((-1.0, ValueError), (math.nan, ValueError), ("1", TypeError)):
            with pytest.raises(error, match="seconds"):
                await clock.sleep(seconds)  # type: ignore[arg-type]
        with pytest.raises(TypeError, match=r"from_seconds\(1\.5\)"):
            await clock.sleep_until(1.5)  # type: ignore[arg-type]
    for seconds in (-1.0, math.inf, math.nan):
        with pytest.raises(ValueError, match=r"seconds|finite"):
            await simulated.advance(seconds)
    await simulated.advance(1.0)
    assert simulated.now() == 3 + SECOND
