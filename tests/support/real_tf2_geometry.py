"""Messages that tf2_geometry_msgs of ROS 2 transforms, and tfbus; run by a Python that has both.

It prints how many were equal at the end. Odometry, paths and arrays of poses are compared by their poses.
"""

import random
from typing import Any

import numpy as np
import tf2_geometry_msgs as real  # type: ignore[import-not-found]
from geometry_msgs.msg import (  # type: ignore[import-not-found]
    Point32,
    PointStamped,
    PolygonStamped,
    PoseStamped,
    PoseWithCovarianceStamped,
    TransformStamped,
    Vector3Stamped,
)

from tfbus import Transform
from tfbus.data import do_transform, from_message

draw = random.Random(43)


def fill(place: Any, names: str) -> None:
    values = np.array([draw.uniform(-3.0, 3.0) for _ in names])
    for name, value in zip(names, values / np.linalg.norm(values) if names == "xyzw" else values, strict=True):
        setattr(place, name, float(value))


def posed(message: Any, pose: Any) -> Any:
    fill(pose.position, "xyz")
    fill(pose.orientation, "xyzw")
    return message


def as_dict(pose: Any) -> dict[str, Any]:
    return {
        "position": {axis: getattr(pose.position, axis) for axis in "xyz"},
        "orientation": {axis: getattr(pose.orientation, axis) for axis in "xyzw"},
    }


def parts(pose: Any) -> list[Any]:
    """The place of a pose, and its matrix: a quaternion may have either sign."""
    place, turn = (tuple(part.values()) for part in as_dict(pose).values())
    return [place, Transform(rotation=turn).matrix()[:3, :3]]


def check(ours: Any, theirs: Any, tolerance: float = 1e-9) -> int:
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(one, other, atol=tolerance)
    return 1


equal = 0
for _ in range(100):
    transform = TransformStamped()
    transform.header.frame_id, transform.child_frame_id = "map", "laser"
    fill(transform.transform.translation, "xyz")
    fill(transform.transform.rotation, "xyzw")
    ours = from_message(transform)

    def moved(message: Any, ours: Any = ours) -> Any:
        return do_transform(from_message(message), ours)

    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "laser"}
    point, vector, pose, polygon = PointStamped(), Vector3Stamped(), PoseStamped(), PolygonStamped()
    uncertain = PoseWithCovarianceStamped()
    for message in (point, vector, pose, polygon, uncertain):
        message.header.frame_id = "laser"
    fill(point.point, "xyz")
    fill(vector.vector, "xyz")
    posed(pose, pose.pose)
    posed(uncertain, uncertain.pose.pose)
    half = np.array([[draw.uniform(-1.0, 1.0) for _ in range(6)] for _ in range(6)])
    uncertain.pose.covariance = (half @ half.T).ravel()
    polygon.polygon.points = [Point32(x=1.0, y=2.0, z=0.5), Point32(x=0.0, y=-1.0, z=0.25)]

    expected = real.do_transform_point(point, transform).point
    equal += check([moved(point).point], [[expected.x, expected.y, expected.z]])
    expected = parts(real.do_transform_pose_stamped(pose, transform).pose)
    several = {"header": header, "poses": [as_dict(pose.pose)] * 2}
    stamped = {"header": header, "poses": [{"header": header, "pose": as_dict(pose.pose)}] * 2}
    for found in (moved(pose).pose, moved(several).poses[1], moved(stamped).poses[1]):
        equal += check([found.translation, found.matrix()[:3, :3]], expected)
    corners = real.do_transform_polygon_stamped(polygon, transform).polygon.points
    # Its numbers are float32.
    equal += check([moved(polygon).points], [[[each.x, each.y, each.z] for each in corners]], 1e-5)
    both = real.do_transform_pose_with_covariance_stamped(uncertain, transform).pose
    expected = [*parts(both.pose), np.array(both.covariance).reshape(6, 6)]
    twist = {"linear": dict.fromkeys("xyz", 0.0), "angular": dict.fromkeys("xyz", 0.0)}
    odometry = {
        "header": header,
        "child_frame_id": "base",
        "pose": {"pose": as_dict(uncertain.pose.pose), "covariance": list(uncertain.pose.covariance)},
        "twist": {"twist": twist, "covariance": [0.0] * 36},
    }
    data, driven = moved(uncertain), moved(odometry)
    for found, covariance in ((data.pose, data.covariance), (driven.pose, driven.pose_covariance)):
        equal += check([found.translation, found.matrix()[:3, :3], covariance], expected)
    # Last, because it sets the translation of the transform to zero.
    expected = real.do_transform_vector3(vector, transform).vector
    equal += check([moved(vector).vector], [[expected.x, expected.y, expected.z]])
print("equal", equal)
