"""`RobotModel`, a robot as a tree of links and joints, and the reader of URDF, which describes robots.

A `Joint` gives the pose of its child link for a position; a `RobotModel` gives the samples of all joints.
urdf-parser-py interprets the elements of a URDF, but prints a complaint to standard error for each unknown one, and
fails at the legacy transmissions of real robots. So it gets one element at a time, reduced to the parts that it knows.
The XML itself is parsed here, with limits, because files may come from untrusted sources.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Real
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias, get_args
from xml.etree import ElementTree as ET
from xml.etree.ElementTree import Element

from tfbus.errors import InvalidRobotError, InvalidTransformError, pip_install
from tfbus.frames import is_frame
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import Transform, from_row
from tfbus.rows import Numbers, Quaternion, Row, Vector, as_vector, compose, rotate
from tfbus.stamps import StampLike

JointKind: TypeAlias = Literal["fixed", "revolute", "continuous", "prismatic", "planar", "floating"]
Position: TypeAlias = float | Sequence[float] | Transform

KINDS: tuple[JointKind, ...] = get_args(JointKind)


@dataclass(frozen=True, slots=True)
class Mimic:
    """A joint follows another: its position is `multiplier` times the position of `joint`, plus `offset` (rad or m).

    Examples
    --------
    >>> finger = Joint("left", "prismatic", "hand", "left_finger", mimic=Mimic("right", multiplier=-1.0))
    >>> finger.mimic.joint
    'right'
    """

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
        The links; each has a frame of the same name.
    origin : Transform
        The pose of the child in the parent at position zero.
    axis : tuple of 3 floats
        The axis of rotation, the direction of sliding, or the normal of the plane, in the coordinates of the child at
        position zero. Any length but zero; it is normalised. Fixed and floating joints ignore it.
    lower, upper : float, optional
        The limits of the position, in rad or m. Violations are reported, never prevented.
    mimic : Mimic, optional
        The joint that this joint follows when it has no position of its own.

    Raises
    ------
    InvalidRobotError
        If the kind is unknown, the axis is zero or not finite, or a limit or a number of the mimic is NaN.

    Notes
    -----
    A planar joint has the coordinates x and y in m and an angle in rad about the axis. URDF does not define the
    directions of x and y. Here they are the child's x and y at position zero, turned by the shortest rotation from z to
    the axis. For the usual axis z, they are simply x and y.

    Examples
    --------
    >>> Joint("elbow", "revolute", "upper", "lower", axis=(0.0, 0.0, 1.0), lower=-1.0, upper=1.0).kind
    'revolute'
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
            If the position is not finite, has a wrong length, or its quaternion is not a unit quaternion. The message
            has the joint's name.
        TypeError
            If the position has a type that the kind of joint does not accept.

        Examples
        --------
        >>> Joint("slide", "prismatic", "rail", "cart", axis=(1.0, 0.0, 0.0)).transform(0.5).translation
        (0.5, 0.0, 0.0)
        """
        return from_row(self.row(position))

    def row(self, position: Position) -> Row:
        """The row of `transform`; faster for many joints.

        Examples
        --------
        >>> Joint("slide", "prismatic", "rail", "cart", axis=(1.0, 0.0, 0.0)).row(0.5)
        (0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        """
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

        Examples
        --------
        >>> Joint("slide", "prismatic", "rail", "cart", axis=(1.0, 0.0, 0.0)).number(0.5)
        0.5
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


MAX_DEPTH = 100
"""The deepest accepted nesting of elements; URDF needs less than ten."""

READ_ELEMENTS = ("link", "joint", "material")
KNOWN_PARTS = {
    "robot": "name version",
    "link": "name, inertial visual collision",
    "joint": "name type, origin axis parent child limit dynamics safety_controller calibration mimic",
    "material": "name, color texture",
    "inertial": ", origin mass inertia",
    "visual": "name, origin geometry material",
    "collision": "name, origin geometry",
    "geometry": ", box cylinder sphere mesh",
    "origin": "xyz rpy",
    "axis": "xyz",
    "parent": "link",
    "child": "link",
    "limit": "effort lower upper velocity",
    "dynamics": "damping friction",
    "safety_controller": "k_velocity k_position soft_lower_limit soft_upper_limit",
    "calibration": "rising falling",
    "mimic": "joint multiplier offset",
    "mass": "value",
    "inertia": "ixx ixy ixz iyy iyz izz",
    "box": "size",
    "cylinder": "radius length",
    "sphere": "radius",
    "mesh": "filename scale",
    "color": "rgba",
    "texture": "filename",
}
"""The attributes of each element that urdf-parser-py reads, and after a comma the elements inside of it."""

