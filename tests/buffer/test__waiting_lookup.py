"""Lookups that wait under a policy end at the first moment at which it allows an answer."""

import gc
from functools import partial
from typing import Any

import anyio
import anyio.lowlevel
import anyio.to_thread
import pytest
from support.asking import Asked, driving, settle

from tfbus import (
    SECOND,
    Buffer,
    Bus,
    FutureExtrapolationError,
    GapError,
    Hold,
    LookupTimeoutError,
    PointStamped,
    SimulatedClock,
    TransformStamped,
    from_seconds,
    to_seconds,
)
from tfbus.buffer.lookups import REPORT_AFTER

pytestmark = [pytest.mark.anyio, pytest.mark.every_loop]


@pytest.mark.parametrize(
    ("policy", "too_early", "enough", "x", "extrapolated_by"),
    [
        ({"tolerance": 0.2}, 9.7, 9.8, 9.8, 0.2),
        ({"extrapolate": Hold(0.5)}, 9.4, 9.6, 9.6, 0.4),
        ({"tolerance": 0.2, "extrapolate": Hold(0.5)}, 9.4, 9.5, 9.5, 0.5),
        ({"max_gap": 1.0}, 9.9, 10.5, 10.0, 0.0),
    ],
)
async def test_a_lookup_under_a_policy_wakes_at_the_first_sample_that_allows_an_answer(
    policy: dict[str, Any], too_early: float, enough: float, x: float, extrapolated_by: float
) -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        bus.publish(driving("map", "base", 9.0))
        async with anyio.create_task_group() as tasks:
            asked: Asked[TransformStamped] = Asked(
                tasks, partial(buffer.lookup, "map", "base", from_seconds(10.0), **policy)
            )
            await settle()
            bus.publish(driving("map", "base", too_early))
            await settle()
            assert not asked.ended
            bus.publish(driving("map", "base", enough))
            await settle()
    assert asked.answer.transform.translation[0] == pytest.approx(x)
    assert asked.answer.stamp == from_seconds(10.0)
    assert asked.answer.extrapolated_by == from_seconds(extrapolated_by)


async def test_a_sample_outside_the_tolerance_does_not_wake_the_lookup() -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        bus.publish(driving("map", "base", 9.0))
        async with anyio.create_task_group() as tasks:
            Asked(tasks, partial(buffer.lookup, "map", "base", from_seconds(10.0), tolerance=0.2))
            await settle()
            (before,) = buffer.pending()
            bus.publish(driving("map", "base", 9.7))
            await settle()
            (after,) = buffer.pending()
            # It would have parked again with a new error.
            assert after.blocked_by is before.blocked_by
            bus.publish(driving("map", "base", 9.8))


async def test_a_gap_around_the_stamp_ends_the_wait_with_a_gap_error() -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        bus.publish(driving("map", "base", 9.0))
        async with anyio.create_task_group() as tasks:
            asked: Asked[TransformStamped] = Asked(
                tasks, partial(buffer.lookup, "map", "base", from_seconds(10.0), max_gap=1.0)
            )
            await settle()
            bus.publish(driving("map", "base", 11.0))
            await settle()
        assert isinstance(asked.error, GapError)
        assert not buffer.pending()


@pytest.mark.parametrize("end", ["the lagging edge comes out of the gap", "a late sample fills the gap"])
async def test_latest_in_the_gap_of_another_edge_waits_for_either_end_of_the_gap(end: str) -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        # map -> base lags at 1.5 s, where base -> arm has a gap from 1 s to 2 s.
        bus.publish([driving("map", "base", 1.5), driving("base", "arm", 1.0), driving("base", "arm", 2.0)])
        async with anyio.create_task_group() as tasks:
            asked: Asked[TransformStamped] = Asked(tasks, partial(buffer.lookup, "map", "arm", max_gap=0.6))
            await settle()
            assert not asked.ended
            if end == "the lagging edge comes out of the gap":
                bus.publish(driving("map", "base", 2.0))
            else:
                bus.publish(driving("base", "arm", 1.4))
            await settle()
            assert asked.ended
    assert asked.answer.transform.translation[0] == pytest.approx(4.0 if asked.answer.stamp == 2 * SECOND else 3.0)


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


