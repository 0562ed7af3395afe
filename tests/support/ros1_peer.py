"""A node of ROS 1 with the real tf2, for `tests/links/rosbridge/test_ros1.py`: run by a Python that has rospy.

It does what `ros_driver.py` says, and sends the static ``base:laser``, x = 0.5.
"""

import time
from typing import Any

import rospy  # type: ignore[import-not-found]
import tf2_ros  # type: ignore[import-not-found]
from geometry_msgs.msg import TransformStamped  # type: ignore[import-not-found]
from ros_driver import Answer, Driver  # type: ignore[import-not-found]
from tf2_msgs.msg import TFMessage  # type: ignore[import-not-found]


def transform(parent: str, child: str, stamp: int, x: float) -> Any:
    message = TransformStamped()
    message.header.frame_id, message.child_frame_id = parent, child
    message.header.stamp = rospy.Time(*divmod(stamp, 10**9))
    message.transform.rotation.w = 1.0
    message.transform.translation.x = x
    return message


def main() -> None:
    driver = Driver()
    rospy.init_node("driver", anonymous=True, disable_signals=True)
    buffer = tf2_ros.Buffer()
    listener = tf2_ros.TransformListener(buffer)

    def hear(message: Any) -> None:
        for each in message.transforms:
            driver.hear(each.child_frame_id, each.header.stamp.to_nsec())

    def send(stamp: int, x: float) -> None:
        moving.sendTransform(transform("odom", "base", stamp, x))

    def ask() -> Answer | None:
        try:
            found = buffer.lookup_transform("odom", "tool", rospy.Time())
        except tf2_ros.TransformException:
            return None
        return found.header.stamp.to_nsec(), found.transform.translation.x

    rospy.Subscriber("/tf", TFMessage, hear, queue_size=100, tcp_nodelay=True)
    moving, static = tf2_ros.TransformBroadcaster(), tf2_ros.StaticTransformBroadcaster()
    static.sendTransform([transform("base", "laser", time.time_ns(), driver.x)])
    driver.run(send, ask)
    listener.unregister()
    rospy.signal_shutdown("the time is over")


if __name__ == "__main__":
    main()
