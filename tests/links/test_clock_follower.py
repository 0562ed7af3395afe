import anyio
import pytest
from support.asking import settle
from support.processes import until

from tfbus import SECOND, Buffer, Bus, ClockResetError, SimulatedClock
from tfbus.links.link import FAR, ClockFollower

pytestmark = [pytest.mark.anyio, pytest.mark.every_loop]

THEN = 1_400_000_000 * SECOND


async def test_it_jumps_to_the_first_stamp_and_advances_to_the_next() -> None:
    clock = SimulatedClock()
    follower = ClockFollower(clock)
    jumps: list[tuple[int, int]] = []
    clock.on_jump(lambda before, after: jumps.append((before, after)))
    follower.hear(THEN)
    assert (clock.now(), jumps) == (THEN, [(0, THEN)])
    ticks: list[int] = []

    async def tick() -> None:
        async for number in clock.ticks(10.0):
            ticks.append(number)
            assert clock.now() == THEN + number * SECOND // 10

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(follower.run)
        tasks.start_soon(tick)
        await settle()
        follower.hear(THEN + SECOND // 4)
        follower.hear(THEN + SECOND // 2)
        await until(lambda: clock.now() == THEN + SECOND // 2)
        assert ticks == [0, 1, 2, 3, 4, 5]
        follower.hear(THEN + SECOND // 2)
        await settle()
        assert len(jumps) == 1
        tasks.cancel_scope.cancel()


async def test_a_step_back_is_one_jump_even_while_the_clock_advances() -> None:
    clock = SimulatedClock()
    follower = ClockFollower(clock)
    resets = 0
    with Bus(clock) as bus, Buffer(bus):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(follower.run)
            follower.hear(THEN)
            await settle()

            async def turn_back() -> None:
                await clock.sleep(1.0)
                follower.hear(THEN - SECOND)

            async def wait() -> None:
                nonlocal resets
                try:
                    await clock.sleep_until(THEN + 9 * SECOND)
                except ClockResetError:
                    resets += 1

            tasks.start_soon(turn_back)
            tasks.start_soon(wait)
            await settle()
            follower.hear(THEN + 5 * SECOND)
            await until(lambda: resets == 1)
            assert (clock.now(), bus.statistics().clock_resets) == (THEN - SECOND, 1)
            follower.hear(THEN)
            await until(lambda: clock.now() == THEN)
            await settle()
            assert resets == 1
            tasks.cancel_scope.cancel()


@pytest.mark.parametrize(("further", "jumped"), [(0, False), (1, True)])
async def test_a_stamp_far_ahead_is_a_jump(further: int, jumped: bool) -> None:
    clock = SimulatedClock(THEN)
    follower = ClockFollower(clock)
    jumps: list[int] = []
    clock.on_jump(lambda _, after: jumps.append(after))
    follower.hear(THEN)
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(follower.run)
        await settle()
        follower.hear(THEN + int(FAR) * SECOND + further)
        await until(lambda: clock.now() == THEN + int(FAR) * SECOND + further)
        assert len(jumps) == jumped
        tasks.cancel_scope.cancel()
