"""`from_message` and `to_message`, which convert between messages of ROS and stamped data, without ROS.

Only the names of fields count, so a message may be an object of rclpy, rospy, rosbags or cyclonedds, or a mapping from
roslib or JSON.
"""

from array import array
from base64 import b64decode
from collections.abc import Callable, Iterable, Mapping
from copy import copy
from typing import Any

import numpy as np
import numpy.typing as npt

from tfbus.data.clouds import PointCloud
from tfbus.data.points import PointStamped, Polygon, PoseStamped, QuaternionStamped, Vector3Stamped
from tfbus.data.scans import LaserScan
from tfbus.data.spatial import PoseWithCovarianceStamped, TwistStamped, WrenchStamped
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import Transform
from tfbus.rows import Vector
from tfbus.stamps import LATEST, SECOND, Latest, as_array

_MISSING = object()


def has(message: object, name: str) -> bool:
    """Whether a message has a field."""
    return name in message if isinstance(message, Mapping) else hasattr(message, name)


def get(message: object, *names: str) -> Any:
    """The field of a message, or a field inside of a field.

    Raises
    ------
    TypeError
        If there is no such field.
    """
    value: Any = message
    for name in names:
        found = value.get(name, _MISSING) if isinstance(value, Mapping) else getattr(value, name, _MISSING)
        if found is _MISSING:
            raise TypeError(f"a {type(message).__name__} has no field {'.'.join(names)!r}")
        value = found
    return value


def numbers(message: object, names: Iterable[str]) -> tuple[float, ...]:
    """Some fields as floats."""
    return tuple(float(get(message, name)) for name in names)


def filled(like: Any, values: Mapping[str, Any]) -> Any:
    """A copy of a message with other values in some fields; fields that are mappings in `values` are copied likewise.

    A new sequence takes the kind of the old value: an ``array``, an array of numpy, bytes or a list.
    """
    result = copy(like)
    for name, value in values.items():
        old = get(like, name)
        new = filled(old, value) if isinstance(value, Mapping) else _as_kind(value, old)
        if isinstance(result, dict):
            result[name] = new
        else:
            setattr(result, name, new)
    return result


def _as_kind(value: Any, old: Any) -> Any:
    if isinstance(value, (bytes, np.ndarray)):
        if isinstance(old, array):
            return array(old.typecode, value if isinstance(value, bytes) else value.ravel().tolist())
        if isinstance(old, np.ndarray):
            found = np.frombuffer(value, np.uint8) if isinstance(value, bytes) else value.ravel()
            return found.astype(old.dtype)
        if isinstance(value, np.ndarray):
            return value.ravel().tolist()
    return value


