"""A robot of ROS 2, for `tests/integration/test_ros2.py`: run by a Python that has rclpy, with a file of URDF.

It publishes ``/robot_description``, transient local, and does what `ros_driver.py` says on ``/joint_states`` and
``/clock``.
"""

import sys
from pathlib import Path

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from ros_driver import JOINTS, play  # type: ignore[import-not-found]
from rosgraph_msgs.msg import Clock  # type: ignore[import-not-found]
from sensor_msgs.msg import JointState  # type: ignore[import-not-found]
from std_msgs.msg import String  # type: ignore[import-not-found]


def main() -> None:
    rclpy.init()
    node = Node("robot")
    urdf = Path(sys.argv[1]).read_text(encoding="utf-8")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    description = node.create_publisher(String, "/robot_description", latched)
    description.publish(String(data=urdf))
    joints = node.create_publisher(JointState, "/joint_states", 10)
    clock = node.create_publisher(Clock, "/clock", 10)

    def move(stamp: int, positions: list[float]) -> None:
        state = JointState(name=JOINTS, position=positions)
        state.header.stamp = Time(nanoseconds=stamp).to_msg()
        joints.publish(state)

    def tell(seconds: float) -> None:
        clock.publish(Clock(clock=Time(nanoseconds=round(seconds * 1e9)).to_msg()))

    play(move, tell, clock.get_subscription_count)


if __name__ == "__main__":
    main()