async def test_a_timeout_names_the_slack_of_the_policy() -> None:
    clock = SimulatedClock()
    with Bus(clock) as bus, Buffer(bus) as buffer:
        bus.publish(driving("map", "base", 9.0))
        async with anyio.create_task_group() as tasks:
            asked: Asked[TransformStamped] = Asked(
                tasks, partial(buffer.lookup, "map", "base", from_seconds(10.0), tolerance=0.2, timeout=1.0)
            )
            await clock.advance(1.0)
        assert isinstance(asked.error, LookupTimeoutError)
        assert isinstance(asked.error.__cause__, FutureExtrapolationError)
        assert "asked for 10.000 s within 200 ms, newest sample is 9.000 s (1 s short)" in str(asked.error)


async def test_transform_takes_a_policy() -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        bus.publish(driving("map", "base", 9.0))
        point = PointStamped("base", from_seconds(9.25), (1.0, 0.0, 0.0))
        expected = PointStamped("map", from_seconds(9.25), (10.0, 0.0, 0.0))
        assert await buffer.transform(point, "map", extrapolate=Hold(0.25)) == expected
        assert buffer.transform_nowait(point, "map", tolerance=0.25) == expected
        with pytest.raises(FutureExtrapolationError):
            buffer.transform_nowait(point, "map", max_gap=0.25)


async def test_a_wrong_policy_raises_at_once() -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        with pytest.raises(TypeError, match="extrapolate must be a Hold"):
            await buffer.lookup("map", "base", extrapolate=0.5)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="max_gap"):
            buffer.lookup_nowait("map", "base", max_gap=-1.0)


async def test_a_long_wait_has_one_timer_for_the_next_log_line_however_often_its_cause_changes(
    caplog: pytest.LogCaptureFixture,
) -> None:
    clock = SimulatedClock()
    bus = Bus(clock)
    buffer = Buffer(bus)
    bus.publish(driving("map", "base", 0.0))
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, partial(buffer.lookup, "map", "arm", timeout=60.0))
        await clock.advance(5.0)
        for parent, child in (("b", "arm"), ("c", "b"), ("d", "c")):
            bus.publish(driving(parent, child, 0.0))
            await clock.advance(1.0)
            assert len(clock._timers) == 2
        assert len(caplog.messages) == 1
        await clock.advance(3.0)
        assert len(caplog.messages) == 2
        asked.cancel()


async def test_on_the_loop_of_another_thread_a_lookup_has_an_answer_and_does_not_wait_for_one() -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        bus._check_thread()

        async def ask() -> TransformStamped:
            return await buffer.lookup("map", "base", timeout=0.001)

        with pytest.raises(RuntimeError, match=r"bus\.threadsafe"):
            await anyio.to_thread.run_sync(anyio.run, ask)
        assert buffer.pending() == ()
        bus.publish(driving("map", "base", 1.0))
        assert (await anyio.to_thread.run_sync(anyio.run, ask)).stamp == SECOND


@pytest.mark.parametrize(("timeout", "timers"), [(REPORT_AFTER, 1), (REPORT_AFTER + 1e-9, 2), (None, 1), (0.0, 0)])
async def test_only_a_lookup_that_may_wait_for_longer_has_a_timer_for_the_log_line(
    timeout: float | None, timers: int
) -> None:
    clock = SimulatedClock()
    with Bus(clock) as bus, Buffer(bus) as buffer:
        async with anyio.create_task_group() as tasks:
            asked = Asked(tasks, partial(buffer.lookup, "map", "base", timeout=timeout))
            await settle()
            assert len(clock._timers) == timers
            asked.cancel()


@pytest.mark.parametrize("ends", ["answered", "timed out", "cancelled", "closed"])
async def test_a_lookup_that_has_waited_leaves_no_timer_and_no_waiter(ends: str) -> None:
    clock = SimulatedClock()
    bus = Bus(clock)
    buffer = Buffer(bus)
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, partial(buffer.lookup, "map", "base", timeout=60.0))
        await settle()
        assert len(clock._timers) == 2, "one for the end, and one for the log line before it"
        if ends == "answered":
            bus.publish(driving("map", "base", 0.0))
        elif ends == "timed out":
            await clock.advance(60.0)
        elif ends == "cancelled":
            asked.cancel()
        else:
            buffer.close()
    assert asked.ended
    assert clock._timers == []
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
