"""Odometry, inertial measurements, velocities, accelerations, inertia, and many poses, in other frames."""

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.strategies import transforms

from tfbus import (
    AccelStamped,
    Imu,
    InertiaStamped,
    Odometry,
    Path,
    PoseArray,
    PoseWithCovarianceStamped,
    Transform,
    TransformStamped,
    TwistStamped,
    TwistWithCovarianceStamped,
    VelocityStamped,
    do_transform,
)

SEEDS = st.integers(0, 2**32 - 1)
LINEAR, ANGULAR = (0.5, -0.25, 1.0), (0.1, 0.2, -0.3)


def answer(t: Transform) -> TransformStamped:
    return TransformStamped("target", "source", 7, t)


def turn(t: Transform) -> npt.NDArray[np.float64]:
    return t.matrix()[:3, :3]


def covariance(seed: int, size: int) -> npt.NDArray[np.float64]:
    half = np.random.default_rng(seed).normal(size=(size, size))
    return half @ half.T


@given(transforms(10.0), transforms(10.0), SEEDS)
def test_odometry_moves_its_pose_and_keeps_its_velocity(t: Transform, pose: Transform, seed: int) -> None:
    spread, rates = covariance(seed, 6), covariance(seed + 1, 6)
    odometry = Odometry("source", 5, "base", pose, LINEAR, ANGULAR, pose_covariance=spread, twist_covariance=rates)
    moved = do_transform(odometry, answer(t))
    beside = do_transform(PoseWithCovarianceStamped("source", 5, pose, spread), answer(t))
    assert (moved.frame, moved.stamp, moved.child, moved.pose) == ("target", 7, "base", beside.pose)
    np.testing.assert_array_equal(moved.pose_covariance, beside.covariance)
    assert (moved.linear, moved.angular) == (LINEAR, ANGULAR)
    np.testing.assert_array_equal(moved.twist_covariance, rates)


def test_odometry_is_a_sample_of_its_child_or_of_its_frame() -> None:
    pose = Transform.from_xyz_rpy((1.0, 2.0, 0.0), (0.0, 0.0, math.pi / 2))
    odometry = Odometry("odom", 5, "base", pose, LINEAR, ANGULAR)
    assert odometry.as_transform() == TransformStamped("odom", "base", 5, pose)
    upside_down = odometry.as_transform(invert=True)
    assert (upside_down.parent, upside_down.child) == ("base", "odom")
    assert upside_down.transform.apply((1.0, 2.0, 0.0)) == pytest.approx((0.0, 0.0, 0.0))


@given(transforms(3.0), SEEDS)
def test_the_covariance_of_a_twist_is_that_of_moved_draws(t: Transform, seed: int) -> None:
    spread = covariance(seed, 6)
    moved = do_transform(TwistWithCovarianceStamped("source", 0, LINEAR, ANGULAR, spread), answer(t))
    plain = do_transform(TwistStamped("source", 0, LINEAR, ANGULAR), answer(t))
    assert (moved.linear, moved.angular) == (plain.linear, plain.angular)
    # A twist is transformed linearly, so the columns of a root of the covariance are transformed as twists are.
    root = np.linalg.cholesky(spread + 1e-9 * np.eye(6)).T
    each = [do_transform(TwistStamped("source", 0, row[:3], row[3:]), answer(t)) for row in root]
    rows = np.array([(*twist.linear, *twist.angular) for twist in each])
    np.testing.assert_allclose(moved.covariance, rows.T @ rows, atol=1e-6)


@pytest.mark.parametrize("known", [1e-4, 1e6])
def test_a_covariance_with_a_negative_variance_is_unknown_and_stays(known: float) -> None:
    unknown = np.diag([-1.0, known, known, known, known, known])
    t = answer(Transform.from_xyz_rpy((1.0, 2.0, 3.0), (0.1, 0.2, 0.3)))
    pose = PoseWithCovarianceStamped("source", 0, Transform(), unknown)
    twist = TwistWithCovarianceStamped("source", 0, LINEAR, ANGULAR, unknown)
    odometry = Odometry("source", 0, "base", Transform(), LINEAR, ANGULAR, pose_covariance=unknown)
    moved = [do_transform(pose, t).covariance, do_transform(twist, t).covariance]
    for found in (*moved, do_transform(odometry, t).pose_covariance):
        np.testing.assert_array_equal(found, unknown)


