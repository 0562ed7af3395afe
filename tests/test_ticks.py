import math
from collections.abc import Callable, Coroutine
from fractions import Fraction
from itertools import pairwise
from typing import Any, TypeVar

import anyio
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tfbus import SECOND, Clock, SimulatedClock, SystemClock, Ticks

pytestmark = pytest.mark.anyio

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


def test_the_beat_begins_with_the_first_iteration() -> None:
    watch = Watch()
    ticks = watch.ticks(10)
    watch.elapsed += 5 * SECOND
    assert now(ticks.__anext__()) == 0
    assert watch.elapsed == 1_000 + 5 * SECOND


@pytest.mark.parametrize(
    ("busy", "tick", "at", "skipped"),
    [
        pytest.param(0.05, 1, 0.1, 0, id="in time"),
        pytest.param(0.1, 1, 0.1, 0, id="just in time"),
        pytest.param(0.15, 1, 0.15, 0, id="late, but less than a period"),
        pytest.param(0.2, 2, 0.2, 1, id="a whole period late"),
        pytest.param(0.35, 3, 0.35, 2, id="several periods late"),
        pytest.param(3600.0, 36_000, 3600.0, 35_999, id="an hour late"),
    ],
)
def test_after_a_hold_up_the_newest_due_tick_comes_at_once_and_the_others_never(
    busy: float, tick: int, at: float, skipped: int
) -> None:
    watch = Watch()
    ticks = watch.ticks(10)
    now(ticks.__anext__())
    watch.elapsed += round(busy * SECOND)
    assert now(ticks.__anext__()) == tick
    assert watch.elapsed == 1_000 + round(at * SECOND)
    assert ticks.skipped == skipped
    assert now(ticks.__anext__()) == tick + 1
    assert watch.elapsed == 1_000 + (tick + 1) * SECOND // 10


@settings(deadline=None)
@given(
    hz=st.one_of(st.integers(1, 1_000), st.floats(0.01, 1_000.0)),
    busy=st.lists(st.integers(0, 30 * SECOND), max_size=30),
)
def test_every_tick_comes_in_its_own_period_or_is_counted_as_skipped(hz: float, busy: list[int]) -> None:
    watch = Watch()
    ticks = watch.ticks(hz)
    period = SECOND / Fraction(hz)
    seen = [now(ticks.__anext__())]
    for held_up in busy:
        watch.elapsed += held_up
        seen.append(now(ticks.__anext__()))
        late = watch.elapsed - 1_000 - seen[-1] * period
        assert -1 <= late < period + 1  # ns
    assert all(later > sooner for sooner, later in pairwise(seen))
    assert ticks.skipped == seen[-1] + 1 - len(seen)


async def test_ticks_are_counted_in_durations_and_survive_jumps() -> None:
    clock = SimulatedClock()
    beats = []

    async def beat() -> None:
        ticks = clock.ticks(2)
        while True:
            beats.append((await anext(ticks), clock.now()))

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(beat)
        await clock.advance(1.25)
        clock.set(0)
        await clock.advance(0.5)
        clock.set(100 * SECOND)
        await clock.advance(0.5)
        tasks.cancel_scope.cancel()
    assert beats == [
        (0, 0),
        (1, SECOND // 2),
        (2, SECOND),
        (3, SECOND // 4),
        (4, 100 * SECOND + SECOND // 4),
    ]


async def test_every_tick_passes_a_checkpoint_even_if_it_is_late() -> None:
    clock = SimulatedClock()
    ticks = clock.ticks(10)
    await anext(ticks)
    await clock.advance(1.0)
    with anyio.CancelScope() as scope:
        scope.cancel()
        await anext(ticks)
    assert scope.cancelled_caught


async def test_what_the_body_raises_comes_out_as_it_is() -> None:
    with pytest.raises(ZeroDivisionError):
        async for tick in SimulatedClock().ticks(1):
            _ = 1 / tick


@pytest.mark.parametrize("make", [SystemClock, SimulatedClock])
@pytest.mark.parametrize(
    ("hz", "error"),
    [(0, ValueError), (-1.0, ValueError), (math.inf, ValueError), (math.nan, ValueError), ("10", TypeError)],
)
def test_a_bad_rate_raises_where_the_ticks_are_made(
    make: Callable[[], Clock], hz: float, error: type[Exception]
) -> None:
    with pytest.raises(error, match="rate"):
        make().ticks(hz)