REPEATABLE = {"visual", "collision"}
REQUIRED_ATTRIBUTES = {"parent": "link", "child": "link", "axis": "xyz", "mass": "value"}
"""Required attributes that urdf-parser-py does not check."""

XACRO_TAGS = {"arg", "attribute", "call", "element", "if", "include", "insert_block", "macro", "property", "unless"}


class Urdf(NamedTuple):
    """The links and joints of a URDF, in the order of the file."""

    name: str
    links: tuple[str, ...]
    joints: tuple[Joint, ...]


class Described(NamedTuple):
    """One element of a robot, as urdf-parser-py interprets it."""

    tag: str
    label: str
    """For errors."""
    value: Any


def read_urdf(source: str | os.PathLike[str]) -> Urdf:
    """Read the links and joints of a URDF; the source and the errors are as in `read_elements`."""
    name, elements = read_elements(source)
    links = tuple(each.value.name for each in elements if each.tag == "link")
    return Urdf(name, links, tuple(_joint(each.value, each.label) for each in elements if each.tag == "joint"))


def read_elements(source: str | os.PathLike[str]) -> tuple[str, list[Described]]:
    """Read the name of a robot, and its links, joints and materials in the order of the file.

    Parameters
    ----------
    source : str or path
        The text itself if it is a string with a ``<`` in it, otherwise the path of the file.

    Raises
    ------
    InvalidRobotError
        If the source is not XML or not URDF, or an element is malformed. The message names the element.
    OSError
        If the file cannot be read.
    ImportError
        If urdf-parser-py is not installed.
    """
    try:
        from urdf_parser_py import urdf
    except ImportError as error:
        raise ImportError(f"to read URDF, tfbus needs one more package: {pip_install('urdf')}") from error
    text = source if isinstance(source, str) and "<" in source else Path(source).read_bytes()
    robot = _parse(text)
    if robot.tag != "robot":
        raise InvalidRobotError(f"a URDF is a <robot>, but this is a <{robot.tag}>")
    _check_expanded(robot)
    name = _interpret(urdf, robot, element("robot", robot.get("name"))).name
    elements = []
    for part, label in _parts(robot):
        if part.tag == "material" and part.find("color") is None and part.find("texture") is None:
            raise InvalidRobotError("it has neither a color nor a texture", element=label)
        elements.append(Described(part.tag, label, _interpret(urdf, part, label)))
    return name, elements


def transform_of(origin: Any, label: str) -> Transform:
    """The transform of an ``<origin>``; identity if there is none.

    Raises
    ------
    InvalidRobotError
        If it is not finite.
    """
    if origin is None:
        return Transform()
    try:
        return Transform.from_xyz_rpy(origin.xyz, origin.rpy)
    except InvalidTransformError as error:
        raise InvalidRobotError(f"origin: {error}", element=label) from None


def _parse(text: str | bytes) -> Element:
    """Parse a document, and return its root without the namespace of unprefixed names."""
    parser = ET.XMLParser(target=_Builder())
    try:
        parser.feed(text)
        root: Element = parser.close()
    except InvalidRobotError:
        raise
    except (ET.ParseError, LookupError, ValueError) as error:
        raise InvalidRobotError(f"it is not well-formed XML: {error}") from None
    namespace = root.tag[: root.tag.rfind("}") + 1]
    for node in root.iter():
        node.tag = node.tag.removeprefix(namespace)
    return root


class _Builder(ET.TreeBuilder):
    """Builds the tree of elements, and refuses deep nesting and a document type, which can exhaust the memory."""

    def __init__(self) -> None:
        super().__init__()
        self._depth = 0

    def start(self, tag: Any, attrs: Any, /) -> Element:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise InvalidRobotError(f"its elements are nested more than {MAX_DEPTH} deep")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> Element:
        self._depth -= 1
        return super().end(tag)

    def doctype(self, *_: object) -> None:
        raise InvalidRobotError("it has a <!DOCTYPE>, which can define entities without end: URDF needs none")


