"""Data that carry their frame and their stamp, and how a transform moves them.

``do_transform(data, transform)`` gives new data in the transform's target frame; inputs are never changed. It is a
`functools.singledispatch` function: register your own types with ``@do_transform.register``.
"""

from tfbus.data._header import Stamped
from tfbus.data.clouds import PointCloud
from tfbus.data.dispatch import check_registered, do_transform
from tfbus.data.points import PointStamped, Polygon, PoseStamped, QuaternionStamped, Vector3Stamped
from tfbus.data.scans import LaserScan
from tfbus.data.spatial import PoseWithCovarianceStamped, TwistStamped, WrenchStamped

__all__ = [
    "LaserScan",
    "PointCloud",
    "PointStamped",
    "Polygon",
    "PoseStamped",
    "PoseWithCovarianceStamped",
    "QuaternionStamped",
    "Stamped",
    "TwistStamped",
    "Vector3Stamped",
    "WrenchStamped",
    "check_registered",
    "do_transform",
]
