"""Deskew a laser scan from a robot that drives and turns while it scans.

The laser sweeps half a turn in 0.1 s. Meanwhile the robot drives at 2 m/s towards a flat wall and turns at 1.5 rad/s,
so each ray starts from another place. If all rays use the transform of one instant, the wall comes out bent. If each
ray uses the transform at its own stamp, the wall comes out flat. The odometry arrives 30 ms late: the scan waits for
it.

Run it with `python demos/deskew.py`. The time is simulated, so it ends at once and always prints the same.
"""

import math

import anyio
import numpy as np

import tfbus
from tfbus.testing import simulate

WALL = 3.0  # m from the origin of odom, along x
SPEED = 2.0  # m/s
TURN = 1.5  # rad/s
RAYS = 181
SWEEP = 0.1  # s


def pose(seconds: float) -> tfbus.Transform:
    return tfbus.Transform.from_xyz_rpy((SPEED * seconds, 0.0, 0.0), (0.0, 0.0, TURN * seconds))


async def publish_odometry(bus: tfbus.Bus) -> None:
    odometry = tfbus.TransformBroadcaster(bus, authority="odometry")
    async for tick in bus.clock.ticks(50.0):
        await bus.clock.sleep_until(tfbus.from_seconds(tick / 50.0 + 0.03))
        odometry.send("odom", "laser", pose(tick / 50.0), at=tfbus.from_seconds(tick / 50.0))


def scan_the_wall(start: float) -> tfbus.LaserScan:
    """The scan that the laser measures: for each ray the way to the wall, from the robot's place at that instant."""
    first, step, period = -math.pi / 4, math.pi / 2 / (RAYS - 1), SWEEP / (RAYS - 1)
    times = start + period * np.arange(RAYS)
    directions = first + step * np.arange(RAYS) + TURN * times
    ranges = (WALL - SPEED * times) / np.cos(directions)
    stamp = tfbus.from_seconds(start)
    return tfbus.LaserScan("laser", stamp, ranges, angle_min=first, angle_increment=step, time_increment=period)


def show(name: str, cloud: tfbus.PointCloud) -> None:
    x = cloud.points[:, 0]
    print(f"{name}: the wall is {x.min():.3f} m to {x.max():.3f} m away")


async def main() -> None:
    clock = tfbus.SimulatedClock()
    with tfbus.Bus(clock) as bus, tfbus.Buffer(bus) as buffer:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(publish_odometry, bus)

            async def see() -> None:
                await clock.sleep(SWEEP)
                cloud = scan_the_wall(0.0).to_points()
                assert cloud.stamps is not None
                newest = int(cloud.stamps.max())
                deskewed = await buffer.deskew(cloud, "odom", fixed="odom", timeout=1.0)
                print(f"the transform of the last ray came {tfbus.to_seconds(clock.now() - newest) * 1000:.0f} ms late")
                show("all rays at one instant", await buffer.transform(cloud, "odom"))
                show("each ray at its own", deskewed)
                ahead = tfbus.PointStamped("laser", 0, (WALL, 0.0, 0.0))
                now = await buffer.transform(ahead, "laser", at=newest, fixed="odom")
                print(f"seen straight ahead at first, and by now at ({now.point[0]:.3f}, {now.point[1]:.3f})")

            await simulate(clock, see, limit=10.0)
            tasks.cancel_scope.cancel()


if __name__ == "__main__":
    anyio.run(main)
