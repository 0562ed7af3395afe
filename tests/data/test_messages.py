""""""

import json
import math
from array import array
from base64 import b64encode
from copy import deepcopy
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.stamped_data import Header, Point, PointMessage, Time

from tfbus import (
    LATEST,
    AccelStamped,
    Imu,
    InertiaStamped,
    InvalidTransformError,
    LaserScan,
    NavSatFix,
    Odometry,
    Path,
    PointCloud,
    PointStamped,
    Polygon,
    PoseArray,
    PoseStamped,
    PoseWithCovarianceStamped,
    QuaternionStamped,
    Transform,
    TransformStamped,
    TwistStamped,
    TwistWithCovarianceStamped,
    Vector3Stamped,
    VelocityStamped,
    WrenchStamped,
    do_transform,
)
from tfbus.data import from_message, to_message

STAMP = 5_000_000_007
V, W = {"x": 1.0, "y": 2.0, "z": 3.0}, {"x": 4.0, "y": 5.0, "z": 6.0}
Q = {"x": 0.5, "y": -0.5, "z": 0.5, "w": -0.5}
POSE = {"position": V, "orientation": Q}
TRANSFORM = Transform((1.0, 2.0, 3.0), (0.5, -0.5, 0.5, -0.5))

SIMPLE: list[tuple[dict[str, Any], Any]] = [
    ({"point": V}, PointStamped("map", STAMP, (1.0, 2.0, 3.0))),
    ({"vector": V}, Vector3Stamped("map", STAMP, (1.0, 2.0, 3.0))),
    ({"quaternion": Q}, QuaternionStamped("map", STAMP, (0.5, -0.5, 0.5, -0.5))),
    ({"pose": POSE}, PoseStamped("map", STAMP, TRANSFORM)),
    ({"twist": {"linear": V, "angular": W}}, TwistStamped("map", STAMP, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0))),
    ({"wrench": {"force": V, "torque": W}}, WrenchStamped("map", STAMP, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0))),
    (
        {"child_frame_id": "base", "transform": {"translation": V, "rotation": Q}},
        TransformStamped("map", "base", STAMP, TRANSFORM),
    ),
    ({"accel": {"linear": V, "angular": W}}, AccelStamped("map", STAMP, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0))),
    (
        {"body_frame_id": "base", "reference_frame_id": "odom", "velocity": {"linear": V, "angular": W}},
        VelocityStamped("map", STAMP, "base", "odom", (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)),
    ),
]
SIX, THREE = [float(number) for number in range(36)], [float(number) for number in range(9)]
SINCE = {"sec": 4, "nanosec": 9}
# Messages with arrays, and some of the plain data that are made of them.
WITH_ARRAYS: list[tuple[dict[str, Any], type, dict[str, Any]]] = [
    (
        {
            "child_frame_id": "base",
            "pose": {"pose": POSE, "covariance": SIX},
            "twist": {"twist": {"linear": V, "angular": W}, "covariance": SIX[::-1]},
        },
        Odometry,
        {"child": "base", "pose": TRANSFORM, "linear": (1.0, 2.0, 3.0), "angular": (4.0, 5.0, 6.0)},
    ),
    (
        {"twist": {"twist": {"linear": V, "angular": W}, "covariance": SIX}},
        TwistWithCovarianceStamped,
        {"linear": (1.0, 2.0, 3.0), "angular": (4.0, 5.0, 6.0)},
    ),
    (
        {
            "orientation": Q,
            "orientation_covariance": THREE,
            "angular_velocity": V,
            "angular_velocity_covariance": THREE[::-1],
            "linear_acceleration": W,
            "linear_acceleration_covariance": THREE,
        },
        Imu,
        {"orientation": (0.5, -0.5, 0.5, -0.5), "angular_velocity": (1.0, 2.0, 3.0), "frame": "map"},
    ),
    (
        {"inertia": {"m": 2.0, "com": V, "ixx": 1.0, "ixy": 2.0, "ixz": 3.0, "iyy": 4.0, "iyz": 5.0, "izz": 6.0}},
        InertiaStamped,
        {"mass": 2.0, "center": (1.0, 2.0, 3.0)},
    ),
    (
        {
            "status": {"status": 1, "service": 3},
            "latitude": 48.0,
            "longitude": 11.0,
            "altitude": 500.0,
            "position_covariance": THREE,
            "position_covariance_type": 2,
        },
        NavSatFix,
        {"latitude": 48.0, "longitude": 11.0, "altitude": 500.0, "status": 1, "service": 3, "covariance_type": 2},
    ),
    ({"poses": [POSE, POSE]}, PoseArray, {}),
    ({"poses": [{"header": {"stamp": SINCE, "frame_id": "map"}, "pose": POSE}]}, Path, {}),
]


