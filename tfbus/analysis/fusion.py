"""`fuse`, which finds the one transform that fits several answers best."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from tfbus.analysis.consistency import NOTHING, quantile, rotation_vector
from tfbus.geometry.covariance import Covariance, Matrix, lever_arm, skew
from tfbus.geometry.transform import Transform
from tfbus.uncertainty import JointAnswers, UncertainTransform, joint

_MOST_STEPS = 50
_TERMS = 40
"""Of the series of a Jacobian; for a rotation of pi, the last one is below 1e-25."""


@dataclass(frozen=True, slots=True, eq=False)
class Fusion:
    """The transform that fits several answers best.

    Attributes
    ----------
    transform : Transform
    covariance : Covariance
        Of its error, along the axes of the target.
    total : float
        The sum of the squared errors of the answers against it, in units of their covariances. If these are right, it
        has a chi-squared distribution.
    degrees : int
        The degrees of freedom of the total: 6 for each answer but one.
    high : float
        The total is below this with the given confidence, if the answers tell of one thing.

    Examples
    --------
    >>> from tfbus.analysis import fuse
    >>> tree = TransformTree()
    >>> for name, x in (("left", 1.0), ("right", 1.3)):
    ...     error = Covariance.of(xyz=0.1, rpy=0.01)
    ...     _ = tree.insert(UncertainSample("map", name, 0, Transform((x, 0.0, 0.0)), covariance=error))
    >>> fused = fuse([tree.lookup("map", name, covariance=True) for name in ("left", "right")])
    >>> round(fused.transform.translation[0], 3), fused.consistent
    (1.15, True)
    """

    transform: Transform
    covariance: Covariance
    total: float
    degrees: int
    high: float

    @property
    def consistent(self) -> bool:
        """Whether the answers agree as well as their covariances say."""
        return self.total <= self.high


def fuse(answers: Iterable[UncertainTransform], *, confidence: float = 0.95) -> Fusion:
    """The transform that fits several answers best: that of the least squared errors, in units of their covariances.

    The answers tell of one thing that was seen several times: by one sensor at several stamps, or by several sensors,
    for each of which it is a frame of its own. Their target is the same frame. An error that they share, such as that
    of the localisation, is in the fused answer as it is in each.

    It is Gauss and Newton's method on SE(3): T. D. Barfoot and P. T. Furgale, "Associating Uncertainty With
    Three-Dimensional Poses for Use in Estimation Problems" (2014), section IV; here with the joint covariance of all
    answers, where that of the paper has a block for each.

    Parameters
    ----------
    answers : iterable of UncertainTransform
    confidence : float
        The probability that right answers count as consistent.

    Raises
    ------
    ValueError
        If there is no answer, their targets differ, they have no error of their own in some direction, no transform
        between them fits best, or the confidence is not between 0 and 1.
    TypeError
        If one is no answer of a lookup with ``covariance=True``.

    Examples
    --------
    >>> from tfbus.analysis import fuse
    >>> tree = TransformTree()
    >>> for name, x, sigma in (("left", 1.0, 0.1), ("right", 1.5, 0.2)):
    ...     error = Covariance.of(xyz=sigma, rpy=0.01)
    ...     _ = tree.insert(UncertainSample("map", name, 0, Transform((x, 0.0, 0.0)), covariance=error))
    >>> fused = fuse([tree.lookup("map", name, covariance=True) for name in ("left", "right")])
    >>> round(fused.transform.translation[0], 3), round(fused.covariance.sigmas[0].item(), 3)
    (1.1, 0.089)
    """
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence must be between 0 and 1, got {confidence!r}")
    together = joint(answers)
    given = [answer.transform for answer in together.answers]
    weight = _weight_of(together)
    found = given[0]
    for _ in range(_MOST_STEPS):
        errors = [_log(found @ one.inverse()) for one in given]
        jacobian = np.vstack([np.linalg.inv(_left_jacobian(error)) for error in errors])
        normal = jacobian.T @ weight @ jacobian
        step = np.asarray(-np.linalg.solve(normal, jacobian.T @ weight @ np.concatenate(errors)))
        found = _exp(step) @ found
        # In units of its own standard deviation.
        if step @ normal @ step < 1e-20:
            break
    else:
        raise ValueError("the answers lie so far apart that no transform between them fits best")
    left = np.concatenate([_log(found @ one.inverse()) for one in given])
    degrees = 6 * (len(given) - 1)
    high = quantile(confidence, degrees) if degrees else 0.0
    error = Covariance.from_left(np.linalg.inv(normal), found)
    return Fusion(found, error, float(left @ weight @ left), degrees, high)


def _weight_of(together: JointAnswers) -> Matrix:
    """The inverse of the covariance of all left perturbations."""
    answers = together.answers
    targets = sorted({answer.parent for answer in answers})
    if len(targets) != 1:
        seen = " and ".join(map(repr, targets))
        raise ValueError(f"answers to fuse are seen from one frame, not from {seen}" if seen else "no answer to fuse")
    # The inverse of the Jacobian of a left perturbation, for each answer.
    carried = np.zeros_like(together.covariance)
    for n, answer in enumerate(answers):
        part = slice(6 * n, 6 * n + 6)
        carried[part, part] = lever_arm(np.negative(answer.transform.translation))
    covariance = carried @ together.covariance @ carried.T
    unit = np.sqrt(covariance.diagonal())
    unit[unit == 0.0] = 1.0
    scaled = covariance / np.outer(unit, unit)
    if np.linalg.eigvalsh(scaled)[0] < NOTHING:
        raise ValueError(
            "in some direction an answer counts as exact, or two have the same error, so that they cannot be weighed: "
            "give each edge an error in all six directions, and each answer once"
        )
    return np.asarray(np.linalg.inv(scaled) / np.outer(unit, unit))


# The group SE(3), with vectors (shift, rotation): Barfoot and Furgale, equations 1 to 9, and Sola 2018, appendix D


def _exp(vector: Matrix) -> Transform:
    angle = float(np.linalg.norm(vector[3:]))
    # sin(a / 2) / a, also at zero.
    scale = 0.5 * np.sinc(0.5 * angle / np.pi)
    shift = _left_jacobian(np.array([0.0, 0.0, 0.0, *vector[3:]]))[:3, :3] @ vector[:3]
    return Transform(shift, (*(scale * vector[3:]), np.cos(0.5 * angle)))


def _log(transform: Transform) -> Matrix:
    rotation = rotation_vector(transform)
    part = _left_jacobian(np.array([0.0, 0.0, 0.0, *rotation]))[:3, :3]
    return np.concatenate((np.linalg.solve(part, transform.translation), rotation))


def _left_jacobian(vector: Matrix) -> Matrix:
    """The left Jacobian, the sum of ad^n / (n + 1)! over all n."""
    ad = np.zeros((6, 6))
    ad[:3, :3] = ad[3:, 3:] = skew(vector[3:])
    ad[:3, 3:] = skew(vector[:3])
    total = term = np.eye(6)
    for n in range(1, _TERMS):
        term = term @ ad / (n + 1)
        total = total + term
    return total
