"""Bring the points of a lidar into the picture of a camera with a rolling shutter, on a robot that turns.

The lidar sees five poles while it goes round; the camera reads its rows one after another. The last column is the error
of the easy way, which moves the whole cloud by one transform.
"""

import anyio
import numpy as np

import tfbus
from tfbus.axes import BODY_FROM_OPTICAL
from tfbus.camera import Camera

TURN = 1.0  # rad/s
PICTURE = tfbus.from_seconds(0.2)
ROW_TIME = 50e-6  # s
MATRIX = [[400.0, 0.0, 320.0], [0.0, 400.0, 240.0], [0.0, 0.0, 1.0]]
POLES = np.array([(8.0, -2.0 + n, 0.5 - 0.25 * n) for n in range(5)])


def base_at(stamp: int) -> tfbus.Transform:
    return tfbus.Transform.from_axis_angle((0.0, 0.0, 1.0), TURN * (tfbus.to_seconds(stamp) - 0.2))


async def main() -> None:
    camera = Camera("camera_optical", 640, 480, MATRIX, "plumb_bob", (-0.1, 0.01))
    with tfbus.Bus(tfbus.SimulatedClock()) as bus, tfbus.Buffer(bus) as buffer:
        robot = tfbus.TransformBroadcaster(bus, "robot")
        robot.send_static("base_link", "lidar", tfbus.Transform((0.2, 0.0, 0.3)))
        robot.send_static("base_link", "camera_optical", tfbus.Transform((0.1, 0.0, 0.2)) @ BODY_FROM_OPTICAL)
        for tick in range(41):
            stamp = tfbus.from_seconds(0.01 * tick)
            robot.send("odom", "base_link", base_at(stamp), at=stamp)

        # The lidar goes round in 0.1 s, and sees each pole at another instant.
        stamps = tfbus.from_seconds(0.12) + np.arange(5) * 20_000_000
        lidar_from_odom = [buffer.lookup_nowait("lidar", "odom", stamp).transform for stamp in stamps.tolist()]
        seen = [move.apply(pole) for move, pole in zip(lidar_from_odom, POLES, strict=True)]
        cloud = tfbus.PointCloud("lidar", int(stamps[0]), np.array(seen), stamps)

        picture = await camera.project_cloud(buffer, cloud, at=PICTURE, fixed="odom", row_time=ROW_TIME, timeout=1.0)
        at_once = await buffer.transform(cloud, "camera_optical", at=PICTURE, fixed="odom", timeout=1.0)
        wrong = camera.project(at_once.points)[0]
    for number, ((column, row), depth, (other, _)) in enumerate(zip(picture.pixels, picture.depth, wrong, strict=True)):
        print(
            f"pole {number}: column {column:5.1f}, row {row:5.1f}, {depth:.2f} m; at once {other - column:+6.1f} pixels"
        )


if __name__ == "__main__":
    anyio.run(main)
