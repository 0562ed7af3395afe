"""A robot to look at: a live page in the browser.

A robot drives on a circle of 2 m at a quarter of a turn a second. On it turns a lidar, whose points the page draws in
their frame. After ten seconds the odometry falls silent: the page shows the frame as stale. Click on the mount of the
lidar, and move it: the lidar and its points follow, and *Save* writes the mount to `lidar_mount.yaml`.

Run it with `python demos/live_view.py`, open the address that it prints, and press Ctrl-C to end it. It needs
`pip install "tfbus[view]"`.
"""

import math

import anyio
import numpy as np

import tfbus
from tfbus.view import View

RADIUS = 2.0
TURN = math.pi / 2.0
SILENT_AFTER = 10.0


async def drive(bus: tfbus.Bus) -> None:
    odometry = tfbus.TransformBroadcaster(bus, authority="odometry")
    async for tick in bus.clock.ticks(50.0):
        time = tick / 50.0
        if time > SILENT_AFTER:
            return
        place = (RADIUS * math.cos(TURN * time), RADIUS * math.sin(TURN * time), 0.0)
        heading = TURN * time + math.pi / 2.0
        odometry.send("map", "base_link", tfbus.Transform.from_xyz_rpy(place, (0.0, 0.0, heading)))


async def scan(bus: tfbus.Bus, view: View) -> None:
    lidar = tfbus.TransformBroadcaster(bus, authority="lidar")
    lidar.send_static("base_link", "lidar_mount", tfbus.Transform((0.2, 0.0, 0.4)))
    angles = np.linspace(-1.0, 1.0, 200)
    async for tick in bus.clock.ticks(10.0):
        lidar.send("lidar_mount", "lidar", tfbus.Transform.from_axis_angle((0.0, 0.0, 1.0), 0.2 * tick))
        wall = np.stack((np.cos(angles), np.sin(angles), np.zeros_like(angles)), axis=1)
        view.add_points(tfbus.PointCloud("lidar", tfbus.LATEST, wall), "scan")


async def main(port: int = 8080, clock: tfbus.Clock | None = None) -> None:
    with tfbus.Bus(clock) as bus, tfbus.Buffer(bus) as buffer:
        page = View(bus, buffer, port, trails=["base_link"], edit=["lidar_mount"], save="lidar_mount.yaml")
        async with page as view, anyio.create_task_group() as robot:
            print(f"open {view.address}", flush=True)
            robot.start_soon(drive, bus)
            robot.start_soon(scan, bus, view)


if __name__ == "__main__":
    try:
        anyio.run(main)
    except KeyboardInterrupt:
        print("the end")
