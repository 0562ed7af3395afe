"""Messages with the positions of joints, and with odometry, by `rosbags`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from tfbus import TransformStamped

TYPES = get_typestore(Stores.ROS2_HUMBLE)
KIND = "sensor_msgs/msg/JointState"


def joint_state(
    stamp: int, positions: dict[str, float], more_names: Sequence[str] = (), little_endian: bool = True
) -> bytes:
    """The message in CDR, by `rosbags`; `more_names` have no positions."""
    kinds = TYPES.types
    header = kinds["std_msgs/msg/Header"](
        stamp=kinds["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9), frame_id="x"
    )
    none = np.array([])
    message = kinds[KIND](header, [*positions, *more_names], np.array(list(positions.values())), none, none)
    return bytes(TYPES.serialize_cdr(message, KIND, little_endian=little_endian))


ODOMETRY = "nav_msgs/msg/Odometry"


def odometry(sample: TransformStamped, little_endian: bool = True, covariance: Any = (7.0,) * 36) -> bytes:
    """Odometry in CDR, with the pose of a sample; its other numbers are 7."""
    make, stamp = TYPES.types, divmod(sample.stamp, 10**9)
    header = make["std_msgs/msg/Header"](make["builtin_interfaces/msg/Time"](*stamp), sample.parent)
    position = make["geometry_msgs/msg/Point"](*sample.transform.translation)
    turn = make["geometry_msgs/msg/Quaternion"](*sample.transform.rotation)
    pose = make["geometry_msgs/msg/PoseWithCovariance"](
        make["geometry_msgs/msg/Pose"](position, turn), np.array(covariance, float)
    )
    still = make["geometry_msgs/msg/Vector3"](7.0, 7.0, 7.0)
    twist = make["geometry_msgs/msg/TwistWithCovariance"](
        make["geometry_msgs/msg/Twist"](still, still), np.full(36, 7.0)
    )
    message = make[ODOMETRY](header, sample.child, pose, twist)
    return bytes(TYPES.serialize_cdr(message, ODOMETRY, little_endian=little_endian))
