"""Motion of a body: odometry, inertial measurements, velocities, accelerations, and its inertia."""

from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tfbus.data.dispatch import (
    CopiedByFields,
    as_covariance,
    check_header,
    check_pose,
    do_transform,
    moved_header,
    set_triples,
)
from tfbus.data.spatial import lever, rotated, shifted
from tfbus.frames import check_frame
from tfbus.geometry.covariance import Covariance, Kind
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import Transform
from tfbus.geometry.transform_array import locked
from tfbus.geometry.uncertain import Belief, with_belief
from tfbus.plain import PlainData
from tfbus.rows import Quaternion, Vector, as_rotation, rotate
from tfbus.stamps import Latest, as_array


def _set_covariances(data: object, size: int, *names: str) -> None:
    for name in names:
        value = getattr(data, name)
        if value is not None:
            object.__setattr__(data, name, as_covariance(value, name, size))


@dataclass(frozen=True, slots=True, eq=False)
class Odometry(CopiedByFields, PlainData):
    """A pose in one frame with a velocity in another, as nav_msgs/Odometry. Equal only to itself.

    Parameters
    ----------
    frame : str
        The frame of the pose, such as ``"odom"``.
    stamp : int or LATEST
        ns.
    child : str
        The frame of the body, such as ``"base_link"``.
    pose : Transform
        Maps coordinates of `child` into `frame`.
    linear : sequence of 3 floats
        Velocity of the origin of `child` in m/s, along the axes of `child`.
    angular : sequence of 3 floats
        Angular velocity in rad/s, about the axes of `child`.
    pose_covariance : array of shape (6, 6), or 36 numbers row by row, optional
        Of (x, y, z, rotation about x, y, z) in m and rad, about the fixed axes of `frame`. Copied.
    twist_covariance : array of shape (6, 6), or 36 numbers row by row, optional
        Of (linear, angular) along the axes of `child`. Copied.

    Notes
    -----
    A transform moves the pose into another frame, as that of a `PoseWithCovarianceStamped`. The velocity stays in the
    axes of `child`.

    Examples
    --------
    >>> odometry = Odometry("odom", 0, "base_link", Transform((2.0, 0.0, 0.0)), (0.5, 0.0, 0.0), (0.0, 0.0, 0.1))
    >>> print(odometry.as_transform())
    odom <- base_link at 0.000 s: Transform(translation=(2.0, 0.0, 0.0), rotation=(0.0, 0.0, 0.0, 1.0))
    """

    frame: str
    stamp: int | Latest
    child: str
    pose: Transform
    linear: Vector
    angular: Vector
    _: KW_ONLY
    pose_covariance: npt.NDArray[np.float64] | None = None
    twist_covariance: npt.NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        check_header(self)
        check_frame(self.child)
        check_pose(self.pose)
        set_triples(self, "linear", "angular")
        _set_covariances(self, 6, "pose_covariance", "twist_covariance")

    def as_transform(self, *, invert: bool = False) -> TransformStamped:
        """The pose as a sample for a bus; an `UncertainSample` of a drift if its covariance is known.

        Parameters
        ----------
        invert : bool
            Whether `child` becomes the parent of `frame`. A frame has one parent: so a second source of odometry,
            whose body has a parent already, hangs its own frame below the body.

        Raises
        ------
        TypeError
            If the stamp is `LATEST`.

        Examples
        --------
        >>> odometry = Odometry("odom", 0, "base_link", Transform((2.0, 0.0, 0.0)), (0.5, 0.0, 0.0), (0.0, 0.0, 0.1))
        >>> odometry.as_transform(invert=True).child
        'odom'
        """
        return pose_as_transform(self, self.child, invert=invert)


def pose_as_transform(data: Any, child: str, *, invert: bool = False) -> TransformStamped:
    """The pose of some data as a sample of the frame `child`; inverted, `child` is the parent.

    A covariance that is known goes with it: that of odometry is a drift.
    """
    sample = TransformStamped(data.frame, child, data.stamp, data.pose)
    kind: Kind = "drift" if isinstance(data, Odometry) else "independent"
    numbers = data.pose_covariance if isinstance(data, Odometry) else getattr(data, "covariance", None)
    covariance = None if numbers is None else Covariance.from_ros(numbers)
    if covariance is not None:
        sample = with_belief(sample, Belief(covariance, kind))
    # The authority of an inverse is empty, as that of the sample.
    return ~sample if invert else sample


