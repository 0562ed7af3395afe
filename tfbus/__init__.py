"""Stamped coordinate transforms for programs that live in an event loop.

A `Bus` broadcasts transforms to its buffers; a `Buffer` keeps a few seconds of every frame, answers where a frame was,
seen from another, and lets a lookup wait for data that are still on their way. Works on asyncio and trio, without ROS.
"""

from tfbus.broadcaster import TransformBroadcaster
from tfbus.buffer import Buffer
from tfbus.bus import Bus
from tfbus.clock import Clock, SimulatedClock, SystemClock
from tfbus.data import (
    LaserScan,
    PointCloud,
    PointStamped,
    Polygon,
    PoseStamped,
    PoseWithCovarianceStamped,
    QuaternionStamped,
    Stamped,
    TwistStamped,
    Vector3Stamped,
    WrenchStamped,
    do_transform,
)
from tfbus.errors import (
    BusClosedError,
    ClockResetError,
    DisconnectedError,
    ExtrapolationError,
    FutureExtrapolationError,
    GapError,
    InvalidRobotError,
    InvalidTransformError,
    LookupTimeoutError,
    PastExtrapolationError,
    RecordingError,
    TransformError,
    TransformLookupError,
    UnknownFrameError,
)
from tfbus.event_stream import EventStream
from tfbus.events import (
    AuthorityConflict,
    ClockReset,
    Event,
    FrameAdded,
    FrameLive,
    FrameRemoved,
    FrameStale,
    KindChanged,
    PeerJoined,
    PeerLost,
    PeerRejected,
    RecordingDropped,
    RecordingFailed,
    Reparented,
    SampleRejected,
    SubscriberFailed,
)
from tfbus.explanation import ExplainedEdge, Explanation
from tfbus.geometry import Transform
from tfbus.history import Edge, Outcome
from tfbus.joint import Joint, Mimic
from tfbus.message_filter import MessageFilter
from tfbus.policy import Hold
from tfbus.registration import Registration
from tfbus.robot import LimitViolation, RobotModel
from tfbus.robot_state import RobotStatePublisher
from tfbus.stamped import TransformStamped
from tfbus.stamps import LATEST, SECOND, Latest, from_seconds, to_seconds
from tfbus.statistics import (
    BufferStatistics,
    BusStatistics,
    LinkStatistics,
    QueueStatistics,
    RecorderStatistics,
    RobotStatistics,
)
from tfbus.stream import Stream
from tfbus.threadsafe import ThreadPublisher
from tfbus.ticks import Ticks
from tfbus.transform_array import TransformArray
from tfbus.tree import TransformTree
from tfbus.waiting import PendingLookup, Question
from tfbus.watch import Watch

__all__ = [
    "LATEST",
    "SECOND",
    "AuthorityConflict",
    "Buffer",
    "BufferStatistics",
    "Bus",
    "BusClosedError",
    "BusStatistics",
    "Clock",
    "ClockReset",
    "ClockResetError",
    "DisconnectedError",
    "Edge",
    "Event",
    "EventStream",
    "ExplainedEdge",
    "Explanation",
    "ExtrapolationError",
    "FrameAdded",
    "FrameLive",
    "FrameRemoved",
    "FrameStale",
    "FutureExtrapolationError",
    "GapError",
    "Hold",
    "InvalidRobotError",
    "InvalidTransformError",
    "Joint",
    "KindChanged",
    "LaserScan",
    "Latest",
    "LimitViolation",
    "LinkStatistics",
    "LookupTimeoutError",
    "MessageFilter",
    "Mimic",
    "Outcome",
    "PastExtrapolationError",
    "PeerJoined",
    "PeerLost",
    "PeerRejected",
    "PendingLookup",
    "PointCloud",
    "PointStamped",
    "Polygon",
    "PoseStamped",
    "PoseWithCovarianceStamped",
    "QuaternionStamped",
    "Question",
    "QueueStatistics",
    "RecorderStatistics",
    "RecordingDropped",
    "RecordingError",
    "RecordingFailed",
    "Registration",
    "Reparented",
    "RobotModel",
    "RobotStatePublisher",
    "RobotStatistics",
    "SampleRejected",
    "SimulatedClock",
    "Stamped",
    "Stream",
    "SubscriberFailed",
    "SystemClock",
    "ThreadPublisher",
    "Ticks",
    "Transform",
    "TransformArray",
    "TransformBroadcaster",
    "TransformError",
    "TransformLookupError",
    "TransformStamped",
    "TransformTree",
    "TwistStamped",
    "UnknownFrameError",
    "Vector3Stamped",
    "Watch",
    "WrenchStamped",
    "do_transform",
    "from_seconds",
    "to_seconds",
]
