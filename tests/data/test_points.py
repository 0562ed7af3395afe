""""""

import copy
import math
from dataclasses import dataclass, replace
from typing import Any, assert_type

import numpy as np
import pytest
from hypothesis import given
from support.stamped_data import (
    ANSWER,
    MOVABLE,
    SCAN,
    Header,
    Point,
    PointMessage,
    Time,
    arrays_of,
    contents,
    name_of,
    numbers,
)
from support.strategies import rotations, transforms, vectors

from tfbus import (
    LATEST,
    InvalidTransformError,
    Latest,
    PointCloud,
    PointStamped,
    Polygon,
    PoseStamped,
    QuaternionStamped,
    Transform,
    TransformStamped,
    Vector3Stamped,
    do_transform,
)
from tfbus.rows import Quaternion, Vector


def test_a_point_is_rotated_and_translated() -> None:
    moved = do_transform(PointStamped("B", 7, (1.0, 2.0, 3.0)), ANSWER)
    assert moved.point == pytest.approx((-9.0, 18.0, 27.0), abs=1e-13)


def test_a_vector_is_rotated_but_not_translated() -> None:
    moved = do_transform(Vector3Stamped("B", 7, (1.0, 2.0, 3.0)), ANSWER)
    assert moved.vector == pytest.approx((1.0, -2.0, -3.0), abs=1e-13)


def test_a_polygon_is_transformed_corner_by_corner() -> None:
    moved = do_transform(Polygon("B", 7, np.array([(1, 2, 3), (0, 0, 0)], np.float32)), ANSWER)
    assert moved.points.dtype == np.float32
    np.testing.assert_allclose(moved.points, [(-9.0, 18.0, 27.0), (-10.0, 20.0, 30.0)], rtol=1e-6)


@given(transforms(), vectors(), vectors())
def test_a_vector_is_the_difference_of_two_points(t: Transform, p: Vector, q: Vector) -> None:
    def moved(point: Vector) -> Vector:
        return do_transform(PointStamped("B", 0, point), sample).point

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
def test_an_orientation_is_that_of_the_pose(t: Transform, place: Vector, turn: Quaternion) -> None:
    sample = TransformStamped("A", "B", 0, t)
    pose = do_transform(PoseStamped("B", 0, Transform(place, turn)), sample).pose
    quaternion = do_transform(QuaternionStamped("B", 0, turn), sample).quaternion
    assert quaternion == pytest.approx(pose.rotation, abs=1e-14)


@pytest.mark.parametrize("pose", [None, (1.0, 2.0, 3.0), np.eye(4)])
def test_a_pose_is_a_transform(pose: Any) -> None:
    with pytest.raises(TypeError, match="pose must be a Transform"):
        PoseStamped("map", 0, pose)


def test_a_quaternion_near_unit_norm_is_normalised_and_keeps_its_sign() -> None:
    nearly: Any = np.array([0.0, 0.0, 0.0, -1.005])
    stored = QuaternionStamped("map", 0, nearly).quaternion
    assert stored == (0.0, 0.0, 0.0, -1.0)


@pytest.mark.parametrize("bad", [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.1), (0.0, 0.0, 0.0, math.nan), (0.0, 1.0)])
def test_an_invalid_quaternion_is_refused_with_the_name_of_the_field(bad: Any) -> None:
    with pytest.raises(InvalidTransformError, match=r"^quaternion "):
        QuaternionStamped("map", 0, bad)


@pytest.mark.parametrize(("static", "moves"), [(True, False), (True, True), (False, False)])
def test_a_transform_is_moved_as_the_pose_of_its_child(static: bool, moves: bool) -> None:
    quarter = Transform.from_axis_angle((0, 0, 1), np.pi / 2)
    by = TransformStamped("map", "base", 9, Transform((1.0, 0.0, 0.0)) @ quarter, static=not moves)
    moved = do_transform(TransformStamped("base", "tool", 5, Transform((2.0, 0.0, 0.0)), "arm", static), by)
    assert (moved.parent, moved.child, moved.stamp, moved.authority) == ("map", "tool", 9, "arm")
    assert moved.static is (static and not moves)
    assert moved.transform.is_close(Transform((1.0, 2.0, 0.0)) @ quarter)
    with pytest.raises(ValueError, match="in frame 'base'"):
        do_transform(TransformStamped("base", "tool", 5, Transform()), moved)


