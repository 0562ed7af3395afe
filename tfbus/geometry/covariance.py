"""`Covariance`, the size of a pose's error, and the first-order arithmetic of errors.

An error of the pose T = (p, R) of a child in its parent is six numbers, the order of ROS (geometry_msgs's
PoseWithCovariance): a shift d of the child's origin in m, and a small rotation vector w in rad, both along the axes of
the *parent*. The true pose is (p + d, Exp(w) R). Two other conventions are common; both describe the same errors:

* *right*, in the child: T Exp(r). manif (Sola 2018, "A micro Lie theory", eq. 25) puts the shift first, GTSAM
  (Pose3) the rotation. With ``r = (rho, phi)``: d = R rho, w = R phi.
* *left*, about the parent's origin: Exp(l) T. Barfoot and Furgale 2014, "Associating Uncertainty With Three-Dimensional
  Poses", eq. 12, put the shift first, pytransform3d the rotation. With ``l = (rho, phi)``: d = rho + phi x p, w = phi.

The lever arm is the whole of the arithmetic: an error (d, w) at one point of a rigid body is (d + w x l, w) at the
point that is l further, and an inverse looks at the parent from the child, with the opposite sign.
"""

from collections.abc import Sequence
from typing import Any, Literal, Self, get_args

import numpy as np
import numpy.typing as npt

from tfbus.geometry.transform import Transform
from tfbus.geometry.transform_array import locked
from tfbus.stamps import as_array

Matrix = npt.NDArray[np.float64]

Kind = Literal["independent", "drift", "constant"]
"""The relation of an edge's errors at two stamps; see `UncertainSample`."""
KINDS: tuple[Kind, ...] = get_args(Kind)

ABSURD = np.repeat((1e6, 10.0), 3)
"""In m^2 and rad^2: ROS drivers write such variances, or -1, where they do not know the error."""
_ROUNDING = 1e-9
"""The negative eigenvalue, as a part of the greatest one, that counts as zero."""


