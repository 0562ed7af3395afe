"""`from_message` and `to_message`, between the messages of ROS and stamped data, without ROS.

Only the names of fields count, so a message may be an object of rclpy, rospy, rosbags or cyclonedds, or a mapping from
roslib or JSON.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from tfbus.data._message_fields import filled, get, has, numbers
from tfbus.data._point_cloud2 import layout_of, new_layout, read_cloud
from tfbus.data.clouds import PointCloud
from tfbus.data.points import PointStamped, Polygon, PoseStamped, QuaternionStamped, Vector3Stamped
from tfbus.data.scans import LaserScan
from tfbus.data.spatial import PoseWithCovarianceStamped, TwistStamped, WrenchStamped
from tfbus.geometry.rows import Vector
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import Transform
from tfbus.stamps import LATEST, SECOND, Latest, as_array

_Writer = Callable[[Any], dict[str, Any]]
_SCAN = ("angle_min", "angle_max", "angle_increment", "time_increment", "scan_time", "range_min", "range_max")

Data = (
    PointStamped
    | Vector3Stamped
    | QuaternionStamped
    | PoseStamped
    | PoseWithCovarianceStamped
    | TwistStamped
    | WrenchStamped
    | Polygon
    | PointCloud
    | LaserScan
    | TransformStamped
)
"""The types that a message can become, and that can become one."""


def from_message(message: object) -> Any:
    """Stamped data of a message of ROS: of ``geometry_msgs``, or a scan or a cloud of ``sensor_msgs``.

    Parameters
    ----------
    message : object or mapping
        With the fields of `PointStamped`, `Vector3Stamped`, `QuaternionStamped`, `PoseStamped`,
        `PoseWithCovarianceStamped`, `TwistStamped`, `WrenchStamped`, ``PolygonStamped``, `TransformStamped`,
        `LaserScan` or ``PointCloud2``, in the names of ROS 1 or ROS 2. Arrays may be of any kind, and base64 in a
        ``PointCloud2`` from JSON.

    Returns
    -------
    Data of the type with that name, `Polygon` or `PointCloud`. Leading slashes of frames are gone. A stamp of zero is
    the stamp 0, not `LATEST`. The points of a cloud and its other fields are views of the message's data, wherever
    x, y and z lie side by side and rows have no gap between them.

    Raises
    ------
    TypeError
        If the message is none of these; the error names its fields.
    ValueError
        If a value is not valid, or the data of a cloud do not fit its layout.
    InvalidTransformError
        If a frame has no name, or a rotation is none.

    Examples
    --------
    >>> from_message({"header": {"stamp": {"sec": 1, "nanosec": 5}, "frame_id": "map"},
    ...               "point": {"x": 1.0, "y": 2.0, "z": 0.0}})
    PointStamped(frame='map', stamp=1000000005, point=(1.0, 2.0, 0.0))
    """
    found = [read for field, read in _READERS.items() if has(message, field)]
    if len(found) == 1 and has(message, "header"):
        header = get(message, "header")
        return found[0](message, str(get(header, "frame_id")).lstrip("/"), _stamp(get(header, "stamp")))
    known = message if isinstance(message, Mapping) else [name for name in dir(message) if not name.startswith("_")]
    shown = ", ".join(sorted(map(str, known))[:10])
    raise TypeError(f"a {type(message).__name__} is no message that can be transformed; its fields are {shown}")


def to_message(data: Data, like: Any = dict) -> Any:
    """A message of ROS with some stamped data.

    Parameters
    ----------
    data : stamped data
        Of a type that `from_message` gives.
    like : object, type or mapping
        A message of the type to make, whose other fields are copied, or that type, if it can be made without
        arguments; by default, a ``dict`` with the names of ROS 2. It is not changed. A cloud is written in the layout
        of `like`, which must have the fields x, y and z.

    Returns
    -------
    A message of the type of `like`.

    Raises
    ------
    TypeError
        If the data are of another type, or `like` has not their fields.
    ValueError
        If the stamp is `LATEST`, which a message cannot tell, or a field of a cloud does not fit.
    """
    write = _WRITERS.get(type(data))
    if write is None:
        raise TypeError(f"a {type(data).__name__} has no message")
    if data.stamp is LATEST:
        raise ValueError("a message cannot be stamped LATEST: give the data a stamp")
    frame = data.parent if isinstance(data, TransformStamped) else data.frame
    if like is dict:
        return {"header": _header(frame, data.stamp, "sec", "nanosec"), **write(data)}
    target = like() if isinstance(like, type) else like
    ros1 = has(get(target, "header", "stamp"), "secs")
    header = _header(frame, data.stamp, *(("secs", "nsecs") if ros1 else ("sec", "nanosec")))
    if isinstance(data, PointCloud):
        counts, content = layout_of(data, target)
        return filled(target, {"header": header, **counts, "data": content})
    if isinstance(data, Polygon):
        return filled(target, {"header": header, "polygon": {"points": _corners(data, target)}})
    return filled(target, {"header": header, **write(data)})


def _stamp(stamp: object) -> int:
    ros1 = has(stamp, "secs")
    seconds, nanoseconds = get(stamp, "secs" if ros1 else "sec"), get(stamp, "nsecs" if ros1 else "nanosec")
    return int(seconds) * SECOND + int(nanoseconds)


def _header(frame: str, stamp: int | Latest, seconds: str, nanoseconds: str) -> dict[str, Any]:
    assert isinstance(stamp, int)
    return {"stamp": {seconds: stamp // SECOND, nanoseconds: stamp % SECOND}, "frame_id": frame}


def _transform(message: object, translation: str, rotation: str) -> Transform:
    return Transform(numbers(get(message, translation), "xyz"), numbers(get(message, rotation), "xyzw"))


def _xyz(values: Any) -> dict[str, float]:
    return dict(zip("xyzw", map(float, values), strict=False))


def _pose(pose: Transform) -> dict[str, Any]:
    return {"position": _xyz(pose.translation), "orientation": _xyz(pose.rotation)}


def _read_scan(message: object, frame: str, stamp: int) -> LaserScan:
    values = dict(zip(_SCAN, numbers(message, _SCAN), strict=True))
    ranges, intensities = (as_array(get(message, name), name) for name in ("ranges", "intensities"))
    return LaserScan(frame, stamp, ranges, intensities=intensities, **values)


def _write_scan(scan: LaserScan) -> dict[str, Any]:
    values = {name: getattr(scan, name) for name in _SCAN}
    none = np.empty(0, scan.ranges.dtype)
    return {**values, "ranges": scan.ranges, "intensities": none if scan.intensities is None else scan.intensities}


def _read_polygon(message: object, frame: str, stamp: int) -> Polygon:
    corners = [numbers(point, "xyz") for point in get(message, "polygon", "points")]
    return Polygon(frame, stamp, np.array(corners, np.float64).reshape(-1, 3))


def _corners(polygon: Polygon, like: object) -> list[Any]:
    """The corners as points of the type that `like` has."""
    points = list(get(like, "polygon", "points"))
    if not points and len(polygon.points) and not isinstance(like, Mapping):
        raise ValueError("the message to be like must have a point, which shows the type of all points")
    return [filled(points[0], _xyz(corner)) if points else _xyz(corner) for corner in polygon.points]


def _triple(message: object, *names: str) -> Vector:
    x, y, z = numbers(get(message, *names), "xyz")
    return x, y, z


def _read_point(message: object, frame: str, stamp: int) -> PointStamped:
    return PointStamped(frame, stamp, _triple(message, "point"))


def _read_vector(message: object, frame: str, stamp: int) -> Vector3Stamped:
    return Vector3Stamped(frame, stamp, _triple(message, "vector"))


def _read_quaternion(message: object, frame: str, stamp: int) -> QuaternionStamped:
    x, y, z, w = numbers(get(message, "quaternion"), "xyzw")
    return QuaternionStamped(frame, stamp, (x, y, z, w))


def _read_transform(message: object, frame: str, stamp: int) -> TransformStamped:
    transform = _transform(get(message, "transform"), "translation", "rotation")
    return TransformStamped(frame, str(get(message, "child_frame_id")).lstrip("/"), stamp, transform)


def _read_pose(message: object, frame: str, stamp: int) -> PoseStamped | PoseWithCovarianceStamped:
    pose = get(message, "pose")
    if not has(pose, "covariance"):
        return PoseStamped(frame, stamp, _transform(pose, "position", "orientation"))
    covariance = as_array(get(pose, "covariance"), "covariance", np.float64)
    return PoseWithCovarianceStamped(frame, stamp, _transform(get(pose, "pose"), "position", "orientation"), covariance)


def _read_twist(message: object, frame: str, stamp: int) -> TwistStamped:
    return TwistStamped(frame, stamp, _triple(message, "twist", "linear"), _triple(message, "twist", "angular"))


def _read_wrench(message: object, frame: str, stamp: int) -> WrenchStamped:
    return WrenchStamped(frame, stamp, _triple(message, "wrench", "force"), _triple(message, "wrench", "torque"))


# A message of several, as nav_msgs/Odometry, is none of them: it is for the caller to say which part is meant.
_READERS: dict[str, Callable[[object, str, int], Data]] = {
    "point_step": read_cloud,
    "ranges": _read_scan,
    "transform": _read_transform,
    "point": _read_point,
    "vector": _read_vector,
    "quaternion": _read_quaternion,
    "pose": _read_pose,
    "twist": _read_twist,
    "wrench": _read_wrench,
    "polygon": _read_polygon,
}
_WRITERS: dict[type, _Writer] = {
    PointStamped: lambda data: {"point": _xyz(data.point)},
    Vector3Stamped: lambda data: {"vector": _xyz(data.vector)},
    QuaternionStamped: lambda data: {"quaternion": _xyz(data.quaternion)},
    PoseStamped: lambda data: {"pose": _pose(data.pose)},
    PoseWithCovarianceStamped: lambda data: {"pose": {"pose": _pose(data.pose), "covariance": data.covariance.ravel()}},
    TwistStamped: lambda data: {"twist": {"linear": _xyz(data.linear), "angular": _xyz(data.angular)}},
    WrenchStamped: lambda data: {"wrench": {"force": _xyz(data.force), "torque": _xyz(data.torque)}},
    TransformStamped: lambda data: {
        "child_frame_id": data.child,
        "transform": {
            "translation": _xyz(data.transform.translation),
            "rotation": _xyz(data.transform.rotation),
        },
    },
    Polygon: lambda data: {"polygon": {"points": list(map(_xyz, data.points))}},
    LaserScan: _write_scan,
    PointCloud: new_layout,
}
