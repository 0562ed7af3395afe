"""Clouds and scans of a recording, written by `rosbags`."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore

from tfbus import RecordingError
from tfbus.recording import load_points, points

POINTS = np.arange(30, dtype=np.float32).reshape(10, 3)


def write(path: Path, ros1: bool) -> Path:
    """A scan of three rays of which two hit, and two clouds of ten points, the later one first; each before damage."""
    types: Any = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)

    def make(name: str, *values: Any) -> Any:
        return types.types[name](*values)

    def header(frame: str, seconds: int) -> Any:
        stamp = make("builtin_interfaces/msg/Time", seconds, 0)
        return make("std_msgs/msg/Header", *((0,) if ros1 else ()), stamp, frame)

    scan = make(
        *("sensor_msgs/msg/LaserScan", header("laser", 1), 0.0, np.pi, np.pi / 2, 0.0, 0.0, 0.1, 10.0),
        *(np.array([1.0, np.inf, 3.0], np.float32), np.empty(0, np.float32)),
    )
    fields = [make("sensor_msgs/msg/PointField", axis, 4 * place, 7, 1) for place, axis in enumerate("xyz")]
    data = np.frombuffer(POINTS.tobytes(), np.uint8)
    clouds = [
        make("sensor_msgs/msg/PointCloud2", header("lidar", seconds), 1, 10, fields, False, 12, 120, data, True)
        for seconds in (3, 2)
    ]
    writer: Any = (
        rosbag1.Writer(path / "run.bag")
        if ros1
        else rosbag2.Writer(path / "run", version=9, storage_plugin=StoragePlugin.MCAP)
    )
    serialize = types.serialize_ros1 if ros1 else types.serialize_cdr
    with writer:
        for topic, kind, messages in (
            ("/scan", "sensor_msgs/msg/LaserScan", [scan]),
            ("/cloud", "sensor_msgs/msg/PointCloud2", clouds),
        ):
            connection = writer.add_connection(topic, kind, typestore=types)
            for at, message in enumerate(messages):
                writer.write(connection, at, bytes(serialize(message, kind)))
            writer.write(connection, 9, bytes(serialize(messages[0], kind))[:40])
    return path / ("run.bag" if ros1 else "run")


@pytest.mark.parametrize("ros1", [True, False])
def test_clouds_and_scans_are_points_in_their_frames_in_the_order_of_their_stamps(tmp_path: Path, ros1: bool) -> None:
    path = write(tmp_path, ros1)
    problems: Counter[str] = Counter()
    [scan] = load_points(path, "scan", problems=problems)
    assert (scan.frame, scan.stamp, problems) == ("laser", 1_000_000_000, {"damaged": 1})
    # The rays of 0 and 180 degrees.
    assert scan.points == pytest.approx(np.array([[1.0, 0.0, 0.0], [-3.0, 0.0, 0.0]]), abs=1e-6)
    clouds = load_points(path, "/cloud")
    assert [(cloud.frame, cloud.stamp) for cloud in clouds] == [("lidar", 2_000_000_000), ("lidar", 3_000_000_000)]
    assert all(np.array_equal(cloud.points, POINTS) for cloud in clouds)


def test_points_are_thinned_to_a_number_and_all_together_to_a_bound(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path, ros1=False)
    assert [cloud.points[:, 0].tolist() for cloud in load_points(path, "/cloud", most=4)] == [
        [0.0, 9.0, 18.0, 27.0]
    ] * 2
    monkeypatch.setattr(points, "MAX_POINTS", 11)
    assert [len(cloud) for cloud in load_points(path, "/cloud")] == [5, 5]


def test_a_topic_without_points_is_told_with_those_that_have_some(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"'/tf'; topics with them: /cloud, /scan"):
        load_points(write(tmp_path, ros1=False), "/tf")
    with pytest.raises(ValueError, match="most=0"):
        load_points(tmp_path, "/scan", most=0)
