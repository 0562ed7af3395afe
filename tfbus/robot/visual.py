"""`Visual`, one visible shape of a robot's link, and `read_visuals`, which reads those of a URDF."""

import math
import os
from dataclasses import dataclass, field
from typing import Any

from tfbus.errors import InvalidRobotError
from tfbus.geometry.transform import Transform
from tfbus.robot._urdf import read_elements, transform_of
from tfbus.rows import Vector


@dataclass(frozen=True, slots=True)
class Box:
    """A box about its origin, with its length along x, y and z in m."""

    size: Vector


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A cylinder about its origin, along z; in m."""

    radius: float
    length: float


@dataclass(frozen=True, slots=True)
class Sphere:
    """A sphere about its origin; in m."""

    radius: float


@dataclass(frozen=True, slots=True)
class Mesh:
    """A mesh in a file, as the URDF names it (``package://...``, ``file://...`` or a path), scaled along x, y and z."""

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
    """
    _, elements = read_elements(source)
    colours = {each.value.name: _colour(each.value, each.label) for each in elements if each.tag == "material"}
    visuals = []
    for each in elements:
        if each.tag != "link":
            continue
        for found in each.value.visuals:
            if found.geometry is None:
                continue
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
