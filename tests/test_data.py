import copy
import math
import pickle
from dataclasses import FrozenInstanceError, dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from strategies import data_stamps, frame_names, rotations, transforms, vectors

from tfbus import (
    LATEST,
    InvalidTransformError,
    Latest,
    PointStamped,
    PoseStamped,
    Transform,
    TransformStamped,
    Vector3Stamped,
    do_transform,
)
from tfbus.geometry import Quaternion, Vector

# The transform and the numbers of tf2_geometry_msgs' own tests: A is at (10, 20, 30) in B, upside down.
A_FROM_B = Transform((10.0, 20.0, 30.0), (1.0, 0.0, 0.0, 0.0)).inverse()
ANSWER = TransformStamped("A", "B", 2_000_000_000, A_FROM_B)

ONE_OF_EACH: list[Any] = [
    PointStamped("B", 7, (1.0, 2.0, 3.0)),
    Vector3Stamped("B", 7, (1.0, 2.0, 3.0)),
    PoseStamped("B", 7, Transform((1.0, 2.0, 3.0))),
]


def one_of_each(frame: str, stamp: Any) -> list[Any]:
    return [replace(data, frame=frame, stamp=stamp) for data in ONE_OF_EACH]


def test_a_point_is_moved() -> None:
    moved = do_transform(PointStamped("B", 7, (1.0, 2.0, 3.0)), ANSWER)
    assert moved.point == pytest.approx((-9.0, 18.0, 27.0), abs=1e-13)


def test_a_vector_is_turned_but_not_shifted() -> None:
    moved = do_transform(Vector3Stamped("B", 7, (1.0, 2.0, 3.0)), ANSWER)
    assert moved.vector == pytest.approx((1.0, -2.0, -3.0), abs=1e-13)


def test_a_pose_is_moved_and_turned() -> None:
    moved = do_transform(PoseStamped("B", 7, Transform((1.0, 2.0, 3.0))), ANSWER)
    assert moved.pose.is_close(Transform((-9.0, 18.0, 27.0), (1.0, 0.0, 0.0, 0.0)), translation_tolerance=1e-12)


@pytest.mark.parametrize("data", ONE_OF_EACH)
def test_moved_data_have_the_frame_and_the_stamp_of_the_transform(data: Any) -> None:
    before = copy.deepcopy(data)
    moved = do_transform(data, ANSWER)
    assert type(moved) is type(data)
    assert (moved.frame, moved.stamp) == ("A", 2_000_000_000)
    assert data == before


def test_data_of_the_latest_get_the_stamp_that_was_found() -> None:
    assert do_transform(PointStamped("B", LATEST, (0, 0, 0)), ANSWER).stamp == 2_000_000_000


@given(transforms(), vectors(), vectors())
def test_a_vector_is_the_difference_of_two_points(t: Transform, p: Vector, q: Vector) -> None:
    def moved(point: Vector) -> Vector:
        return do_transform(PointStamped("B", 0, point), sample).point  # type: ignore[no-any-return]

    sample = TransformStamped("A", "B", 0, t)
    vector = Vector3Stamped("B", 0, tuple(np.subtract(q, p)))
    turned = do_transform(vector, sample).vector
    assert math.dist(turned, np.subtract(moved(q), moved(p))) <= 1e-9


@given(transforms(), transforms(), vectors())
def test_a_point_seen_from_a_posed_body_moves_with_the_pose(t: Transform, body: Transform, seen: Vector) -> None:
    sample = TransformStamped("A", "B", 0, t)
    pose = do_transform(PoseStamped("B", 0, body), sample).pose
    point = do_transform(PointStamped("B", 0, body.apply(seen)), sample).point
    assert math.dist(pose.apply(seen), point) <= 1e-9


@given(transforms(), vectors(), rotations())
def test_the_inverse_brings_data_back(t: Transform, place: Vector, turn: Quaternion) -> None:
    there, back = TransformStamped("A", "B", 0, t), TransformStamped("B", "A", 0, t.inverse())
    pose = PoseStamped("B", 0, Transform(place, turn))
    returned = do_transform(do_transform(pose, there), back)
    assert returned.frame == "B"
    assert returned.pose.is_close(pose.pose)


def test_a_missing_point_stays_missing() -> None:
    moved = do_transform(PointStamped("B", 0, (math.nan, math.nan, math.nan)), ANSWER)
    assert all(map(math.isnan, moved.point))


@dataclass(frozen=True)
class Sphere:
    frame: str
    stamp: int | Latest
    centre: Vector
    radius: float