class Covariance:
    """The covariance of a pose's error. Immutable.

    Parameters
    ----------
    matrix : array of shape (6, 6), or 36 numbers row by row
        Of (x, y, z, rotation about x, y, z) in m and rad, along the axes of the parent. Copied.

    Raises
    ------
    ValueError
        If the shape is another, a number is not finite, or the matrix is not symmetric and positive semidefinite.
    TypeError
        If they are not numbers.

    Examples
    --------
    >>> Covariance.of(xyz=0.01, rpy=(0.0, 0.0, 0.002)).sigmas.tolist()
    [0.01, 0.01, 0.01, 0.0, 0.0, 0.002]
    """

    __slots__ = ("matrix",)
    matrix: Matrix
    """Shape (6, 6), read-only."""

    def __init__(self, matrix: npt.ArrayLike) -> None:
        given: Matrix = as_array(matrix, "covariance", np.float64)
        if given.shape not in ((6, 6), (36,)):
            raise ValueError(f"a covariance must have shape (6, 6) or (36,), got {given.shape}")
        given = given.reshape(6, 6)
        if not np.isfinite(given).all():
            raise ValueError("a covariance must be finite: leave an unknown one out")
        scale = float(np.abs(given).max())
        if np.abs(given - given.T).max() > 1e-6 * scale:
            raise ValueError("a covariance must be symmetric")
        if not _is_positive(given):
            least = float(np.linalg.eigvalsh(given)[0])
            raise ValueError(f"a covariance has no negative variance in any direction, this one has {least:.3g}")
        self._hold(given)

    @classmethod
    def of(cls, xyz: float | Sequence[float] = 0.0, rpy: float | Sequence[float] = 0.0) -> Self:
        """The covariance of six independent errors by their standard deviations, one number for all axes or three.

        Parameters
        ----------
        xyz : float or sequence of 3 floats
            In m, along the axes of the parent.
        rpy : float or sequence of 3 floats
            In rad, about the axes of the parent.

        Raises
        ------
        ValueError, TypeError
            If one is negative, or they are not numbers.

        Examples
        --------
        >>> Covariance.of(xyz=0.5).matrix.diagonal().tolist()
        [0.25, 0.25, 0.25, 0.0, 0.0, 0.0]
        """
        parts = []
        for name, sigma in (("xyz", xyz), ("rpy", rpy)):
            numbers: Matrix = as_array(sigma, name, np.float64)
            if numbers.shape not in ((), (3,)) or not (numbers >= 0.0).all():
                raise ValueError(f"{name} must be one standard deviation or three, and none negative: got {sigma!r}")
            parts.append(np.broadcast_to(numbers, 3))
        return cls(np.diag(np.concatenate(parts) ** 2))

    @classmethod
    def from_ros(cls, numbers: npt.ArrayLike) -> Self | None:
        """The covariance in a message of ROS; None if its 36 numbers say that it is unknown.

        It is unknown if it is all zeros, or has a variance that is negative (drivers write -1), of 1e6 m^2 or 10 rad^2
        or more (drivers of flat robots write 1e6 for the height), or if it cannot be a covariance at all.

        Examples
        --------
        >>> print(Covariance.from_ros([-1.0] + [0.0] * 35))
        None
        """
        given: Matrix = as_array(numbers, "covariance", np.float64)
        try:
            found = cls(given)
            return found if given.any() and (found.matrix.diagonal() < ABSURD).all() else None
        except ValueError:
            return None

    @classmethod
    def from_right(cls, matrix: npt.ArrayLike, transform: Transform, *, rotation_first: bool = False) -> Self:
        """The covariance whose right perturbation, ``transform @ Exp(r)``, has a covariance.

        Parameters
        ----------
        matrix : array of shape (6, 6)
        transform : Transform
            The pose, child in parent.
        rotation_first : bool
            False for (shift, rotation), as manif has it; True for (rotation, shift), as GTSAM.

        Examples
        --------
        >>> quarter = Transform.from_axis_angle((0.0, 0.0, 1.0), np.pi / 2)
        >>> Covariance.from_right(np.diag([4.0, 0.0, 0.0, 0.0, 0.0, 0.0]), quarter).sigmas.round(9).tolist()
        [0.0, 2.0, 0.0, 0.0, 0.0, 0.0]
        """
        return cls(_carried(right_jacobian(transform), _ordered(matrix, rotation_first)))

    @classmethod
    def from_left(cls, matrix: npt.ArrayLike, transform: Transform, *, rotation_first: bool = False) -> Self:
        """The covariance whose left perturbation, ``Exp(l) @ transform``, has a covariance; arguments as `from_right`.

        (shift, rotation) is the order of Barfoot, and (rotation, shift) that of pytransform3d.

        Examples
        --------
        >>> turned = Covariance.from_left(np.diag([0.0] * 5 + [0.01]), Transform((2.0, 0.0, 0.0)))
        >>> turned.sigmas.round(9).tolist()
        [0.0, 0.2, 0.0, 0.0, 0.0, 0.1]
        """
        return cls(_carried(left_jacobian(transform), _ordered(matrix, rotation_first)))

    def right(self, transform: Transform, *, rotation_first: bool = False) -> Matrix:
        """The covariance of the right perturbation, shape (6, 6): the inverse of `from_right`.

        Examples
        --------
        >>> Covariance.of(xyz=0.1).right(Transform(), rotation_first=True).diagonal().round(9).tolist()
        [0.0, 0.0, 0.0, 0.01, 0.01, 0.01]
        """
        return _ordered(_carried(right_jacobian(transform).T, self.matrix), rotation_first)

    def left(self, transform: Transform, *, rotation_first: bool = False) -> Matrix:
        """The covariance of the left perturbation, shape (6, 6): the inverse of `from_left`.

        Examples
        --------
        >>> Covariance.of(rpy=0.1).left(Transform((2.0, 0.0, 0.0))).diagonal().round(9).tolist()
        [0.0, 0.04, 0.04, 0.01, 0.01, 0.01]
        """
        return _ordered(_carried(lever_arm(np.negative(transform.translation)), self.matrix), rotation_first)

    @property
    def sigmas(self) -> Matrix:
        """The standard deviation of each number, shape (6,), in m and rad."""
        return np.sqrt(self.matrix.diagonal())

    def interpolate(self, other: "Covariance", fraction: float) -> "Covariance":
        """The covariance a `fraction` of the way between two samples: ``(1 - s) self + s other``.

        It bounds the error of the interpolated pose whatever the correlation of the two errors. ``(1 - s)^2 self +
        s^2 other``, that of independent errors, would be half as large in the middle, although the motion between the
        samples is not known better than at them.

        Examples
        --------
        >>> Covariance.of(xyz=1.0).interpolate(Covariance.of(xyz=3.0), 0.5).matrix[0, 0].item()
        5.0
        """
        return covariance_of((1.0 - fraction) * self.matrix + fraction * other.matrix)

    def to_dict(self) -> list[float]:
        """The 36 numbers row by row, plain data for JSON.

        Examples
        --------
        >>> len(Covariance.of(xyz=1.0).to_dict())
        36
        """
        numbers: list[float] = self.matrix.ravel().tolist()
        return numbers

    def _hold(self, matrix: Matrix) -> None:
        symmetric = 0.5 * (matrix + matrix.T)
        object.__setattr__(self, "matrix", locked(symmetric))

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"a Covariance is immutable: make another one instead of setting {name}")

    def __eq__(self, other: object) -> bool:
        return np.array_equal(self.matrix, other.matrix) if isinstance(other, Covariance) else NotImplemented

    def __hash__(self) -> int:
        return hash(self.matrix.tobytes())

    def __reduce__(self) -> tuple[Any, ...]:
        return covariance_of, (np.array(self.matrix),)

    def __repr__(self) -> str:
        x, y, z, roll, pitch, yaw = (f"{sigma:.3g}" for sigma in self.sigmas)
        return f"<Covariance of sigmas ({x}, {y}, {z}) m, ({roll}, {pitch}, {yaw}) rad>"


def covariance_of(matrix: Matrix) -> Covariance:
    """A covariance made of a valid matrix; nothing is checked."""
    covariance = Covariance.__new__(Covariance)
    covariance._hold(matrix)
    return covariance


