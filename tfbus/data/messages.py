"""`from_message` and `to_message`, which convert between messages of ROS and stamped data, without ROS.

Only the names of fields count, so a message may be an object of rclpy, rospy, rosbags or cyclonedds, or a mapping from
roslib or JSON.
"""

from array import array
from base64 import b64decode
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from typing import Any

import numpy as np
import numpy.typing as npt

from tfbus.data.clouds import PointCloud
from tfbus.data.motion import (
    AccelStamped,
    Imu,
    InertiaStamped,
    Odometry,
    TwistWithCovarianceStamped,
    VelocityStamped,
    pose_as_transform,
)
from tfbus.data.paths import Path, PoseArray
from tfbus.data.points import NavSatFix, PointStamped, Polygon, PoseStamped, QuaternionStamped, Vector3Stamped
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


_ROS1 = {"sec": "secs", "nanosec": "nsecs"}
"""The names in messages of ROS 1 that differ from those of ROS 2."""


def filled(like: Any, values: Mapping[str, Any]) -> Any:
    """A copy of a message with other values in some fields, which have the names of ROS 2.

    Fields that are mappings in `values` are copied likewise. A new sequence takes the kind of the old value: an
    ``array``, an array of numpy, bytes or a list; and its messages the type of the first one in the old value.
    """
    result = copy(like)
    for ros2, value in values.items():
        name = ros2 if has(like, ros2) else _ROS1.get(ros2, ros2)
        old = get(like, name)
        if isinstance(value, Mapping):
            new = filled(old, value)
        elif isinstance(value, list):
            new = _parts(name, value, old, like)
        else:
            new = _as_kind(value, old)
        if isinstance(result, dict):
            result[name] = new
        else:
            setattr(result, name, new)
    return result


def _parts(name: str, values: list[dict[str, Any]], old: Any, like: object) -> list[Any]:
    samples = list(old)
    if not samples and values and not isinstance(like, Mapping):
        raise ValueError(f"the {name} of the message to be like must have one part, which shows the type of all {name}")
    return [filled(samples[0], value) if samples else value for value in values]


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
_IMU = ("orientation", "angular_velocity", "linear_acceleration")
_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_SCAN = ("angle_min", "angle_max", "angle_increment", "time_increment", "scan_time", "range_min", "range_max")

Data = (
    PointStamped
    | Vector3Stamped
    | QuaternionStamped
    | PoseStamped
    | PoseWithCovarianceStamped
    | PoseArray
    | Path
    | Odometry
    | TwistStamped
    | TwistWithCovarianceStamped
    | VelocityStamped
    | AccelStamped
    | WrenchStamped
    | InertiaStamped
    | Imu
    | NavSatFix
    | Polygon
    | PointCloud
    | LaserScan
    | TransformStamped
)
"""The types of data that messages are converted to and from."""


def from_message(message: object) -> Any:
    """Stamped data of a message of ROS: of ``geometry_msgs``, ``nav_msgs``, ``sensor_msgs`` or ``tf2_msgs``.

    Parameters
    ----------
    message : object or mapping
        With the fields of a type of `tfbus.data`, of ``PolygonStamped``, ``PointCloud2`` or ``TFMessage``, in the names
        of ROS 1 or ROS 2. Arrays may be of any kind, and base64 in a ``PointCloud2`` from JSON.

    Returns
    -------
    Data of the type with that name, `Polygon`, `PointCloud`, or a list of `TransformStamped`. Leading slashes of
    frames are removed. A stamp of zero is the stamp 0, not `LATEST`. The points of a cloud and its other fields are
    views of the message's data, if x, y and z lie side by side and the rows have no gap between them.

    Raises
    ------
    TypeError
        If the message is not one of these, whose error names its fields, or is a marker, which has more than a pose.
    ValueError
        If a value is not valid, a pose of a path is in another frame than the path, or the data of a cloud do not fit
        its layout.
    InvalidTransformError
        If a frame has no name, or a rotation is invalid.

    Examples
    --------
    >>> from_message({"header": {"stamp": {"sec": 1, "nanosec": 5}, "frame_id": "map"},
    ...               "point": {"x": 1.0, "y": 2.0, "z": 0.0}})
    PointStamped(frame='map', stamp=1000000005, point=(1.0, 2.0, 0.0))
    """
    if has(message, "transforms"):
        return [from_message(transform) for transform in get(message, "transforms")]
    if has(message, "frame_locked"):
        raise TypeError(
            f"a {type(message).__name__} is not data that can be transformed, for its points and scale belong to its "
            "pose: send it in its own frame, from which RViz transforms it, or transform a PoseStamped of its pose"
        )
    found = [read for names, read in _READERS_OF_SEVERAL.items() if all(has(message, name) for name in names)]
    found = found or [read for name, read in _READERS.items() if has(message, name)]
    if len(found) == 1 and has(message, "header"):
        header = get(message, "header")
        return found[0](message, str(get(header, "frame_id")).lstrip("/"), _stamp(get(header, "stamp")))
    known = message if isinstance(message, Mapping) else [name for name in dir(message) if not name.startswith("_")]
    shown = ", ".join(sorted(map(str, known))[:10])
    raise TypeError(f"a {type(message).__name__} is not a message that can be transformed; its fields are {shown}")