@do_transform.register
def _(data: Sphere, transform: TransformStamped) -> Sphere:
    return Sphere(transform.parent, transform.stamp, transform.transform.apply(data.centre), data.radius)


def test_a_program_can_register_a_type_of_its_own() -> None:
    moved = do_transform(Sphere("B", 7, (1.0, 2.0, 3.0), 0.5), ANSWER)
    assert (moved.frame, moved.stamp, moved.radius) == ("A", 2_000_000_000, 0.5)
    assert moved.centre == pytest.approx((-9.0, 18.0, 27.0), abs=1e-13)


@pytest.mark.parametrize(("data", "kind"), [((1.0, 2.0, 3.0), "tuple"), (None, "NoneType"), (Transform(), "Transform")])
def test_a_type_that_nobody_registered_is_a_type_error_that_says_how_to(data: Any, kind: str) -> None:
    with pytest.raises(TypeError, match=rf"@do_transform\.register\({kind}\)"):
        do_transform(data, ANSWER)


@given(frame_names(), data_stamps())
def test_any_frame_and_stamp_are_kept(frame: str, stamp: int | Latest) -> None:
    for data in one_of_each(frame, stamp):
        assert data.frame == frame
        assert data.stamp == stamp


@pytest.mark.parametrize("frame", ["", "/map"])
def test_a_bad_frame_name_is_refused(frame: str) -> None:
    for data in ONE_OF_EACH:
        with pytest.raises(InvalidTransformError, match="frame name"):
            replace(data, frame=frame)


@pytest.mark.parametrize("stamp", [1.5, None, True, "LATEST"])
def test_a_stamp_is_an_int_or_latest(stamp: Any) -> None:
    for data in ONE_OF_EACH:
        with pytest.raises(TypeError, match="int of nanoseconds"):
            replace(data, stamp=stamp)


def test_a_stamp_of_numpy_becomes_a_plain_int() -> None:
    for data in one_of_each("map", np.int64(3)):
        assert type(data.stamp) is int


@pytest.mark.parametrize("kind", [PointStamped, Vector3Stamped])
@pytest.mark.parametrize("numbers", [[1, 2, 3], np.array([1, 2, 3]), np.array([1, 2, 3], np.float32)])
def test_three_numbers_of_any_kind_become_a_tuple_of_floats(kind: Any, numbers: Any) -> None:
    data = kind("map", 0, numbers)
    assert data == kind("map", 0, (1.0, 2.0, 3.0))
    (value,) = {field: getattr(data, field) for field in ("point", "vector") if hasattr(data, field)}.values()
    assert [type(part) for part in value] == [float, float, float]


@pytest.mark.parametrize("kind", [PointStamped, Vector3Stamped])
@pytest.mark.parametrize("numbers", [(), (1.0, 2.0), (1.0, 2.0, 3.0, 1.0), np.zeros((4, 3))])
def test_another_number_of_numbers_is_refused_with_the_shape(kind: Any, numbers: Any) -> None:
    with pytest.raises(ValueError, match=rf"\({len(numbers)},"):
        kind("map", 0, numbers)


@pytest.mark.parametrize("pose", [None, (1.0, 2.0, 3.0), np.eye(4)])
def test_a_pose_is_a_transform(pose: Any) -> None:
    with pytest.raises(TypeError, match="pose must be a Transform"):
        PoseStamped("map", 0, pose)


@pytest.mark.parametrize("data", ONE_OF_EACH)
def test_data_are_immutable_values(data: Any) -> None:
    twin = pickle.loads(pickle.dumps(data))
    assert twin == data
    assert hash(twin) == hash(data)
    assert replace(data, stamp=8) != data
    with pytest.raises(FrozenInstanceError):
        data.frame = "odom"


@pytest.mark.parametrize(
    "data",
    [
        PointStamped("camera", 0, (1.0, 2.0, 3.0)),
        Vector3Stamped("camera", 0, (1.0, 2.0, 3.0)),
        PoseStamped("camera", 0, Transform()),
    ],
)
def test_data_of_another_frame_than_the_transforms_are_refused(
    data: PointStamped | Vector3Stamped | PoseStamped,
) -> None:
    with pytest.raises(ValueError, match=r"the data are in frame 'camera', but the transform is from 'laser'"):
        do_transform(data, TransformStamped("base", "laser", 0, Transform()))


def test_digits_in_a_string_are_no_point() -> None:
    with pytest.raises(TypeError, match="point must be three numbers, not '123'"):
        PointStamped("map", 0, "123")  # type: ignore[arg-type]
