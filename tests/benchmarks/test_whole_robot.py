"""The cost of a whole robot, from a message of its joints to transforms that are inserted in one buffer."""

from collections.abc import Callable
from time import perf_counter

import pytest
from beside import Table, show
from support import pr2

from tfbus import Buffer, Bus, RobotModel, RobotStatePublisher, SimulatedClock

pytest_plugins = ["side_by_side"]

ROUNDS = 15
RATE = 100.0
WANTED = 0.25
"""Of one core."""


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


@pr2.needed
def test_reading_the_urdf_of_a_pr2(table: Table) -> None:
    rounds = []
    for _ in range(ROUNDS):
        start = perf_counter()
        RobotModel.from_urdf(pr2.URDF)
        rounds.append(perf_counter() - start)
    table.add("PR2, from_urdf", show(rounds, "ms"))
