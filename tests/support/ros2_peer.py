"""A ROS 2 node with the real tf2, for `tests/integration/test_ros2.py`: run by a Python that has rclpy and tf2_ros.

It broadcasts ``odom:base``, x = t, at 100 Hz, and the static ``base:laser``, x = 0.5; it asks for ``odom:tool``
100 times a second, which needs the frames of the other side. So many seconds after the first answer, when the two have
met, it ends with one line of JSON.
"""

import argparse
import json
import threading
import time
from collections import Counter
from typing import Any

import rclpy
import tf2_ros  # type: ignore[import-not-found]
from geometry_msgs.msg import TransformStamped  # type: ignore[import-not-found]
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.time import Time
from tf2_msgs.msg import TFMessage  # type: ignore[import-not-found]

RATE = 100
MEETING_TIME = 60.0
"""s; whoever has not met by then never will."""


def seconds(stamp: int) -> float:
    """The time of the day, or so: between two samples tf2 is exact, however late the second one is."""
    return stamp % 10**14 / 1e9


def transform(parent: str, child: str, stamp: int, x: float) -> Any:
    message = TransformStamped()
    message.header.frame_id, message.child_frame_id = parent, child
    message.header.stamp = Time(nanoseconds=stamp).to_msg()
    message.transform.translation.x = x
    return message


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--x", type=float, default=0.5, help="of the laser")
    options = parser.parse_args()
    rclpy.init()
    node = Node("driver")
    buffer = tf2_ros.Buffer(node=node)
    listener = tf2_ros.TransformListener(buffer, node)
    received: Counter[str] = Counter()
    latencies: list[int] = []

    def hear(message: Any) -> None:
        for each in message.transforms:
            received[each.child_frame_id] += 1
            if each.child_frame_id == "arm":
                latencies.append(time.time_ns() - each.header.stamp.sec * 10**9 - each.header.stamp.nanosec)

    node.create_subscription(TFMessage, "/tf", hear, 100)
    moving, static = tf2_ros.TransformBroadcaster(node), tf2_ros.StaticTransformBroadcaster(node)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    static.sendTransform([transform("base", "laser", time.time_ns(), options.x)])
    print(json.dumps({"event": "up"}), flush=True)
    answered = failed = wrong = sent = 0
    due = time.monotonic()
    end = due + MEETING_TIME
    while (now := time.monotonic()) < end:
        time.sleep(max(0.0, due - now))
        due = max(due + 1 / RATE, now - 1 / RATE)
        stamp = time.time_ns()
        moving.sendTransform(transform("odom", "base", stamp, seconds(stamp)))
        sent += 1
        try:
            found = buffer.lookup_transform("odom", "tool", Time())
        except tf2_ros.TransformException:
            # Before the two have met, nothing can be answered.
            failed += answered > 0
            continue
        if not answered:
            end = time.monotonic() + options.seconds
            latencies.clear()
        answered += 1
        t = seconds(found.header.stamp.sec * 10**9 + found.header.stamp.nanosec)
        wrong += abs(found.transform.translation.x - (3 * t + 0.1)) > 1e-6
    facts = {"sent": sent, "answered": answered, "failed": failed, "wrong": wrong, "received": received}
    median = sorted(latencies)[len(latencies) // 2] / 1e6 if latencies else None
    print(json.dumps({"event": "end", **facts, "latency_ms": median}), flush=True)
    del listener
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
