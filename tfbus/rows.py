"""The arithmetic of rigid transforms, on rows.

A *row* is one transform as a tuple of seven floats: ``(tx, ty, tz, qx, qy, qz, qw)``. `compose`, `invert` and `rotate`
take arrays in place of floats as well. The kernel of the lookup repeats this arithmetic in one loop; these functions
are its readable definition.
"""

import math
from collections.abc import Sequence
from typing import Any, TypeAlias, overload

import numpy as np
import numpy.typing as npt

from tfbus.errors import InvalidTransformError
from tfbus.stamps import as_array

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]
Numbers: TypeAlias = Sequence[float] | npt.NDArray[Any]
Row: TypeAlias = tuple[float, float, float, float, float, float, float]

NORM_TOLERANCE = 0.01
"""The largest accepted distance of a quaternion's norm from one; such a quaternion is normalised."""
ROUNDING = 1e-15
"""The largest distance of a quaternion's squared norm from one at which the quaternion is left as it is."""
IDENTITY: Row = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)

Columns: TypeAlias = tuple[Any, Any, Any, Any, Any, Any, Any]
"""Many rows as seven columns: each an array, or a float if all rows have the same number there."""

RawColumns: TypeAlias = tuple[Any, int, Any, int, int, int]
"""A buffer and the byte at which stamps begin in it; a buffer and the byte at which rows begin; their width, the
number of floats from one row to the next (the last seven are the row); and the number of samples."""


@overload
def compose(a: Row, b: Row) -> Row: ...


@overload
def compose(a: Columns, b: Columns) -> Columns: ...


def compose(a: Columns, b: Columns) -> Columns:
    """The row of ``a @ b``: first `b`, then `a`."""
    ax, ay, az, ai, aj, ak, aw = a
    bx, by, bz, bi, bj, bk, bw = b
    x, y, z = rotate((ai, aj, ak, aw), bx, by, bz)
    return (
        ax + x,
        ay + y,
        az + z,
        aw * bi + ai * bw + aj * bk - ak * bj,
        aw * bj - ai * bk + aj * bw + ak * bi,
        aw * bk + ai * bj - aj * bi + ak * bw,
        aw * bw - ai * bi - aj * bj - ak * bk,
    )


@overload
def invert(a: Row) -> Row: ...


@overload
def invert(a: Columns) -> Columns: ...


def invert(a: Columns) -> Columns:
    """The row of the inverse: the conjugate rotation, and the translation turned back by it."""
    ax, ay, az, ai, aj, ak, aw = a
    x, y, z = rotate((-ai, -aj, -ak, aw), ax, ay, az)
    return -x, -y, -z, -ai, -aj, -ak, aw


def interpolate(a: Row, b: Row, fraction: float) -> Row:
    """The row a `fraction` of the way from `a` to `b`: translation linear, rotation slerp along the shorter arc.

    Slerp is Shoemake's, "Animating rotation with quaternion curves", SIGGRAPH 1985, section 3.3. There is no switch
    to a straight line near the identity: ``acos``, and the sine of the whole angle as the root of 1 - cos^2, keep all
    digits of a given cosine, so only parallel quaternions, where it would divide by zero, are blended as they are.
    """
    ax, ay, az, ai, aj, ak, aw = a
    bx, by, bz, bi, bj, bk, bw = b
    keep, turn = 1.0 - fraction, fraction
    dot = ai * bi + aj * bj + ak * bk + aw * bw
    if -1.0 < dot < 1.0:
        angle = math.acos(abs(dot))
        scale = 1.0 / math.sqrt((1.0 - dot) * (1.0 + dot))
        keep = math.sin(angle - fraction * angle) * scale
        turn = math.sin(fraction * angle) * scale
    if dot < 0.0:
        turn = -turn
    return (
        ax + fraction * (bx - ax),
        ay + fraction * (by - ay),
        az + fraction * (bz - az),
        keep * ai + turn * bi,
        keep * aj + turn * bj,
        keep * ak + turn * bk,
        keep * aw + turn * bw,
    )


@overload
def rotate(rotation: Quaternion, x: float, y: float, z: float) -> Vector: ...


@overload
def rotate(rotation: tuple[Any, ...], x: Any, y: Any, z: Any) -> tuple[Any, Any, Any]: ...


def rotate(rotation: tuple[Any, ...], x: Any, y: Any, z: Any) -> tuple[Any, Any, Any]:
    """A vector turned by a unit quaternion: v + 2 w (q x v) + 2 q x (q x v)."""
    qx, qy, qz, qw = rotation
    tx = 2.0 * (qy * z - qz * y)
    ty = 2.0 * (qz * x - qx * z)
    tz = 2.0 * (qx * y - qy * x)
    return x + qw * tx + qy * tz - qz * ty, y + qw * ty + qz * tx - qx * tz, z + qw * tz + qx * ty - qy * tx


def as_vector(value: object, name: str) -> Vector:
    """Three finite numbers as a tuple of floats.

    Raises
    ------
    InvalidTransformError
        If there are not three, or one is not finite.
    TypeError
        If they are not numbers.
    """
    x, y, z = as_floats(value, 3, name)
    return x, y, z


def as_rotation(value: object, name: str) -> Quaternion:
    """A unit quaternion (x, y, z, w) as a tuple of floats, normalised; its sign stays.

    Raises
    ------
    InvalidTransformError
        If there are not four finite numbers, or the norm is off by more than 1 %.
    TypeError
        If they are not numbers.
    """
    x, y, z, w = as_floats(value, 4, name)
    square = x * x + y * y + z * z + w * w
    if abs(square - 1.0) <= ROUNDING:
        return x, y, z, w
    norm = math.sqrt(square)
    if norm == 0.0:
        raise InvalidTransformError(f"{name} is the zero quaternion", reason="zero quaternion")
    if not abs(norm - 1.0) <= NORM_TOLERANCE:
        raise InvalidTransformError(
            f"{name} {(x, y, z, w)} is not a unit quaternion: its norm is {norm:.6g}", reason="not a unit quaternion"
        )
    return x / norm, y / norm, z / norm, w / norm


def as_floats(value: object, length: int, name: str) -> tuple[float, ...]:
    """`length` finite numbers as a tuple of floats; raises the errors of `as_vector`."""
    if isinstance(value, (str, bytes)) or not isinstance(value, (Sequence, np.ndarray)):
        raise TypeError(f"{name} must be {length} numbers, not {value!r}")
    if len(value) != length or (isinstance(value, np.ndarray) and value.ndim != 1):
        shape = getattr(value, "shape", (len(value),))
        raise InvalidTransformError(f"{name} must be {length} numbers, got shape {shape}", reason="wrong length")
    if isinstance(value, np.ndarray):
        value = as_array(value, name)
    try:
        finite = all(map(math.isfinite, value))
    except OverflowError:
        finite = False
    except TypeError:
        raise TypeError(f"{name} must be {length} numbers, not {value!r}") from None
    if not finite:
        raise InvalidTransformError(f"{name} {value!r} is not finite", reason="not finite")
    return tuple(map(float, value))
