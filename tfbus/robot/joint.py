"""Joints: how one link of a robot moves against another."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from numbers import Real
from typing import Literal, TypeAlias, get_args

from tfbus.errors import InvalidRobotError, InvalidTransformError
from tfbus.geometry.rows import Numbers, Quaternion, Row, Vector, as_vector, compose, rotate
from tfbus.geometry.transform import Transform, from_row

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
    """Joins a child link to its parent, as URDF has it.

    Parameters
    ----------
    name : str
    kind : {"fixed", "revolute", "continuous", "prismatic", "planar", "floating"}
    parent, child : str
        Links, which are the names of their frames.
    origin : Transform
        Where the child is, seen from the parent, when the joint is at zero.
    axis : sequence of 3 floats
        What a joint turns about, slides along, or what its plane is normal to, in the coordinates of the child at zero.
        Any length but zero; it is made one. Fixed and floating joints have none that counts.
    lower, upper : float, optional
        The positions between which it is meant to stay, in rad or m. They are reported on, never enforced.
    mimic : Mimic, optional
        The joint that it follows where it is given no position of its own.

    Raises
    ------
    InvalidRobotError
        If the kind is none of these, the axis is zero or not finite, or a limit or the mimic is not a number.

    Notes
    -----
    A planar joint has the coordinates x and y in m and an angle in rad about the axis. URDF leaves open where its x and
    y point: here they are those of the child at zero, turned on the shortest way that takes z to the axis; so for the
    usual axis z they are just x and y.
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
    # Of the quaternion at an angle, what is multiplied by the sine of its half; the direction in the parent's frame.
    _swing: Quaternion = field(init=False, repr=False, compare=False)
    _slide: Vector = field(init=False, repr=False, compare=False)

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
        object.__setattr__(self, "_swing", compose(turn, (0.0, 0.0, 0.0, x, y, z, 0.0))[3:])
        object.__setattr__(self, "_slide", rotate(self.origin.rotation, x, y, z))

    @property
    def element(self) -> str:
        """How errors call it: ``<joint name="elbow">``."""
        return element("joint", self.name)

    @property
    def zero(self) -> Position:
        """The position at which the child is at the joint's origin."""
        if self.kind == "planar":
            return 0.0, 0.0, 0.0
        return Transform() if self.kind == "floating" else 0.0

    def transform(self, position: Position = 0.0) -> Transform:
        """Where the child is, seen from the parent.

        Parameters
        ----------
        position : float, sequence of floats, or Transform
            rad for a revolute or continuous joint, m for a prismatic one; (x, y, angle) for a planar one;
            (x, y, z, qx, qy, qz, qw) or a transform for a floating one. A fixed joint takes no notice of it.

        Raises
        ------
        InvalidTransformError
            If it is not finite, has a wrong length, or holds no unit quaternion. The message has the joint's name.
        TypeError
            If it is of a type that such a joint has no use for.
        """
        return from_row(self.row(position))

    def row(self, position: Position) -> Row:
        """As `transform`, as a row: for those who need many."""
        kind = self.kind
        x, y, z, i, j, k, w = self.origin._row
        if kind == "revolute" or kind == "continuous":
            half = 0.5 * self.number(position)
            sine, cosine = math.sin(half), math.cos(half)
            a, b, c, d = self._swing
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
            a, b, c = self._slide
            row = (x + length * a, y + length * b, z + length * c, i, j, k, w)
        else:
            row = compose(self.origin._row, self._planar(position) if kind == "planar" else self._floating(position))
        if not all(map(math.isfinite, row[:3])):
            raise self._bad_position(f"position {position!r} takes it further than a float can tell", "not finite")
        return row

    def number(self, position: Position) -> float:
        """A position that is to be one finite number.

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
            numbers = tuple(position)  # type: ignore[arg-type]  # what cannot be one is told below
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
    """An element of a robot's description as errors show it, in one line."""
    if name is None:
        return f"<{tag}>"
    quoted = repr(name)[1:-1].replace('"', '\\"')
    return f'<{tag} name="{quoted}">'


def _from_z(axis: Vector) -> Quaternion:
    """The shortest rotation that takes z to a unit vector; of all half turns to -z, that about x."""
    x, y, z = axis
    # Near -z, where 1 + z has no digits left, the rest of the length has them all.
    w = 1.0 + z if z > 0.0 else (x * x + y * y) / (1.0 - z)
    norm = math.hypot(x, y, w)
    return (-y / norm, x / norm, 0.0, w / norm) if norm else (1.0, 0.0, 0.0, 0.0)
