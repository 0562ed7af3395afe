"""Reads transforms, the time and a text from messages of ROS, in bytes of either ROS or as mappings.

Links through rosbridge get messages of ROS 1 in bytes, and messages of both in JSON or CBOR, which are mappings here.
Links to ROS 2 get CDR: `tfbus.tf_message` reads the transforms of that, and `tfbus.robot` the positions of joints.

A message of transforms of ROS 1 is their number, then for each ``uint32 seq, sec, nsec``, two strings of a length and
UTF-8, and seven ``float64``; everything is little endian, and nothing is aligned. A transform that is not valid is an
error beside the others. Anything else that is wrong makes the message malformed.
"""

import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from itertools import islice
from typing import Any

from tfbus.errors import InvalidTransformError
from tfbus.geometry.covariance import Covariance
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import Transform
from tfbus.geometry.uncertain import Belief, with_belief
from tfbus.links.replica import FromLink, ReceivedTransform, received
from tfbus.stamps import SECOND
from tfbus.tf_message import MAX_NAME, Decoded, FieldReader, MalformedMessageError

_COUNT = struct.Struct("<I")
_HEAD = struct.Struct("<4xII")
_NUMBERS = struct.Struct("<7d")
_SHORTEST = 4 + 8 + 2 * 4 + 56
_TIME_OF_ROS1 = struct.Struct("<II")
_TIME_OF_CDR = {b"\0\1": struct.Struct("<4xiI"), b"\0\0": struct.Struct(">4xiI")}
_BYTE_ORDERS = {b"\0\1": "<", b"\0\0": ">"}
_SIZE = 4

_Parts = tuple[object, object, int, int, tuple[Any, ...]]
"""Parent, child, seconds, nanoseconds, and x, y, z and the quaternion (x, y, z, w)."""


def decode_ros1(payload: bytes) -> Decoded[ReceivedTransform]:
    """The transforms of a message of ROS 1.

    Raises
    ------
    MalformedMessageError
        If the payload is no such message.
    """
    return _decoded(_parts_of_ros1(payload))


