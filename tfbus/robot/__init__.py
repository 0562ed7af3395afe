"""Robots described in URDF, and the transforms of their links for given positions of the joints.

A `RobotModel` is a tree of links and joints, read from a URDF file or built by hand; a `RobotStatePublisher` publishes
its transforms on a bus.
"""

from tfbus.robot.joint import Joint, Mimic
from tfbus.robot.model import LimitViolation, RobotModel
from tfbus.robot.state_publisher import RobotStatePublisher

__all__ = ["Joint", "LimitViolation", "Mimic", "RobotModel", "RobotStatePublisher"]