def skew(vectors: npt.ArrayLike) -> Matrix:
    """The matrices [v]x with ``[v]x w = v x w``; shape (..., 3, 3) for vectors of shape (..., 3)."""
    v = np.asarray(vectors, np.float64)
    found = np.zeros((*v.shape, 3))
    found[..., 0, 1], found[..., 0, 2], found[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    found[..., 1, 0], found[..., 2, 0], found[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return found


def lever_arm(arms: npt.ArrayLike) -> Matrix:
    """The maps of an error at a point to the error at the point that is `arms` further; shape (..., 6, 6).

    ``[[I, -l x], [0, I]]``: a small rotation w shifts the further point by w x l.
    """
    crossed = skew(arms)
    found = np.zeros((*crossed.shape[:-2], 6, 6))
    found[...] = np.eye(6)
    found[..., :3, 3:] = -crossed
    return found


def turned(rotations: Matrix) -> Matrix:
    """``diag(R, R)`` for rotation matrices of shape (..., 3, 3)."""
    found = np.zeros((*rotations.shape[:-2], 6, 6))
    found[..., :3, :3] = found[..., 3:, 3:] = rotations
    return found


def right_jacobian(transform: Transform) -> Matrix:
    """``diag(R, R)``: the error (d, w) of a right perturbation (rho, phi)."""
    return turned(transform.matrix()[:3, :3])


def left_jacobian(transform: Transform) -> Matrix:
    """``[[I, -p x], [0, I]]``: the error (d, w) of a left perturbation (rho, phi)."""
    return lever_arm(transform.translation)


def compose_jacobians(a_from_b: Transform, b_from_c: Transform) -> tuple[Matrix, Matrix]:
    """The errors of ``a_from_b @ b_from_c`` for an error of either, J1 and J2: ``S = J1 S_ab J1^T + J2 S_bc J2^T``.

    With the lever arm l = R_ab p_bc: J1 = [[I, -l x], [0, I]], J2 = diag(R_ab, R_ab). From the product
    (p_ab + d1 + Exp(w1) R_ab (p_bc + d2), Exp(w1) R_ab Exp(w2) R_bc) to first order; the same as Sola 2018, section
    3.5, in other coordinates.

    Examples
    --------
    >>> first, _ = compose_jacobians(Transform(), Transform((2.0, 0.0, 0.0)))
    >>> float(first[1, 5])
    2.0
    """
    rotation = a_from_b.matrix()[:3, :3]
    return lever_arm(rotation @ b_from_c.translation), turned(rotation)


def inverse_jacobian(transform: Transform) -> Matrix:
    """The error of the inverse for an error of a pose: ``[[-R^T, -R^T p x], [0, -R^T]]``.

    From (-R^T Exp(-w) (p + d), R^T Exp(-w)) to first order.

    Examples
    --------
    >>> inverse_jacobian(Transform()).diagonal().tolist()
    [-1.0, -1.0, -1.0, -1.0, -1.0, -1.0]
    """
    back = -transform.matrix()[:3, :3].T
    found = turned(back)
    found[:3, 3:] = back @ skew(transform.translation)
    return found


def root_of(matrix: Matrix) -> Matrix:
    """The symmetric positive semidefinite square root of one, shape (n, n)."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def as_covariance(value: Covariance) -> Covariance:
    """The argument `covariance`; `TypeError` if it is none, such as a bare matrix."""
    if not isinstance(value, Covariance):
        raise TypeError(f"covariance must be a Covariance, such as Covariance.of(xyz=0.01, rpy=0.002), not {value!r}")
    return value


def as_kind(kind: Kind) -> Kind:
    """The argument `kind`; `ValueError` if it is none of the three."""
    if kind not in KINDS:
        raise ValueError(f"kind must be 'independent', 'drift' or 'constant', not {kind!r}")
    return kind


def _is_positive(matrix: Matrix) -> bool:
    # Each variable in its own unit, so that mm beside rad are not taken for rounding.
    unit = np.sqrt(np.maximum(matrix.diagonal(), 0.0))
    for half in (unit[:3], unit[3:]):
        half[half == 0.0] = half.max() or 1.0
    try:
        np.linalg.cholesky(matrix / np.outer(unit, unit) + _ROUNDING * np.eye(6))
    except np.linalg.LinAlgError:
        return False
    return True


def _carried(jacobian: Matrix, matrix: Matrix) -> Matrix:
    return np.asarray(jacobian @ matrix @ jacobian.T)


def _ordered(matrix: npt.ArrayLike, rotation_first: bool) -> Matrix:
    """A matrix of (shift, rotation) from one of that order, or with rotation and shift exchanged; and the reverse."""
    given: Matrix = as_array(matrix, "covariance", np.float64)
    if given.shape != (6, 6):
        raise ValueError(f"a covariance must have shape (6, 6), got {given.shape}")
    order = [3, 4, 5, 0, 1, 2] if rotation_first else [0, 1, 2, 3, 4, 5]
    return np.asarray(given[np.ix_(order, order)])
