"""Record a robot, look up its path without an event loop, and play the recording.

The robot goes round a circle of 2 m once in 8 s, with a camera in front of it. The recording is an MCAP file that ROS 2
and Foxglove read as well. `load` makes a tree of it, which answers lookups at every recorded stamp. A player publishes
it again, and listeners on the bus cannot tell it from the robot.

Run it with `python demos/record_and_replay.py`, or with a path to keep the recording there. The time is simulated, so
it ends soon and always prints the same.
"""

import math
import sys
import tempfile
from pathlib import Path

import anyio

import tfbus
from tfbus.recording import Player, Recorder, load


async def drive(bus: tfbus.Bus) -> None:
    robot = tfbus.TransformBroadcaster(bus, authority="odometry")
    robot.send_static("base", "camera", tfbus.Transform((0.3, 0.0, 0.5)))
    async for tick in bus.clock.ticks(50.0):
        turn = math.tau * tick / 400
        place = (2.0 * math.cos(turn), 2.0 * math.sin(turn), 0.0)
        robot.send("map", "base", tfbus.Transform.from_xyz_rpy(place, (0.0, 0.0, turn + math.pi / 2)))


def place(answer: tfbus.TransformStamped) -> str:
    x, y, z = answer.transform.translation
    return f"({x:.3f}, {y:.3f}, {z:.3f}) at {tfbus.to_seconds(answer.stamp):.2f} s"


async def main(path: Path) -> None:
    clock = tfbus.SimulatedClock()
    async with Recorder(tfbus.Bus(clock), path) as recorder, anyio.create_task_group() as tasks:
        tasks.start_soon(drive, recorder.bus)
        await clock.advance(8.0)
        tasks.cancel_scope.cancel()
    print(f"recorded: {recorder.statistics().samples} samples")

    tree = load(path)
    for second in (1, 2, 4):
        print("the camera was at", place(tree.lookup("map", "camera", second * tfbus.SECOND)))

    with tfbus.Bus(tfbus.SimulatedClock()) as bus, tfbus.Buffer(bus) as buffer:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(Player(bus, path, rate=math.inf).play)
            print("and once more at", place(await buffer.lookup("map", "camera", 4 * tfbus.SECOND)))


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        anyio.run(main, Path(sys.argv[1]) if len(sys.argv) > 1 else Path(folder) / "run.mcap")
