"""Messages as rclpy has them: mutable, with their frame and stamp in a header."""

from dataclasses import dataclass, field


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
