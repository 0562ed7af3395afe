"""The messages of the rosbridge protocol, version 2, as far as transforms need them.

``cbor-raw`` gives a message of ROS as its bytes, ``cbor`` its fields in CBOR, and anything else JSON. A server that
does not know an encoding uses another, so the answer is read as it comes.
"""

import json
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import cbor2

from tfbus.geometry.stamped import TransformStamped
from tfbus.links._provenance import ReceivedTransform
from tfbus.links.ros._transforms import as_mapping, decode_mapping, decode_ros1, stamp_of
from tfbus.robot.joint_state_message import decode_joint_state
from tfbus.tf_message import Decoded, MalformedMessageError, decode

TYPE: Final = "tf2_msgs/TFMessage"
"""ROS 2 takes this name too."""
JOINT_TYPE: Final = "sensor_msgs/JointState"
CLOCK_TYPE: Final = "rosgraph_msgs/Clock"
TEXT_TYPE: Final = "std_msgs/String"
QUEUE: Final = 100
_CDR: Final = b"\0\1\0\0"
_DOUBLES: Final = 86
"""The tag of little endian float64 (RFC 8746)."""


class Incoming(NamedTuple):
    """A message of the server."""

    topic: str
    """Empty if the server only tells of its status."""
    content: Any
    """The argument of `decode_content`, or the text of the status."""
    encoding: str
    """``"cbor-raw"``, ``"cbor"`` or ``"none"``, for a message in JSON."""


def subscribe(topic: str, encoding: str, type_: str = TYPE) -> str:
    """The request for all messages of a topic."""
    return _request("subscribe", topic, type=type_, queue_length=0, compression=encoding)


def unsubscribe(topic: str) -> str:
    """The end of that."""
    return _request("unsubscribe", topic)


def advertise(topic: str, static: bool) -> str:
    """The announcement of messages on a topic; the last one is kept for late joiners if they are static."""
    return _request("advertise", topic, type=TYPE, latch=static, queue_size=1 if static else QUEUE)


def publish(topic: str, samples: Sequence[TransformStamped]) -> str:
    """A message of transforms for a topic."""
    return json.dumps({"op": "publish", "topic": topic, "msg": {"transforms": list(map(as_mapping, samples))}})


def read(message: str | bytes) -> Incoming:
    """A message of the server.

    Raises
    ------
    MalformedMessageError
        If it is none.
    """
    try:
        content = json.loads(message) if isinstance(message, str) else cbor2.loads(message)
    # Of a deep or a huge one, the two raise whatever they like.
    except Exception as error:  # noqa: BLE001
        raise MalformedMessageError("encoding", f"it is neither JSON nor CBOR: {error!r}"[:200]) from None
    if not isinstance(content, dict):
        raise MalformedMessageError("encoding", f"a {type(content).__name__} is no message of rosbridge")
    operation, topic = content.get("op"), content.get("topic")
    if operation == "publish" and isinstance(topic, str):
        inner = content.get("msg")
        if isinstance(message, str):
            return Incoming(topic, inner, "none")
        raw = inner.get("bytes") if isinstance(inner, dict) else None
        return Incoming(topic, inner, "cbor") if raw is None else Incoming(topic, raw, "cbor-raw")
    return Incoming("", f"{operation}: {content.get('msg', '')}"[:200], "none")


def decode_content(content: Any) -> Decoded[ReceivedTransform]:
    """The transforms of a message, in bytes of either ROS or as a mapping.

    Raises
    ------
    MalformedMessageError
        If it holds none.
    """
    if not isinstance(content, bytes):
        return decode_mapping(content)
    if content[:2] in (b"\0\0", b"\0\1"):
        try:
            return decode(content, kind=ReceivedTransform, bare_names=True)
        except MalformedMessageError:
            # 256 transforms of ROS 1 begin like that.
            return decode_ros1(content)
    return decode_ros1(content)


def is_of_ros2(content: Any) -> bool:
    """Whether the content of a message of transforms tells that it comes from ROS 2."""
    if isinstance(content, bytes):
        return len(content) > len(_CDR) and content.startswith(_CDR)
    try:
        return "sec" in content["transforms"][0]["header"]["stamp"]
    except (LookupError, TypeError):
        return False


def decode_joints(content: Any) -> tuple[int, dict[str, float]]:
    """The stamp and the positions of joints of a message, in bytes of either ROS or as a mapping.

    Raises
    ------
    MalformedMessageError
        If it holds none.
    """
    if isinstance(content, bytes):
        if content.startswith(_CDR):
            try:
                return decode_joint_state(content, ros1=False)
            except MalformedMessageError:
                # The message with the number 256 of ROS 1 begins like that.
                return decode_joint_state(content, ros1=True)
        return decode_joint_state(content, ros1=True)
    try:
        stamp, names, positions = stamp_of(content["header"]["stamp"]), content["name"], content["position"]
        if isinstance(positions, cbor2.CBORTag) and positions.tag == _DOUBLES:
            positions = memoryview(positions.value).cast("B").cast("d")
        if len(positions) < len(names):
            raise MalformedMessageError("positions", f"there are {len(names)} names, and {len(positions)} positions")
        return stamp, {str(name): float(position) for name, position in zip(names, positions, strict=False)}
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, MalformedMessageError):
            raise
        raise MalformedMessageError("encoding", f"it has not the fields of a JointState: {error!r}"[:200]) from None


def _request(operation: str, topic: str, **arguments: Any) -> str:
    return json.dumps({"op": operation, "id": f"tfbus:{topic}", "topic": topic, **arguments})
