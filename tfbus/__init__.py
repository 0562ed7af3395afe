"""Stamped coordinate transforms for programs that live in an event loop.

A `Bus` broadcasts transforms to its buffers; a `Buffer` keeps a few seconds of every frame, answers where a frame was,
seen from another, and lets a lookup wait for data that are still on their way. Works on asyncio and trio, without ROS.
"""

__version__ = "0.1.0"

_NAMES_IN = {
    "analysis.examiner": ("Finding", "diagnose"),
    "buffer.buffer": ("Buffer",),
    "buffer.watch": ("Watch",),
    "bus.broadcaster": ("TransformBroadcaster",),
    "bus.bus": ("Bus", "ThreadPublisher"),
    "bus.event_stream": ("EventStream",),
    "bus.queues": ("Stream",),
    "clock": ("Clock", "SimulatedClock", "SystemClock", "Ticks"),
    "data": (
        "AccelStamped",
        "Imu",
        "InertiaStamped",
        "LaserScan",
        "NavSatFix",
        "Odometry",
        "Path",
        "PointCloud",
        "PointStamped",
        "PointWithCovarianceStamped",
        "Polygon",
        "PoseArray",
        "PoseStamped",
        "PoseWithCovarianceStamped",
        "QuaternionStamped",
        "Stamped",
        "TwistArray",
        "TwistStamped",
        "TwistWithCovarianceStamped",
        "Vector3Stamped",
        "VelocityStamped",
        "WrenchStamped",
        "do_transform",
    ),
    "errors": (
        "AheadError",
        "BusClosedError",
        "ClockResetError",
        "DisconnectedError",
        "ExtrapolationError",
        "FutureExtrapolationError",
        "GapError",
        "InvalidRobotError",
        "InvalidTransformError",
        "LookupTimeoutError",
        "MissingRecordingError",
        "PastExtrapolationError",
        "RecordingError",
        "RemoteLookupError",
        "TooManyFramesError",
        "TransformError",
        "TransformLookupError",
        "UnknownFrameError",
    ),
    "events": (
        "AuthorityConflict",
        "ClockOffset",
        "ClockReset",
        "Event",
        "FrameAdded",
        "FrameLive",
        "FrameRemoved",
        "FrameStale",
        "KindChanged",
        "PastLoop",
        "PeerClockStepped",
        "PeerJoined",
        "PeerLost",
        "PeerRejected",
        "RecordingDropped",
        "RecordingFailed",
        "Reparented",
        "SampleRejected",
        "StampAhead",
        "StampBehind",
        "SubscriberFailed",
    ),
    "geometry.covariance": ("Covariance",),
    "geometry.stamped": ("TransformStamped",),
    "geometry.transform": ("Transform",),
    "geometry.transform_array": ("TransformArray",),
    "geometry.uncertain": ("UncertainSample",),
    "links.local.local_link": ("LocalLink",),
    "message_filter.message_filter": ("MessageFilter",),
    "recording.static_frames": ("load_static", "save_static"),
    "registration": ("Registration",),
    "robot.model": ("Joint", "LimitViolation", "Mimic", "RobotModel"),
    "robot.state_publisher": ("RobotStatePublisher",),
    "stamps": ("LATEST", "Latest", "SECOND", "format_stamp", "from_seconds", "to_seconds"),
    "statistics": (
        "BufferServerStatistics",
        "BufferStatistics",
        "BusStatistics",
        "LinkStatistics",
        "PeerClock",
        "QueueStatistics",
        "RecorderStatistics",
        "RobotStatistics",
    ),
    "synchronizer": ("SynchronizedSet", "Synchronizer"),
    "tree.explanation": ("ExplainedEdge", "Explanation"),
    "tree.history": ("Edge", "Outcome"),
    "tree.lookup": ("Hold", "Question"),
    "tree.tree": ("TransformTree",),
    "uncertainty": (
        "JointAnswers",
        "Share",
        "UncertainTransform",
        "UncertainTransformArray",
        "UncertainTwist",
        "joint",
    ),
    "waiting.live_tree": ("PendingLookup",),
    "which_kernel": ("kernel",),
}
"""The public names by module. `__init__.pyi` has the same as imports, for type checkers."""

_HOMES = {name: module for module, names in _NAMES_IN.items() for name in names}
_ROOMS = (
    "analysis",
    "axes",
    "camera",
    "data",
    "earth",
    "links",
    "plot",
    "recording",
    "robot",
    "testing",
    "view",
    "web",
)

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> object:
    # A module is loaded when one of its names is used first: numpy alone takes longer than a command that prints help.
    from importlib import import_module

    if name in _HOMES:
        value = getattr(import_module(f"tfbus.{_HOMES[name]}"), name)
    elif name in _ROOMS:
        return import_module(f"tfbus.{name}")
    else:
        from tfbus.tf2_names import ours

        hint = ours("tfbus", name)
        raise AttributeError(f"module 'tfbus' has no attribute {name!r}" + (f": {hint}" if hint else ""))
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
