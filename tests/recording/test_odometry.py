"""Odometry and poses of a recording, read as transforms: written by `rosbags`, in the frames of closed forms."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore
from support.recorded import SMALL, write_mcap

from tfbus import Covariance, RecordingError, Transform, UncertainSample
from tfbus.geometry.covariance import inverse_jacobian
from tfbus.recording import examine, load, open_recording

KNOWN = Covariance(np.diag(np.arange(1.0, 7.0)) + np.eye(6, k=1) * 0.1 + np.eye(6, k=-1) * 0.1)
CHOSEN = {"/odom": None, "/camera/pose": "camera", "/amcl": "amcl_base"}


def contents(types: Any, ros1: bool) -> list[tuple[str, str, Any]]:
    def make(name: str, *values: Any) -> Any:
        return types.types[name](*values)

    number = (0,) if ros1 else ()
    quaternion = make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.6, 0.8)
    pose = make("geometry_msgs/msg/Pose", make("geometry_msgs/msg/Point", 1.0, 2.0, 3.0), quaternion)
    still = make("geometry_msgs/msg/Vector3", 9.0, 9.0, 9.0)
    twist = make("geometry_msgs/msg/Twist", still, still)
    spread = np.full(36, 7.0)
    with_spread = make("geometry_msgs/msg/PoseWithCovariance", pose, KNOWN.matrix.ravel())
    found = []
    # Names of all lengths, because the alignment depends on them.
    for k in range(8):
        stamp = make("builtin_interfaces/msg/Time", 5, k)
        header = make("std_msgs/msg/Header", *number, stamp, "o" * (k + 1))
        moving = make("geometry_msgs/msg/TwistWithCovariance", twist, spread)
        odometry = make("nav_msgs/msg/Odometry", header, "base" + "e" * k, with_spread, moving)
        found += [
            ("/odom", "nav_msgs/msg/Odometry", odometry),
            ("/camera/pose", "geometry_msgs/msg/PoseStamped", make("geometry_msgs/msg/PoseStamped", header, pose)),
            (
                "/amcl",
                "geometry_msgs/msg/PoseWithCovarianceStamped",
                make("geometry_msgs/msg/PoseWithCovarianceStamped", header, with_spread),
            ),
        ]
    return found


def write_bag(path: Path) -> Path:
    types = get_typestore(Stores.ROS1_NOETIC)
    with rosbag1.Writer(path / "run.bag") as writer:
        topics: dict[str, Any] = {}
        for at, (topic, kind, message) in enumerate(contents(types, ros1=True)):
            topics.setdefault(topic, None)
            topics[topic] = topics[topic] or writer.add_connection(topic, kind, typestore=types)
            writer.write(topics[topic], at, bytes(types.serialize_ros1(message, kind)))
    return path / "run.bag"


def write_ros2(path: Path, storage: StoragePlugin) -> Path:
    types = get_typestore(Stores.ROS2_HUMBLE)
    with rosbag2.Writer(path / "run", version=9, storage_plugin=storage) as writer:
        topics: dict[str, Any] = {}
        for at, (topic, kind, message) in enumerate(contents(types, ros1=False)):
            topics.setdefault(topic, None)
            topics[topic] = topics[topic] or writer.add_connection(topic, kind, typestore=types)
            writer.write(topics[topic], at, bytes(types.serialize_cdr(message, kind)))
    return path / "run"


WRITERS: list[Callable[[Path], Path]] = [
    write_bag,
    lambda path: write_ros2(path, StoragePlugin.MCAP),
    lambda path: write_ros2(path, StoragePlugin.SQLITE3),
]


@pytest.mark.parametrize("write", WRITERS, ids=["bag", "mcap", "db3"])
@pytest.mark.parametrize("invert", [False, True])
def test_odometry_and_poses_are_samples_at_their_own_stamps(
    tmp_path: Path, write: Callable[[Path], Path], invert: bool
) -> None:
    pose = Transform((1.0, 2.0, 3.0), (0.0, 0.0, 0.6, 0.8))
    with open_recording(write(tmp_path), odometry=CHOSEN, invert=invert, prefix="r/") as recording:
        messages = list(recording.messages())
    assert [message.errors for message in messages] == [()] * 24
    found = [sample for message in messages for sample in message.batch]
    for k in range(8):
        for sample, child in zip(found[3 * k : 3 * k + 3], ("base" + "e" * k, "camera", "amcl_base"), strict=True):
            edge = ("r/" + "o" * (k + 1), "r/" + child)
            assert (sample.parent, sample.child) == (edge[::-1] if invert else edge)
            assert (sample.stamp, sample.static) == (5_000_000_000 + k, False)
            assert sample.transform.is_close(pose.inverse() if invert else pose)
            if child == "camera":
                assert not isinstance(sample, UncertainSample)
                continue
            assert isinstance(sample, UncertainSample)
            assert sample.kind == ("drift" if child.startswith("base") and not invert else "independent")
            jacobian = inverse_jacobian(pose) if invert else np.eye(6)
            assert sample.covariance.matrix == pytest.approx(jacobian @ KNOWN.matrix @ jacobian.T)


def test_odometry_and_poses_are_examined_with_the_frames_that_they_have(tmp_path: Path) -> None:
    with open_recording(WRITERS[1](tmp_path), odometry=CHOSEN) as recording:
        found = {(finding.kind, finding.frame) for finding in examine(recording)}
    # Each message has another parent: the eight names of the frame.
    assert ("two parents", "camera") in found
    assert not {kind for kind, _ in found} & {"refused", "rotation", "unfinished"}


@pytest.mark.parametrize(
    ("odometry", "words"),
    [
        ("/nothing", "'nothing' is not there; topics with odometry or poses: /amcl, /camera/pose, /odom"),
        ("/camera/pose", "'camera/pose' of type geometry_msgs/.*PoseStamped needs the name of its child"),
        ({"/odom": "base"}, "'odom' of type nav_msgs/.*Odometry names its child itself"),
    ],
)
def test_a_topic_that_cannot_be_read_as_odometry_is_named(tmp_path: Path, odometry: Any, words: str) -> None:
    with pytest.raises(RecordingError, match=words):
        load(write_bag(tmp_path), odometry=odometry)


def test_a_topic_of_another_type_is_no_odometry() -> None:
    with pytest.raises(RecordingError, match="'tf' has type tf2_msgs/TFMessage, which is no odometry and no pose"):
        load(SMALL, odometry="/tf")


@pytest.mark.parametrize("kind", ["nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"])
def test_odometry_that_is_cut_off_is_counted(tmp_path: Path, kind: str) -> None:
    lines = [(at, "/odom", bytes([0, 1, 0, 0]) + bytes(size)) for at, size in enumerate((0, 11, 60, 700))]
    problems: Counter[str] = Counter()
    path = write_mcap(tmp_path / "run.mcap", lines, schema=kind)
    tree = load(path, odometry={"/odom": "camera" if "Pose" in kind else None}, problems=problems)
    assert (problems.total(), tree.frames()) == (4, [])
