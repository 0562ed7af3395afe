"""Two processes: one drives a robot and its laser, the other one puts the scans into odom.

tfbus carries the transforms between the two. It carries no scans: these travel by whatever the robot has, here by a
session of zenoh (`pip install ".[zenoh]"`). The receiver needs both, and `buffer.transform` joins them: it waits until
the transform of the scan's own stamp has arrived.

Run it with `python demos/scans_between_processes.py`: it starts the laser as a process of its own, and ends after five
scans.
"""

import asyncio
import json
import socket
import subprocess
import sys

import numpy as np
import zenoh

import tfbus

KEY = "robot/scan"


def open_session(side: str, port: str) -> zenoh.Session:
    """A session that listens at a port of this machine, or connects to it, and looks for nobody else."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5(f"{side}/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    return zenoh.open(config)


async def scan_and_drive(port: str) -> None:
    """The laser's process: a wall at 5 m, from a robot that drives towards it at 1 m/s."""
    with open_session("connect", port) as session, tfbus.Bus() as bus:
        odometry = tfbus.TransformBroadcaster(bus, authority="odometry")
        async with tfbus.LocalLink(bus, f"scans-{port}"):
            start = bus.clock.now()
            async for _ in bus.clock.ticks(20.0):
                now = bus.clock.now()
                x = tfbus.to_seconds(now - start)
                scan = tfbus.LaserScan("laser", now, np.array([5.0 - x]), angle_min=0.0, angle_increment=0.1)
                session.put(KEY, json.dumps(scan.to_dict()))
                odometry.send("odom", "laser", tfbus.Transform((x, 0.0, 0.0)), at=now)


async def place_scans(port: str, count: int) -> None:
    """The other process: each scan in odom."""
    loop = asyncio.get_running_loop()
    scans: asyncio.Queue[tfbus.LaserScan] = asyncio.Queue(10)

    def keep(scan: tfbus.LaserScan) -> None:
        if scans.full():
            scans.get_nowait()
        scans.put_nowait(scan)

    def receive(sample: zenoh.Sample) -> None:
        # zenoh calls this in a thread of its own.
        scan = tfbus.LaserScan.from_dict(json.loads(sample.payload.to_string()))
        loop.call_soon_threadsafe(keep, scan)

    with open_session("listen", port) as session, tfbus.Bus() as bus, tfbus.Buffer(bus) as buffer:
        async with tfbus.LocalLink(bus, f"scans-{port}"):
            subscriber = session.declare_subscriber(KEY, receive)
            while count > 0:
                cloud = (await scans.get()).to_points()
                try:
                    in_odom = await buffer.transform(cloud, "odom", timeout=1.0)
                except tfbus.TransformLookupError as error:
                    # The scans of before the two buses had met.
                    print(f"left out: {type(error).__name__}", file=sys.stderr)
                    continue
                print(f"the wall is at x = {in_odom.points[0, 0]:.3f} m in odom", flush=True)
                count -= 1
            subscriber.undeclare()


if __name__ == "__main__":
    if len(sys.argv) > 1:
        asyncio.run(scan_and_drive(sys.argv[1]))
    else:
        with socket.create_server(("127.0.0.1", 0)) as probe:
            free = str(probe.getsockname()[1])
        with subprocess.Popen([sys.executable, __file__, free]) as laser:
            try:
                asyncio.run(place_scans(free, 5))
            finally:
                laser.terminate()