@pytest.mark.parametrize("data", MOVABLE, ids=name_of)
def test_moved_data_have_the_frame_and_stamp_of_the_transform_and_the_originals_are_unchanged(data: Any) -> None:
    before = copy.deepcopy(data)
    for stamp in (data.stamp, LATEST):
        moved = do_transform(replace(data, stamp=stamp), ANSWER)
        assert type(moved) is type(data)
        assert (moved.frame, moved.stamp) == ("A", 2_000_000_000)
        assert not any(array.flags.writeable for array in arrays_of(moved))
    assert contents(data) == contents(before)
    with pytest.raises(ValueError, match=r"the data are in frame 'B', but the transform is from 'laser'"):
        do_transform(data, TransformStamped("base", "laser", 0, Transform()))


@given(transforms(10.0), transforms(10.0))
def test_two_transforms_in_turn_equal_their_product(c_from_a: Transform, a_from_b: Transform) -> None:
    first, second = TransformStamped("A", "B", 0, a_from_b), TransformStamped("C", "A", 0, c_from_a)
    both = TransformStamped("C", "B", 0, c_from_a @ a_from_b)
    for data in MOVABLE:
        exact = replace(data, points=data.points.astype(np.float64)) if hasattr(data, "points") else data
        steps, leap = do_transform(do_transform(exact, first), second), do_transform(exact, both)
        assert steps.frame == leap.frame == "C"
        np.testing.assert_allclose(numbers(steps), numbers(leap), rtol=0.0, atol=1e-10)


@pytest.mark.parametrize(("data", "kind"), [((1.0, 2.0, 3.0), "tuple"), (None, "NoneType"), (Transform(), "Transform")])
def test_an_unregistered_type_is_a_type_error_that_says_how_to_register_it(data: Any, kind: str) -> None:
    with pytest.raises(TypeError, match=rf"@do_transform\.register\({kind}\)") as caught:
        do_transform(data, ANSWER)
    assert "to_points" not in str(caught.value)


def test_a_scan_is_refused_with_a_hint_at_to_points() -> None:
    with pytest.raises(TypeError, match=r"cannot transform a LaserScan: transform its to_points\(\) instead"):
        do_transform(SCAN, ANSWER)
    assert do_transform(SCAN.to_points(), ANSWER).frame == "A"


@dataclass(frozen=True)
class Sphere:
    frame: str
    stamp: int | Latest
    centre: Vector
    radius: float


@do_transform.register
def _(data: Sphere, transform: TransformStamped) -> Sphere:
    return Sphere(transform.parent, transform.stamp, transform.transform.apply(data.centre), data.radius)


def test_a_program_can_register_its_own_type() -> None:
    moved = do_transform(Sphere("B", 7, (1.0, 2.0, 3.0), 0.5), ANSWER)
    assert (moved.frame, moved.stamp, moved.radius) == ("A", 2_000_000_000, 0.5)
    assert moved.centre == pytest.approx((-9.0, 18.0, 27.0), abs=1e-13)


@do_transform.register
def _(data: PointMessage, transform: TransformStamped) -> PointMessage:
    p = data.point
    header = Header(Time(*divmod(transform.stamp, 1_000_000_000)), transform.parent)
    return PointMessage(header, Point(*transform.transform.apply((p.x, p.y, p.z))))


def test_type_checkers_see_the_type_that_was_given() -> None:
    assert_type(do_transform(PointStamped("B", 0, (1.0, 2.0, 3.0)), ANSWER), PointStamped)
    assert_type(do_transform(PointCloud("B", 0, np.zeros((1, 3))), ANSWER), PointCloud)
