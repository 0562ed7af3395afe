"""`Transform`, a rigid transform.

A `Transform` maps points of one frame into another: ``p_target = target_from_source.apply(p_source)``, and equal
neighbours cancel in ``map_from_base @ base_from_lidar``. Quaternions are ``(x, y, z, w)``; transforms3d, which does the
conversions, has ``w`` first, so every crossing says ``wxyz``. It is imported where it is used: programs that need no
conversion start sooner without it.

A transform holds one tuple of seven floats, a row; `tfbus.rows` has the arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypedDict, Unpack, overload

import numpy as np
import numpy.typing as npt

from tfbus.errors import InvalidTransformError
from tfbus.plain import from_fields, schema_of
from tfbus.rows import (
    IDENTITY,
    NORM_TOLERANCE,
    ROUNDING,
    Numbers,
    Quaternion,
    Row,
    Vector,
    as_floats,
    as_rotation,
    as_vector,
    interpolate,
    rotate,
)
from tfbus.stamps import as_array
from tfbus.which_kernel import compose_rows, fill_matrix, invert_row, move_point, move_points, row_of_matrix

_KINDS = {"translation": Vector, "rotation": Quaternion}


class Changes(TypedDict, total=False):
    """The fields of a `Transform`, as `copy.replace` takes them."""

    translation: Numbers
    rotation: Numbers


class Transform:
    """A rotation followed by a translation; immutable and hashable.

    Parameters
    ----------
    translation : sequence of 3 floats
        In m.
    rotation : sequence of 4 floats
        Unit quaternion (x, y, z, w). A norm within 1 % of one is normalised; the sign stays as given.

    Raises
    ------
    InvalidTransformError
        If a number is not finite, a length is wrong, or the norm is off by more than 1 %.

    Examples
    --------
    >>> base_from_laser = Transform((0.1, 0.0, 0.2))
    >>> base_from_laser.apply((1.0, 0.2, 0.0))
    (1.1, 0.2, 0.2)
    """

    __slots__ = ("_row",)
    __match_args__ = ("translation", "rotation")
    _row: Row

    def __init__(
        self,
        translation: Numbers = (0.0, 0.0, 0.0),
        rotation: Numbers = (0.0, 0.0, 0.0, 1.0),
    ) -> None:
        if type(translation) is tuple and type(rotation) is tuple and len(translation) == 3 and len(rotation) == 4:
            x, y, z = translation
            i, j, k, w = rotation
            if type(x) is type(y) is type(z) is type(i) is type(j) is type(k) is type(w) is float:
                # The usual case. `as_vector` and `as_rotation` check the same, and take eight times as long.
                # Zero times a float is zero unless the float is infinite or NaN; this check needs no call.
                error = i * i + j * j + k * k + w * w - 1.0
                if -ROUNDING <= error <= ROUNDING and 0.0 * x + 0.0 * y + 0.0 * z == 0.0:
                    self._row = x, y, z, i, j, k, w
                    return
        self._row = (*as_vector(translation, "translation"), *as_rotation(rotation, "rotation"))

    @classmethod
    def identity(cls) -> Transform:
        """The transform that changes nothing.

        Examples
        --------
        >>> Transform.identity() @ Transform((1.0, 0.0, 0.0))
        Transform(translation=(1.0, 0.0, 0.0), rotation=(0.0, 0.0, 0.0, 1.0))
        """
        return from_row(IDENTITY)

    @classmethod
    def from_wxyz(cls, translation: Numbers, wxyz: Numbers) -> Transform:
        """From a translation in m and a unit quaternion in transforms3d's order, (w, x, y, z).

        Examples
        --------
        >>> Transform.from_wxyz((1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)).rotation
        (0.0, 0.0, 0.0, 1.0)
        """
        w, x, y, z = as_floats(wxyz, 4, "rotation")
        return cls(translation, (x, y, z, w))

    @classmethod
    def from_matrix(cls, matrix: npt.ArrayLike) -> Transform:
        """From a homogeneous matrix of shape (4, 4).

        The quaternion has w >= 0. If the rotation part is within 1 % of a rotation, it is projected on the nearest one
        (Bar-Itzhack 2000, as transforms3d does it); within 1e-14, its quaternion is read from its elements.

        Raises
        ------
        InvalidTransformError
            If the shape is not (4, 4), a number is not finite, the last row is not (0, 0, 0, 1), or the rotation part
            is not a rotation.

        Examples
        --------
        >>> Transform.from_matrix(np.eye(4)) == Transform.identity()
        True
        """
        m = as_array(matrix, "matrix", np.float64)
        row = row_of_matrix(m)
        if row is not None:
            return from_row(row)
        from transforms3d.quaternions import mat2quat

        if m.shape != (4, 4):
            raise InvalidTransformError(f"matrix must have shape (4, 4), got {m.shape}", reason="wrong length")
        if not np.isfinite(m).all():
            raise InvalidTransformError(f"matrix {m.tolist()} is not finite", reason="not finite")
        r = m[:3, :3]
        if np.abs(m[3] - (0.0, 0.0, 0.0, 1.0)).max() > NORM_TOLERANCE:
            raise InvalidTransformError(f"matrix is not rigid: its last row is {m[3]}", reason="not a rotation")
        if np.abs(r @ r.T - np.eye(3)).max() > 2 * NORM_TOLERANCE or np.linalg.det(r) < 0:
            raise InvalidTransformError(
                f"matrix is not rigid: no rotation is near {r.tolist()}", reason="not a rotation"
            )
        return cls.from_wxyz(m[:3, 3], mat2quat(r))

    @classmethod
    def from_xyz_rpy(cls, xyz: Numbers, rpy: Numbers, *, degrees: bool = False) -> Transform:
        """From a translation in m and roll, pitch, yaw about the fixed axes x, y, z, as in URDF.

        Parameters
        ----------
        xyz : sequence of 3 floats
            In m.
        rpy : sequence of 3 floats
            In rad.
        degrees : bool
            Whether `rpy` is in degrees instead.

        Raises
        ------
        InvalidTransformError
            If a number is not finite, or a length is wrong.

        Examples
        --------
        >>> Transform.from_xyz_rpy((0.1, 0.0, 0.2), (0.0, 0.0, 180.0), degrees=True).apply((1.0, 0.0, 0.0))
        (-0.9, 1.2246467991473532e-16, 0.2)
        """
        from transforms3d.euler import euler2quat

        roll, pitch, yaw = as_floats(rpy, 3, "rpy")
        if degrees:
            roll, pitch, yaw = map(math.radians, (roll, pitch, yaw))
        return cls.from_wxyz(xyz, euler2quat(roll, pitch, yaw, "sxyz"))

    @classmethod
    def from_euler(
        cls, sequence: str, angles: Numbers, translation: Numbers = (0.0, 0.0, 0.0), *, degrees: bool = False
    ) -> Transform:
        """From three rotations about axes, one after another, and a translation in m.

        Parameters
        ----------
        sequence : str
            The three axes, as in SciPy: ``"ZYX"`` turns about z, then about the new y, then about the new x;
            ``"xyz"`` turns about the fixed x, then the fixed y, then the fixed z. Neighbours differ.
        angles : sequence of 3 floats
            In rad, in the order of `sequence`.
        translation : sequence of 3 floats
            In m.
        degrees : bool
            Whether `angles` are in degrees instead.

        Raises
        ------
        ValueError
            If `sequence` is none.
        InvalidTransformError
            If a number is not finite, or a length is wrong.

        Examples
        --------
        >>> Transform.from_euler("ZYX", (90.0, 0.0, 0.0), degrees=True).is_close(
        ...     Transform.from_xyz_rpy((0.0, 0.0, 0.0), (0.0, 0.0, 90.0), degrees=True))
        True
        """
        from transforms3d.euler import euler2quat

        code = f"r{sequence.lower()}" if sequence.isupper() else f"s{sequence}" if sequence.islower() else ""
        first, second, third = as_floats(angles, 3, "angles")
        if degrees:
            first, second, third = map(math.radians, (first, second, third))
        try:
            wxyz = euler2quat(first, second, third, code)
        except KeyError:
            raise ValueError(
                f"sequence must be three axes, such as 'ZYX' or 'xyz', whose neighbours differ, not {sequence!r}"
            ) from None
        return cls.from_wxyz(translation, wxyz)

    @classmethod
    def from_axis_angle(cls, axis: Numbers, angle: float, translation: Numbers = (0.0, 0.0, 0.0)) -> Transform:
        """From a rotation by `angle` (rad) about `axis` (any length but zero), and a translation in m.

        Examples
        --------
        >>> turn = Transform.from_axis_angle((0.0, 0.0, 1.0), np.pi / 2)
        >>> turn.is_close(Transform.from_xyz_rpy((0.0, 0.0, 0.0), (0.0, 0.0, 90.0), degrees=True))
        True
        """
        from transforms3d.quaternions import axangle2quat

        x, y, z = as_floats(axis, 3, "axis")
        length = math.hypot(x, y, z)
        if length == 0.0:
            raise InvalidTransformError(f"axis {(x, y, z)} has no direction", reason="zero axis")
        if not math.isfinite(angle):
            raise InvalidTransformError(f"angle {angle!r} is not finite", reason="not finite")
        return cls.from_wxyz(translation, axangle2quat((x / length, y / length, z / length), angle, True))

    @classmethod
    def from_scipy(cls, translation: Numbers, rotation: Any) -> Transform:
        """From a translation in m and one ``scipy.spatial.transform.Rotation``.

        Examples
        --------
        >>> from scipy.spatial.transform import Rotation
        >>> half_turn = Rotation.from_euler("z", 180.0, degrees=True)
        >>> Transform.from_scipy((1.0, 0.0, 0.0), half_turn).apply((1.0, 0.0, 0.0))[0]
        0.0
        """
        return cls(translation, rotation.as_quat())

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Transform:
        """The transform from which `to_dict` made `data`; `ValueError` if the data are not a transform.

        Examples
        --------
        >>> Transform.from_dict({"translation": [1, 2, 3], "rotation": [0, 0, 0, 1]}).translation
        (1.0, 2.0, 3.0)
        """
        return cls(**from_fields(cls, data, _KINDS))

    @classmethod
    def __get_pydantic_core_schema__(cls, _source: Any, handler: Any) -> Any:
        return schema_of(Transform, _KINDS, {"type": None}, handler)

    def __replace__(self, **changes: Unpack[Changes]) -> Transform:
        fields: Changes = {"translation": self.translation, "rotation": self.rotation}
        fields.update(changes)
        return Transform(**fields)

    @property
    def translation(self) -> Vector:
        """(x, y, z) in m."""
        return self._row[:3]

    @property
    def rotation(self) -> Quaternion:
        """Unit quaternion (x, y, z, w)."""
        return self._row[3:]

    def as_wxyz(self) -> Quaternion:
        """The rotation in transforms3d's order, (w, x, y, z).

        Examples
        --------
        >>> Transform().as_wxyz()
        (1.0, 0.0, 0.0, 0.0)
        """
        return self._row[6], *self._row[3:6]

    def as_rpy(self) -> Vector:
        """Roll, pitch, yaw in rad about the fixed axes x, y, z; at a pitch of 90 degrees yaw is 0.

        Sum and difference of roll and yaw are computed from the quaternion (Bernardes and Viollet, "Quaternion to
        Euler angles conversion", PLoS ONE 17(11), 2022): computed from a matrix, as in transforms3d, they are
        wrong by up to half a rad within 1e-8 rad of that pitch.

        Examples
        --------
        >>> Transform().as_rpy()
        (0.0, 0.0, 0.0)
        """
        x, y, z, w = self.rotation
        low, high = math.hypot(x + z, w - y), math.hypot(x - z, w + y)
        half_sum, half_difference = math.atan2(x + z, w - y), math.atan2(x - z, w + y)
        if low <= ROUNDING:
            half_sum = half_difference
        elif high <= ROUNDING:
            half_difference = half_sum
        roll = math.remainder(half_sum + half_difference, math.tau)
        yaw = math.remainder(half_sum - half_difference, math.tau)
        return roll, math.pi / 2.0 - 2.0 * math.atan2(low, high), yaw

    def as_axis_angle(self) -> tuple[Vector, float]:
        """Unit axis and angle in rad, from 0 to pi; the axis of no rotation is (1, 0, 0).

        The angle comes from ``atan2``: ``acos``, which transforms3d uses, loses half the digits near the identity.

        Examples
        --------
        >>> Transform((0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)).as_axis_angle()
        ((0.0, 0.0, 1.0), 3.141592653589793)
        """
        x, y, z, w = self.rotation
        sine = math.hypot(x, y, z)
        if sine == 0.0:
            return (1.0, 0.0, 0.0), 0.0
        length = math.copysign(sine, w)
        return (x / length, y / length, z / length), 2.0 * math.atan2(sine, abs(w))

    def as_scipy(self) -> Any:
        """The rotation as a ``scipy.spatial.transform.Rotation``.

        Raises
        ------
        ImportError
            If scipy is not installed.

        Examples
        --------
        >>> turn = Transform.from_xyz_rpy((0.0, 0.0, 0.0), (0.0, 0.0, 90.0), degrees=True)
        >>> turn.as_scipy().as_euler("xyz", degrees=True).round(6) + 0.0
        array([ 0.,  0., 90.])
        """
        from scipy.spatial.transform import Rotation

        return Rotation.from_quat(self.rotation)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON: ``"translation"`` [x, y, z] in m and ``"rotation"`` [x, y, z, w].

        Examples
        --------
        >>> Transform((1.0, 2.0, 3.0)).to_dict()
        {'translation': [1.0, 2.0, 3.0], 'rotation': [0.0, 0.0, 0.0, 1.0]}
        """
        return {"translation": list(self.translation), "rotation": list(self.rotation)}

    def matrix(self) -> npt.NDArray[np.float64]:
        """A new homogeneous matrix of shape (4, 4).

        Examples
        --------
        >>> Transform((1.0, 2.0, 3.0)).matrix()[:3, 3]
        array([1., 2., 3.])
        """
        return fill_matrix(self._row, np.empty((4, 4)))

    def inverse(self) -> Transform:
        """The transform that undoes this one.

        Examples
        --------
        >>> Transform((1.0, 2.0, 3.0)).inverse().translation
        (-1.0, -2.0, -3.0)
        """
        return from_row(invert_row(self._row))

    def __matmul__(self, other: Transform) -> Transform:
        if not isinstance(other, Transform):
            return NotImplemented
        return from_row(compose_rows(self._row, other._row))

    @overload
    def apply(self, points: npt.NDArray[Any]) -> npt.NDArray[Any]: ...
    @overload
    def apply(self, points: Sequence[float]) -> Vector: ...
    def apply(self, points: Sequence[float] | npt.NDArray[Any]) -> Vector | npt.NDArray[Any]:
        """Map points of the source frame into the target frame.

        Parameters
        ----------
        points : sequence of 3 floats, or array of shape (..., 3)
            In m. Arrays of float32 stay float32; integers become float64. Numbers that are not finite stay so.

        Returns
        -------
        tuple of 3 floats, or a new array of the same shape

        Raises
        ------
        ValueError
            If the shape does not end in 3. The message has the shape.

        Examples
        --------
        >>> Transform((1.0, 0.0, 0.0)).apply(np.zeros((2, 3)))
        array([[1., 0., 0.],
               [1., 0., 0.]])
        """
        moved = move_point(self._row, points)
        if moved is not None:
            return moved
        if not isinstance(points, np.ndarray):
            if len(points) != 3:
                raise ValueError(f"a point is three numbers, got shape ({len(points)},); points go in an array")
            x, y, z = points
            tx, ty, tz = self._row[:3]
            try:
                rx, ry, rz = rotate(self.rotation, x, y, z)
            except TypeError:
                raise ValueError(f"a point is three numbers, not {points!r}; points go in an array") from None
            return float(tx + rx), float(ty + ry), float(tz + rz)
        points = as_array(points, "points")
        if points.ndim == 0 or points.shape[-1] != 3:
            raise ValueError(f"points must have shape (..., 3), got {points.shape}")
        points = np.ascontiguousarray(points, points.dtype if points.dtype.kind == "f" else np.float64)
        out = np.empty_like(points)
        if not move_points(self._row, points, out):
            # The compiled kernel takes no such floats. Other processes need no memory for the kernel in Python.
            from tfbus import _python_kernel

            _python_kernel.move_points(self._row, points, out)
        return out

    def interpolate(self, other: Transform, fraction: float) -> Transform:
        """The transform a `fraction` of the way to `other`: translation linear, rotation along the shorter arc.

        Raises
        ------
        ValueError
            If `fraction` is not from 0 to 1: nothing here extrapolates by itself.

        Examples
        --------
        >>> Transform().interpolate(Transform((1.0, 0.0, 0.0)), 0.25).translation
        (0.25, 0.0, 0.0)
        """
        if not 0.0 <= fraction <= 1.0:
            raise ValueError(f"fraction must be from 0 to 1, got {fraction!r}")
        return from_row(interpolate(self._row, other._row, float(fraction)))

    def is_close(
        self, other: Transform, *, translation_tolerance: float = 1e-9, rotation_tolerance: float = 1e-9
    ) -> bool:
        """Whether the transforms are equal within tolerances; quaternions are compared up to their sign.

        Parameters
        ----------
        translation_tolerance : float
            Greatest distance in m.
        rotation_tolerance : float
            Greatest angle between the rotations in rad.

        Examples
        --------
        >>> Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)).is_close(Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, -1.0)))
        True
        """
        if math.dist(self.translation, other.translation) > translation_tolerance:
            return False
        return (self.inverse() @ other).as_axis_angle()[1] <= rotation_tolerance

    def __eq__(self, other: object) -> bool:
        return self._row == other._row if isinstance(other, Transform) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._row)

    def __repr__(self) -> str:
        return f"Transform(translation={self.translation}, rotation={self.rotation})"


def from_row(row: Row) -> Transform:
    """The transform of a valid row; nothing is checked."""
    transform = Transform.__new__(Transform)
    transform._row = row
    return transform
