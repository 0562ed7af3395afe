"""Stamped coordinate transforms for programs that live in an event loop.

A `Bus` broadcasts transforms to its buffers; a `Buffer` keeps a few seconds of every frame, answers where a frame was,
seen from another, and lets a lookup wait for data that are still on their way. Works on asyncio and trio, without ROS.
"""

from tfbus.analysis.diagnose import diagnose
from tfbus.analysis.finding import Finding
from tfbus.buffer.buffer import Buffer
from tfbus.buffer.watch import Watch
from tfbus.bus.broadcaster import TransformBroadcaster
from tfbus.bus.bus import Bus
from tfbus.bus.event_stream import EventStream
from tfbus.bus.stream import Stream
from tfbus.bus.thread_publisher import ThreadPublisher
from tfbus.clock import Clock, SimulatedClock, SystemClock, Ticks
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
    AheadError,
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
    RemoteLookupError,
    TransformError,
    TransformLookupError,
    UnknownFrameError,
)
from tfbus.events import (
    AuthorityConflict,
    ClockReset,
    Event,
    FrameAdded,
    FrameLive,
    FrameRemoved,
    FrameStale,
    KindChanged,
    PastLoop,
    PeerJoined,
    PeerLost,
    PeerRejected,
    RecordingDropped,
    RecordingFailed,
    Reparented,
    SampleRejected,
    StampAhead,
    SubscriberFailed,
)
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import Transform
from tfbus.geometry.transform_array import TransformArray
from tfbus.message_filter.message_filter import MessageFilter
from tfbus.registration import Registration
from tfbus.robot.joint import Joint, Mimic
from tfbus.robot.model import LimitViolation, RobotModel
from tfbus.robot.state_publisher import RobotStatePublisher
from tfbus.stamps import LATEST, SECOND, Latest, format_stamp, from_seconds, to_seconds
from tfbus.statistics import (
    BufferServerStatistics,
    BufferStatistics,
    BusStatistics,
    LinkStatistics,
    QueueStatistics,
    RecorderStatistics,
    RobotStatistics,
)
from tfbus.tree.explanation import ExplainedEdge, Explanation
from tfbus.tree.history import Edge, Outcome
from tfbus.tree.policy import Hold
from tfbus.tree.question import Question
from tfbus.tree.tree import TransformTree
from tfbus.waiting.waiting_index import PendingLookup

__all__ = [
    "LATEST",
    "SECOND",
    "AheadError",
    "AuthorityConflict",
    "Buffer",
    "BufferServerStatistics",
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
    "Finding",
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
    "PastLoop",
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
    "RemoteLookupError",
    "Reparented",
    "RobotModel",
    "RobotStatePublisher",
    "RobotStatistics",
    "SampleRejected",
    "SimulatedClock",
    "StampAhead",
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
    "diagnose",
    "do_transform",
    "format_stamp",
    "from_seconds",
    "to_seconds",
]


def __getattr__(name: str) -> str:
    if name != "__version__":
        raise AttributeError(f"module 'tfbus' has no attribute {name!r}")
    # Reading it takes as long as a quarter of the import.
    from importlib.metadata import version

    return version("tfbus")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
