"""Messages of rclpy or rospy that become data, and messages again; run by a Python that has them, and tfbus.

It prints how many were equal to themselves at the end.
"""

import array
import struct
from typing import Any

import numpy as np
from geometry_msgs.msg import (  # type: ignore[import-not-found]
    Point32,
    PointStamped,
    PolygonStamped,
    PoseStamped,
    PoseWithCovarianceStamped,
    QuaternionStamped,
    TransformStamped,
    TwistStamped,
    Vector3Stamped,
    WrenchStamped,
)
from sensor_msgs.msg import LaserScan, PointCloud2, PointField  # type: ignore[import-not-found]

from tfbus.data import from_message, to_message

STAMP = 1_700_000_000_123_456_789


def stamped(kind: Any) -> Any:
    message = kind()
    seconds, nanoseconds = divmod(STAMP, 10**9)
    names = ("sec", "nanosec") if hasattr(message.header.stamp, "sec") else ("secs", "nsecs")
    for name, value in zip(names, (seconds, nanoseconds), strict=True):
        setattr(message.header.stamp, name, value)
    message.header.frame_id = "laser"
    return message


def messages() -> list[Any]:
    point, vector, turn = stamped(PointStamped), stamped(Vector3Stamped), stamped(QuaternionStamped)
    pose, covariant, polygon = stamped(PoseStamped), stamped(PoseWithCovarianceStamped), stamped(PolygonStamped)
    twist, wrench, transform = stamped(TwistStamped), stamped(WrenchStamped), stamped(TransformStamped)
    for place in (point.point, vector.vector, pose.pose.position, covariant.pose.pose.position):
        place.x, place.y, place.z = 1.0, 2.5, -3.0
    twist.twist.linear.x = wrench.wrench.force.y = transform.transform.translation.z = 4.5
    for rotation in (turn.quaternion, pose.pose.orientation, covariant.pose.pose.orientation):
        rotation.x, rotation.w = 1.0, 0.0
    transform.transform.rotation.z, transform.transform.rotation.w = 1.0, 0.0
    transform.child_frame_id = "camera"
    polygon.polygon.points = [Point32(x=1.0, y=2.0, z=0.5), Point32(x=0.0, y=1.0, z=0.0)]
    scan = stamped(LaserScan)
    scan.angle_max, scan.angle_increment, scan.range_max = 1.0, 0.5, 10.0
    scan.ranges, scan.intensities = [1.0, 2.0, 3.0], [0.5, 0.25, 0.125]
    return [point, vector, turn, pose, covariant, polygon, twist, wrench, transform, scan]


def cloud() -> Any:
    message = stamped(PointCloud2)
    names = ("x", "y", "z", "intensity")
    message.fields = [
        PointField(name=name, offset=4 * number, datatype=7, count=1) for number, name in enumerate(names)
    ]
    content = struct.pack("<12f", *range(12))
    message.height, message.width, message.point_step, message.row_step = 1, 3, 16, 48
    message.data = content if isinstance(message.data, bytes) else array.array("B", content)
    return message


def main() -> None:
    for message in messages():
        assert to_message(from_message(message), like=message) == message, message
    message = cloud()
    found = from_message(message)
    assert found.points.tolist() == [[0, 1, 2], [4, 5, 6], [8, 9, 10]]
    assert found.fields["intensity"].tolist() == [3, 7, 11]
    assert np.shares_memory(found.points, np.frombuffer(message.data, np.uint8)), "a cloud was copied"
    back = to_message(found, like=message)
    assert (bytes(back.data), back.header.stamp) == (bytes(message.data), message.header.stamp)
    scan = from_message(messages()[-1]).to_points()
    assert (scan.frame, scan.stamp, len(scan.points)) == ("laser", STAMP, 3)
    print("equal", len(messages()) + 1)


if __name__ == "__main__":
    main()
