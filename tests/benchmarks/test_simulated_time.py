"""The cost of simulated time: one timed task that wakes and sleeps again, among many others."""

from time import process_time

import anyio
import pytest
from beside import Table, show

from tfbus import SimulatedClock

pytest_plugins = ["side_by_side"]

ROUNDS = 5
TICKS = 2_000
CROWDS = (100, 1_000, 3_000)


async def seconds_a_tick(robots: int) -> float:
    """Of processor time."""
    clock = SimulatedClock()

    async def robot() -> None:
        async for _ in clock.ticks(1.0):
            pass

    async with anyio.create_task_group() as tasks:
        for _ in range(robots):
            tasks.start_soon(robot)
        await clock.advance(0.0)
        periods = max(1, TICKS // robots)
        start = process_time()
        await clock.advance(float(periods))
        spent = process_time() - start
        tasks.cancel_scope.cancel()
    return spent / (periods * robots)


@pytest.mark.parametrize("loop", ["asyncio", "uvloop", "trio"])
def test_a_tick_costs_the_same_among_many(table: Table, loop: str) -> None:
    backend = "trio" if loop == "trio" else "asyncio"
    options = {"use_uvloop": True} if loop == "uvloop" else {}
    rounds: dict[int, list[float]] = {robots: [] for robots in CROWDS}
    for _ in range(ROUNDS):
        for robots in CROWDS:
            rounds[robots].append(anyio.run(seconds_a_tick, robots, backend=backend, backend_options=options))
    fewest = sorted(rounds[CROWDS[0]])[ROUNDS // 2]
    for robots in CROWDS:
        ratio = sorted(rounds[robots])[ROUNDS // 2] / fewest
        table.add(f"{loop}, a tick among {robots:,} robots", show(rounds[robots], "us"), "", f"{ratio:.2f}", "<= 1.5")
