import anyio
import pytest
from support.asking import settle
from support.processes import until

from tfbus import SECOND, SimulatedClock
from tfbus.links.link import FAR, ClockFollower

pytestmark = [pytest.mark.anyio, pytest.mark.every_loop]

THEN = 1_400_000_000 * SECOND


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