_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""The constants of ``sensor_msgs/PointField``."""


def read_cloud(message: object, frame: str, stamp: int) -> PointCloud:
    """The cloud of a message; arrays are views of its data wherever its layout allows that.

    Raises
    ------
    ValueError
        If the layout does not fit the data, or has no x, y and z.
    """
    kind = _dtype(message)
    height, width = int(get(message, "height")), int(get(message, "width"))
    row_step = int(get(message, "row_step"))
    data = _bytes(get(message, "data"))
    if min(height, width) < 0 or row_step < width * kind.itemsize or height * row_step > data.size:
        raise ValueError(
            f"a cloud of {height} rows of {width} points of {kind.itemsize} bytes, {row_step} bytes a row, is not in"
            f" {data.size} bytes"
        )
    rows = np.ndarray((height, width), kind, data.data, 0, (row_step, kind.itemsize)) if data.size else None
    points: npt.NDArray[Any] = np.empty(0, kind) if rows is None else rows.reshape(-1)
    columns = {name: points[name] for name in kind.names or () if name not in ("x", "y", "z")}
    return PointCloud(frame, stamp, _coordinates(points), fields=columns)


def layout_of(cloud: PointCloud, like: object) -> tuple[dict[str, Any], bytes]:
    """The fields of a message for a cloud in the layout of another message, and its data."""
    kind = _dtype(like)
    rows = np.zeros(len(cloud), kind)
    for number, axis in enumerate("xyz"):
        rows[axis] = cloud.points[:, number]
    for name in kind.names or ():
        if name not in ("x", "y", "z"):
            if name not in cloud.fields:
                raise ValueError(f"the cloud has no field {name!r}, which the message to be like has")
            rows[name] = cloud.fields[name]
    big = bool(get(like, "is_bigendian"))
    return _counts(len(cloud), kind.itemsize, big), rows.tobytes()


def new_layout(cloud: PointCloud) -> dict[str, Any]:
    """All fields but the header of a message for a cloud, as a mapping: x, y, z, and then the others."""
    codes = {np.dtype(text): code for code, text in _KINDS.items()}
    named = [*((axis, cloud.points[:, number]) for number, axis in enumerate("xyz")), *cloud.fields.items()]
    columns = []
    for name, values in named:
        code = codes.get(values.dtype.newbyteorder("="))
        if code is None or values.ndim > 2:
            raise ValueError(f"a PointCloud2 cannot hold field {name!r} of dtype {values.dtype}, shape {values.shape}")
        columns.append((name, code, values.reshape(len(cloud), *(values.shape[1:] or (1,)))))
    kind = np.dtype([(name, f"<{_KINDS[code]}", (values.shape[1],)) for name, code, values in columns])
    rows = np.zeros(len(cloud), kind)
    fields = []
    for name, code, values in columns:
        rows[name] = values
        offset = _places(kind)[name][1]
        fields.append({"name": name, "offset": offset, "datatype": code, "count": values.shape[1]})
    counts = _counts(len(cloud), kind.itemsize, big=False)
    return {**counts, "fields": fields, "data": rows.tobytes()}


def _counts(size: int, point_step: int, big: bool) -> dict[str, Any]:
    step = {"point_step": point_step, "row_step": size * point_step}
    return {"height": 1, "width": size, "is_bigendian": big, **step, "is_dense": False}


def _dtype(message: object) -> np.dtype[Any]:
    order = ">" if get(message, "is_bigendian") else "<"
    names, formats, offsets = [], [], []
    for field in get(message, "fields"):
        name, code, count = get(field, "name"), int(get(field, "datatype")), int(get(field, "count"))
        if code not in _KINDS:
            raise ValueError(f"field {name!r} has the datatype {code}, which is none of PointField's")
        names.append(str(name))
        # Old drivers write 0 for one.
        formats.append((f"{order}{_KINDS[code]}", (count,)) if count > 1 else f"{order}{_KINDS[code]}")
        offsets.append(int(get(field, "offset")))
    if not {"x", "y", "z"} <= set(names):
        raise ValueError(f"a cloud needs the fields x, y and z, this one has {', '.join(names) or 'none'}")
    step = int(get(message, "point_step"))
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})


def _bytes(data: Any) -> npt.NDArray[np.uint8]:
    """The data of a message without a copy, if it is in one piece; JSON has it in base64."""
    if isinstance(data, str):
        data = b64decode(data)
    if isinstance(data, (list, tuple)):
        data = bytes(data)
    return np.frombuffer(data, np.uint8)


def _coordinates(points: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """x, y and z of all points, shape (n, 3): a view if they lie side by side."""
    kind = points.dtype
    (x, at_x), (y, at_y), (z, at_z) = (_places(kind)[axis][:2] for axis in "xyz")
    if x.shape or y.shape or z.shape:
        raise ValueError("x, y and z must be one number each")
    if x == y == z and x.kind == "f" and at_y - at_x == at_z - at_y == x.itemsize and len(points):
        return np.ndarray((len(points), 3), x, points.data, at_x, (points.strides[0], x.itemsize))
    return np.stack([points[axis] for axis in "xyz"], axis=-1)


def _places(kind: np.dtype[Any]) -> Mapping[str, Any]:
    """The type and the offset of each field."""
    return {} if kind.fields is None else kind.fields


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
"""The types of data that messages are converted to and from."""


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
    Data of the type with that name, `Polygon` or `PointCloud`. Leading slashes of frames are removed. A stamp of zero
    is the stamp 0, not `LATEST`. The points of a cloud and its other fields are views of the message's data, if x, y
    and z lie side by side and the rows have no gap between them.

    Raises
    ------
    TypeError
        If the message is not one of these; the error names its fields.
    ValueError
        If a value is not valid, or the data of a cloud do not fit its layout.
    InvalidTransformError
        If a frame has no name, or a rotation is invalid.

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
    raise TypeError(f"a {type(message).__name__} is not a message that can be transformed; its fields are {shown}")


def to_message(data: Data, like: Any = dict) -> Any:
    """A message of ROS with some stamped data.

    Parameters
    ----------
    data : stamped data
        Of a type that `from_message` gives.
    like : object, type or mapping
        A message of the wanted type, whose other fields are copied and which is not changed; or the type itself, if it
        can be made without arguments. By default, a ``dict`` with the names of ROS 2. A cloud is written in the layout
        of `like`, which must have the fields x, y and z.

    Returns
    -------
    A message of the type of `like`.

    Raises
    ------
    TypeError
        If the data are of another type, or `like` lacks their fields.
    ValueError
        If the stamp is `LATEST`, which a message cannot express, or a field of a cloud does not fit.
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


# A message with several of these, such as nav_msgs/Odometry, is refused: the caller has to choose a part.
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
