"""Reading URDF, the description of a robot as links and joints.

urdf-parser-py interprets the elements, but prints a complaint to standard error for each unknown one, and fails at the
legacy transmissions of real robots. So this module passes it one element at a time, reduced to the parts that it knows.
The XML itself is parsed here, with limits, because files may come from untrusted sources.
"""

import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree as ET
from xml.etree.ElementTree import Element

from tfbus.errors import InvalidRobotError, InvalidTransformError, pip_install
from tfbus.geometry.transform import Transform
from tfbus.robot.joint import Joint, Mimic, element

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
"""Attributes that must be there, although urdf-parser-py does not check it."""

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
    """Read the links and joints of a URDF; the source and the errors are those of `read_elements`."""
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
        raise ImportError(f"to read URDF, tfbus needs a package more: {pip_install('urdf')}") from error
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
    """The elements of a robot that are read, each with its label for errors; those without a name are numbered."""
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
