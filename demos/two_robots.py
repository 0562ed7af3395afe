"""Two robots with the same frame names share one bus, and one sees the other through the map.

Robot 1 drives round a circle of 2 m in the map, robot 2 twice as fast round a circle of 3 m. Each robot publishes its
frames `base_link`, `camera` and `gripper` under its own prefix; the map is the same for both. So a robot asks about
itself in its own names, and a buffer without a prefix can ask about both: where is robot 2's gripper, seen from robot
1's camera? Neither robot may end because of samples of the other, so each leaves out its own samples that the bus
refuses.

Run it with `python demos/two_robots.py`.
"""

import math

import anyio

import tfbus

SHARED = {"map"}


async def drive(bus: tfbus.Bus, name: str, radius: float, speed: float, start: int) -> None:
    """Publish the frames of a robot that goes round the map's origin, at `speed` rad/s, and looks ahead."""
    robot = tfbus.TransformBroadcaster(bus, authority=name, prefix=f"{name}/", shared=SHARED, invalid="drop")
    robot.send_static("base_link", "camera", tfbus.Transform(translation=(0.2, 0.0, 1.0)))
    robot.send_static("base_link", "gripper", tfbus.Transform(translation=(0.5, 0.0, 0.4)))
    async for tick in bus.clock.ticks(50.0):
        stamp = start + tick * tfbus.SECOND // 50
        angle = speed * tfbus.to_seconds(stamp - start)
        place = (radius * math.cos(angle), radius * math.sin(angle), 0.0)
        pose = tfbus.Transform.from_xyz_rpy(place, (0.0, 0.0, angle + math.pi / 2))
        robot.send("map", "base_link", pose, at=stamp)


def show(answer: tfbus.TransformStamped) -> str:
    x, y, z = answer.transform.translation
    return f"{answer.child} in {answer.parent}: ({x:.3f}, {y:.3f}, {z:.3f})"


async def main(clock: tfbus.Clock | None = None) -> None:
    with tfbus.Bus(clock) as bus, tfbus.Buffer(bus) as everybody:
        start = bus.clock.now()
        robot2 = tfbus.Buffer(bus, prefix="robot2/", shared=SHARED)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(drive, bus, "robot1", 2.0, 0.5, start)
            tasks.start_soon(drive, bus, "robot2", 3.0, 1.0, start)
            for tenths in (2, 6, 10):
                at = start + tenths * tfbus.SECOND // 10
                own = await robot2.lookup("map", "gripper", at, timeout=5.0)
                across = await everybody.lookup("robot1/camera", "robot2/gripper", at, timeout=5.0)
                print(f"after {tenths / 10} s, {show(own)}; {show(across)}")
            print(everybody.explain("robot1/camera", "robot2/gripper"))
            tasks.cancel_scope.cancel()


if __name__ == "__main__":
    anyio.run(main)