@given(transforms(10.0), transforms(10.0), SEEDS)
def test_an_inertial_sensor_in_another_frame(t: Transform, attitude: Transform, seed: int) -> None:
    spreads: dict[str, Any] = {
        "orientation_covariance": covariance(seed, 3),
        "angular_velocity_covariance": covariance(seed + 1, 3),
        "linear_acceleration_covariance": covariance(seed + 2, 3),
    }
    moved = do_transform(Imu("source", 0, attitude.rotation, ANGULAR, LINEAR, **spreads), answer(t))
    assert moved.orientation is not None
    # A direction of the sensor has the same direction in the world by either frame.
    there = Transform(rotation=moved.orientation).apply(turn(t) @ LINEAR)
    assert there == pytest.approx(turn(attitude) @ LINEAR)
    assert moved.angular_velocity == pytest.approx(turn(t) @ ANGULAR)
    assert moved.linear_acceleration == pytest.approx(turn(t) @ LINEAR)
    np.testing.assert_array_equal(moved.orientation_covariance, spreads["orientation_covariance"])
    for name in ("angular_velocity_covariance", "linear_acceleration_covariance"):
        np.testing.assert_allclose(getattr(moved, name), turn(t) @ spreads[name] @ turn(t).T, atol=1e-9)


@given(transforms(10.0))
def test_accelerations_and_velocities_of_other_frames_are_turned(t: Transform) -> None:
    accel = do_transform(AccelStamped("source", 0, LINEAR, ANGULAR), answer(t))
    velocity = do_transform(VelocityStamped("source", 0, "base", "odom", LINEAR, ANGULAR), answer(t))
    assert (velocity.frame, velocity.body, velocity.reference) == ("target", "base", "odom")
    for moved in (accel, velocity):
        assert moved.linear == pytest.approx(turn(t) @ LINEAR)
        assert moved.angular == pytest.approx(turn(t) @ ANGULAR)


@given(transforms(3.0), SEEDS)
def test_a_moved_body_has_the_inertia_of_its_moved_points(t: Transform, seed: int) -> None:
    random = np.random.default_rng(seed)
    points, masses = random.normal(size=(8, 3)), random.uniform(0.1, 1.0, 8)

    def body(points: npt.NDArray[Any], frame: str) -> InertiaStamped:
        center = masses @ points / masses.sum()
        arms = points - center
        moments = sum(m * (a @ a * np.eye(3) - np.outer(a, a)) for m, a in zip(masses, arms, strict=True))
        return InertiaStamped(frame, 0, float(masses.sum()), center, moments)

    moved, expected = do_transform(body(points, "source"), answer(t)), body(t.apply(points), "target")
    assert moved.mass == expected.mass
    assert moved.center == pytest.approx(expected.center, abs=1e-9)
    np.testing.assert_allclose(moved.inertia, expected.inertia, atol=1e-9)


def test_poses_and_paths_are_moved_one_by_one() -> None:
    t = Transform.from_xyz_rpy((1.0, 2.0, 3.0), (0.1, 0.2, 0.3))
    poses = [Transform((float(n), 0.0, 0.0), (0.0, 0.0, math.sin(n), math.cos(n))) for n in range(4)]
    rows = [pose.translation for pose in poses], [pose.rotation for pose in poses]
    particles = do_transform(PoseArray("source", 5, *rows), answer(t))
    path = do_transform(Path("source", 5, *rows, [10, 20, 30, 40]), answer(t))
    for moved in (particles, path):
        assert (moved.frame, moved.stamp, len(moved)) == ("target", 7, 4)
        assert all(found.is_close(t @ pose) for found, pose in zip(moved.poses, poses, strict=True))
    assert path.stamps.tolist() == [10, 20, 30, 40]
    with pytest.raises(ValueError, match="3 stamps for 4 transforms"):
        Path("source", 5, *rows, [1, 2, 3])
    with pytest.raises(ValueError, match="read-only"):
        particles.positions[0, 0] = 5.0


def test_a_velocity_that_is_missing_is_refused_and_a_measurement_that_is_missing_stays() -> None:
    with pytest.raises(TypeError, match="linear must be three numbers, not None"):
        Odometry("odom", 0, "base", Transform(), None, ANGULAR)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="center must be three numbers, not None"):
        InertiaStamped("base", 0, 1.0, None, np.eye(3))  # type: ignore[arg-type]
    imu = Imu("imu", 0, None, None, LINEAR)
    assert (imu.angular_velocity, imu.linear_acceleration) == (None, LINEAR)
