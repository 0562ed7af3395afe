"""A ROS 2 node with the real tf2, for `tests/integration/test_ros2.py`: run by a Python that has rclpy and tf2_ros.

It does what `ros_driver.py` says, and sends the static ``base:laser``, x = 0.5.
"""

import threading
import time
from typing import Any

import rclpy
import tf2_ros  # type: ignore[import-not-found]
from geometry_msgs.msg import TransformStamped  # type: ignore[import-not-found]
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.time import Time
from ros_driver import Answer, Driver  # type: ignore[import-not-found]
from tf2_msgs.msg import TFMessage  # type: ignore[import-not-found]


def transform(parent: str, child: str, stamp: int, x: float) -> Any:
    message = TransformStamped()
    message.header.frame_id, message.child_frame_id = parent, child
    message.header.stamp = Time(nanoseconds=stamp).to_msg()
    message.transform.translation.x = x
    return message


def main() -> None:
    driver = Driver()
    rclpy.init()
    node = Node("driver")
    buffer = tf2_ros.Buffer(node=node)
    listener = tf2_ros.TransformListener(buffer, node)

    def hear(message: Any) -> None:
        for each in message.transforms:
            stamp = each.header.stamp
            driver.hear(each.child_frame_id, stamp.sec * 10**9 + stamp.nanosec)

    def send(stamp: int, x: float) -> None:
        moving.sendTransform(transform("odom", "base", stamp, x))

    def ask() -> Answer | None:
        try:
            found = buffer.lookup_transform("odom", "tool", Time())
        except tf2_ros.TransformException:
            return None
        stamp = found.header.stamp
        return stamp.sec * 10**9 + stamp.nanosec, found.transform.translation.x

    node.create_subscription(TFMessage, "/tf", hear, 100)
    moving, static = tf2_ros.TransformBroadcaster(node), tf2_ros.StaticTransformBroadcaster(node)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    static.sendTransform([transform("base", "laser", time.time_ns(), driver.x)])
    driver.run(send, ask)
    del listener
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
