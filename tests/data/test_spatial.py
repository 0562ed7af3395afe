import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.strategies import transforms, vectors

from tfbus import (
    PoseWithCovarianceStamped,
    Transform,
    TransformStamped,
    TwistStamped,
    Vector3Stamped,
    WrenchStamped,
    do_transform,
)
from tfbus.rows import Vector

HALF_TURN = (1.0, 0.0, 0.0, 0.0)
SIX = st.tuples(vectors(10.0), vectors(10.0))


def answer(target_from_source: Transform) -> TransformStamped:
    return TransformStamped("target", "source", 0, target_from_source)


# Poses with covariance


def turned(covariance: npt.ArrayLike, target_from_source: Transform) -> npt.NDArray[np.float64]:
    data = PoseWithCovarianceStamped("source", 0, Transform(), np.asarray(covariance))
    moved: npt.NDArray[np.float64] = do_transform(data, answer(target_from_source)).covariance
    return moved


def test_the_covariance_of_tf2s_own_test_is_rotated_as_in_tf2() -> None:
    # The numbers of tf2_geometry_msgs' test_tf2_geometry_msgs.py.
    data = PoseWithCovarianceStamped("source", 0, Transform((1.0, 2.0, 3.0), HALF_TURN), np.tile(np.arange(1.0, 7), 6))
    moved = do_transform(data, answer(Transform((1.0, 2.0, 3.0), HALF_TURN)))
    assert moved.pose.translation == pytest.approx((2.0, 0.0, 0.0), abs=1e-15)
    assert np.abs(moved.pose.rotation).tolist() == [0.0, 0.0, 0.0, 1.0]
    first = [1.0, -2.0, -3.0, 4.0, -5.0, -6.0]
    other = [-1.0, 2.0, 3.0, -4.0, 5.0, 6.0]
    assert moved.covariance.tolist() == [first, other, other, first, other, other]


@given(transforms(), SIX)
def test_a_covariance_of_rank_one_is_rotated_like_its_vector(t: Transform, error: tuple[Vector, Vector]) -> None:
    there = [do_transform(Vector3Stamped("source", 0, part), answer(t)).vector for part in error]
    expected = np.outer(np.ravel(there), np.ravel(there))
    np.testing.assert_allclose(turned(np.outer(np.ravel(error), np.ravel(error)), t), expected, atol=1e-11)


def test_a_nan_block_does_not_spread_to_the_others() -> None:
    covariance = np.eye(6)
    covariance[3:, 3:] = math.nan
    moved = turned(covariance, Transform.from_xyz_rpy((0.0, 0.0, 0.0), (0.1, 0.2, 0.3)))
    assert np.isnan(moved[3:, 3:]).all()
    np.testing.assert_allclose(moved[:3, :3], np.eye(3), atol=1e-15)
    np.testing.assert_allclose(moved[:3, 3:], 0.0, atol=1e-15)


@pytest.mark.parametrize("numbers", [range(36), list(range(36)), np.arange(36.0), np.arange(36).reshape(6, 6)])
def test_a_covariance_is_given_as_a_matrix_or_row_by_row(numbers: Any) -> None:
    covariance = PoseWithCovarianceStamped("map", 0, Transform(), numbers).covariance
    assert covariance.dtype == np.float64
    assert covariance.tolist() == [[float(6 * row + column) for column in range(6)] for row in range(6)]


def test_numbers_that_mean_unknown_are_kept() -> None:
    covariance = np.diag([-1.0, math.nan, math.inf, 0.0, 0.0, 0.0])
    kept = PoseWithCovarianceStamped("map", 0, Transform(), covariance).covariance
    np.testing.assert_array_equal(kept, covariance)


@pytest.mark.parametrize("shape", [(35,), (6,), (3, 3), (4, 9), (1, 6, 6), ()])
def test_a_covariance_of_another_shape_is_refused_with_the_shape(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"covariance must have shape \(6, 6\) or \(36,\), got") as caught:
        PoseWithCovarianceStamped("map", 0, Transform(), np.zeros(shape))
    assert str(caught.value).endswith(f"got {shape}")