def header(frame: str = "map", ros1: bool = False) -> dict[str, Any]:
    stamp = {"secs": 5, "nsecs": 7} if ros1 else {"sec": 5, "nanosec": 7}
    return {"stamp": stamp, "frame_id": frame, **({"seq": 3} if ros1 else {})}


def as_object(value: Any) -> Any:
    """The same fields as attributes."""
    if isinstance(value, dict):
        return SimpleNamespace(**{name: as_object(part) for name, part in value.items()})
    return [as_object(part) for part in value] if isinstance(value, list) else value


@pytest.mark.parametrize(("fields", "data"), SIMPLE, ids=[type(data).__name__ for _, data in SIMPLE])
@pytest.mark.parametrize("ros1", [False, True])
def test_messages_become_data_and_data_messages(fields: dict[str, Any], data: Any, ros1: bool) -> None:
    message = {"header": header(ros1=ros1), **fields}
    assert from_message(message) == from_message(as_object(message)) == data
    if not ros1:
        assert to_message(data) == message
    blank = deepcopy(message)
    blank["header"]["stamp"] = dict.fromkeys(blank["header"]["stamp"], 0)
    blank["header"]["frame_id"] = ""
    before = deepcopy(blank)
    assert to_message(data, like=blank) == message
    assert to_message(data, like=as_object(blank)) == as_object(message)
    assert blank == before


@pytest.mark.parametrize(("fields", "kind", "values"), WITH_ARRAYS, ids=[kind.__name__ for _, kind, _ in WITH_ARRAYS])
@pytest.mark.parametrize("ros1", [False, True])
def test_messages_with_arrays_become_data_and_data_messages(
    fields: dict[str, Any], kind: Any, values: dict[str, Any], ros1: bool
) -> None:
    message = {"header": header(ros1=ros1), **deepcopy(fields)}
    if ros1 and kind is Path:
        message["poses"][0]["header"] = {"stamp": {"secs": 4, "nsecs": 9}, "frame_id": "map"}
    data = from_message(as_object(message))
    assert type(data) is kind
    assert (data.frame, data.stamp) == ("map", STAMP)
    assert {name: getattr(data, name) for name in values} == values
    assert to_message(data, like=message) == message
    assert to_message(data, like=as_object(message)) == as_object(message)
    again = kind.from_dict(json.loads(json.dumps(data.to_dict())))
    assert to_message(again, like=message) == message
    if not ros1:
        assert to_message(from_message(to_message(data)), like=message) == message


def test_an_inertial_sensor_says_what_it_does_not_measure() -> None:
    unknown = [-1.0] + 8 * [0.0]
    message = {"header": header(), **deepcopy(WITH_ARRAYS[2][0])}
    message["orientation"], message["angular_velocity_covariance"] = dict.fromkeys("xyzw", 0.0), unknown
    imu = from_message(message)
    assert (imu.orientation, imu.angular_velocity, imu.angular_velocity_covariance) == (None, None, None)
    assert imu.linear_acceleration == (4.0, 5.0, 6.0)
    moved = to_message(do_transform(imu, TransformStamped("base", "map", STAMP, TRANSFORM)), like=message)
    assert moved["orientation_covariance"] == moved["angular_velocity_covariance"] == unknown
    assert from_message(moved).orientation is None


def test_a_path_is_in_one_frame_and_may_be_empty() -> None:
    message: dict[str, Any] = {"header": header(), "poses": [{"header": header("odom"), "pose": POSE}]}
    with pytest.raises(ValueError, match="pose 0 of the path is in frame 'odom', and the path in 'map'"):
        from_message(message)
    message["poses"][0]["header"]["frame_id"] = ""
    assert from_message(message).poses[0] == TRANSFORM
    empty = from_message({"header": header(), "poses": []})
    assert (type(empty), len(empty)) == (PoseArray, 0)


