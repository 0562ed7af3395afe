"""A robot of ROS 2, for `tests/integration/test_ros2.py`: run by a Python that has rclpy, with a file of URDF.

It publishes ``/robot_description``, transient local, moves the shoulder to sin(t) and the elbow to cos(t) on
``/joint_states``, and publishes ``/clock`` from 100 s on, which jumps back to 50 s after somebody has listened to it
for 1.5 s.
"""

import math
import sys
import time
from pathlib import Path

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
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
    print("up", flush=True)
    start, listened = time.monotonic(), 0.0
    while True:
        time.sleep(0.02)
        stamp = time.time_ns()
        state = JointState(name=["shoulder", "elbow"], position=[math.sin(stamp / 10**9), math.cos(stamp / 10**9)])
        state.header.stamp = Time(nanoseconds=stamp).to_msg()
        joints.publish(state)
        if clock.get_subscription_count() and not listened:
            listened = time.monotonic()
        ended = listened + 1.5 if listened else math.inf
        now = time.monotonic()
        seconds = 100 + now - start if now < ended else 50 + now - ended
        clock.publish(Clock(clock=Time(nanoseconds=round(seconds * 1e9)).to_msg()))


if __name__ == "__main__":
    main()