@dataclass(frozen=True, slots=True, eq=False)
class TwistWithCovarianceStamped(CopiedByFields, PlainData):
    """The velocity of a body at the origin of a frame that is fixed to it, and its covariance. Equal only to itself.

    Parameters
    ----------
    frame : str
    stamp : int or LATEST
        ns.
    linear, angular : sequence of 3 floats
        As those of a `TwistStamped`, in m/s and rad/s.
    covariance : array of shape (6, 6), or 36 numbers row by row
        Of (linear, angular) along the axes of `frame`. Copied.

    Notes
    -----
    A transform moves the velocity as that of a `TwistStamped`, and the covariance S to A S A^T with its adjoint map A:
    with a lever arm, an uncertain rotation makes the linear part uncertain. If a variance is negative, the covariance
    is unknown and stays as it is.

    Examples
    --------
    >>> wheel = TwistWithCovarianceStamped("wheel", 0, (1.0, 0.0, 0.0), (0.0, 0.0, 0.5), np.diag([0.0] * 5 + [0.01]))
    >>> moved = do_transform(wheel, TransformStamped("base", "wheel", 0, Transform((0.0, 2.0, 0.0))))
    >>> moved.linear, float(moved.covariance[0, 0])
    ((2.0, 0.0, 0.0), 0.04)
    """

    frame: str
    stamp: int | Latest
    linear: Vector
    angular: Vector
    covariance: npt.NDArray[np.float64]

    def __post_init__(self) -> None:
        check_header(self)
        set_triples(self, "linear", "angular")
        _set_covariances(self, 6, "covariance")


@dataclass(frozen=True, slots=True)
class VelocityStamped(PlainData):
    """The velocity of one frame against another, along the axes of a third, as geometry_msgs/VelocityStamped.

    Parameters
    ----------
    frame : str
        The frame along whose axes the velocity is given.
    stamp : int or LATEST
        ns.
    body : str
        The frame that moves.
    reference : str
        The frame against which it moves.
    linear : sequence of 3 floats
        Velocity of the origin of `body` in m/s.
    angular : sequence of 3 floats
        In rad/s.

    Notes
    -----
    A transform turns both parts to the axes of another frame; there is no lever arm, because the velocity stays that of
    the origin of `body`.

    Examples
    --------
    >>> velocity = VelocityStamped("odom", 0, "base_link", "odom", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    >>> quarter = Transform.from_axis_angle((0.0, 0.0, 1.0), np.pi / 2)
    >>> moved = do_transform(velocity, TransformStamped("map", "odom", 0, quarter))
    >>> moved.body, round(moved.linear[1], 6)
    ('base_link', 1.0)
    """

    frame: str
    stamp: int | Latest
    body: str
    reference: str
    linear: Vector
    angular: Vector

    def __post_init__(self) -> None:
        check_header(self)
        check_frame(self.body)
        check_frame(self.reference)
        set_triples(self, "linear", "angular")


@dataclass(frozen=True, slots=True)
class AccelStamped(PlainData):
    """The acceleration of a body, as geometry_msgs/AccelStamped.

    Parameters
    ----------
    frame : str
    stamp : int or LATEST
        ns.
    linear : sequence of 3 floats
        In m/s^2, along the axes of `frame`.
    angular : sequence of 3 floats
        In rad/s^2, about the axes of `frame`.

    Notes
    -----
    A transform turns both parts. They stay the acceleration of the same point of the body: that of another point
    depends on the angular velocity, which the message does not have.

    Examples
    --------
    >>> quarter = Transform.from_axis_angle((0.0, 0.0, 1.0), np.pi / 2)
    >>> seen = AccelStamped("imu", 0, (1.0, 0.0, 9.5), (0.0, 0.0, 0.0))
    >>> moved = do_transform(seen, TransformStamped("base", "imu", 0, quarter))
    >>> [round(number, 6) for number in moved.linear]
    [0.0, 1.0, 9.5]
    """

    frame: str
    stamp: int | Latest
    linear: Vector
    angular: Vector

    def __post_init__(self) -> None:
        check_header(self)
        set_triples(self, "linear", "angular")


@dataclass(frozen=True, slots=True, eq=False)
class Imu(CopiedByFields, PlainData):
    """The measurement of an inertial sensor, as sensor_msgs/Imu. Equal only to itself.

    Parameters
    ----------
    frame : str
        The frame of the sensor.
    stamp : int or LATEST
        ns.
    orientation : sequence of 4 floats, or None
        Unit quaternion (x, y, z, w) that rotates directions of `frame` into a fixed frame of the world, which the
        message does not name; None if the sensor has no compass.
    angular_velocity : sequence of 3 floats, or None
        In rad/s, about the axes of `frame`.
    linear_acceleration : sequence of 3 floats, or None
        In m/s^2, along the axes of `frame`, gravity included.
    orientation_covariance : array of shape (3, 3), or 9 numbers row by row, optional
        In rad^2, about the fixed axes of the world. Copied. Messages have zeros for an unknown one.
    angular_velocity_covariance, linear_acceleration_covariance : array of shape (3, 3), or 9 numbers, optional
        Along the axes of `frame`. Copied.

    Notes
    -----
    A transform turns rates, accelerations and their covariances. The orientation becomes that of the target frame,
    against the same world, so its covariance stays: the same as tf2_sensor_msgs does. The lever arm between two places
    on a body is left out, because it depends on the angular acceleration.

    Examples
    --------
    >>> half = Transform.from_axis_angle((1.0, 0.0, 0.0), np.pi)
    >>> imu = Imu("imu", 0, None, (0.0, 0.0, 0.5), (0.0, 0.0, -9.5))
    >>> moved = do_transform(imu, TransformStamped("base", "imu", 0, half))
    >>> round(moved.angular_velocity[2], 6), round(moved.linear_acceleration[2], 6)
    (-0.5, 9.5)
    """

    frame: str
    stamp: int | Latest
    orientation: Quaternion | None
    angular_velocity: Vector | None
    linear_acceleration: Vector | None
    _: KW_ONLY
    orientation_covariance: npt.NDArray[np.float64] | None = None
    angular_velocity_covariance: npt.NDArray[np.float64] | None = None
    linear_acceleration_covariance: npt.NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        check_header(self)
        if self.orientation is not None:
            object.__setattr__(self, "orientation", as_rotation(self.orientation, "orientation"))
        measured = ("angular_velocity", "linear_acceleration")
        set_triples(self, *(name for name in measured if getattr(self, name) is not None))
        _set_covariances(
            self, 3, "orientation_covariance", "angular_velocity_covariance", "linear_acceleration_covariance"
        )


