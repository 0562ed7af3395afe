"""The names of tf2 that a newcomer tries, each with the name that tfbus has instead.

Only an error reads this table. A class gets a descriptor for each name, which raises the `AttributeError`: a method
``__getattr__`` would make every access to an attribute of the class slower, also to those that exist.
"""

from collections.abc import Iterable
from typing import Any, NoReturn, TypeVar

ClassT = TypeVar("ClassT", bound=type)

_LOOKUP = "`lookup(target, source, at, timeout=...)`, which is awaited, or `lookup_nowait(target, source, at)`"
_TRAVEL = "`lookup(target, source, at, source_at=..., fixed=...)`, which is awaited, or `lookup_nowait`"
_TRANSFORM = "`transform(data, target)`, which is awaited, or `transform_nowait`; `from_message` converts a ROS message"
_SEND = "`send(parent, child, transform, at=...)`, or `send_all` for several"
_READERS = {
    "lookup_transform": _LOOKUP,
    "lookupTransform": _LOOKUP,
    "lookup_transform_async": "`await lookup(target, source, at, timeout=...)`",
    "lookup_transform_full": _TRAVEL,
    "lookup_transform_full_async": _TRAVEL,
    "wait_for_transform": _LOOKUP,
    "waitForTransform": _LOOKUP,
    "wait_for_transform_async": "`await lookup(target, source, at, timeout=...)`",
    "canTransform": "`can_transform(target, source, at)`, or `can_transform_within` with a timeout",
    "can_transform_full": "`can_transform(target, source, at, source_at=..., fixed=...)`",
    "transform_full": "`transform(data, target, at=..., fixed=...)`",
    "transformPoint": _TRANSFORM,
    "transformPose": _TRANSFORM,
    "transformPointCloud": _TRANSFORM,
    "set_transform": "`TransformBroadcaster(bus).send(parent, child, transform)`",
    "setTransform": "`TransformBroadcaster(bus).send(parent, child, transform)`",
    "set_transform_static": "`TransformBroadcaster(bus).send_static(parent, child, transform)`",
    "all_frames_as_yaml": "`tree.to_yaml()`",
    "allFramesAsYAML": "`tree.to_yaml()`",
    "all_frames_as_string": "`describe()`",
    "allFramesAsString": "`describe()`",
    "get_latest_common_time": "`tree.latest_common_stamp(target, source)`",
    "getLatestCommonTime": "`tree.latest_common_stamp(target, source)`",
    "get_frame_strings": "`tree.frames()`",
    "getFrameStrings": "`tree.frames()`",
    "frameExists": "`frame in tree`",
    "lookup_velocity": "`tree.twist(frame, reference, at)`",
    "lookupVelocity": "`tree.twist(frame, reference, at)`",
    "lookupTwist": "`tree.twist(frame, reference, at)`",
}
_SENDERS = {
    "sendTransform": _SEND,
    "send_transform": _SEND,
    "send_transform_static": "`send_static(parent, child, transform)`",
}
_OURS: dict[str, dict[str, str]] = {
    "Buffer": _READERS,
    "TransformTree": _READERS,
    "TransformBroadcaster": _SENDERS,
    "Bus": {
        **dict.fromkeys(_READERS, "a method of `Buffer(bus)`"),
        **dict.fromkeys(_SENDERS, "`TransformBroadcaster(bus).send(parent, child, transform)`, or `publish(sample)`"),
    },
    "TransformStamped": {
        "header": "`parent` and `stamp`",
        "child_frame_id": "`child`",
        "frame_id": "`parent`",
        "child_frame": "`child`",
    },
    "command": {
        "view_frames": "`tfbus tree`, or `tfbus view` in the browser",
        "tf2_echo": "`tfbus echo TARGET SOURCE`",
        "tf_echo": "`tfbus echo TARGET SOURCE`",
        "tf2_monitor": "`tfbus monitor`",
        "tf_monitor": "`tfbus monitor`",
        "static_transform_publisher": "`tfbus static PARENT CHILD --xyz X Y Z --rpy ROLL PITCH YAW`",
        "robot_state_publisher": "`tfbus robot FILE`",
        "buffer_server": "`tfbus.links.BufferServer` in a program",
        "rosbag": "`tfbus record` and `tfbus play`",
        "bag": "`tfbus record` and `tfbus play`",
    },
    "tfbus": {
        "TransformListener": "`Buffer(bus)`, which the bus fills",
        "BufferCore": "`TransformTree`",
        "BufferInterface": "`Buffer`",
        "BufferClient": "`lookup` of a link, such as `LocalLink(bus)`",
        "BufferServer": "`tfbus.links.BufferServer`",
        "StaticTransformBroadcaster": "`TransformBroadcaster.send_static`",
        "TransformException": "`TransformError`",
        "LookupException": "`UnknownFrameError`; both have the base `TransformLookupError`",
        "ConnectivityException": "`DisconnectedError`",
        "ExtrapolationException": "`ExtrapolationError`",
        "InvalidArgumentException": "`InvalidTransformError`",
        "TimeoutException": "`LookupTimeoutError`",
        "Time": "an `int` of nanoseconds, from `from_seconds(1.5)`; `Time(0)` is `LATEST`",
        "Duration": "a `float` of seconds",
    },
}


def ours(owner: str, name: str) -> str | None:
    """The words of an error about a name of tf2 that has another name here; None otherwise.

    Parameters
    ----------
    owner : str
        A class, ``"tfbus"`` for the package, or ``"command"`` for the words after ``tfbus``.
    name : str

    Examples
    --------
    >>> ours("tfbus", "TransformListener")
    "tf2's TransformListener is `Buffer(bus)`, which the bus fills"
    """
    instead = _OURS[owner].get(name)
    return None if instead is None else f"tf2's {name} is {instead}"


class _Missing:
    """A name that a class does not have."""

    def __init__(self, owner: str, name: str) -> None:
        self._owner = owner
        self._name = name

    def __get__(self, instance: object, kind: type | None = None) -> NoReturn:
        raise AttributeError(f"{self._owner} has no {self._name!r}: {ours(self._owner, self._name)}")


def says_ours(kind: ClassT) -> ClassT:
    """A decorator of a class of the table: its `AttributeError` for a name of tf2 says the name in tfbus."""
    missing = _OURS[kind.__name__]
    for name in missing:
        setattr(kind, name, _Missing(kind.__name__, name))

    def names(self: Any) -> Iterable[str]:
        return [name for name in object.__dir__(self) if name not in missing]

    # Completion, and what Python suggests in place of a wrong name, should not offer them.
    kind.__dir__ = names  # type: ignore[assignment]
    return kind
