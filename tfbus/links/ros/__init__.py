"""The common half of links to ROS: topics, names, and no origin, for no message of ROS has one.

`RosLink` is the base of the links that `tfbus.links.dds`, `tfbus.links.rosbridge` and `tfbus.links.rmw_zenoh` give.
"""

from tfbus.links.ros.ros_link import RosLink
from tfbus.links.ros.settings import RosOptions

__all__ = ["RosLink", "RosOptions"]
