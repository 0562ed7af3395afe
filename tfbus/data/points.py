"""Points, directions, orientations and poses; and fixes of a satellite receiver, which are places on the earth."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tfbus.data.dispatch import (
    CopiedByFields,
    as_covariance,
    as_points,
    as_triple,
    check_header,
    check_pose,
    construct,
    do_transform,
    made,
    moved_header,
)
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import Transform, from_row
from tfbus.geometry.transform_array import locked
from tfbus.plain import PlainData
from tfbus.rows import Numbers, Quaternion, Vector, as_rotation, rotate
from tfbus.stamps import AtLike, Latest, is_real
from tfbus.which_kernel import compose_rows, move_point


@dataclass(frozen=True, slots=True)
class PointStamped(PlainData):
    """A position.

    Parameters
    ----------
    frame : str
    stamp : int or LATEST
        ns.
    point : sequence of 3 floats
        (x, y, z) in m. NaN is allowed: sensors send it for a missing point.

    Examples
    --------
    >>> PointStamped("laser", 0, (1.0, 2.0, 3.0)).point
    (1.0, 2.0, 3.0)
    """

    frame: str
    stamp: int | Latest
    point: Vector

    def __init__(self, frame: str, stamp: AtLike, point: Numbers) -> None:
        construct(self, frame, stamp, point)

    def __post_init__(self) -> None:
        check_header(self)
        object.__setattr__(self, "point", as_triple(self.point, "point"))


@dataclass(frozen=True, slots=True)
class Vector3Stamped(PlainData):
    """A direction with a length, such as a velocity or a normal: a transform rotates it but does not translate it.

    Parameters
    ----------
    frame : str
    stamp : int or LATEST
        ns.
    vector : sequence of 3 floats
        (x, y, z) in any unit.

    Examples
    --------
    >>> Vector3Stamped("laser", 0, (1.0, 2.0, 3.0)).vector
    (1.0, 2.0, 3.0)
    """

    frame: str
    stamp: int | Latest
    vector: Vector

    def __init__(self, frame: str, stamp: AtLike, vector: Numbers) -> None:
        construct(self, frame, stamp, vector)

    def __post_init__(self) -> None:
        check_header(self)
        object.__setattr__(self, "vector", as_triple(self.vector, "vector"))


@dataclass(frozen=True, slots=True)
class QuaternionStamped(PlainData):
    """An orientation.

    Parameters
    ----------
    frame : str
    stamp : int or LATEST
        ns.
    quaternion : sequence of 4 floats
        Unit quaternion (x, y, z, w): rotates directions of the oriented body into `frame`. A norm within 1 % of one is
        normalised; the sign stays as given.

    Examples
    --------
    >>> QuaternionStamped("imu", 0, (0.0, 0.0, 0.0, 1.0)).quaternion
    (0.0, 0.0, 0.0, 1.0)
    """

    frame: str
    stamp: int | Latest
    quaternion: Quaternion

    def __init__(self, frame: str, stamp: AtLike, quaternion: Numbers) -> None:
        construct(self, frame, stamp, quaternion)

    def __post_init__(self) -> None:
        check_header(self)
        object.__setattr__(self, "quaternion", as_rotation(self.quaternion, "quaternion"))


@dataclass(frozen=True, slots=True)
class PoseStamped(PlainData):
    """A position and an orientation.

    Parameters
    ----------
    frame : str
    stamp : int or LATEST
        ns.
    pose : Transform
        Maps coordinates of the posed body into `frame`.

    Examples
    --------
    >>> base_from_tool = TransformStamped("base", "tool", 0, Transform((0.0, 0.0, 1.0)))
    >>> do_transform(PoseStamped("tool", 0, Transform()), base_from_tool).pose.translation
    (0.0, 0.0, 1.0)
    """

    frame: str
    stamp: int | Latest
    pose: Transform

    def __init__(self, frame: str, stamp: AtLike, pose: Transform) -> None:
        construct(self, frame, stamp, pose)

    def __post_init__(self) -> None:
        check_header(self)
        check_pose(self.pose)


@dataclass(frozen=True, slots=True, eq=False)
class Polygon(CopiedByFields, PlainData):
    """The corners of an area, in order; the last one is joined to the first. Equal only to itself.

    Parameters
    ----------
    frame : str
    stamp : int or LATEST
        ns.
    points : array of shape (n, 3)
        In m; copied, and read-only from then on. Floats keep their dtype, integers become float64.

    Examples
    --------
    >>> Polygon("map", 0, [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0)]).points.shape
    (3, 3)
    """

    frame: str
    stamp: int | Latest
    points: npt.NDArray[Any]

    def __init__(self, frame: str, stamp: AtLike, points: npt.ArrayLike) -> None:
        construct(self, frame, stamp, points)

    def __post_init__(self) -> None:
        check_header(self)
        object.__setattr__(self, "points", locked(as_points(self.points).copy()))


@dataclass(frozen=True, slots=True, eq=False)
class NavSatFix(CopiedByFields, PlainData):
    """A place on the earth by a satellite receiver, as sensor_msgs/NavSatFix. Equal only to itself.

    It is not a point of `frame`, which is where the antenna is fixed on the robot, so no transform moves it.

    Parameters
    ----------
    frame : str
        The frame of the antenna.
    stamp : int or LATEST
        ns.
    latitude, longitude : float
        In degrees, positive to the north and to the east.
    altitude : float
        In m above the ellipsoid of WGS 84; NaN if it is not known.
    covariance : array of shape (3, 3), or 9 numbers row by row, optional
        Of the position to the east, to the north and up, in m^2. Copied.
    covariance_type : int
        0 for an unknown covariance, 1 approximated, 2 only the diagonal is known, 3 known.
    status : int
        -1 without a fix, 0 with one, 1 with augmentation by satellites, 2 by stations on the ground.
    service : int
        The systems that the receiver uses, a sum of 1 (GPS), 2 (GLONASS), 4 (BeiDou) and 8 (Galileo).

    Examples
    --------
    >>> fix = NavSatFix("gps", 0, 48.0, 11.0, 500.0)
    >>> fix.latitude, fix.covariance
    (48.0, None)
    """

    frame: str
    stamp: int | Latest
    latitude: float
    longitude: float
    altitude: float
    _: KW_ONLY
    covariance: npt.NDArray[np.float64] | None = None
    covariance_type: int = 0
    status: int = 0
    service: int = 1

    def __post_init__(self) -> None:
        check_header(self)
        for name in ("latitude", "longitude", "altitude"):
            value = getattr(self, name)
            if not is_real(value):
                raise TypeError(f"{name} must be a number, not {value!r}")
            object.__setattr__(self, name, float(value))
        if self.covariance is not None:
            object.__setattr__(self, "covariance", as_covariance(self.covariance, "covariance", 3))


@do_transform.register
def _(data: PointStamped, transform: TransformStamped) -> PointStamped:
    return made(PointStamped, *moved_header(data, transform), move_point(transform._row, data.point))


@do_transform.register
def _(data: Vector3Stamped, transform: TransformStamped) -> Vector3Stamped:
    return made(Vector3Stamped, *moved_header(data, transform), rotate(transform._row[3:], *data.vector))


@do_transform.register
def _(data: QuaternionStamped, transform: TransformStamped) -> QuaternionStamped:
    turned = transform.transform @ Transform(rotation=data.quaternion)
    return QuaternionStamped(*moved_header(data, transform), turned.rotation)


@do_transform.register
def _(data: PoseStamped, transform: TransformStamped) -> PoseStamped:
    moved = from_row(compose_rows(transform._row, data.pose._row))
    return made(PoseStamped, *moved_header(data, transform), moved)


@do_transform.register
def _(data: Polygon, transform: TransformStamped) -> Polygon:
    return Polygon(*moved_header(data, transform), transform.transform.apply(data.points))


@do_transform.register
def _(data: TransformStamped, transform: TransformStamped) -> TransformStamped:
    target, stamp = moved_header(data, transform)
    static = data.static and transform.static
    return TransformStamped(target, data.child, stamp, transform.transform @ data.transform, data.authority, static)
