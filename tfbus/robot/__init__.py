"""Robots described in URDF, and the transforms that the positions of their joints make."""

from tfbus.robot.joint import Joint, Mimic
from tfbus.robot.model import LimitViolation, RobotModel
from tfbus.robot.state_publisher import RobotStatePublisher

__all__ = ["Joint", "LimitViolation", "Mimic", "RobotModel", "RobotStatePublisher"]