@dataclass(frozen=True, slots=True, eq=False)
class InertiaStamped(CopiedByFields, PlainData):
    """The mass of a body and how it is distributed, as geometry_msgs/InertiaStamped. Equal only to itself.

    Parameters
    ----------
    frame : str
    stamp : int or LATEST
        ns.
    mass : float
        In kg.
    center : sequence of 3 floats
        The centre of mass in `frame`, in m.
    inertia : array of shape (3, 3)
        Moments of inertia about the centre of mass, along the axes of `frame`, in kg m^2. Copied.

    Notes
    -----
    A transform moves the centre, and turns the moments, I -> R I R^T.

    Examples
    --------
    >>> load = InertiaStamped("tool", 0, 2.0, (0.0, 0.0, 0.1), np.eye(3))
    >>> moved = do_transform(load, TransformStamped("flange", "tool", 0, Transform((0.0, 0.0, 0.2))))
    >>> moved.mass, round(moved.center[2], 6)
    (2.0, 0.3)
    """

    frame: str
    stamp: int | Latest
    mass: float
    center: Vector
    inertia: npt.NDArray[np.float64]

    def __post_init__(self) -> None:
        check_header(self)
        object.__setattr__(self, "mass", float(self.mass))
        set_triples(self, "center")
        inertia = as_array(self.inertia, "inertia", np.float64)
        if inertia.shape != (3, 3):
            raise ValueError(f"inertia must have shape (3, 3), got {inertia.shape}")
        object.__setattr__(self, "inertia", locked(inertia.copy()))


def _rotated(covariance: npt.NDArray[np.float64] | None, turn: Transform) -> npt.NDArray[np.float64] | None:
    return None if covariance is None else rotated(covariance, turn)


@do_transform.register
def _(data: Odometry, transform: TransformStamped) -> Odometry:
    return Odometry(
        *moved_header(data, transform),
        data.child,
        transform.transform @ data.pose,
        data.linear,
        data.angular,
        pose_covariance=_rotated(data.pose_covariance, transform.transform),
        twist_covariance=data.twist_covariance,
    )


@do_transform.register
def _(data: TwistWithCovarianceStamped, transform: TransformStamped) -> TwistWithCovarianceStamped:
    header = moved_header(data, transform)
    linear, angular = shifted(data.linear, data.angular, transform.transform)
    covariance = data.covariance
    if (covariance.diagonal() >= 0.0).all():
        adjoint = lever(transform.transform)
        covariance = adjoint @ covariance @ adjoint.T
    return TwistWithCovarianceStamped(*header, linear, angular, covariance)


@do_transform.register
def _(data: VelocityStamped, transform: TransformStamped) -> VelocityStamped:
    turn = transform.transform.rotation
    linear, angular = rotate(turn, *data.linear), rotate(turn, *data.angular)
    return VelocityStamped(*moved_header(data, transform), data.body, data.reference, linear, angular)


@do_transform.register
def _(data: AccelStamped, transform: TransformStamped) -> AccelStamped:
    turn = transform.transform.rotation
    return AccelStamped(*moved_header(data, transform), rotate(turn, *data.linear), rotate(turn, *data.angular))


@do_transform.register
def _(data: Imu, transform: TransformStamped) -> Imu:
    target_from_source = transform.transform
    turn = target_from_source.rotation
    orientation = data.orientation
    if orientation is not None:
        orientation = (Transform(rotation=orientation) @ target_from_source.inverse()).rotation
    return Imu(
        *moved_header(data, transform),
        orientation,
        data.angular_velocity and rotate(turn, *data.angular_velocity),
        data.linear_acceleration and rotate(turn, *data.linear_acceleration),
        orientation_covariance=data.orientation_covariance,
        angular_velocity_covariance=_rotated(data.angular_velocity_covariance, target_from_source),
        linear_acceleration_covariance=_rotated(data.linear_acceleration_covariance, target_from_source),
    )


@do_transform.register
def _(data: InertiaStamped, transform: TransformStamped) -> InertiaStamped:
    turn = transform.transform.matrix()[:3, :3]
    header, center = moved_header(data, transform), transform.transform.apply(data.center)
    return InertiaStamped(*header, data.mass, center, turn @ data.inertia @ turn.T)
