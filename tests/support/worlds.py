"""Transforms with errors as 4 x 4 matrices, by Rodrigues: a second implementation, for Monte Carlo."""

from typing import Any

import numpy as np
import numpy.typing as npt

from tfbus import Buffer, Covariance, Transform, TransformTree, UncertainSample
from tfbus.geometry.covariance import Matrix


def rotations(vectors: Matrix) -> Matrix:
    """The matrices of rotation vectors of shape (n, 3), by Rodrigues' formula; shape (n, 3, 3)."""
    angle = np.maximum(np.linalg.norm(vectors, axis=1), 1e-30)[:, None, None]
    x, y, z = vectors.T
    zero = np.zeros(len(vectors))
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    half = np.sin(0.5 * angle) / angle
    return np.asarray(np.eye(3) + np.sin(angle) / angle * cross + 2.0 * half * half * cross @ cross)


def rotation_vectors(matrices: Matrix) -> Matrix:
    """The rotation vectors of matrices of shape (n, 3, 3), for turns of less than pi."""
    skew = 0.5 * (matrices - matrices.swapaxes(1, 2))
    axis = np.stack((skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]), axis=1)
    sine = np.maximum(np.linalg.norm(axis, axis=1), 1e-30)
    angle = np.arctan2(sine, 0.5 * (np.trace(matrices, axis1=1, axis2=2) - 1.0))
    return np.asarray(axis * (angle / sine)[:, None])


def disturbed(transform: Transform, errors: Matrix) -> Matrix:
    """``(p + d, Exp(w) R)`` for errors (d, w) of shape (n, 6), as matrices of shape (n, 4, 4)."""
    found = np.tile(transform.matrix(), (len(errors), 1, 1))
    found[:, :3, :3] = rotations(errors[:, 3:]) @ transform.matrix()[:3, :3]
    found[:, :3, 3] += errors[:, :3]
    return found


def errors_of(matrices: Matrix, mean: Matrix) -> Matrix:
    """The errors (d, w) of shape (n, 6) of poses around a mean pose of shape (4, 4)."""
    turns = matrices[:, :3, :3] @ mean[:3, :3].T
    return np.hstack((matrices[:, :3, 3] - mean[:3, 3], rotation_vectors(turns)))


def covariance_around(matrices: Matrix, mean: Matrix) -> Matrix:
    """The covariance of poses around a mean pose, shape (6, 6)."""
    return np.asarray(np.cov(errors_of(matrices, mean).T))


def white(rng: np.random.Generator, n: int, size: int) -> Matrix:
    """Draws of shape (n, size) whose own mean is zero and whose own covariance is the identity, but for rounding."""
    draws = rng.standard_normal((n, size))
    draws -= draws.mean(axis=0)
    return np.asarray(np.linalg.solve(np.linalg.cholesky(np.cov(draws.T).reshape(size, size)), draws.T).T)


def root(matrix: Matrix) -> Matrix:
    """A matrix A with A A^T = `matrix`."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def random_transform(rng: np.random.Generator, size: float = 1.0) -> Transform:
    """A translation of about `size` m, and any rotation."""
    quaternion = rng.normal(size=4)
    return Transform(rng.normal(0.0, size, 3), quaternion / np.linalg.norm(quaternion))


def random_covariance(rng: np.random.Generator, xyz: float, rpy: float) -> Matrix:
    """A covariance with correlations, whose largest standard deviations are about `xyz` m and `rpy` rad."""
    shape = rng.normal(size=(6, 6))
    matrix = shape @ shape.T
    unit = np.sqrt(matrix.diagonal())
    scale = np.repeat((xyz, rpy), 3) * rng.uniform(0.1, 1.0, 6) / unit
    return np.asarray(matrix * np.outer(scale, scale))


def is_positive(matrix: npt.NDArray[Any]) -> bool:
    """Whether a covariance has no negative variance in any direction, each number in its own unit."""
    unit = np.sqrt(np.maximum(matrix.diagonal(), 0.0))
    unit[unit == 0.0] = 1.0
    return bool(np.linalg.eigvalsh(matrix / np.outer(unit, unit))[0] > -1e-9)


def unsure(
    parent: str, child: str, stamp: int, sigma: float = 0.1, x: float = 0.0, static: bool = False
) -> UncertainSample:
    error = Covariance.of(xyz=sigma)
    return UncertainSample(parent, child, stamp, Transform((x, 0.0, 0.0)), static=static, covariance=error)


def sigma_of(tree: TransformTree | Buffer, target: str, source: str, at: int) -> float | None:
    """The standard deviation of x; None if the only edge counts as exact."""
    ask = tree.lookup_nowait if isinstance(tree, Buffer) else tree.lookup
    found = ask(target, source, at, covariance=True)
    return None if found.exact else float(found.covariance.sigmas[0])
