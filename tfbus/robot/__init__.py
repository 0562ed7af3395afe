"""Robots described in URDF, and the transforms of their links for given positions of the joints.

A `RobotModel` is a tree of links and joints, read from a URDF file or built by hand; a `RobotStatePublisher` publishes
its transforms on a bus. `read_visuals` reads the visible shapes of the links, for pictures.
"""

from tfbus.robot.model import (
    Box,
    Cylinder,
    Joint,
    LimitViolation,
    Mesh,
    Mimic,
    RobotModel,
    Sphere,
    Visual,
    read_visuals,
)
from tfbus.robot.state_publisher import RobotStatePublisher

__all__ = [
    "Box",
    "Cylinder",
    "Joint",
    "LimitViolation",
    "Mesh",
    "Mimic",
    "RobotModel",
    "RobotStatePublisher",
    "Sphere",
    "Visual",
    "read_visuals",
]