def decode_mapping(message: object) -> Decoded[ReceivedTransform]:
    """The transforms of a message as mappings, by the names that ROS 1 or ROS 2 give to its fields.

    Raises
    ------
    MalformedMessageError
        If it is no such message.
    """
    try:
        return _decoded(_parts_of_mapping(message))
    except (LookupError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise MalformedMessageError("encoding", f"it has not the fields of a TFMessage: {error!r}"[:200]) from None


def decode_odometry(
    content: object, ros1: bool, doubles: Callable[[Any], Any] = lambda value: value
) -> Decoded[FromLink]:
    """The transform of a ``nav_msgs/Odometry``, in bytes or as a mapping: its pose, from its frame to its child.

    A covariance that is known comes along, as that of a drift.

    Parameters
    ----------
    content : bytes or mapping
    ros1 : bool
        Whether bytes are those of ROS 1.
    doubles : callable
        Makes numbers of an array in a mapping.

    Raises
    ------
    MalformedMessageError
        If it is no such message.
    """
    try:
        if isinstance(content, bytes):
            fields = FieldReader(content, ros1)
            stamp, parent = fields.header()
            child, numbers, variances = fields.text(), fields.doubles(7), fields.doubles(36)
            plain = _decoded([(_text(parent), _text(child), stamp // SECOND, stamp % SECOND, numbers)])
            return _drifting(plain, variances)
        message: Any = content
        pose = message["pose"]["pose"]
        transform = {"translation": pose["position"], "rotation": pose["orientation"]}
        plain = _decoded(_parts_of_mapping({"transforms": [{**message, "transform": transform}]}))
        return _drifting(plain, doubles(message["pose"].get("covariance")))
    except struct.error:
        raise MalformedMessageError("truncated", "it ends before the covariance of its pose does") from None
    except (LookupError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise MalformedMessageError("encoding", f"it has not the fields of an Odometry: {error!r}"[:200]) from None


def _drifting(decoded: Decoded[ReceivedTransform], covariance: Any) -> Decoded[FromLink]:
    """Samples with the covariance of odometry; without it if it is unknown, as JSON has null for what is no number."""
    samples: list[FromLink | None] = list(decoded.samples)
    with suppress(TypeError, ValueError, OverflowError):
        if (known := Covariance.from_ros(covariance)) is not None:
            samples = [sample and received(with_belief(sample, Belief(known, "drift"))) for sample in samples]
    return Decoded(samples, decoded.errors)


def decode_ros1_in_parts(payload: bytes, most: int) -> Iterator[Decoded[ReceivedTransform]]:
    """As `decode_ros1`, but at most so many transforms at a time."""
    parts = _parts_of_ros1(payload)
    while (decoded := _decoded(islice(parts, most))).samples:
        yield decoded


def as_mapping(sample: TransformStamped) -> dict[str, Any]:
    """A transform as a mapping, with a stamp that ROS 1 and ROS 2 read."""
    parent, child, stamp, (x, y, z, qx, qy, qz, qw), _, _ = sample._fields
    seconds, nanoseconds = divmod(stamp, SECOND)
    return {
        "header": {"stamp": {"secs": seconds, "nsecs": nanoseconds}, "frame_id": parent},
        "child_frame_id": child,
        "transform": {"translation": {"x": x, "y": y, "z": z}, "rotation": {"x": qx, "y": qy, "z": qz, "w": qw}},
    }


def stamp_of(stamp: Mapping[str, Any]) -> int:
    """The stamp of a message as a mapping, in ns; `TypeError` or `KeyError` if it is none."""
    return _either(stamp, "sec", "secs") * SECOND + _either(stamp, "nanosec", "nsecs")


def _parts_of_ros1(payload: bytes) -> Iterator[_Parts]:
    try:
        (count,) = _COUNT.unpack_from(payload)
        if count * _SHORTEST > len(payload):
            raise MalformedMessageError("truncated", f"{len(payload)} bytes cannot hold {count} transforms")
        at = 4
        for _ in range(count):
            seconds, nanoseconds = _HEAD.unpack_from(payload, at)
            at += _HEAD.size
            names = []
            for _ in range(2):
                (length,) = _COUNT.unpack_from(payload, at)
                names.append(payload[at + 4 : at + 4 + length])
                at += 4 + length
            numbers = _NUMBERS.unpack_from(payload, at)
            at += _NUMBERS.size
            yield *map(_text, names), seconds, nanoseconds, numbers
    except struct.error:
        raise MalformedMessageError("truncated", f"{len(payload)} bytes end inside of a transform") from None
    if at != len(payload):
        raise MalformedMessageError("oversized", f"{len(payload) - at} bytes behind the last transform")


def _text(name: bytes) -> str | None:
    try:
        return name.decode()
    except UnicodeDecodeError:
        return None


def _parts_of_mapping(message: Any) -> Iterator[_Parts]:
    for each in message["transforms"]:
        header, transform = each["header"], each["transform"]
        stamp = header["stamp"]
        seconds, nanoseconds = _either(stamp, "sec", "secs"), _either(stamp, "nanosec", "nsecs")
        numbers = *(transform["translation"][axis] for axis in "xyz"), *(transform["rotation"][axis] for axis in "xyzw")
        yield header["frame_id"], each["child_frame_id"], seconds, nanoseconds, numbers


def _either(stamp: Mapping[str, Any], name: str, of_ros1: str) -> int:
    value = stamp[name if name in stamp else of_ros1]
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"{name} is no integer but {value!r}")
    return value


def _decoded(parts: Iterable[_Parts]) -> Decoded[ReceivedTransform]:
    samples: list[ReceivedTransform | None] = []
    errors: list[InvalidTransformError] = []
    for parent, child, seconds, nanoseconds, numbers in parts:
        bare = [_bare(name) for name in (parent, child)]
        try:
            if None in bare:
                raise InvalidTransformError(
                    f"a frame name must be UTF-8 of at most {MAX_NAME} bytes", reason="frame name"
                )
            if not 0 <= nanoseconds < SECOND:
                raise InvalidTransformError(f"a stamp has less than 1e9 nanosec, got {nanoseconds}", reason="stamp")
            transform = Transform(numbers[:3], numbers[3:])
            samples.append(ReceivedTransform(str(bare[0]), str(bare[1]), seconds * SECOND + nanoseconds, transform))
        except InvalidTransformError as error:
            error.parent, error.child = bare
            errors.append(error.with_traceback(None))
            samples.append(None)
    return Decoded(samples, errors)


def _bare(name: object) -> str | None:
    """A name without leading slashes; None if it is too long or no text."""
    if not isinstance(name, str):
        return None
    try:
        return name.lstrip("/") if len(name.encode()) <= MAX_NAME else None
    except UnicodeEncodeError:
        return None


def decode_clock(content: Any) -> int:
    """The time in ns of a message, in bytes of either ROS or as a mapping.

    Raises
    ------
    MalformedMessageError
        If it holds none.
    """
    if isinstance(content, bytes):
        # Only that of ROS 1 has no header.
        layout = _TIME_OF_ROS1 if len(content) == _TIME_OF_ROS1.size else _TIME_OF_CDR.get(content[:2])
        if layout is None or len(content) < layout.size:
            raise MalformedMessageError("truncated", f"{len(content)} bytes are no time")
        seconds, nanoseconds = layout.unpack_from(content)
        return int(seconds * SECOND + nanoseconds)
    try:
        return stamp_of(content["clock"])
    except (LookupError, TypeError) as error:
        raise MalformedMessageError("encoding", f"it has not the fields of a Clock: {error!r}"[:200]) from None


def decode_text(content: Any) -> str:
    """The text of a message, in bytes of either ROS or as a mapping.

    Raises
    ------
    MalformedMessageError
        If it holds none.
    """
    if isinstance(content, bytes):
        # A text of ROS 1 is its length and as many bytes; one of ROS 2 has a header, and a zero at the end.
        if len(content) >= _SIZE and struct.unpack_from("<I", content)[0] == len(content) - _SIZE:
            return _as_text(content[_SIZE:])
        order = _BYTE_ORDERS.get(content[:2])
        if order is None or len(content) < 2 * _SIZE:
            raise MalformedMessageError("truncated", f"{len(content)} bytes are no text")
        (length,) = struct.unpack_from(f"{order}I", content, _SIZE)
        held = content[2 * _SIZE : 2 * _SIZE + length]
        if len(held) < length:
            raise MalformedMessageError("truncated", f"{len(content)} bytes cannot hold a text of {length}")
        return _as_text(held.removesuffix(b"\0"))
    text = content.get("data") if isinstance(content, dict) else None
    if not isinstance(text, str):
        raise MalformedMessageError("encoding", f"it has not the field of a String: {content!r}"[:200])
    return text


def _as_text(content: bytes) -> str:
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        raise MalformedMessageError("encoding", f"the text is no UTF-8: {error}"[:200]) from None
