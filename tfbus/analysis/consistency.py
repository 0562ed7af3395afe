"""`nees`, which tests whether errors are as large as their covariances say."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tfbus.geometry.covariance import Matrix
from tfbus.geometry.transform import Transform
from tfbus.uncertainty import UncertainTransform

NOTHING = 1e-12
"""A variance, as a part of the greatest one, that counts as none."""


@dataclass(frozen=True, slots=True, eq=False)
class Consistency:
    """The normalised estimation errors squared of some answers.

    Attributes
    ----------
    values : float64 array of shape (n,)
        e^T S^-1 e of each answer. Infinite for an error in a direction in which an answer counts as exact.
    degrees : int array of shape (n,)
        The degrees of freedom of each: 6, or fewer if a covariance has no variance in some direction.
    total : float
        The sum of the values. For true covariances and independent errors it has a chi-squared distribution.
    low, high : float
        The interval that holds the total with the given confidence.

    Examples
    --------
    >>> from tfbus.analysis import nees
    >>> nees([], []).consistent
    True
    """

    values: npt.NDArray[np.float64]
    degrees: npt.NDArray[np.int64]
    total: float
    low: float
    high: float

    @property
    def consistent(self) -> bool:
        """Whether the total is in its interval."""
        return self.low <= self.total <= self.high

    @property
    def ratio(self) -> float:
        """The total over its expected value: above 1 the answers are too sure, below 1 they are not sure enough.

        Its root is the factor between the true standard deviations and those of the answers.
        """
        degrees = int(self.degrees.sum())
        return self.total / degrees if degrees else 1.0

    def __str__(self) -> str:
        verdict = "consistent" if self.consistent else "too sure" if self.total > self.high else "not sure enough"
        return f"{verdict}: {self.total:.4g}, between {self.low:.4g} and {self.high:.4g} expected"


def nees(answers: Iterable[UncertainTransform], truth: Iterable[Transform], *, confidence: float = 0.95) -> Consistency:
    """Test the covariances of answers with the truth, by their normalised estimation errors squared.

    The test is that of Y. Bar-Shalom, X. R. Li and T. Kirubarajan, "Estimation with Applications to Tracking and
    Navigation" (2001), section 5.4.2. The errors of the answers must be independent of each other: ask at stamps that
    share no drift, or in different runs.

    Parameters
    ----------
    answers : iterable of UncertainTransform
    truth : iterable of Transform
        The true transform of each answer; a `TransformArray` is one.
    confidence : float
        The probability that consistent answers pass.

    Raises
    ------
    ValueError
        If there is not one truth for each answer, or the confidence is not between 0 and 1.

    Examples
    --------
    >>> from tfbus.analysis import nees
    >>> tree = TransformTree()
    >>> _ = tree.insert(UncertainSample("map", "base", 0, Transform(), covariance=Covariance.of(xyz=0.1, rpy=0.01)))
    >>> print(nees([tree.lookup("map", "base", covariance=True)], [Transform((0.5, 0.0, 0.0))]))
    too sure: 25, between 1.237 and 14.45 expected
    """
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence must be between 0 and 1, got {confidence!r}")
    pairs = list(zip(answers, truth, strict=True))
    found = [_of_one(answer, true) for answer, true in pairs]
    values = np.array([value for value, _ in found])
    degrees = np.array([degree for _, degree in found], np.int64)
    count, tail = int(degrees.sum()), 0.5 * (1.0 - confidence)
    low, high = (quantile(probability, count) if count else 0.0 for probability in (tail, 1.0 - tail))
    return Consistency(values, degrees, float(values.sum()), low, high)


def _of_one(answer: UncertainTransform, true: Transform) -> tuple[float, int]:
    error = _error(answer.transform, true)
    matrix = answer.covariance.matrix
    # Each number in its own unit.
    unit = np.sqrt(np.maximum(matrix.diagonal(), 0.0))
    unit[unit == 0.0] = 1.0
    values, vectors = np.linalg.eigh(matrix / np.outer(unit, unit))
    along = vectors.T @ (error / unit)
    known = values > NOTHING
    if (np.abs(along[~known]) > 1e-9).any():
        return math.inf, int(known.sum())
    return float((along[known] ** 2 / values[known]).sum()), int(known.sum())


def _error(found: Transform, true: Transform) -> Matrix:
    """The error (d, w) along the axes of the target: the true pose is (p + d, Exp(w) R)."""
    turn = Transform(rotation=true.rotation) @ Transform(rotation=found.rotation).inverse()
    return np.concatenate((np.subtract(true.translation, found.translation), rotation_vector(turn)))


def rotation_vector(transform: Transform) -> Matrix:
    """The axis of a rotation times its angle from 0 to pi, in rad; shape (3,)."""
    axis, angle = transform.as_axis_angle()
    return angle * np.array(axis)


def quantile(probability: float, degrees: int) -> float:
    """The value that a chi-squared variable is below with a probability, by bisection."""
    low, high = 0.0, degrees + 20.0 * math.sqrt(2.0 * degrees) + 20.0
    for _ in range(100):
        middle = 0.5 * (low + high)
        if _cumulative(middle, degrees) < probability:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def _cumulative(value: float, degrees: int) -> float:
    """The regularised lower incomplete gamma function by its series: Abramowitz and Stegun, 6.5.29."""
    shape, x = 0.5 * degrees, 0.5 * value
    if x <= 0.0:
        return 0.0
    term = total = math.exp(shape * math.log(x) - x - math.lgamma(shape + 1.0))
    place = shape
    while place < x or term > 1e-16 * total:
        place += 1.0
        term *= x / place
        total += term
        if term == 0.0:
            break
    return min(total, 1.0)
