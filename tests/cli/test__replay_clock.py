import time

import anyio
import pytest
from support.asking import settle
from support.samples import moving

from tfbus import SECOND, Buffer, Bus, ClockResetError
from tfbus.cli._replay_clock import ReplayClock

pytestmark = pytest.mark.anyio

THEN = 1_400_000_000 * SECOND


async def test_it_is_the_machine_s_time_until_a_stamp_is_heard_and_then_that() -> None:
    clock = ReplayClock()
    jumps: list[tuple[int, int]] = []
    registration = clock.on_jump(lambda before, after: jumps.append((before, after)))
    earlier = time.time_ns()
    assert earlier <= clock.now() <= time.time_ns()
    clock.hear(THEN)
    clock.hear(THEN + 5)
    assert clock.now() == THEN + 5
    assert jumps == [(THEN, THEN)], "it is another clock's time, so no jump back"
    clock.hear(THEN - 1)
    assert jumps[1:] == [(THEN + 5, THEN - 1)]
    registration.close()
    clock.hear(THEN - 2)
    assert len(jumps) == 2


async def test_what_arrives_before_the_first_time_of_a_simulation_stays_and_nothing_is_told(
    caplog: pytest.LogCaptureFixture,
) -> None:
    clock = ReplayClock()
    with Bus(clock) as bus, Buffer(bus) as buffer:
        assert not clock.is_set
        bus.publish(moving("odom", "base", 100 * SECOND))
        for second in (100, 101):
            clock.hear(second * SECOND)
        assert clock.is_set
        assert buffer.lookup_nowait("odom", "base").stamp == 100 * SECOND
        assert (bus.statistics().clock_resets, bus.statistics().behind, caplog.records) == (0, 0, [])
        bus.publish(moving("odom", "base", 101))
        assert bus.statistics().behind == 1
        clock.hear(50 * SECOND)
        assert bus.statistics().clock_resets == 1


async def test_sleep_until_waits_for_the_time_that_is_told() -> None:
    clock = ReplayClock()
    await clock.sleep_until(clock.now() + SECOND // 1_000)
    clock.hear(THEN)
    ended: list[str] = []

    async def sleep() -> None:
        try:
            await clock.sleep_until(THEN + SECOND)
        except ClockResetError:
            ended.append("reset")
        else:
            ended.append("reached")

    for last, result in ((THEN + SECOND, "reached"), (THEN - 1, "reset")):
        async with anyio.create_task_group() as tasks:
            clock.hear(THEN)
            tasks.start_soon(sleep)
            await settle()
            clock.hear(THEN + 7)
            await settle()
            clock.hear(last)
        assert ended.pop() == result