def test_the_transforms_of_a_tf_message_become_samples_and_a_tf_message_again() -> None:
    fields = {"child_frame_id": "base", "transform": {"translation": V, "rotation": Q}}
    message = {"transforms": [{"header": header(), **fields}, {"header": header("odom"), **fields}]}
    samples = from_message(as_object(message))
    assert samples == [TransformStamped(parent, "base", STAMP, TRANSFORM) for parent in ("map", "odom")]
    assert to_message(samples) == message
    assert to_message(samples, like=as_object(message)) == as_object(message)


def test_a_marker_is_refused_by_name_and_not_taken_for_its_pose() -> None:
    marker = {"header": header(), "ns": "", "id": 1, "pose": POSE, "points": [V], "scale": V, "frame_locked": False}
    with pytest.raises(TypeError, match="a dict is not data that can be transformed, for its points and scale"):
        from_message(marker)


def test_leading_slashes_are_gone_and_a_stamp_of_zero_stays() -> None:
    message = {"header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "//map"}, "point": V}
    assert from_message(message) == PointStamped("map", 0, (1.0, 2.0, 3.0))
    fields = {"header": header("/a"), "child_frame_id": "/b", "transform": {"translation": V, "rotation": Q}}
    assert (from_message(fields).parent, from_message(fields).child) == ("a", "b")
    with pytest.raises(InvalidTransformError):
        from_message({"header": header(""), "point": V})


def test_a_covariance_is_read_row_by_row_and_written_back() -> None:
    rows = [float(number) for number in range(36)]
    message = {"header": header(), "pose": {"pose": POSE, "covariance": rows}}
    data = from_message(message)
    assert isinstance(data, PoseWithCovarianceStamped)
    assert data.pose == TRANSFORM
    assert data.covariance.tolist() == np.arange(36.0).reshape(6, 6).tolist()
    assert to_message(data, like={**message, "pose": {"pose": POSE, "covariance": [0.0] * 36}}) == message
    typed = to_message(data, like={**message, "pose": {"pose": POSE, "covariance": np.zeros(36)}})
    assert isinstance(typed["pose"]["covariance"], np.ndarray)


def test_a_polygon_has_the_corners_of_its_message() -> None:
    message = {"header": header(), "polygon": {"points": [V, W]}}
    data = from_message(as_object(message))
    assert isinstance(data, Polygon)
    assert data.points.tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    assert to_message(data) == message
    one = {**message, "polygon": {"points": [{"x": 0.0, "y": 0.0, "z": 0.0}]}}
    assert to_message(data, like=as_object(one)) == as_object(message)
    none = as_object({**message, "polygon": {"points": []}})
    with pytest.raises(ValueError, match="the type of all points"):
        to_message(data, like=none)
    assert from_message(none).points.shape == (0, 3)


def scan_fields(ranges: Any, intensities: Any) -> dict[str, Any]:
    return {
        "header": header("laser"),
        "angle_min": -1.0,
        "angle_max": 1.0,
        "angle_increment": 1.0,
        "time_increment": 0.5,
        "scan_time": 2.0,
        "range_min": 0.25,
        "range_max": 8.0,
        "ranges": ranges,
        "intensities": intensities,
    }


def test_a_scan_has_its_points_at_their_angles_and_its_message_the_kind_of_arrays_of_the_other() -> None:
    scan = from_message(as_object(scan_fields(array("f", [1.0, 2.0, 4.0]), array("f"))))
    assert isinstance(scan, LaserScan)
    assert (scan.frame, scan.stamp, scan.ranges.dtype, scan.intensities) == ("laser", STAMP, np.dtype(np.float32), None)
    cosine, sine = math.cos(1.0), math.sin(1.0)
    expected = [[cosine, -sine, 0.0], [2.0, 0.0, 0.0], [4 * cosine, 4 * sine, 0.0]]
    assert np.allclose(scan.to_points().points, expected, atol=1e-6)
    back = to_message(scan, like=as_object(scan_fields(array("f"), array("f"))))
    assert back.ranges == array("f", [1.0, 2.0, 4.0])
    assert to_message(scan, like=scan_fields([], []))["ranges"] == [1.0, 2.0, 4.0]
    bare = LaserScan("laser", STAMP, np.ones(3), angle_min=-1.0, angle_increment=0.5)
    assert to_message(bare)["angle_max"] == 0.0


def cloud_fields(rows: Any, **changes: Any) -> dict[str, Any]:
    """x, y, z as float32, four bytes of nothing, an intensity and a ring."""
    fields = [
        {"name": "x", "offset": 0, "datatype": 7, "count": 1},
        {"name": "y", "offset": 4, "datatype": 7, "count": 1},
        {"name": "z", "offset": 8, "datatype": 7, "count": 1},
        {"name": "intensity", "offset": 16, "datatype": 8, "count": 1},
        {"name": "ring", "offset": 24, "datatype": 4, "count": 0},
        {"name": "pair", "offset": 26, "datatype": 2, "count": 2},
    ]
    shape = {"height": 1, "width": rows, "point_step": 32, "row_step": 32 * rows}
    blank = {"header": header("lidar"), **shape, "fields": fields, "is_bigendian": False, "is_dense": True}
    return {**blank, "data": b"", **changes}


KIND = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "pair"],
        "formats": ["<f4", "<f4", "<f4", "<f8", "<u2", ("<u1", (2,))],
        "offsets": [0, 4, 8, 16, 24, 26],
        "itemsize": 32,
    }
)