def samples_of(message: object, child: str | None = None, *, invert: bool = False) -> list[TransformStamped]:
    """The transforms of a message, or of stamped data, for `TransformBroadcaster.send_message`, which has the rules."""
    known = (TransformStamped, Odometry, PoseStamped, PoseWithCovarianceStamped)
    data = message if isinstance(message, known) else from_message(message)
    if isinstance(data, PoseStamped | PoseWithCovarianceStamped):
        if child is None:
            raise TypeError(f"a {type(data).__name__} in {data.frame!r} does not say which frame is there: give child=")
        return [pose_as_transform(data, child, invert=invert)]
    samples = [data.as_transform()] if isinstance(data, Odometry) else data if isinstance(data, list) else [data]
    if not all(isinstance(sample, TransformStamped) for sample in samples):
        raise TypeError(f"a {type(data).__name__} does not say where a frame is, so it cannot be sent as a transform")
    if child is not None:
        names = ", ".join(repr(sample.child) for sample in samples)
        raise TypeError(f"child={child!r} was given, but the message names its own: {names}")
    return [~sample for sample in samples] if invert else samples


def to_message(data: Data | Sequence[TransformStamped], like: Any = dict) -> Any:
    """A message of ROS with some stamped data.

    Parameters
    ----------
    data : stamped data, or list of TransformStamped
        Of a type that `from_message` gives. A list becomes a ``TFMessage``.
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
    if isinstance(data, Sequence):
        fields: dict[str, Any] = {"transforms": [to_message(sample) for sample in data]}
    else:
        write = _WRITERS.get(type(data))
        if write is None:
            raise TypeError(f"a {type(data).__name__} has no message")
        if data.stamp is LATEST:
            raise ValueError("a message cannot be stamped LATEST: give the data a stamp")
        frame = data.parent if isinstance(data, TransformStamped) else data.frame
        fields = {"header": _header(frame, data.stamp)}
        if like is dict or not isinstance(data, PointCloud):
            fields |= write(data)
    if like is dict:
        return fields
    target = like() if isinstance(like, type) else like
    if isinstance(data, PointCloud):
        counts, content = layout_of(data, target)
        fields |= {**counts, "data": content}
    return filled(target, fields)


def _stamp(stamp: object) -> int:
    ros1 = has(stamp, "secs")
    seconds, nanoseconds = get(stamp, "secs" if ros1 else "sec"), get(stamp, "nsecs" if ros1 else "nanosec")
    return int(seconds) * SECOND + int(nanoseconds)


def _header(frame: str, stamp: int | Latest) -> dict[str, Any]:
    assert isinstance(stamp, int)
    return {"stamp": {"sec": stamp // SECOND, "nanosec": stamp % SECOND}, "frame_id": frame}


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


def _triple(message: object, *names: str) -> Vector:
    x, y, z = numbers(get(message, *names), "xyz")
    return x, y, z


def _twist(data: Any) -> dict[str, Any]:
    return {"linear": _xyz(data.linear), "angular": _xyz(data.angular)}


def _covariance(message: object, *names: str) -> npt.NDArray[np.float64]:
    return as_array(get(message, *names), names[-1], np.float64)


def _numbers(covariance: npt.NDArray[np.float64] | None, count: int) -> npt.NDArray[np.float64]:
    """The numbers of a covariance row by row; zeros, as messages have for an unknown one, without it."""
    return np.zeros(count) if covariance is None else covariance.ravel()


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
    covariance = _covariance(pose, "covariance")
    return PoseWithCovarianceStamped(frame, stamp, _transform(get(pose, "pose"), "position", "orientation"), covariance)


def _read_twist(message: object, frame: str, stamp: int) -> TwistStamped | TwistWithCovarianceStamped:
    if not has(get(message, "twist"), "covariance"):
        return TwistStamped(frame, stamp, _triple(message, "twist", "linear"), _triple(message, "twist", "angular"))
    linear, angular = (_triple(message, "twist", "twist", part) for part in ("linear", "angular"))
    return TwistWithCovarianceStamped(frame, stamp, linear, angular, _covariance(message, "twist", "covariance"))


def _read_odometry(message: object, frame: str, stamp: int) -> Odometry:
    linear, angular = (_triple(message, "twist", "twist", part) for part in ("linear", "angular"))
    return Odometry(
        frame,
        stamp,
        str(get(message, "child_frame_id")).lstrip("/"),
        _transform(get(message, "pose", "pose"), "position", "orientation"),
        linear,
        angular,
        pose_covariance=_covariance(message, "pose", "covariance"),
        twist_covariance=_covariance(message, "twist", "covariance"),
    )


def _write_odometry(data: Odometry) -> dict[str, Any]:
    return {
        "child_frame_id": data.child,
        "pose": {"pose": _pose(data.pose), "covariance": _numbers(data.pose_covariance, 36)},
        "twist": {"twist": _twist(data), "covariance": _numbers(data.twist_covariance, 36)},
    }


def _read_poses(message: object, frame: str, stamp: int) -> PoseArray | Path:
    poses = list(get(message, "poses"))
    is_path = has(poses[0], "header") if poses else "Path" in type(message).__name__
    bare = [get(pose, "pose") if is_path else pose for pose in poses]
    positions = [numbers(get(pose, "position"), "xyz") for pose in bare]
    orientations = [numbers(get(pose, "orientation"), "xyzw") for pose in bare]
    if not is_path:
        return PoseArray(frame, stamp, positions, orientations)
    for number, pose in enumerate(poses):
        other = str(get(pose, "header", "frame_id")).lstrip("/")
        if other not in ("", frame):
            raise ValueError(f"pose {number} of the path is in frame {other!r}, and the path in {frame!r}")
    stamps = np.array([_stamp(get(pose, "header", "stamp")) for pose in poses], np.int64)
    return Path(frame, stamp, positions, orientations, stamps)


def _write_poses(data: PoseArray | Path) -> dict[str, Any]:
    pairs = zip(data.positions.tolist(), data.orientations.tolist(), strict=True)
    return {"poses": [{"position": _xyz(place), "orientation": _xyz(turn)} for place, turn in pairs]}


def _write_path(data: Path) -> dict[str, Any]:
    poses = _write_poses(data)["poses"]
    stamped = zip(poses, data.stamps.tolist(), strict=True)
    return {"poses": [{"header": _header(data.frame, stamp), "pose": pose} for pose, stamp in stamped]}


def _read_imu(message: object, frame: str, stamp: int) -> Imu:
    # A first element of -1 says that the sensor does not measure this, by the comment of sensor_msgs/Imu.
    covariances = {part: _covariance(message, f"{part}_covariance") for part in _IMU}
    known = {part: covariance.item(0) != -1.0 for part, covariance in covariances.items()}
    orientation = numbers(get(message, "orientation"), "xyzw")
    # Drivers without a compass leave all numbers at zero.
    known["orientation"] &= any(orientation)
    rate, acceleration = (_triple(message, part) for part in _IMU[1:])
    values: tuple[Any, ...] = orientation, rate, acceleration
    return Imu(
        frame,
        stamp,
        *(value if known[part] else None for part, value in zip(_IMU, values, strict=True)),
        **{f"{part}_covariance": spread if known[part] else None for part, spread in covariances.items()},  # type: ignore[arg-type]
    )


def _write_imu(data: Imu) -> dict[str, Any]:
    written: dict[str, Any] = {}
    for part, unset in zip(_IMU, ((0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), strict=True):
        value = getattr(data, part)
        covariance = _numbers(getattr(data, f"{part}_covariance"), 9)
        if value is None:
            covariance = np.array([-1.0] + 8 * [0.0])
        written |= {part: _xyz(unset if value is None else value), f"{part}_covariance": covariance}
    return written


def _read_velocity(message: object, frame: str, stamp: int) -> VelocityStamped:
    body, reference = (str(get(message, name)).lstrip("/") for name in ("body_frame_id", "reference_frame_id"))
    linear, angular = (_triple(message, "velocity", part) for part in ("linear", "angular"))
    return VelocityStamped(frame, stamp, body, reference, linear, angular)


def _read_accel(message: object, frame: str, stamp: int) -> AccelStamped:
    return AccelStamped(frame, stamp, _triple(message, "accel", "linear"), _triple(message, "accel", "angular"))


def _read_inertia(message: object, frame: str, stamp: int) -> InertiaStamped:
    xx, xy, xz, yy, yz, zz = numbers(get(message, "inertia"), _MOMENTS)
    moments = np.array(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
    mass = float(get(message, "inertia", "m"))
    return InertiaStamped(frame, stamp, mass, _triple(message, "inertia", "com"), moments)


def _write_inertia(data: InertiaStamped) -> dict[str, Any]:
    moments = dict(zip(_MOMENTS, data.inertia[np.triu_indices(3)].tolist(), strict=True))
    return {"inertia": {"m": data.mass, "com": _xyz(data.center), **moments}}


def _read_fix(message: object, frame: str, stamp: int) -> NavSatFix:
    return NavSatFix(
        frame,
        stamp,
        *numbers(message, ("latitude", "longitude", "altitude")),
        covariance=_covariance(message, "position_covariance"),
        covariance_type=int(get(message, "position_covariance_type")),
        status=int(get(message, "status", "status")),
        service=int(get(message, "status", "service")),
    )


def _write_fix(data: NavSatFix) -> dict[str, Any]:
    return {
        "status": {"status": data.status, "service": data.service},
        "latitude": data.latitude,
        "longitude": data.longitude,
        "altitude": data.altitude,
        "position_covariance": _numbers(data.covariance, 9),
        "position_covariance_type": data.covariance_type,
    }


def _read_wrench(message: object, frame: str, stamp: int) -> WrenchStamped:
    return WrenchStamped(frame, stamp, _triple(message, "wrench", "force"), _triple(message, "wrench", "torque"))


_Reader = Callable[[object, str, int], Data]

# The readers of messages that have all of some fields, and the readers of messages that have one field. A message with
# several of the latter, such as a pose and a twist without a child, is refused: the caller has to choose a part.
_READERS_OF_SEVERAL: dict[tuple[str, ...], _Reader] = {
    ("child_frame_id", "pose", "twist"): _read_odometry,
    _IMU: _read_imu,
    ("body_frame_id", "reference_frame_id", "velocity"): _read_velocity,
    ("latitude", "longitude", "altitude", "position_covariance"): _read_fix,
}
_READERS: dict[str, _Reader] = {
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
    "poses": _read_poses,
    "accel": _read_accel,
    "inertia": _read_inertia,
}
_WRITERS: dict[type, _Writer] = {
    PointStamped: lambda data: {"point": _xyz(data.point)},
    Vector3Stamped: lambda data: {"vector": _xyz(data.vector)},
    QuaternionStamped: lambda data: {"quaternion": _xyz(data.quaternion)},
    PoseStamped: lambda data: {"pose": _pose(data.pose)},
    PoseWithCovarianceStamped: lambda data: {"pose": {"pose": _pose(data.pose), "covariance": data.covariance.ravel()}},
    PoseArray: _write_poses,
    Path: _write_path,
    Odometry: _write_odometry,
    TwistStamped: lambda data: {"twist": _twist(data)},
    TwistWithCovarianceStamped: lambda data: {"twist": {"twist": _twist(data), "covariance": data.covariance.ravel()}},
    VelocityStamped: lambda data: {
        "body_frame_id": data.body,
        "reference_frame_id": data.reference,
        "velocity": _twist(data),
    },
    AccelStamped: lambda data: {"accel": _twist(data)},
    InertiaStamped: _write_inertia,
    Imu: _write_imu,
    NavSatFix: _write_fix,
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