def _check_expanded(robot: Element) -> None:
    """Raise `InvalidRobotError` if the file still needs xacro.

    Some real files contain calls of unknown macros as elements of the robot; those are ignored.
    """
    for part in robot:
        read = part.tag in READ_ELEMENTS
        for node in part.iter() if read else (part,):
            namespace, _, tag = node.tag.rpartition("}")
            if "xacro" in namespace and (read or tag in XACRO_TAGS):
                raise InvalidRobotError(
                    "this is still to be expanded: run xacro on the file first",
                    element=element(f"xacro:{tag}", node.get("name")),
                )
            for value in node.attrib.values() if read else ():
                if "${" in value or "$(" in value:
                    raise InvalidRobotError(
                        f"{value!r} is still to be expanded: run xacro on the file first",
                        element=element(part.tag, part.get("name")),
                    )


def _parts(robot: Element) -> Iterator[tuple[Element, str]]:
    """The elements of a robot that are read, each with its label for errors; nameless elements are numbered."""
    seen: Counter[str] = Counter()
    for part in robot:
        if part.tag in READ_ELEMENTS:
            seen[part.tag] += 1
            name = part.get("name")
            yield part, element(part.tag, name) + (f" number {seen[part.tag]}" if name is None else "")


def _interpret(parser: Any, part: Element, label: str) -> Any:
    """Interpret one element with urdf-parser-py."""
    known = _reduce(part, label)
    path = parser.xmlr.Path(part.tag)
    try:
        return getattr(parser, part.tag.capitalize()).from_xml(known, path)
    except Exception as error:  # noqa: BLE001 - urdf-parser-py raises plain Exceptions
        # Errors of urdf-parser-py have the path of the element, but span several lines.
        where = str(getattr(error, "path", path)).removeprefix(str(path)).strip("/")
        text = " ".join(str(getattr(error, "e", error)).split()) or type(error).__name__
        raise InvalidRobotError(f"{where}: {text}" if where else text, element=label) from None


def _reduce(node: Element, label: str) -> Element:
    """A copy of an element with only the parts that urdf-parser-py knows."""
    attributes, _, inside = (names.split() for names in KNOWN_PARTS[node.tag].partition(","))
    if REQUIRED_ATTRIBUTES.get(node.tag, "") not in ("", *node.attrib):
        raise InvalidRobotError(f"<{node.tag}> has no {REQUIRED_ATTRIBUTES[node.tag]}", element=label)
    copy = Element(node.tag, {name: value for name, value in node.attrib.items() if name in attributes})
    for child in node:
        shape = child.find("geometry/*")
        # Some programs have more shapes, such as capsules; the shape of a link does not matter here.
        if child.tag not in inside or (shape is not None and shape.tag not in KNOWN_PARTS):
            continue
        if child.tag not in REPEATABLE and copy.find(child.tag) is not None:
            raise InvalidRobotError(f"there is more than one <{child.tag}>", element=label)
        copy.append(_reduce(child, label))
    return copy


def _joint(found: Any, label: str) -> Joint:
    """Convert a joint of urdf-parser-py to a `Joint`."""
    mimic = None
    if found.mimic is not None:
        multiplier, offset = found.mimic.multiplier, found.mimic.offset
        mimic = Mimic(found.mimic.joint, 1.0 if multiplier is None else multiplier, 0.0 if offset is None else offset)
    limited = found.limit is not None and found.type in ("revolute", "prismatic")
    return Joint(
        name=found.name,
        kind=found.type,
        parent=found.parent,
        child=found.child,
        origin=transform_of(found.origin, label),
        axis=(1.0, 0.0, 0.0) if found.axis is None else tuple(found.axis),
        lower=found.limit.lower if limited else None,
        upper=found.limit.upper if limited else None,
        mimic=mimic,
    )


