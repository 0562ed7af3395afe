"""`Covariance`: units, order, conventions and Jacobians, by closed forms and by pytransform3d."""

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from support.worlds import disturbed, errors_of, is_positive, random_covariance, random_transform

from tfbus import Covariance, Transform
from tfbus.geometry.covariance import Matrix, compose_jacobians, inverse_jacobian

SMALL = 1e-6


def slopes(function: Any, mean: Transform) -> Matrix:
    """The derivative of the error (d, w) of a pose by six numbers, by differences; shape (6, 6)."""
    steps = SMALL * np.vstack((np.eye(6), -np.eye(6)))
    moved = errors_of(function(steps), mean.matrix())
    return np.asarray((moved[:6] - moved[6:]).T / (2.0 * SMALL))


def carried(jacobian: Matrix, matrix: Matrix) -> Matrix:
    return np.asarray(jacobian @ matrix @ jacobian.T)


def exponentials(twists: Matrix) -> Matrix:
    """Exp of (rho, phi), shape (n, 6), by the series; shape (n, 4, 4)."""
    generators = np.zeros((len(twists), 4, 4))
    x, y, z = twists[:, 3:].T
    generators[:, 0, 1], generators[:, 0, 2], generators[:, 1, 2] = -z, y, -x
    generators[:, 1, 0], generators[:, 2, 0], generators[:, 2, 1] = z, -y, x
    generators[:, :3, 3] = twists[:, :3]
    return np.asarray(np.eye(4) + generators + 0.5 * generators @ generators)


@pytest.mark.parametrize("axis", range(6))
def test_each_number_is_a_standard_deviation_in_m_or_rad_along_its_own_axis(axis: int) -> None:
    sigmas = np.zeros(6)
    sigmas[axis] = 0.3
    covariance = Covariance.of(xyz=sigmas[:3].tolist(), rpy=sigmas[3:].tolist())
    assert covariance.matrix[axis, axis] == pytest.approx(0.09)
    assert covariance.matrix.sum() == pytest.approx(0.09)
    assert covariance.sigmas == pytest.approx(sigmas)


