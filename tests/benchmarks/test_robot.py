"""The cost of a whole robot, from a message of its joints to transforms in one buffer; and of simulated time."""

from collections.abc import Callable
from time import perf_counter, process_time

import anyio
import pytest
from beside import Table, show
from support import pr2

from tfbus import Buffer, Bus, RobotModel, RobotStatePublisher, SimulatedClock

pytest_plugins = ["side_by_side"]

ROUNDS = 15
RATE = 100.0
WANTED = 0.25
"""Of one core."""
FEW_ROUNDS, TICKS, CROWDS = 5, 2_000, (100, 1_000, 3_000)


def seconds_a_message(publish: Callable[[RobotStatePublisher, pr2.JointState], None], model: RobotModel) -> float:
    """All messages of the recording, through a bus to one buffer."""
    states = pr2.recorded().states
    with Bus(SimulatedClock()) as bus, Buffer(bus) as buffer:
        robot = RobotStatePublisher(bus, model)
        start = perf_counter()
        for state in states:
            publish(robot, state)
        spent = perf_counter() - start
        assert buffer.can_transform("base_footprint", "r_gripper_tool_frame", states[-1].stamp)
        assert len(buffer.tree.frames()) == 83
    return spent / len(states)


@pr2.needed
@pytest.mark.parametrize("kind", ["names and positions", "mapping"])
def test_a_pr2_from_joint_message_to_buffer(table: Table, kind: str) -> None:
    model = RobotModel.from_urdf(pr2.URDF)
    mappings = {
        state.stamp: dict(zip(state.names, state.positions.tolist(), strict=True)) for state in pr2.recorded().states
    }

    def publish(robot: RobotStatePublisher, state: pr2.JointState) -> None:
        if kind == "mapping":
            robot.publish(mappings[state.stamp], state.stamp)
        else:
            robot.publish_state(state.names, state.positions, state.stamp)

    rounds = [seconds_a_message(publish, model) for _ in range(ROUNDS)]
    core = f"{sorted(rounds)[len(rounds) // 2] * RATE:.1%} of a core at {RATE:.0f} Hz"
    table.add(f"PR2, 82 frames, {kind}", show(rounds, "us"), core, "", f"<= {WANTED:.0%}")


async def seconds_a_tick(robots: int) -> float:
    """The processor time of a timed task that wakes and sleeps again, among others."""
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
    for _ in range(FEW_ROUNDS):
        for robots in CROWDS:
            rounds[robots].append(anyio.run(seconds_a_tick, robots, backend=backend, backend_options=options))
    fewest = sorted(rounds[CROWDS[0]])[FEW_ROUNDS // 2]
    for robots in CROWDS:
        ratio = sorted(rounds[robots])[FEW_ROUNDS // 2] / fewest
        table.add(f"{loop}, a tick among {robots:,} robots", show(rounds[robots], "us"), "", f"{ratio:.2f}", "<= 1.5")