@dataclass(frozen=True, slots=True)
class Box:
    """A box about its origin, with its length along x, y and z in m.

    Examples
    --------
    >>> from tfbus.robot import Box
    >>> Box((1.0, 2.0, 3.0)).size
    (1.0, 2.0, 3.0)
    """

    size: Vector


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A cylinder about its origin, along z; in m.

    Examples
    --------
    >>> from tfbus.robot import Cylinder
    >>> Cylinder(radius=0.1, length=2.0).length
    2.0
    """

    radius: float
    length: float


@dataclass(frozen=True, slots=True)
class Sphere:
    """A sphere about its origin; in m.

    Examples
    --------
    >>> from tfbus.robot import Sphere
    >>> Sphere(0.5).radius
    0.5
    """

    radius: float


@dataclass(frozen=True, slots=True)
class Mesh:
    """A mesh in a file, as the URDF names it (``package://...``, ``file://...`` or a path), scaled along x, y and z.

    Examples
    --------
    >>> from tfbus.robot import Mesh
    >>> Mesh("package://rig/cart.dae").scale
    (1.0, 1.0, 1.0)
    """

    filename: str
    scale: Vector = (1.0, 1.0, 1.0)


Shape = Box | Cylinder | Sphere | Mesh


@dataclass(frozen=True, slots=True)
class Visual:
    """One visible shape of a link.

    Parameters
    ----------
    link : str
        The link, and the frame of that name.
    shape : Box, Cylinder, Sphere or Mesh
    origin : Transform
        Maps coordinates of the shape into the link.
    colour : (float, float, float, float), optional
        Red, green, blue and opacity from 0 to 1; None if the URDF gives none.

    Examples
    --------
    >>> from tfbus.robot import Sphere, Visual
    >>> Visual("cart", Sphere(0.5), colour=(1.0, 0.0, 0.0, 1.0)).link
    'cart'
    """

    link: str
    shape: Shape
    origin: Transform = field(default_factory=Transform)
    colour: tuple[float, float, float, float] | None = None


def read_visuals(source: str | os.PathLike[str]) -> list[Visual]:
    """Read the visible shapes of a URDF, in the order of the file.

    Shapes that URDF does not define, such as capsules, are left out.

    Parameters
    ----------
    source : str or path
        The text itself if it is a string with a ``<`` in it, otherwise the path of the file.

    Raises
    ------
    InvalidRobotError
        If the source is not XML or not URDF, or an element is malformed. The message names the element.
    OSError
        If the file cannot be read.
    ImportError
        If urdf-parser-py is not installed.

    Examples
    --------
    >>> from tfbus.robot import read_visuals
    >>> ball = '<visual><geometry><sphere radius="0.5"/></geometry></visual>'
    >>> read_visuals(f'<robot name="rig"><link name="cart">{ball}</link></robot>')[0].shape
    Sphere(radius=0.5)
    """
    _, elements = read_elements(source)
    colours = {each.value.name: _colour(each.value, each.label) for each in elements if each.tag == "material"}
    visuals = []
    for each in elements:
        if each.tag != "link":
            continue
        for found in each.value.visuals:
            colour = None
            if found.material is not None:
                colour = _colour(found.material, each.label) or colours.get(found.material.name)
            origin = transform_of(found.origin, each.label)
            visuals.append(Visual(each.value.name, _shape(found.geometry, each.label), origin, colour))
    return visuals


def _shape(found: Any, label: str) -> Shape:
    """The shape of a ``<geometry>`` that urdf-parser-py has interpreted."""
    kind = type(found).__name__
    if kind == "Mesh":
        x, y, z = _numbers(found.scale or (1.0, 1.0, 1.0), "scale", label)
        return Mesh(found.filename, (x, y, z))
    if kind == "Box":
        x, y, z = _numbers(found.size, "size", label)
        return Box((x, y, z))
    if kind == "Sphere":
        return Sphere(*_numbers([found.radius], "radius", label))
    return Cylinder(*_numbers([found.radius, found.length], "radius and length", label))


def _colour(material: Any, label: str) -> tuple[float, float, float, float] | None:
    if material.color is None or material.color.rgba is None:
        return None
    red, green, blue, opacity = (min(max(part, 0.0), 1.0) for part in _numbers(material.color.rgba, "color", label))
    return red, green, blue, opacity


def _numbers(values: Any, name: str, label: str) -> list[float]:
    numbers = [float(value) for value in values]
    if not all(map(math.isfinite, numbers)):
        raise InvalidRobotError(f"{name} {numbers} is not finite", element=label)
    return numbers


@dataclass(frozen=True, slots=True)
class LimitViolation:
    """A joint whose position is outside of its limits; in rad or m.

    Examples
    --------
    >>> elbow = Joint("elbow", "revolute", "upper", "lower", lower=-1.0, upper=1.0)
    >>> RobotModel("arm", ["upper", "lower"], [elbow]).violations({"elbow": 1.5})
    [LimitViolation(joint='elbow', position=1.5, lower=-1.0, upper=1.0)]
    """

    joint: str
    position: float
    lower: float | None
    upper: float | None

    def __str__(self) -> str:
        lower = "" if self.lower is None else f" from {self.lower:g}"
        upper = "" if self.upper is None else f" to {self.upper:g}"
        return f"joint {self.joint!r}: position {self.position:g} is outside its limits,{lower}{upper}"


@dataclass(frozen=True, slots=True)
class RobotModel:
    """A tree of links and joints: plain data, from a URDF or built by hand.

    Parameters
    ----------
    name : str
    links : sequence of str
        The names of the links, and of their frames.
    joints : sequence of Joint

    Attributes
    ----------
    root : str
        The link without a parent.

    Raises
    ------
    InvalidRobotError
        If a name occurs twice or is not a frame name; if a joint has an unknown link, a link has two parents, or the
        links form a loop or have several roots; if a joint mimics an unknown joint, a joint whose position is not one
        number, or, through others, itself. The message names the element.

    Examples
    --------
    >>> elbow = Joint("elbow", "revolute", "upper_arm", "forearm", Transform((0.4, 0.0, 0.0)), axis=(0, 0, 1))
    >>> arm = RobotModel("arm", ["upper_arm", "forearm"], [elbow])
    >>> [sample] = arm.transforms({"elbow": 0.0}, stamp=0)
    >>> sample
    TransformStamped('upper_arm', 'forearm', 0, Transform(translation=(0.4, 0.0, 0.0), rotation=(0.0, 0.0, 0.0, 1.0)))
    """

    name: str
    links: Sequence[str]
    joints: Sequence[Joint]
    root: str = field(init=False)
    _fixed: tuple[Joint, ...] = field(init=False, compare=False)
    _resolved: tuple[tuple[Joint, Joint | None], ...] = field(init=False, compare=False)
    _names: frozenset[str] = field(init=False, compare=False)

    def __post_init__(self) -> None:
        def set_field(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        set_field("links", tuple(self.links))
        set_field("joints", tuple(self.joints))
        _check_links(self)
        set_field("root", _root(self))
        ordered = _leaders_first(self.joints)
        named = {joint.name: joint for joint in ordered}
        leaders = {joint.mimic.joint for joint in ordered if joint.mimic is not None}
        set_field("_fixed", tuple(joint for joint in self.joints if joint.kind == "fixed"))
        set_field(
            "_resolved",
            tuple(
                (joint, named[joint.mimic.joint] if joint.mimic else None)
                for joint in ordered
                if joint.kind != "fixed" or joint.name in leaders
            ),
        )
        set_field("_names", frozenset(named))

    def __repr__(self) -> str:
        moving = sum(joint.kind != "fixed" for joint in self.joints)
        return f"<RobotModel {self.name!r}: {len(self.links)} links below {self.root!r}, {moving} moving joints>"

    @classmethod
    def from_urdf(cls, source: str | os.PathLike[str]) -> RobotModel:
        """Read a URDF file, or its text.

        Elements other than links, joints and materials are ignored, such as ``<transmission>`` and ``<gazebo>``. Needs
        ``pip install "tfbus[urdf]"``.

        Parameters
        ----------
        source : str or path
            The text itself if it is a string with a ``<`` in it, otherwise the path of the file.

        Raises
        ------
        InvalidRobotError
            If the source is not XML, not URDF or not yet expanded by xacro, an element is malformed, or the elements
            do not form a robot. The message names the element.
        OSError
            If the file cannot be read.
        ImportError
            If urdf-parser-py is not installed.

        Examples
        --------
        >>> source = '<robot name="box"><link name="base"/></robot>'
        >>> RobotModel.from_urdf(source).name
        'box'
        """
        name, links, joints = read_urdf(source)
        return cls(name, links, joints)

    def transforms(
        self, positions: Mapping[str, Position], stamp: StampLike, authority: str = "", prefix: str = ""
    ) -> list[TransformStamped]:
        """The transforms of all links, each in its parent.

        Parameters
        ----------
        positions : mapping of str to float, sequence of floats, or Transform
            By name of joint, as `Joint.transform` takes them. A moving joint without a position is left out, unless it
            mimics a joint that has one. Positions of fixed and of unknown joints are ignored: see `unknown_joints`.
        stamp : int
            ns.
        authority : str
            The sender.
        prefix : str
            A prefix for the names of all frames, such as ``"robot1/"``.

        Returns
        -------
        list of TransformStamped
            First the static transforms of the fixed joints, then the transforms of the moving joints.

        Raises
        ------
        InvalidTransformError
            If a position is not finite, has a wrong length or holds no unit quaternion, or the prefix or the stamp is
            invalid. The message has the name of the joint.
        TypeError
            If a position has a type that its joint does not accept.

        Examples
        --------
        >>> slide = Joint("slide", "prismatic", "rail", "cart", axis=(1.0, 0.0, 0.0))
        >>> model = RobotModel("rig", ["rail", "cart"], [slide])
        >>> [sample.transform.translation for sample in model.transforms({"slide": 0.5}, stamp=0)]
        [(0.5, 0.0, 0.0)]
        """
        return [
            *self.fixed_transforms(stamp, authority, prefix),
            *self.moving_transforms(positions, stamp, authority, prefix),
        ]

    def fixed_transforms(self, stamp: StampLike, authority: str = "", prefix: str = "") -> list[TransformStamped]:
        """The static samples of `transforms`.

        Examples
        --------
        >>> model = RobotModel("rig", ["base", "laser"], [Joint("mount", "fixed", "base", "laser")])
        >>> [sample.child for sample in model.fixed_transforms(stamp=0)]
        ['laser']
        """
        return [
            TransformStamped(prefix + joint.parent, prefix + joint.child, stamp, joint.origin, authority, static=True)
            for joint in self._fixed
        ]

    def moving_transforms(
        self, positions: Mapping[str, Position], stamp: StampLike, authority: str = "", prefix: str = ""
    ) -> list[TransformStamped]:
        """The moving samples of `transforms`.

        Examples
        --------
        >>> slide = Joint("slide", "prismatic", "rail", "cart", axis=(1.0, 0.0, 0.0))
        >>> model = RobotModel("rig", ["rail", "cart"], [slide])
        >>> [sample.child for sample in model.moving_transforms({"slide": 0.5}, stamp=0)]
        ['cart']
        """
        return [
            TransformStamped(
                prefix + joint.parent, prefix + joint.child, stamp, from_row(joint.row(position)), authority
            )
            for joint, position in self.resolve(positions)
        ]

    def resolve(self, positions: Mapping[str, Position]) -> list[tuple[Joint, Position]]:
        """Pair each moving joint that has a position, or mimics a joint that has one, with its position.

        Raises
        ------
        InvalidTransformError, TypeError
            If the position of a mimicked joint is not one finite number.

        Examples
        --------
        >>> slide = Joint("slide", "prismatic", "rail", "cart", axis=(1.0, 0.0, 0.0))
        >>> model = RobotModel("rig", ["rail", "cart"], [slide])
        >>> [(joint.name, position) for joint, position in model.resolve({"slide": 0.5})]
        [('slide', 0.5)]
        """
        found: dict[str, Position] = {}
        moving = []
        for joint, leader in self._resolved:
            name, mimic = joint.name, joint.mimic
            if name in positions:
                position = positions[name]
            elif leader is not None and mimic is not None and leader.name in found:
                position = mimic.multiplier * leader.number(found[leader.name]) + mimic.offset
            else:
                continue
            found[name] = position
            if joint.kind != "fixed":
                moving.append((joint, position))
        return moving

    def violations(self, positions: Mapping[str, Position]) -> list[LimitViolation]:
        """The joints whose positions are outside of their limits; joints that mimic another count too.

        Raises
        ------
        InvalidTransformError, TypeError
            As `transforms`.

        Examples
        --------
        >>> slide = Joint("slide", "prismatic", "rail", "cart", lower=0.0, upper=1.0)
        >>> [str(each.joint) for each in RobotModel("rig", ["rail", "cart"], [slide]).violations({"slide": 1.5})]
        ['slide']
        """
        found = []
        for joint, position in self.resolve(positions):
            lower, upper = joint.lower, joint.upper
            if lower is None and upper is None:
                continue
            number = joint.number(position)
            if (lower is not None and number < lower) or (upper is not None and number > upper):
                found.append(LimitViolation(joint.name, number, lower, upper))
        return found

    def unknown_joints(self, names: Iterable[str]) -> list[str]:
        """The names that are not names of joints.

        Examples
        --------
        >>> RobotModel("rig", ["rail"], []).unknown_joints(["slide"])
        ['slide']
        """
        return [name for name in names if name not in self._names]

    def zeros(self) -> dict[str, Position]:
        """The zero position of every moving joint that does not mimic another.

        Examples
        --------
        >>> slide = Joint("slide", "prismatic", "rail", "cart")
        >>> RobotModel("rig", ["rail", "cart"], [slide]).zeros()
        {'slide': 0.0}
        """
        return {joint.name: joint.zero for joint in self.joints if joint.kind != "fixed" and joint.mimic is None}


def _check_links(model: RobotModel) -> None:
    """Raise `InvalidRobotError` for a name that occurs twice, or is not a frame name."""
    robot = element("robot", model.name)
    if not model.links:
        raise InvalidRobotError("it has no links", element=robot)
    for link in model.links:
        if not is_frame(link):
            raise InvalidRobotError("a frame name must not be empty or start with '/'", element=element("link", link))
    for tag, names in (("link", model.links), ("joint", [joint.name for joint in model.joints])):
        for name, count in Counter(names).items():
            if count > 1:
                raise InvalidRobotError(f"there are {count} of this name", element=element(tag, name))


def _root(model: RobotModel) -> str:
    """The link without a parent; raises `InvalidRobotError` unless the links form one tree."""
    above: dict[str, Joint] = {}
    known = set(model.links)
    for joint in model.joints:
        for end, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in known:
                raise InvalidRobotError(f"{end} link {link!r} is not there", element=joint.element)
        if joint.child in above:
            first = above[joint.child]
            raise InvalidRobotError(
                f"link {joint.child!r} has two parents: {first.parent!r} by joint {first.name!r}, and {joint.parent!r}",
                element=joint.element,
            )
        above[joint.child] = joint
    in_tree: set[str] = set()
    for link in model.links:
        climbed: dict[str, Joint] = {}
        while link in above and link not in in_tree:
            if link in climbed:
                names = list(climbed)
                loop = [*names[names.index(link) :], link]
                text = " -> ".join(map(repr, loop))
                raise InvalidRobotError(f"the links {text} form a loop", element=above[link].element)
            climbed[link] = above[link]
            link = above[link].parent
        in_tree.update(climbed)
    roots = [link for link in model.links if link not in above]
    if len(roots) > 1:
        raise InvalidRobotError(
            f"it has several roots: {', '.join(map(repr, roots))}", element=element("robot", model.name)
        )
    return roots[0]


def _leaders_first(joints: Sequence[Joint]) -> list[Joint]:
    """Order the joints so that each follows the joint that it mimics; raises `InvalidRobotError` if that fails."""
    named = {joint.name: joint for joint in joints}
    ordered: dict[str, Joint] = {}
    for joint in joints:
        chain: dict[str, Joint] = {}
        while joint.name not in ordered:
            if joint.name in chain:
                names = list(chain)
                text = " -> ".join(map(repr, [*names[names.index(joint.name) :], joint.name]))
                raise InvalidRobotError(f"the joints {text} mimic each other", element=joint.element)
            chain[joint.name] = joint
            if joint.mimic is None:
                break
            leader = named.get(joint.mimic.joint)
            if leader is None:
                raise InvalidRobotError(f"it mimics {joint.mimic.joint!r}, which is not there", element=joint.element)
            for each in (joint, leader):
                if each.kind in ("planar", "floating"):
                    raise InvalidRobotError(
                        f"it mimics {leader.name!r}, but {each.name!r} is {each.kind}: only one number can be mimicked",
                        element=joint.element,
                    )
            joint = leader
        ordered.update(reversed(chain.items()))
    return list(ordered.values())