@pytest.mark.parametrize("seed", range(5))
def test_the_jacobians_are_the_derivatives_of_composition_and_inverse(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = random_transform(rng), random_transform(rng)
    first, second = compose_jacobians(a, b)
    assert first == pytest.approx(slopes(lambda e: disturbed(a, e) @ b.matrix(), a @ b), abs=1e-6)
    assert second == pytest.approx(slopes(lambda e: a.matrix() @ disturbed(b, e), a @ b), abs=1e-6)
    inverse = slopes(lambda e: np.linalg.inv(disturbed(a, e)), a.inverse())
    assert inverse_jacobian(a) == pytest.approx(inverse, abs=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_left_and_right_perturbations_are_the_exponentials_on_their_side_of_the_pose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, given = random_transform(rng), random_covariance(rng, 0.1, 0.1)
    right = slopes(lambda e: pose.matrix() @ exponentials(e), pose)
    left = slopes(lambda e: exponentials(e) @ pose.matrix(), pose)
    assert Covariance.from_right(given, pose).matrix == pytest.approx(carried(right, given), abs=1e-8)
    assert Covariance.from_left(given, pose).matrix == pytest.approx(carried(left, given), abs=1e-8)
    turned = np.roll(given, (3, 3), (0, 1))
    assert Covariance.from_right(turned, pose, rotation_first=True) == Covariance.from_right(given, pose)
    for name in ("right", "left"):
        for rotation_first in (False, True):
            made = getattr(Covariance, f"from_{name}")(given, pose, rotation_first=rotation_first)
            assert getattr(made, name)(pose, rotation_first=rotation_first) == pytest.approx(given, abs=1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(5))
def test_pytransform3d_composes_and_inverts_to_the_same_covariances(seed: int) -> None:
    other: Any = pytest.importorskip("pytransform3d.uncertainty", reason="pip install pytransform3d")
    rng = np.random.default_rng(seed)
    a, b = random_transform(rng), random_transform(rng)
    # Terms of the fourth order, which its global composition adds, vanish.
    own_a, own_b = random_covariance(rng, 1e-4, 1e-4), random_covariance(rng, 1e-4, 1e-4)
    first, second = compose_jacobians(a, b)
    for name, compose in (
        ("left", lambda x, y: other.concat_globally_uncertain_transforms(b.matrix(), y, a.matrix(), x)),
        ("right", lambda x, y: other.concat_locally_uncertain_transforms(b.matrix(), a.matrix(), y, x)),
    ):
        made = getattr(Covariance, f"from_{name}")
        ab, bc = made(own_a, a, rotation_first=True), made(own_b, b, rotation_first=True)
        ours = Covariance(carried(first, ab.matrix) + carried(second, bc.matrix))
        mean, theirs = compose(own_a, own_b)  # type: ignore[no-untyped-call]
        assert mean == pytest.approx((a @ b).matrix())
        assert getattr(ours, name)(a @ b, rotation_first=True) == pytest.approx(theirs, rel=1e-6, abs=1e-14)
    own = Covariance.from_left(own_a, a, rotation_first=True)
    ours = Covariance(carried(inverse_jacobian(a), own.matrix))
    theirs = other.invert_uncertain_transform(a.matrix(), own_a)[1]
    assert ours.left(a.inverse(), rotation_first=True) == pytest.approx(theirs, rel=1e-6, abs=1e-14)


def test_interpolation_bounds_the_error_whatever_the_correlation_of_the_two_ends() -> None:
    rng = np.random.default_rng(4)
    for _ in range(500):
        joint = rng.normal(size=(12, 12)) @ np.diag(rng.uniform(0.0, 1.0, 12) ** 8)
        joint = joint @ joint.T
        s = rng.uniform()
        blend = np.hstack(((1.0 - s) * np.eye(6), s * np.eye(6)))
        bound = Covariance(joint[:6, :6]).interpolate(Covariance(joint[6:, 6:]), s)
        assert is_positive(bound.matrix - carried(blend, joint) + 1e-12 * np.eye(6))


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(5), "shape"),
        (np.full((6, 6), np.nan), "finite"),
        (np.eye(6) + np.eye(6, k=1), "symmetric"),
        (np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1e-6]), "negative variance"),
        (np.eye(6) + 2.0 * (np.eye(6, k=1) + np.eye(6, k=-1)), "negative variance"),
        (np.diag([1e6, 1.0, 1.0, 1e-12, 1e-12, -1e-13]), "negative variance"),
    ],
)
def test_a_matrix_that_is_no_covariance_is_refused(matrix: Matrix, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Covariance(matrix)


@pytest.mark.parametrize(
    "matrix",
    [
        np.diag([-1.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        -np.eye(6),
        np.zeros((6, 6)),
        np.full((6, 6), np.nan),
        np.diag([0.01, 0.01, 1e6, 1e6, 1e6, 0.03]),
        np.diag([0.01, 0.01, 0.01, 0.01, 0.01, 10.0]),
    ],
)
def test_the_words_of_ros_for_an_unknown_covariance_are_not_taken_for_numbers(matrix: Matrix) -> None:
    assert Covariance.from_ros(matrix.ravel()) is None


def test_a_known_covariance_of_ros_is_taken_as_it_is() -> None:
    matrix = random_covariance(np.random.default_rng(5), 10.0, 0.5)
    assert Covariance.from_ros(matrix.ravel()) == Covariance(matrix)


def test_a_covariance_is_immutable_and_survives_copies() -> None:
    covariance = Covariance.of(xyz=0.1)
    with pytest.raises(AttributeError, match="immutable"):
        covariance.matrix = np.eye(6)
    with pytest.raises(ValueError, match="read-only"):
        covariance.matrix[0, 0] = 2.0
    for twin in (copy.deepcopy(covariance), pickle.loads(pickle.dumps(covariance))):
        assert twin == covariance
        assert hash(twin) == hash(covariance)
    with pytest.raises(ValueError, match="none negative"):
        Covariance.of(rpy=-0.1)
