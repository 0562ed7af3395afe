"""Data with a frame and a stamp, such as points, poses, clouds and scans, and their transformation.

``do_transform(data, transform)`` returns new data in the transform's target frame; inputs are never changed. It is a
`functools.singledispatch` function: register your own types with ``@do_transform.register``.
"""

from tfbus.data.clouds import PointCloud
from tfbus.data.dispatch import Stamped, check_registered, do_transform
from tfbus.data.messages import from_message, to_message
from tfbus.data.motion import (
    AccelStamped,
    Imu,
    InertiaStamped,
    Odometry,
    TwistWithCovarianceStamped,
    VelocityStamped,
)
from tfbus.data.paths import Path, PoseArray
from tfbus.data.points import NavSatFix, PointStamped, Polygon, PoseStamped, QuaternionStamped, Vector3Stamped
from tfbus.data.scans import LaserScan
from tfbus.data.spatial import (
    PointWithCovarianceStamped,
    PoseWithCovarianceStamped,
    TwistArray,
    TwistStamped,
    WrenchStamped,
)

__all__ = [
    "AccelStamped",
    "Imu",
    "InertiaStamped",
    "LaserScan",
    "NavSatFix",
    "Odometry",
    "Path",
    "PointCloud",
    "PointStamped",
    "PointWithCovarianceStamped",
    "Polygon",
    "PoseArray",
    "PoseStamped",
    "PoseWithCovarianceStamped",
    "QuaternionStamped",
    "Stamped",
    "TwistArray",
    "TwistStamped",
    "TwistWithCovarianceStamped",
    "Vector3Stamped",
    "VelocityStamped",
    "WrenchStamped",
    "check_registered",
    "do_transform",
    "from_message",
    "to_message",
]
