"""Put the scans of a bag into the map: each ray where the laser was when it was sent.

`tfbus.recording.load` reads the transforms, and rosbags (which the extra `bag` installs) the scans. A scan that the
transforms do not cover, such as the first of many bags, is left out with the reason.

Run it with `python demos/scans_in_map.py`: a robot drives at 1 m/s towards a wall, and is recorded first. Or give it a
bag of ROS 1 or ROS 2: `python demos/scans_in_map.py run.bag /scan map`.
"""

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import tfbus
from tfbus.data import from_message
from tfbus.recording import load


def scans_in(path: Path, topic: str, target: str) -> Iterator[tfbus.PointCloud]:
    tree = load(path)
    with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
        scans = [each for each in bag.connections if each.topic == topic]
        if not scans:  # rosbags would read every topic
            raise SystemExit(f"no topic {topic!r} in {sorted(bag.topics)}")
        for connection, _, message in bag.messages(scans):
            cloud = from_message(bag.deserialize(message, connection.msgtype)).to_points()
            try:
                yield tree.deskew(cloud, target, fixed=target)
            except tfbus.TransformLookupError as error:
                print(f"left out: {error}")


def record(path: Path) -> None:
    """A wall at 5 m, seen ten times from a robot that drives towards it."""
    types = get_typestore(Stores.LATEST)
    time, header, vector, quaternion, transform, sample, batch, scan = (
        types.types[name]
        for name in (
            "builtin_interfaces/msg/Time",
            "std_msgs/msg/Header",
            "geometry_msgs/msg/Vector3",
            "geometry_msgs/msg/Quaternion",
            "geometry_msgs/msg/Transform",
            "geometry_msgs/msg/TransformStamped",
            "tf2_msgs/msg/TFMessage",
            "sensor_msgs/msg/LaserScan",
        )
    )
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        transforms = writer.add_connection("/tf", batch.__msgtype__, typestore=types)
        scans = writer.add_connection("/scan", scan.__msgtype__, typestore=types)
        for tick in range(11):
            stamp, x = tick * 100_000_000, 0.1 * tick
            at = time(stamp // tfbus.SECOND, stamp % tfbus.SECOND)
            pose = transform(vector(x, 0.0, 0.0), quaternion(0.0, 0.0, 0.0, 1.0))
            moved = batch([sample(header(at, "map"), "laser", pose)])
            writer.write(transforms, stamp, types.serialize_cdr(moved, batch.__msgtype__))
            # Two rays straight ahead, 50 ms apart.
            ranges = np.array([5.0 - x, 4.95 - x], np.float32)
            seen = scan(header(at, "laser"), 0.0, 0.0, 1e-6, 0.05, 0.1, 0.1, 30.0, ranges, np.zeros(0, np.float32))
            writer.write(scans, stamp, types.serialize_cdr(seen, scan.__msgtype__))


def main(path: Path, topic: str = "/scan", target: str = "map") -> None:
    clouds = list(scans_in(path, topic, target))
    if not clouds:
        raise SystemExit(f"no scan of {topic!r} could be put into {target!r}")
    points = np.concatenate([cloud.points for cloud in clouds])
    print(f"{len(clouds)} scans, {len(points)} points in {target!r}: x from {points[:, 0].min():.3f} m", end=" ")
    print(f"to {points[:, 0].max():.3f} m")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]), *sys.argv[2:4])
    else:
        with tempfile.TemporaryDirectory() as folder:
            record(Path(folder, "run"))
            main(Path(folder, "run"))
