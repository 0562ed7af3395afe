"""A whole robot from its URDF: an arm of seven joints at 100 Hz, with a camera on its hand that sees something.

Each detection has a stamp between two messages of the joints, so it waits a few milliseconds for the next message, and
is then transformed into the base at its own stamp. It is straight ahead of the camera, so its place has a closed form,
too. The arm itself is in `robot_arm.urdf`. Run it with `python demos/robot_arm.py`.
"""

import cmath
import math
from pathlib import Path

import anyio

import tfbus

URDF = Path(__file__).with_name("robot_arm.urdf")
JOINTS = ("shoulder_pan", "shoulder_lift", "upper_arm_roll", "elbow_flex", "forearm_roll", "wrist_flex", "wrist_roll")
AHEAD = 0.6
LINE = "({:.3f}, {:.3f}, {:.3f}) in the base, after {:.0f} ms; by the closed form ({:.3f}, {:.3f}, {:.3f})"


def positions(seconds: float) -> tuple[float, ...]:
    """The positions of the seven joints, in rad: four swing, and the last one goes round and round."""
    swing = math.sin(2.0 * seconds)
    return 1.2 * swing, 0.4 * swing, 0.0, -0.9 * swing, 0.0, 0.8 * swing, 3.0 * seconds


def closed_form(seconds: float) -> tuple[float, float, float]:
    """Parts of 0.4 m, 0.35 m and 0.15 m in a plane through the post of 0.5 m, which the first joint turns."""
    pan, lift, _, elbow, _, wrist, _ = positions(seconds)
    upper_arm, forearm, hand = (cmath.exp(-1j * angle) for angle in (lift, lift + elbow, lift + elbow + wrist))
    place = 0.5j + 0.4 * upper_arm + 0.35 * forearm + (0.15 + AHEAD) * hand
    return place.real * math.cos(pan), place.real * math.sin(pan), place.imag


async def move(robot: tfbus.RobotStatePublisher, start: int) -> None:
    async for _ in robot.bus.clock.ticks(100.0):
        stamp = robot.bus.clock.now()
        robot.publish_state(JOINTS, positions(tfbus.to_seconds(stamp - start)), stamp)


async def main(clock: tfbus.Clock | None = None) -> None:
    with tfbus.Bus(clock) as bus, tfbus.Buffer(bus) as buffer:
        start = bus.clock.now()
        robot = tfbus.RobotStatePublisher(bus, tfbus.RobotModel.from_urdf(URDF))
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(move, robot, start)
            for _ in range(5):
                await bus.clock.sleep(0.195)
                seen = bus.clock.now()
                detection = tfbus.PointStamped("camera", seen, (0.0, 0.0, AHEAD))
                placed = await buffer.transform(detection, "base_link", timeout=1.0)
                waited = (bus.clock.now() - seen) / 1e6
                print(LINE.format(*placed.point, waited, *closed_form(tfbus.to_seconds(seen - start))))
            tasks.cancel_scope.cancel()


if __name__ == "__main__":
    anyio.run(main)
