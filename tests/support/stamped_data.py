"""One of each type of stamped data, a transform that they can be moved by, and a way to compare arrays too."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from tfbus import (
    LaserScan,
    PointCloud,
    PointStamped,
    Polygon,
    PoseStamped,
    PoseWithCovarianceStamped,
    QuaternionStamped,
    Transform,
    TransformStamped,
    TwistStamped,
    Vector3Stamped,
    WrenchStamped,
)

# The transform and the numbers of tf2_geometry_msgs' own tests: B is at (10, 20, 30) in A, upside down. They ask for
# data of A in B; here the names are the other way round.
A_FROM_B = Transform((10.0, 20.0, 30.0), (1.0, 0.0, 0.0, 0.0)).inverse()
ANSWER = TransformStamped("A", "B", 2_000_000_000, A_FROM_B)

POINTS = np.array([(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)], np.float32)

VALUES: list[Any] = [
    PointStamped("B", 7, (1.0, 2.0, 3.0)),
    Vector3Stamped("B", 7, (1.0, 2.0, 3.0)),
    QuaternionStamped("B", 7, (0.6, 0.0, 0.0, 0.8)),
    PoseStamped("B", 7, Transform((1.0, 2.0, 3.0))),
    TwistStamped("B", 7, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)),
    WrenchStamped("B", 7, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)),
]
CLOUD = PointCloud("B", 7, POINTS, np.array([7, 8]), {"intensity": np.array([0.5, 1.5])})
SCAN = LaserScan("B", 7, POINTS[0], angle_min=0.0, angle_increment=0.5, intensities=np.array([1, 2, 3]))
HOLDERS: list[Any] = [
    Polygon("B", 7, POINTS),
    PoseWithCovarianceStamped("B", 7, Transform((1.0, 2.0, 3.0)), np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])),
    CLOUD,
    SCAN,
]
"""Data that hold arrays."""

ONE_OF_EACH = [*VALUES, *HOLDERS]
MOVABLE = [data for data in ONE_OF_EACH if data is not SCAN]


def name_of(data: Any) -> str:
    return type(data).__name__


def contents(data: Any) -> dict[str, Any]:
    """All fields, in a form that compares by value and dtype, NaN included."""
    return {part.name: _comparable(getattr(data, part.name)) for part in fields(data)}


def _comparable(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, Mapping):
        return {key: _comparable(part) for key, part in value.items()}
    return value


def arrays_of(data: Any) -> list[np.ndarray[Any, Any]]:
    """Every array that `data` hold."""
    values = [getattr(data, part.name) for part in fields(data)]
    parts = [part for value in values for part in (value.values() if isinstance(value, Mapping) else [value])]
    return [part for part in parts if isinstance(part, np.ndarray)]


def numbers(data: Any) -> np.ndarray[Any, Any]:
    """Every number that a transform can have changed, in one row."""
    row: list[Any] = []
    for part in fields(data):
        value = getattr(data, part.name)
        if isinstance(value, Transform):
            row += (*value.translation, *value.rotation)
        elif isinstance(value, (tuple, np.ndarray)):
            row += np.ravel(value).tolist()
    return np.array(row, np.float64)


# Messages as rclpy has them: mutable, with their frame and stamp in a header


@dataclass
class Time:
    sec: int = 0
    nanosec: int = 0


@dataclass
class Header:
    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@dataclass
class Point:
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass
class PointMessage:
    """As geometry_msgs/PointStamped is."""

    header: Header = field(default_factory=Header)
    point: Point = field(default_factory=Point)