def test_a_covariance_of_text_and_a_pose_of_numbers_are_refused() -> None:
    with pytest.raises(TypeError, match="covariance must be numbers"):
        PoseWithCovarianceStamped("map", 0, Transform(), np.array(["1"] * 36))
    with pytest.raises(TypeError, match="pose must be a Transform"):
        PoseWithCovarianceStamped("map", 0, (0.0, 0.0, 0.0), np.eye(6))  # type: ignore[arg-type]


# Twists


@pytest.mark.parametrize("radius", [4.0, -7.5])
@pytest.mark.parametrize(("ahead", "aside"), [(2.5, 0.8), (2.5, -0.8), (0.0, 0.8)])
def test_no_wheel_slips_when_a_car_drives_on_a_circle(radius: float, ahead: float, aside: float) -> None:
    speed = 3.0
    rate = speed / radius
    # The centre of the circle is at (0, radius) of the rear axle, and a wheel rolls at right angles to the line to it.
    steering = math.atan2(ahead, radius - aside) if radius > 0 else math.atan2(-ahead, aside - radius)
    axle_from_wheel = Transform.from_xyz_rpy((ahead, aside, 0.3), (0.0, 0.0, steering))
    wheel_from_axle = TransformStamped("wheel", "axle", 5, axle_from_wheel.inverse())
    wheel = do_transform(TwistStamped("axle", 5, (speed, 0.0, 0.0), (0.0, 0.0, rate)), wheel_from_axle)
    rolled = abs(rate) * math.hypot(ahead, radius - aside)
    assert wheel.linear == pytest.approx((rolled, 0.0, 0.0), abs=1e-14)
    assert wheel.angular == pytest.approx((0.0, 0.0, rate), abs=1e-15)


def adjoint(t: Transform) -> npt.NDArray[np.float64]:
    """Ad of a transform, the linear part first."""
    x, y, z = t.translation
    turn = t.matrix()[:3, :3]
    skew = np.array([(0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)])
    return np.block([[turn, skew @ turn], [np.zeros((3, 3)), turn]])


@given(transforms(), SIX)
def test_a_twist_is_transformed_by_the_adjoint_matrix(t: Transform, six: tuple[Vector, Vector]) -> None:
    moved = do_transform(TwistStamped("source", 0, *six), answer(t))
    expected = adjoint(t) @ np.ravel(six)
    np.testing.assert_allclose((*moved.linear, *moved.angular), expected, atol=1e-9)


# Wrenches


def test_the_wrench_of_tf2s_own_test_is_transformed_as_in_tf2() -> None:
    # The numbers of tf2_geometry_msgs' test_tf2_geometry_msgs.cpp.
    t = Transform.from_axis_angle((0.0, 0.0, 1.0), -math.pi / 2, (0.0, -2.0, 0.0))
    moved = do_transform(WrenchStamped("source", 0, (2.0, 1.0, 3.0), (2.0, 1.0, 3.0)), answer(t))
    assert moved.force == pytest.approx((1.0, -2.0, 3.0), abs=1e-15)
    assert moved.torque == pytest.approx((-5.0, -2.0, 5.0), abs=1e-14)


@given(transforms(10.0), SIX, SIX)
def test_power_is_the_same_in_every_frame(
    t: Transform, motion: tuple[Vector, Vector], load: tuple[Vector, Vector]
) -> None:
    def power(twist: TwistStamped, wrench: WrenchStamped) -> float:
        return float(np.dot(twist.linear, wrench.force) + np.dot(twist.angular, wrench.torque))

    twist, wrench = TwistStamped("source", 0, *motion), WrenchStamped("source", 0, *load)
    there = power(do_transform(twist, answer(t)), do_transform(wrench, answer(t)))
    assert there == pytest.approx(power(twist, wrench), abs=1e-9)
