import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from support.stamped_data import ANSWER
from support.strategies import rotations, transforms, vectors

from tfbus import (
    InvalidTransformError,
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


def test_a_pose_is_composed_with_the_transform() -> None:
    moved = do_transform(PoseStamped("B", 7, Transform((1.0, 2.0, 3.0))), ANSWER)
    assert moved.pose.is_close(Transform((-9.0, 18.0, 27.0), (1.0, 0.0, 0.0, 0.0)), translation_tolerance=1e-12)


def test_an_orientation_is_rotated_but_not_translated() -> None:
    half = math.sqrt(0.5)
    answer = TransformStamped("A", "B", 0, Transform((10.0, 20.0, 30.0), (1.0, 0.0, 0.0, 0.0)))
    moved = do_transform(QuaternionStamped("B", 7, (0.0, -half, 0.0, half)), answer)
    assert moved.quaternion == pytest.approx((half, 0.0, -half, 0.0), abs=1e-15)


def test_a_polygon_is_transformed_corner_by_corner() -> None:
    moved = do_transform(Polygon("B", 7, np.array([(1, 2, 3), (0, 0, 0)], np.float32)), ANSWER)
    assert moved.points.dtype == np.float32
    np.testing.assert_allclose(moved.points, [(-9.0, 18.0, 27.0), (-10.0, 20.0, 30.0)], rtol=1e-6)


def test_a_polygon_may_have_no_corners() -> None:
    assert do_transform(Polygon("B", 7, np.empty((0, 3))), ANSWER).points.shape == (0, 3)


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


def test_a_missing_point_stays_missing() -> None:
    moved = do_transform(PointStamped("B", 0, (math.nan, math.nan, math.nan)), ANSWER)
    assert all(map(math.isnan, moved.point))


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
