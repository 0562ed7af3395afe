# /// script
# requires-python = ">=3.11"
# dependencies = ["tfbus[bag]", "rerun-sdk>=0.30"]
# ///
"""Show a recording, or a bus, in Rerun, with the names of its frames.

Rerun has named frames, as tf has: a transform names its parent and its child, and whatever is logged in a frame moves
with it. So each frame of tf becomes one entity of Rerun. A recording is sent in columns, one call for a frame; a live
bus sample by sample. Rerun stores numbers with 32 bits, so draw large maps in a frame that is near, and compute with
tfbus.

Run it with `pip install rerun-sdk` and `python demos/rerun_frames.py run.mcap`: Rerun's viewer opens. With a second
path, such as `run.rrd`, the file is written instead. Without arguments, it shows a robot that drives a circle on a bus.
"""

import math
import sys
from collections.abc import Iterable

import anyio
import numpy as np
import rerun as rr

import tfbus
from tfbus.recording import load

TIMELINE = "stamp"
AXES = 0.3
"""The length of the axes of each frame, in m."""


def entity(frame: str) -> str:
    """The entity of a frame, whose name may have any letters."""
    path: str = rr.new_entity_path(["tf", frame])
    return path


def draw_axes(frame: str) -> None:
    rr.log(entity(frame), rr.CoordinateFrame(frame), rr.TransformAxes3D(AXES), static=True)


def look_from(frame: str) -> None:
    """Let the views show everything in a frame."""
    rr.log("/", rr.CoordinateFrame(frame), static=True)
    draw_axes(frame)


def log_tree(tree: tfbus.TransformTree) -> None:
    """Log all samples of a recording; raises `ValueError` for a frame that changed its parent."""
    look_from(next(frame for frame in tree.frames() if tree.parent(frame) is None))
    for edge in tree.edges():
        draw_axes(edge.child)
        samples = tree.samples(edge.child)
        columns = rr.Transform3D.columns(
            translation=samples.translations,
            quaternion=samples.rotations,
            parent_frame=[edge.parent] * len(samples),
            child_frame=[edge.child] * len(samples),
        )
        stamps = np.asarray(samples.stamps).view("M8[ns]")
        rr.send_columns(entity(edge.child), [] if edge.static else [rr.TimeColumn(TIMELINE, timestamp=stamps)], columns)


def log_batch(samples: Iterable[tfbus.TransformStamped]) -> None:
    """Log the samples of a message or of a bus."""
    for sample in samples:
        rr.set_time(TIMELINE, timestamp=np.datetime64(sample.stamp, "ns"))
        pose = rr.Transform3D(
            translation=sample.transform.translation,
            quaternion=rr.Quaternion(xyzw=sample.transform.rotation),
            parent_frame=sample.parent,
            child_frame=sample.child,
        )
        rr.log(entity(sample.child), pose, static=sample.static)


async def drive() -> None:
    """A robot that drives a circle of 2 m, with a lidar on it."""
    with tfbus.Bus() as bus, bus.subscribe(log_batch):
        robot = tfbus.TransformBroadcaster(bus, authority="odometry")
        robot.send_static("base_link", "lidar", tfbus.Transform((0.3, 0.0, 0.5)))
        look_from("map")
        draw_axes("base_link")
        draw_axes("lidar")
        async for tick in bus.clock.ticks(20.0):
            turn = 0.02 * tick
            place = (2.0 * math.cos(turn), 2.0 * math.sin(turn), 0.0)
            robot.send("map", "base_link", tfbus.Transform.from_xyz_rpy(place, (0.0, 0.0, turn + math.pi / 2)))


if __name__ == "__main__":
    rr.init("tfbus", spawn=len(sys.argv) < 3)
    if len(sys.argv) > 2:
        rr.save(sys.argv[2])
    if len(sys.argv) > 1:
        log_tree(load(sys.argv[1]))
    else:
        anyio.run(drive)
