"""The axes of different worlds: rotations between conventions of right-handed axes, and left-handed worlds.

ROS has x forward, y left, z up for bodies (FLU) and x east, y north, z up for maps (ENU), by REP 103 and REP 105.
Aircraft and PX4 have x forward, y right, z down (FRD) and x north, y east, z down (NED). A camera's optical frame has z
forward, x right, y down. The pose of a body changes on both sides: from a FLU body in an ENU world to a FRD body in a
NED world it is ``NED_FROM_ENU @ enu_from_flu @ FLU_FROM_FRD``.

Unity and Unreal are left-handed. No rotation leads there, so there is no `Transform` for it: `UNITY` and `UNREAL`
convert coordinates.
"""

from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from tfbus.geometry.transform import Transform
from tfbus.rows import Numbers, Quaternion, Vector

_HALF = sqrt(0.5)

NED_FROM_ENU = Transform(rotation=(_HALF, _HALF, 0.0, 0.0))
"""(x, y, z) in ENU is (y, x, -z) in NED."""
ENU_FROM_NED = Transform(rotation=(-_HALF, -_HALF, 0.0, 0.0))
"""(x, y, z) in NED is (y, x, -z) in ENU."""
FRD_FROM_FLU = Transform(rotation=(1.0, 0.0, 0.0, 0.0))
"""(x, y, z) in FLU is (x, -y, -z) in FRD."""
FLU_FROM_FRD = Transform(rotation=(-1.0, 0.0, 0.0, 0.0))
"""(x, y, z) in FRD is (x, -y, -z) in FLU."""
OPTICAL_FROM_BODY = Transform(rotation=(0.5, -0.5, 0.5, 0.5))
"""(x, y, z) in FLU is (-y, -z, x) in the optical frame."""
BODY_FROM_OPTICAL = Transform(rotation=(-0.5, 0.5, -0.5, 0.5))
"""(x, y, z) in the optical frame is (z, -x, -y) in FLU."""


@dataclass(frozen=True, slots=True)
class LeftHandedWorld:
    """A world whose axes are a mirror image of those of ROS.

    Parameters
    ----------
    axes : tuple of 3 pairs of (int, float)
        For each axis of that world, the index of the axis of ROS that it is, and its sign.
    units : float
        The units of that world in a metre.

    Examples
    --------
    >>> UNITY.points([[1.0, 2.0, 3.0]])
    array([[-2.,  3.,  1.]])
    >>> UNITY.pose(Transform((1.0, 2.0, 3.0)))
    ((-2.0, 3.0, 1.0), (0.0, 0.0, 0.0, 1.0))
    """

    axes: tuple[tuple[int, float], tuple[int, float], tuple[int, float]]
    units: float = 1.0

    def points(self, points: npt.ArrayLike) -> npt.NDArray[Any]:
        """Points or vertices of ROS in that world.

        Parameters
        ----------
        points : array of shape (..., 3)
            In m.

        Returns
        -------
        array of shape (..., 3)
            In the units of that world. The triangles of a mesh need the other order as well: see `triangles`.

        Examples
        --------
        >>> UNREAL.points((1.0, 2.0, 3.0))
        array([ 100., -200.,  300.])
        """
        array = np.asarray(points)
        return np.stack([array[..., axis] * (sign * self.units) for axis, sign in self.axes], axis=-1)

    def points_back(self, points: npt.ArrayLike) -> npt.NDArray[Any]:
        """Points of that world, shape (..., 3), in ROS, in m.

        Examples
        --------
        >>> UNREAL.points_back((100.0, -200.0, 300.0))
        array([1., 2., 3.])
        """
        array = np.asarray(points)
        found = {axis: array[..., place] * (sign / self.units) for place, (axis, sign) in enumerate(self.axes)}
        return np.stack([found[axis] for axis in range(3)], axis=-1)

    def pose(self, pose: Transform) -> tuple[Vector, Quaternion]:
        """A pose of ROS in that world: its position in the units of that world, and a quaternion (x, y, z, w).

        The mirror image of a rotation by some angle turns by the opposite angle: the vector part of the quaternion is
        mirrored and negated.

        Examples
        --------
        >>> UNREAL.pose(Transform((1.0, 0.0, 0.0), (0.0, 0.0, 0.6, 0.8)))[1]
        (0.0, 0.0, -0.6, 0.8)
        """
        x, y, z = (self.points(pose.translation)).tolist()
        i, j, k = (pose.rotation[axis] * -sign for axis, sign in self.axes)
        return (x, y, z), (i + 0.0, j + 0.0, k + 0.0, pose.rotation[3])

    def pose_back(self, position: Numbers, rotation: Numbers) -> Transform:
        """The pose of ROS for a position and a quaternion (x, y, z, w) of that world.

        Examples
        --------
        >>> UNREAL.pose_back((100.0, 0.0, 0.0), (0.0, 0.0, -0.6, 0.8)).rotation[2]
        0.6
        """
        vector = {axis: rotation[place] * -sign for place, (axis, sign) in enumerate(self.axes)}
        return Transform(self.points_back(position).tolist(), (vector[0], vector[1], vector[2], rotation[3]))

    @staticmethod
    def triangles(indices: npt.ArrayLike) -> npt.NDArray[Any]:
        """The corners of triangles, shape (n, 3), in the other order: a mirrored triangle shows its back otherwise.

        Examples
        --------
        >>> UNITY.triangles([[0, 1, 2]])
        array([[2, 1, 0]])
        """
        return np.asarray(indices)[:, ::-1]


UNITY = LeftHandedWorld(((1, -1.0), (2, 1.0), (0, 1.0)))
"""x right, y up, z forward, in m."""
UNREAL = LeftHandedWorld(((0, 1.0), (1, -1.0), (2, 1.0)), 100.0)
"""x forward, y right, z up, in cm."""
