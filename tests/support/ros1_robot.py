"""A robot of ROS 1, for `tests/links/rosbridge/test_ros1.py`: run by a Python that has rospy, with a file of URDF.

It latches ``/robot_description``, and does what `ros_driver.py` says on ``/joint_states`` and ``/clock``.
"""

import sys
from pathlib import Path

import rospy  # type: ignore[import-not-found]
from ros_driver import JOINTS, play  # type: ignore[import-not-found]
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

    def move(stamp: int, positions: list[float]) -> None:
        state = JointState(name=JOINTS, position=positions)
        state.header.stamp = rospy.Time(*divmod(stamp, 10**9))
        joints.publish(state)

    play(move, lambda seconds: clock.publish(Clock(rospy.Time.from_sec(seconds))), clock.get_num_connections)


if __name__ == "__main__":
    main()
