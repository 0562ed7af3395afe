"""`Joint`, the motion of one link of a robot relative to another."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from numbers import Real
from typing import Literal, TypeAlias, get_args

from tfbus.errors import InvalidRobotError, InvalidTransformError
from tfbus.geometry.transform import Transform, from_row
from tfbus.rows import Numbers, Quaternion, Row, Vector, as_vector, compose, rotate

JointKind: TypeAlias = Literal["fixed", "revolute", "continuous", "prismatic", "planar", "floating"]
Position: TypeAlias = float | Sequence[float] | Transform

KINDS: tuple[JointKind, ...] = get_args(JointKind)


@dataclass(frozen=True, slots=True)
class Mimic:
    """A joint that follows another: its position is `multiplier` times that of `joint`, plus `offset` (rad or m)."""

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, slots=True)
class Joint:
    """A joint between a parent link and a child link, as in URDF.

    Parameters
    ----------
    name : str
    kind : {"fixed", "revolute", "continuous", "prismatic", "planar", "floating"}
    parent, child : str
        The links, whose names are those of their frames.
    origin : Transform
        The pose of the child in the parent at position zero.
    axis : tuple of 3 floats
        The axis of rotation, the direction of sliding, or the normal of the plane, in the coordinates of the child at
        position zero. Any length but zero; it is normalised. Fixed and floating joints ignore it.
    lower, upper : float, optional
        The limits of the position, in rad or m. Violations are reported, never prevented.
    mimic : Mimic, optional
        The joint that this one follows when it has no position of its own.

    Raises
    ------
    InvalidRobotError
        If the kind is unknown, the axis is zero or not finite, or a limit or a number of the mimic is NaN.

    Notes
    -----
    A planar joint has the coordinates x and y in m and an angle in rad about the axis. URDF does not define the
    directions of x and y: here they are those of the child at position zero, rotated by the shortest rotation that
    takes z to the axis. So for the usual axis z they are just x and y.
    """

    name: str
    kind: JointKind
    parent: str
    child: str
    origin: Transform = field(default_factory=Transform)
    axis: Vector = (1.0, 0.0, 0.0)
    lower: float | None = None
    upper: float | None = None
    mimic: Mimic | None = None
    # The part of the rotation that is multiplied by the sine of half the angle; the axis in the parent's frame.
    _sine_part: Quaternion = field(init=False, repr=False, compare=False)
    _axis_in_parent: Vector = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise self._invalid(f"type {self.kind!r} is none of {', '.join(KINDS)}")
        numbers = [self.lower, self.upper] + ([self.mimic.multiplier, self.mimic.offset] if self.mimic else [])
        if any(number is not None and math.isnan(number) for number in numbers):
            raise self._invalid("a limit or the mimic is NaN")
        axis = (1.0, 0.0, 0.0) if self.kind in ("fixed", "floating") else self._unit(self.axis)
        object.__setattr__(self, "axis", axis)
        x, y, z = axis
        turn = (0.0, 0.0, 0.0, *self.origin.rotation)
        object.__setattr__(self, "_sine_part", compose(turn, (0.0, 0.0, 0.0, x, y, z, 0.0))[3:])
        object.__setattr__(self, "_axis_in_parent", rotate(self.origin.rotation, x, y, z))

    @property
    def element(self) -> str:
        """The label of the joint in errors: ``<joint name="elbow">``."""
        return element("joint", self.name)

    @property
    def zero(self) -> Position:
        """The position in which the pose of the child is the joint's origin."""
        if self.kind == "planar":
            return 0.0, 0.0, 0.0
        return Transform() if self.kind == "floating" else 0.0

    def transform(self, position: Position = 0.0) -> Transform:
        """The pose of the child in the parent.

        Parameters
        ----------
        position : float, sequence of floats, or Transform
            rad for a revolute or continuous joint, m for a prismatic one; (x, y, angle) for a planar one;
            (x, y, z, qx, qy, qz, qw) or a transform for a floating one. A fixed joint ignores it.

        Raises
        ------
        InvalidTransformError
            If the position is not finite, has a wrong length, or holds no unit quaternion. The message has the joint's
            name.
        TypeError
            If the position has a type that the kind of joint does not accept.
        """
        return from_row(self.row(position))

    def row(self, position: Position) -> Row:
        """The row of `transform`; faster for many joints."""
        kind = self.kind
        x, y, z, i, j, k, w = self.origin._row
        if kind == "revolute" or kind == "continuous":
            half = 0.5 * self.number(position)
            sine, cosine = math.sin(half), math.cos(half)
            a, b, c, d = self._sine_part
            return (
                x,
                y,
                z,
                cosine * i + sine * a,
                cosine * j + sine * b,
                cosine * k + sine * c,
                cosine * w + sine * d,
            )
        if kind == "fixed":
            return self.origin._row
        if kind == "prismatic":
            length = self.number(position)
            a, b, c = self._axis_in_parent
            row = (x + length * a, y + length * b, z + length * c, i, j, k, w)
        else:
            row = compose(self.origin._row, self._planar(position) if kind == "planar" else self._floating(position))
        if not all(map(math.isfinite, row[:3])):
            raise self._bad_position(f"position {position!r} takes it further than a float can tell", "not finite")
        return row

    def number(self, position: Position) -> float:
        """Convert a position to one finite number.

        Raises
        ------
        InvalidTransformError, TypeError
            As `transform`.
        """
        if type(position) is not float:
            if not isinstance(position, Real):
                raise TypeError(f"joint {self.name!r}: position must be a number, not {position!r}")
            try:
                position = float(position)
            except OverflowError:
                position = math.inf
        if not math.isfinite(position):
            raise self._bad_position(f"position {position!r} is not finite", "not finite")
        return position

    def _planar(self, position: Position) -> Row:
        try:
            x, y, angle = as_vector(position, "position")
        except (TypeError, InvalidTransformError) as error:
            raise self._named(error) from None
        i, j, k = self.axis
        sine = math.sin(0.5 * angle)
        return (*rotate(_from_z(self.axis), x, y, 0.0), sine * i, sine * j, sine * k, math.cos(0.5 * angle))

    def _floating(self, position: Position) -> Row:
        if isinstance(position, Transform):
            return position._row
        try:
            numbers = tuple(position)  # type: ignore[arg-type]  # the TypeError is caught below
            return Transform(numbers[:3], numbers[3:])._row
        except TypeError:
            raise TypeError(
                f"joint {self.name!r}: position must be a Transform or 7 numbers, not {position!r}"
            ) from None
        except InvalidTransformError as error:
            raise self._named(error) from None

    def _unit(self, axis: Numbers) -> Vector:
        try:
            x, y, z = as_vector(axis, "axis")
        except InvalidTransformError as error:
            raise self._invalid(str(error)) from None
        length = math.hypot(x, y, z)
        if length == 0.0:
            raise self._invalid(f"axis {(x, y, z)} has no direction")
        return x / length, y / length, z / length

    def _invalid(self, problem: str) -> InvalidRobotError:
        return InvalidRobotError(problem, element=self.element)

    def _bad_position(self, problem: str, reason: str) -> InvalidTransformError:
        return InvalidTransformError(
            f"joint {self.name!r}: {problem}", reason=reason, parent=self.parent, child=self.child
        )

    def _named(self, error: TypeError | InvalidTransformError) -> TypeError | InvalidTransformError:
        if isinstance(error, InvalidTransformError):
            return self._bad_position(str(error), error.reason)
        return TypeError(f"joint {self.name!r}: {error}")


def element(tag: str, name: str | None) -> str:
    """The label of a URDF element in errors, on one line."""
    if name is None:
        return f"<{tag}>"
    quoted = repr(name)[1:-1].replace('"', '\\"')
    return f'<{tag} name="{quoted}">'


def _from_z(axis: Vector) -> Quaternion:
    """The shortest rotation that takes z to a unit vector; for -z, the half turn about x."""
    x, y, z = axis
    # Near -z, 1 + z would lose its digits; x and y keep theirs.
    w = 1.0 + z if z > 0.0 else (x * x + y * y) / (1.0 - z)
    norm = math.hypot(x, y, w)
    return (-y / norm, x / norm, 0.0, w / norm) if norm else (1.0, 0.0, 0.0, 0.0)
