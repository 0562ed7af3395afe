"""A robot of ROS 1, for `tests/links/rosbridge/test_ros1.py`: run by a Python that has rospy, with a file of URDF.

It latches ``/robot_description``, moves the shoulder to sin(t) and the elbow to cos(t) on ``/joint_states``, and
publishes ``/clock`` from 100 s on, which jumps back to 50 s after somebody has listened to it for 1.5 s.
"""

import math
import sys
import time
from pathlib import Path

import rospy  # type: ignore[import-not-found]
from rosgraph_msgs.msg import Clock  # type: ignore[import-not-found]
from sensor_msgs.msg import JointState  # type: ignore[import-not-found]
from std_msgs.msg import String  # type: ignore[import-not-found]


def main() -> None:
    rospy.init_node("robot", disable_signals=True)
    urdf = Path(sys.argv[1]).read_text(encoding="utf-8")
    rospy.set_param("/robot_description", urdf)
    description = rospy.Publisher("/robot_description", String, latch=True, queue_size=1)
    description.publish(urdf)
    joints = rospy.Publisher("/joint_states", JointState, queue_size=10)
    clock = rospy.Publisher("/clock", Clock, queue_size=10)
    print("up", flush=True)
    start, listened = time.monotonic(), 0.0
    while True:
        time.sleep(0.02)
        stamp = time.time_ns()
        state = JointState(name=["shoulder", "elbow"], position=[math.sin(stamp / 10**9), math.cos(stamp / 10**9)])
        state.header.stamp = rospy.Time(*divmod(stamp, 10**9))
        joints.publish(state)
        if clock.get_num_connections() and not listened:
            listened = time.monotonic()
        ended = listened + 1.5 if listened else math.inf
        now = time.monotonic()
        clock.publish(Clock(rospy.Time.from_sec(100 + now - start if now < ended else 50 + now - ended)))


if __name__ == "__main__":
    main()