def cloud_rows(size: int) -> np.ndarray[Any, Any]:
    rows = np.zeros(size, KIND)
    for number, axis in enumerate("xyz"):
        rows[axis] = np.arange(size) + number / 4
    rows["intensity"], rows["ring"] = np.arange(size) / 8, np.arange(size)
    rows["pair"] = np.arange(2 * size).reshape(size, 2)
    return rows


def test_a_cloud_is_a_view_of_its_message_and_is_written_back_in_its_layout() -> None:
    rows = cloud_rows(5)
    data = bytearray(rows.tobytes())
    message = cloud_fields(5, data=data)
    cloud = from_message(as_object(message))
    assert isinstance(cloud, PointCloud)
    assert (cloud.frame, cloud.stamp, cloud.points.dtype) == ("lidar", STAMP, np.dtype(np.float32))
    assert cloud.points.tolist() == [[n, n + 0.25, n + 0.5] for n in range(5)]
    assert cloud.fields["intensity"].tolist() == [n / 8 for n in range(5)]
    assert cloud.fields["ring"].tolist() == list(range(5))
    assert cloud.fields["pair"].tolist() == [[2 * n, 2 * n + 1] for n in range(5)]
    assert set(cloud.fields) == {"intensity", "ring", "pair"}
    for values in (cloud.points, *cloud.fields.values()):
        assert np.shares_memory(values, np.frombuffer(data, np.uint8))
    moved = do_transform(cloud, TransformStamped("map", "lidar", STAMP, Transform((1.0, 0.0, 0.0))))
    back = to_message(moved, like=message)
    rows["x"] += 1
    assert back["data"] == rows.tobytes()
    assert (back["header"]["frame_id"], back["width"], back["row_step"]) == ("map", 5, 160)


@pytest.mark.parametrize("kind", ["list", "array", "base64", "numpy"])
def test_the_data_of_a_cloud_may_be_of_any_kind(kind: str) -> None:
    raw = cloud_rows(3).tobytes()
    data: Any = {
        "list": list(raw),
        "array": array("B", raw),
        "base64": b64encode(raw).decode(),
        "numpy": np.frombuffer(raw, np.uint8),
    }[kind]
    cloud = from_message(cloud_fields(3, data=data))
    assert cloud.points.tolist() == [[n, n + 0.25, n + 0.5] for n in range(3)]
    back = to_message(cloud, like=cloud_fields(3, data=data))
    assert bytes(back["data"]) == raw


