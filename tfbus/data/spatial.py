"""Data with a linear and an angular part: poses with covariance, twists and wrenches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tfbus.data.dispatch import (
    CopiedByFields,
    as_covariance,
    as_triple,
    check_header,
    check_pose,
    construct,
    do_transform,
    moved_header,
    set_triples,
)
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import Transform
from tfbus.plain import PlainData
from tfbus.rows import Numbers, Vector, rotate
from tfbus.stamps import AtLike, Latest, Stamps


@dataclass(frozen=True, slots=True, eq=False)
class PoseWithCovarianceStamped(CopiedByFields, PlainData):
    """A pose and its covariance. Equal only to itself.

    Parameters
    ----------
    frame : str
    stamp : int or LATEST
        ns.
    pose : Transform
        Maps coordinates of the posed body into `frame`.
    covariance : array of shape (6, 6), or 36 numbers row by row
        The covariance of (x, y, z, rotation about x, y, z) in m and rad, about the fixed axes of `frame`: the order of
        geometry_msgs/PoseWithCovariance. Copied as float64, and read-only from then on. Only the shape is checked,
        because messages write NaN or -1 for "unknown".

    Notes
    -----
    A transform rotates both sides, S -> diag(R, R) S diag(R, R)^T, as tf2_geometry_msgs does. The covariance is about
    the pose's own origin, so no lever arm couples translation and rotation, and the transform adds no error of its own.
    NaN stays in its 3x3 block. If a variance is negative, because drivers write -1 for "unknown", the covariance stays
    as it is.

    Examples
    --------
    >>> PoseWithCovarianceStamped("map", 0, Transform(), np.eye(6)).covariance.shape
    (6, 6)
    """

    frame: str
    stamp: int | Latest
    pose: Transform
    covariance: npt.NDArray[np.float64]

    def __init__(self, frame: str, stamp: AtLike, pose: Transform, covariance: npt.ArrayLike) -> None:
        construct(self, frame, stamp, pose, covariance)

    def __post_init__(self) -> None:
        check_header(self)
        check_pose(self.pose)
        object.__setattr__(self, "covariance", as_covariance(self.covariance, "covariance", 6))


@dataclass(frozen=True, slots=True, eq=False)
class PointWithCovarianceStamped(CopiedByFields, PlainData):
    """A position and its covariance, as a buffer gives it with ``covariance=True``. Equal only to itself.

    Parameters
    ----------
    frame : str
    stamp : int or LATEST
        ns.
    point : sequence of 3 floats
        (x, y, z) in m.
    covariance : array of shape (3, 3), or 9 numbers row by row
        In m^2, along the axes of `frame`. Copied.

    Notes
    -----
    A transform turns the covariance, S -> R S R^T. ROS has no such message.

    Examples
    --------
    >>> PointWithCovarianceStamped("laser", 0, (1.0, 2.0, 3.0), np.eye(3)).covariance.shape
    (3, 3)
    """

    frame: str
    stamp: int | Latest
    point: Vector
    covariance: npt.NDArray[np.float64]

    def __init__(self, frame: str, stamp: AtLike, point: Numbers, covariance: npt.ArrayLike) -> None:
        construct(self, frame, stamp, point, covariance)

    def __post_init__(self) -> None:
        check_header(self)
        object.__setattr__(self, "point", as_triple(self.point, "point"))
        object.__setattr__(self, "covariance", as_covariance(self.covariance, "covariance", 3))


@dataclass(frozen=True, slots=True)
class TwistStamped(PlainData):
    """The velocity of a body at the origin of a frame that is fixed to it.

    Parameters
    ----------
    frame : str
    stamp : int or LATEST
        ns.
    linear : sequence of 3 floats
        Velocity, in m/s along the axes of `frame`, of the body's point that is at the origin of `frame`; see Notes for
        the answers of `TransformTree.twist`.
    angular : sequence of 3 floats
        Angular velocity in rad/s about the axes of `frame`.

    Notes
    -----
    A transform gives the same motion at the origin of another frame, which it assumes to be fixed to the same body:
    with R and t of target_from_source, angular' = R angular and linear' = R linear + t x angular'. This is the
    adjoint map of Lynch and Park, "Modern Robotics", 2017, section 3.3.2, who write the angular part first.

    An answer of `TransformTree.twist` is such a twist only with ``expressed_in=frame``. By default, or with another
    frame, it has the velocity of the origin of `frame` along the axes of that other frame: do not transform it.

    Examples
    --------
    >>> TwistStamped("base_link", 0, linear=(1.0, 0.0, 0.0), angular=(0.0, 0.0, 0.5)).angular
    (0.0, 0.0, 0.5)
    """

    frame: str
    stamp: int | Latest
    linear: Vector
    angular: Vector

    def __init__(self, frame: str, stamp: AtLike, linear: Numbers, angular: Numbers) -> None:
        construct(self, frame, stamp, linear, angular)

    def __post_init__(self) -> None:
        check_header(self)
        set_triples(self, "linear", "angular")


@dataclass(frozen=True, slots=True, eq=False)
class TwistArray:
    """The velocities of a frame at many stamps, as `TransformTree.twist_many` gives them. Equal only to itself.

    Parameters
    ----------
    frame : str
        The frame along whose axes the velocities are given.
    stamps : integer array of shape (n,)
        ns.
    linear : array of shape (n, 3)
        Velocity in m/s. NaN where there is no answer.
    angular : array of shape (n, 3)
        Angular velocity in rad/s; NaN as `linear`.

    Examples
    --------
    >>> tree = TransformTree()
    >>> outcomes = tree.insert_columns("map", "base_link", [0, SECOND], [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]],
    ...                                [[0.0, 0.0, 0.0, 1.0]] * 2)
    >>> tree.twist_many("base_link", "map", [0, SECOND // 2])
    <TwistArray of 2 along the axes of 'map'>
    """

    frame: str
    stamps: Stamps
    linear: npt.NDArray[np.float64]
    angular: npt.NDArray[np.float64]

    def __repr__(self) -> str:
        return f"<TwistArray of {len(self.stamps)} along the axes of {self.frame!r}>"


@dataclass(frozen=True, slots=True)
class WrenchStamped(PlainData):
    """A force on a body, and its torque about the origin of a frame.

    Parameters
    ----------
    frame : str
    stamp : int or LATEST
        ns.
    force : sequence of 3 floats
        In N along the axes of `frame`.
    torque : sequence of 3 floats
        In N m about the origin and along the axes of `frame`.

    Notes
    -----
    A transform gives the same load at the origin of another frame: with R and t of target_from_source,
    force' = R force and torque' = R torque + t x force'. This is the adjoint map of Lynch and Park, "Modern Robotics",
    2017, section 3.4, who write the torque first; tf2 does the same in C++, and leaves out the lever arm in Python.

    Examples
    --------
    >>> WrenchStamped("tool", 0, force=(0.0, 0.0, -9.81), torque=(0.0, 0.0, 0.0)).force
    (0.0, 0.0, -9.81)
    """

    frame: str
    stamp: int | Latest
    force: Vector
    torque: Vector

    def __init__(self, frame: str, stamp: AtLike, force: Numbers, torque: Numbers) -> None:
        construct(self, frame, stamp, force, torque)

    def __post_init__(self) -> None:
        check_header(self)
        set_triples(self, "force", "torque")


@do_transform.register
def _(data: PoseWithCovarianceStamped, transform: TransformStamped) -> PoseWithCovarianceStamped:
    header = moved_header(data, transform)
    covariance = rotated(data.covariance, transform.transform)
    return PoseWithCovarianceStamped(*header, transform.transform @ data.pose, covariance)


@do_transform.register
def _(data: PointWithCovarianceStamped, transform: TransformStamped) -> PointWithCovarianceStamped:
    header, point = moved_header(data, transform), transform.transform.apply(data.point)
    return PointWithCovarianceStamped(*header, point, rotated(data.covariance, transform.transform))


@do_transform.register
def _(data: TwistStamped, transform: TransformStamped) -> TwistStamped:
    header = moved_header(data, transform)
    linear, angular = shifted(data.linear, data.angular, transform.transform)
    return TwistStamped(*header, linear, angular)


@do_transform.register
def _(data: WrenchStamped, transform: TransformStamped) -> WrenchStamped:
    header = moved_header(data, transform)
    torque, force = shifted(data.torque, data.force, transform.transform)
    return WrenchStamped(*header, force, torque)


def shifted(moment: Vector, line: Vector, target_from_source: Transform) -> tuple[Vector, Vector]:
    """Rotate a line vector and its moment into the target, and take the moment about the target's origin."""
    turn = target_from_source.rotation
    tx, ty, tz = target_from_source.translation
    x, y, z = rotate(turn, *line)
    mx, my, mz = rotate(turn, *moment)
    return (mx + ty * z - tz * y, my + tz * x - tx * z, mz + tx * y - ty * x), (x, y, z)


def lever(target_from_source: Transform) -> npt.NDArray[np.float64]:
    """The adjoint map of a transform, shape (6, 6), which `shifted` applies; the linear part comes first."""
    matrix = target_from_source.matrix()
    turn, (x, y, z) = matrix[:3, :3], matrix[:3, 3]
    skew = np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))
    return np.block([[turn, skew @ turn], [np.zeros((3, 3)), turn]])


def rotated(covariance: npt.NDArray[np.float64], target_from_source: Transform) -> npt.NDArray[np.float64]:
    """A covariance of one or two vectors along the axes of the target; one with a negative variance is unknown."""
    if (covariance.diagonal() < 0.0).any():
        return covariance
    turn = target_from_source.matrix()[:3, :3]
    count = len(covariance) // 3
    blocks = covariance.reshape(count, 3, count, 3).swapaxes(1, 2)
    return (turn @ blocks @ turn.T).swapaxes(1, 2).reshape(covariance.shape)
