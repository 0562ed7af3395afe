"""A node of ROS 1 with the real tf2, for `tests/links/rosbridge/test_ros1.py`: run by a Python that has rospy.

It broadcasts ``odom:base``, x = t, at 100 Hz, and the static ``base:laser``, x = 0.5; it asks for ``odom:tool``
100 times a second, which needs the frames of the other side. So many seconds after the first answer, when the two have
met, it ends with one line of JSON.
"""

import argparse
import json
import time
from collections import Counter
from typing import Any

import rospy  # type: ignore[import-not-found]
import tf2_ros  # type: ignore[import-not-found]
from geometry_msgs.msg import TransformStamped  # type: ignore[import-not-found]
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
    message.header.stamp = rospy.Time(*divmod(stamp, 10**9))
    message.transform.rotation.w = 1.0
    message.transform.translation.x = x
    return message


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--x", type=float, default=0.5, help="of the laser")
    options = parser.parse_args()
    rospy.init_node("driver", anonymous=True, disable_signals=True)
    buffer = tf2_ros.Buffer()
    listener = tf2_ros.TransformListener(buffer)
    received: Counter[str] = Counter()
    latencies: list[int] = []

    def hear(message: Any) -> None:
        for each in message.transforms:
            received[each.child_frame_id] += 1
            if each.child_frame_id == "arm":
                latencies.append(time.time_ns() - each.header.stamp.to_nsec())

    rospy.Subscriber("/tf", TFMessage, hear, queue_size=100, tcp_nodelay=True)
    moving, static = tf2_ros.TransformBroadcaster(), tf2_ros.StaticTransformBroadcaster()
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
            found = buffer.lookup_transform("odom", "tool", rospy.Time())
        except tf2_ros.TransformException:
            # Before the two have met, nothing can be answered.
            failed += answered > 0
            continue
        if not answered:
            end = time.monotonic() + options.seconds
            latencies.clear()
        answered += 1
        t = seconds(found.header.stamp.to_nsec())
        wrong += abs(found.transform.translation.x - (3 * t + 0.1)) > 1e-6
    facts = {"sent": sent, "answered": answered, "failed": failed, "wrong": wrong, "received": received}
    median = sorted(latencies)[len(latencies) // 2] / 1e6 if latencies else None
    print(json.dumps({"event": "end", **facts, "latency_ms": median}), flush=True)
    listener.unregister()
    rospy.signal_shutdown("the time is over")


if __name__ == "__main__":
    main()