def test_rows_with_gaps_other_orders_and_scattered_coordinates_are_read() -> None:
    rows = cloud_rows(6)
    gaps = b"".join(rows[first : first + 3].tobytes() + b"gap!" for first in (0, 3))
    two = from_message(cloud_fields(3, height=2, row_step=100, data=gaps))
    assert two.points.tolist() == [[n, n + 0.25, n + 0.5] for n in range(6)]
    big = from_message(cloud_fields(6, is_bigendian=True, data=rows.astype(KIND.newbyteorder(">")).tobytes()))
    assert big.points.tolist() == two.points.tolist()
    swapped = cloud_fields(6, data=rows.tobytes())
    swapped["fields"][0], swapped["fields"][2] = (
        {**swapped["fields"][0], "offset": 8},
        {**swapped["fields"][2], "offset": 0},
    )
    assert from_message(swapped).points.tolist() == [[n + 0.5, n + 0.25, n] for n in range(6)]
    assert len(from_message(cloud_fields(0))) == 0


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"data": bytes(95)}, "is not in 95 bytes"),
        ({"row_step": 10}, "10 bytes a row"),
        ({"width": -1}, "-1 points"),
        ({"point_step": 8}, "itemsize"),
        ({"fields": [{"name": "x", "offset": 0, "datatype": 7, "count": 1}]}, "x, y and z, this one has x"),
        ({"fields": [{"name": "x", "offset": 0, "datatype": 9, "count": 1}]}, "datatype 9"),
        ({"fields": [{"name": axis, "offset": 0, "datatype": 7, "count": 3} for axis in "xyz"]}, "one number each"),
    ],
)
def test_a_cloud_whose_layout_does_not_fit_is_refused(changes: dict[str, Any], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        from_message(cloud_fields(3, **{"data": bytes(96), **changes}))


def test_a_cloud_without_a_message_to_be_like_has_its_fields_side_by_side() -> None:
    cloud = PointCloud("lidar", STAMP, np.ones((2, 3), np.float32), fields={"t": np.array([7, 8], np.uint32)})
    message = to_message(cloud)
    assert [(each["name"], each["offset"], each["datatype"]) for each in message["fields"]] == [
        ("x", 0, 7),
        ("y", 4, 7),
        ("z", 8, 7),
        ("t", 12, 6),
    ]
    assert (message["point_step"], message["row_step"], message["width"], message["height"]) == (16, 32, 2, 1)
    again = from_message(message)
    assert again.points.tolist() == cloud.points.tolist()
    assert again.fields["t"].tolist() == [7, 8]
    assert len(from_message(to_message(PointCloud("a", 1, np.empty((0, 3)))))) == 0
    with pytest.raises(ValueError, match="'t' of dtype int64"):
        to_message(PointCloud("a", 1, np.ones((1, 3)), fields={"t": np.array([1])}))
    with pytest.raises(ValueError, match=r"field 'grid' of dtype uint8, shape \(2, 1, 1\)"):
        to_message(PointCloud("a", 5, np.zeros((2, 3)), fields={"grid": np.zeros((2, 1, 1), np.uint8)}))
    with pytest.raises(ValueError, match="no field 'intensity'"):
        to_message(cloud, like=cloud_fields(1))


def test_a_type_of_messages_is_as_good_as_a_message() -> None:
    made = to_message(PointStamped("map", STAMP, (1.0, 2.0, 3.0)), like=PointMessage)
    assert made == PointMessage(Header(Time(5, 7), "map"), Point(1.0, 2.0, 3.0))
    assert PointMessage() == PointMessage(Header(Time(0, 0), ""), Point())


@pytest.mark.parametrize(
    "message",
    [
        None,
        5,
        {"point": V},
        {"header": header()},
        {"header": header(), "pose": POSE, "twist": {"linear": V, "angular": W}},
        {"header": {"frame_id": "map"}, "point": V},
        {"header": header(), "point": {"x": 1.0}},
    ],
)
def test_what_is_no_message_is_a_type_error(message: Any) -> None:
    with pytest.raises(TypeError, match=r"is not a message|has no field"):
        from_message(message)


def test_the_error_of_what_is_no_message_names_its_fields() -> None:
    fields = dict.fromkeys("lkjihgfedcba", 0)
    for message, kind in ((fields, "dict"), (as_object(fields), "SimpleNamespace")):
        with pytest.raises(TypeError) as caught:
            from_message(message)
        assert str(caught.value) == (
            f"a {kind} is not a message that can be transformed; its fields are a, b, c, d, e, f, g, h, i, j"
        )


def test_data_that_have_no_message_are_refused() -> None:
    with pytest.raises(TypeError, match="int has no message"):
        to_message(5)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="LATEST"):
        to_message(PointStamped("map", LATEST, (1.0, 2.0, 3.0)))
    with pytest.raises(TypeError, match="'point'"):
        to_message(PointStamped("map", 5, (1.0, 2.0, 3.0)), like={"header": header()})


