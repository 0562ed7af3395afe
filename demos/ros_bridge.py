"""Transform a scan of a robot with ROS in a program without ROS.

The robot and the program run in one process here, so that the demo runs anywhere. They share only a DDS domain, where
any ROS 2 node would hear them. The robot drives along x at 1 m/s, and has a laser 0.2 m before its base. The program
takes a scan message of ROS, awaits the transform at the scan's own stamp, and prints where the scan hit something.

Run it with `python demos/ros_bridge.py`. With a robot's place instead, as in `python demos/ros_bridge.py 42` for
ROS_DOMAIN_ID 42, it prints that robot's tree for three seconds. It needs `pip install ".[dds]"`.
"""

import sys
from typing import Any

import anyio

import tfbus
from tfbus.data import from_message
from tfbus.links.dds import DdsLink

DOMAIN = 97
SPEED = 1.0


def scan_at(stamp: int) -> dict[str, Any]:
    """A `sensor_msgs/LaserScan` with one ray, straight ahead; rclpy's objects would do as well."""
    sec, nanosec = divmod(stamp, tfbus.SECOND)
    limits = {"range_min": 0.1, "range_max": 30.0, "angle_min": 0.0, "angle_max": 0.0, "angle_increment": 0.01}
    header = {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": "laser"}
    return {"header": header, **limits, "time_increment": 0.0, "scan_time": 0.1, "ranges": [4.0], "intensities": []}


async def robot(start: int, domain: int) -> None:
    """Publish on ``/tf`` and ``/tf_static``, as a driver does."""
    with tfbus.Bus() as bus:
        async with DdsLink(bus, domain):
            driver = tfbus.TransformBroadcaster(bus, authority="driver")
            driver.send_static("base_link", "laser", tfbus.Transform((0.2, 0.0, 0.0)))
            async for _ in bus.clock.ticks(50.0):
                stamp = bus.clock.now()
                driver.send("odom", "base_link", tfbus.Transform((SPEED * tfbus.to_seconds(stamp - start), 0.0, 0.0)))


async def main(domain: int = DOMAIN) -> None:
    start = tfbus.SystemClock().now()
    with tfbus.Bus() as bus, tfbus.Buffer(bus) as buffer:
        async with DdsLink(bus, domain), anyio.create_task_group() as tasks:
            tasks.start_soon(robot, start, domain)
            await buffer.lookup("odom", "laser", timeout=10.0)
            taken = bus.clock.now()
            points = from_message(scan_at(taken)).to_points()
            hit = await buffer.transform(points, "odom", timeout=10.0)
            driven = SPEED * tfbus.to_seconds(taken - start)
            print(f"hit {hit.points[0][0] - driven:.2f} m before the place of the robot, in {hit.frame}")
            tasks.cancel_scope.cancel()


async def look(domain: int) -> None:
    with tfbus.Bus() as bus, tfbus.Buffer(bus) as buffer:
        async with DdsLink(bus, domain, send=False):
            await anyio.sleep(3.0)
            print(buffer.tree.describe())


if __name__ == "__main__":
    if len(sys.argv) > 1:
        anyio.run(look, int(sys.argv[1]))
    else:
        anyio.run(main)