@pytest.mark.thorough
def test_messages_of_rosbags_as_they_come_from_a_bag_become_data_and_messages_again() -> None:
    rosbags = pytest.importorskip("rosbags.typesys", reason='pip install "tfbus[bag]"')
    store = rosbags.get_typestore(rosbags.Stores.ROS2_JAZZY)
    types = store.types
    head = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](5, 7), "laser")
    point = types["geometry_msgs/msg/PointStamped"](head, types["geometry_msgs/msg/Point"](1.0, 2.0, 3.0))
    ranges, nothing = np.array([1.0, 2.0, math.nan], np.float32), np.zeros(0, np.float32)
    scan = types["sensor_msgs/msg/LaserScan"](head, 0.0, 1.0, 0.5, 0.0, 0.1, 0.5, 10.0, ranges, nothing)
    field = types["sensor_msgs/msg/PointField"]
    fields = [field(name, 4 * number, 7, 1) for number, name in enumerate(("x", "y", "z", "intensity"))]
    content = np.arange(8, dtype="<f4").view(np.uint8)
    cloud = types["sensor_msgs/msg/PointCloud2"](head, 1, 2, fields, False, 16, 32, content, False)
    came = [
        store.deserialize_cdr(store.serialize_cdr(message, message.__msgtype__), message.__msgtype__)
        for message in (point, scan, cloud)
    ]
    found = [from_message(message) for message in came]
    assert found[0] == PointStamped("laser", STAMP, (1.0, 2.0, 3.0))
    assert [len(found[1].to_points().points), found[1].stamp] == [2, STAMP]
    assert found[2].points.tolist() == [[0, 1, 2], [4, 5, 6]]
    assert found[2].fields["intensity"].tolist() == [3, 7]
    assert np.shares_memory(found[2].points, came[2].data), "the cloud was copied"
    for message, data in zip(came, found, strict=True):
        again = to_message(data, like=message)
        kind = message.__msgtype__
        assert bytes(store.serialize_cdr(again, kind)) == bytes(store.serialize_cdr(message, kind))


@pytest.mark.thorough
def test_messages_of_cyclone_dds_become_data_and_messages_again() -> None:
    pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')
    from tfbus.links.dds import types

    make: Any = types
    place, turn = make.Vector3(1.5, 0.0, 0.0), make.Quaternion(0.0, 0.0, 0.0, 1.0)
    made = make.TransformStamped(make.Header(make.Time(5, 7), "map"), "base", make.Transform(place, turn))
    # As it comes over the network.
    came = type(made).deserialize(made.serialize())
    found = from_message(came)
    assert found == TransformStamped("map", "base", STAMP, Transform((1.5, 0.0, 0.0)))
    assert to_message(found, like=came) == came


@pytest.mark.parametrize("big", [False, True])
def test_a_field_of_every_datatype_is_written_and_read_in_either_byte_order(big: bool) -> None:
    # The constants of sensor_msgs/PointField: INT8 is 1, and so on up to FLOAT64.
    kinds = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
    fields = {kind: np.array([100, 7], kind) for kind in kinds}
    fields["pair"] = np.arange(4, dtype=">u2").reshape(2, 2)
    cloud = PointCloud("a", 5, np.arange(6.0).reshape(2, 3), fields=fields)
    message = to_message(cloud, like={**to_message(cloud), "is_bigendian": big})
    assert (message["is_bigendian"], message["is_dense"]) == (big, False)
    described = [(field["datatype"], field["count"]) for field in message["fields"]]
    assert described == [(8, 1)] * 3 + [(datatype, 1) for datatype in range(1, 9)] + [(4, 2)]
    again = from_message(message)
    assert (again.points.dtype.kind, again.points.tolist()) == ("f", cloud.points.tolist())
    for name, values in fields.items():
        found = again.fields[name]
        assert (found.dtype.newbyteorder("="), found.tolist()) == (values.dtype.newbyteorder("="), values.tolist())


@pytest.mark.parametrize(("first", "places", "is_view"), [(4, "xyz", True), (0, "xyz", True), (4, "zyx", False)])
def test_coordinates_side_by_side_anywhere_in_a_point_are_a_view(first: int, places: str, is_view: bool) -> None:
    message = to_message(PointCloud("a", 5, np.array([(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)], np.float32)))
    for field in message["fields"]:
        field["offset"] = first + 4 * places.index(field["name"])
    rows = np.zeros((2, 5), np.float32)
    for number, axis in enumerate("xyz"):
        rows[:, first // 4 + places.index(axis)] = (number + 1, number + 4)
    data = rows.tobytes()
    message.update(point_step=20, row_step=40, data=data)
    points = from_message(message).points
    assert points.tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    assert np.shares_memory(points, np.frombuffer(data, np.uint8)) == is_view
