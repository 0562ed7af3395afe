"""Transforms of stored messages as they are in the file, bit by bit, and messages of them.

Nothing is checked or normalised here: the numbers stay bytes, so that a transform can pass from one format to another
without a change. The layout of a ROS message is a sequence of numbers and strings; in CDR each is aligned to its size
(see `tfbus.tf_message`), in ROS 1 nothing is aligned, strings have no NUL, and a header begins with a sequence number.
"""

import json
import struct
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from typing import Any, Final, NamedTuple

from tfbus.errors import pip_install
from tfbus.recording.formats._bounds import MAX_MESSAGE
from tfbus.recording.formats._storage import Channel
from tfbus.recording.formats._unfold import UnfoldError, unfold
from tfbus.tf_message import MalformedMessageError

TF_TYPES: Final = frozenset(("tf2_msgs/msg/TFMessage", "tf2_msgs/TFMessage", "tf/msg/tfMessage", "tf/tfMessage"))
FOXGLOVE_TYPES: Final = frozenset(
    f"{package}{name}"
    for package in ("foxglove.", "foxglove_msgs/msg/", "foxglove_msgs/")
    for name in ("FrameTransform", "FrameTransforms")
)
COMPRESSED: Final = b"\x28\xb5\x2f\xfd"
"""The first bytes of Zstandard data (RFC 8878, section 3.1.1); a message in CDR begins with a zero."""

_NUMBERS: Final = struct.Struct("<7d")
_HEADER: Final = b"\x00\x01\x00\x00"


class RawTransform(NamedTuple):
    """One transform of a message."""

    seconds: int
    nanoseconds: int
    parent: bytes
    """The name in UTF-8, as it is in the message."""
    child: bytes
    numbers: bytes
    """Seven little endian float64: x, y, z in m, and the quaternion (x, y, z, w)."""


def holds_transforms(channel: Channel) -> bool:
    """Whether the messages of a channel hold transforms, and can be read."""
    if channel.type in TF_TYPES:
        return channel.encoding in ("cdr", "ros1")
    return channel.type in FOXGLOVE_TYPES and channel.encoding in ("cdr", "ros1", "protobuf", "json")


def parser_of(channel: Channel) -> Callable[[bytes], list[RawTransform]]:
    """The function that parses the messages of a channel; it raises `MalformedMessageError`."""
    single = channel.type.endswith("FrameTransform")
    if channel.encoding == "json":
        return lambda payload: _parse_json(payload, single)
    if channel.encoding == "protobuf":
        return _protobuf_parser(channel, single)
    if channel.encoding == "ros1":
        return lambda payload: _parse_ros1(payload, single, channel.type in TF_TYPES)
    return lambda payload: _parse_cdr(payload, single)


def bounded(payload: bytes) -> bytes:
    """The payload, decompressed if the recorder has compressed it.

    Raises
    ------
    MalformedMessageError
        If it is larger than `MAX_MESSAGE`, compressed or not, or cannot be decompressed.
    """
    try:
        return unfold(payload, "zstd" if payload[:4] == COMPRESSED else "", MAX_MESSAGE)
    except UnfoldError as error:
        raise MalformedMessageError("oversized" if "bound" in str(error) else "encoding", str(error)) from None


def write_cdr(transforms: Sequence[RawTransform]) -> bytes:
    """A little endian ``tf2_msgs/msg/TFMessage`` in CDR; raises `MalformedMessageError` if a stamp does not fit."""
    parts = [_HEADER, struct.pack("<I", len(transforms))]
    at = 4
    for seconds, nanoseconds, parent, child, numbers in transforms:
        names = b"".join(_cdr_string(name) for name in (parent, child))
        # Behind the strings, which end at multiples of 4, the numbers begin at a multiple of 8.
        padding = bytes(-(at + 8 + len(names)) % 8)
        stamp = _pack_stamp("<iI", seconds, nanoseconds)
        parts += (stamp, names, padding, numbers)
        at += 8 + len(names) + len(padding) + 56
    return b"".join(parts)


def _cdr_string(text: bytes) -> bytes:
    # The next one is aligned to 4.
    return struct.pack("<I", len(text) + 1) + text + bytes(1 + -(len(text) + 1) % 4)


def write_ros1(transforms: Sequence[RawTransform]) -> bytes:
    """A ``tf2_msgs/TFMessage`` of ROS 1; raises `MalformedMessageError` if a stamp does not fit."""
    parts = [struct.pack("<I", len(transforms))]
    for seconds, nanoseconds, parent, child, numbers in transforms:
        parts += (bytes(4), _pack_stamp("<II", seconds, nanoseconds))
        for name in (parent, child):
            parts += (struct.pack("<I", len(name)), name)
        parts.append(numbers)
    return b"".join(parts)


def _pack_stamp(layout: str, seconds: int, nanoseconds: int) -> bytes:
    try:
        return struct.pack(layout, seconds, nanoseconds)
    except struct.error:
        raise MalformedMessageError("stamp", f"{seconds} s does not fit the stamp of a message") from None


def _parse_cdr(payload: bytes, single: bool) -> list[RawTransform]:
    order = {b"\0\0": ">", b"\0\1": "<"}.get(payload[:2])
    if order is None:
        raise MalformedMessageError("encoding", f"it is not plain CDR, its header is {payload[:4].hex(' ')}")
    body = payload[4:]
    stamp, size, numbers = struct.Struct(f"{order}iI"), struct.Struct(f"{order}I"), struct.Struct(f"{order}7d")
    found = []
    try:
        (count,) = (1,) if single else size.unpack_from(body)
        at = 0 if single else 4
        for _ in range(count):
            seconds, nanoseconds = stamp.unpack_from(body, at)
            at += 8
            names = []
            for _ in range(2):
                at = at + 3 & -4
                (length,) = size.unpack_from(body, at)
                text = body[at + 4 : at + 4 + length]
                if len(text) < length or not text.endswith(b"\0"):
                    raise MalformedMessageError("text", f"the string {text[:40]!r} does not end with NUL")
                names.append(text[:-1])
                at += 4 + length
            at = at + 7 & -8
            # Only another byte order is unpacked: that may change the bits of a NaN.
            values = body[at : at + 56] if order == "<" else _NUMBERS.pack(*numbers.unpack_from(body, at))
            at += 56
            if at > len(body):
                raise MalformedMessageError("truncated", f"{len(body)} bytes end inside of a transform")
            found.append(RawTransform(seconds, nanoseconds, names[0], names[1], values))
    except struct.error:
        raise MalformedMessageError("truncated", f"{len(body)} bytes end inside of a transform") from None
    if body[at:] not in (b"", b"\0", b"\0\0", b"\0\0\0"):
        raise MalformedMessageError("oversized", f"{len(body) - at} bytes behind the last transform")
    return found


def _parse_ros1(payload: bytes, single: bool, header: bool) -> list[RawTransform]:
    stamp, size = struct.Struct("<II"), struct.Struct("<I")
    found = []
    try:
        (count,) = (1,) if single else size.unpack_from(payload)
        at = 0 if single else 4
        for _ in range(count):
            at += 4 * header
            seconds, nanoseconds = stamp.unpack_from(payload, at)
            at += 8
            names = []
            for _ in range(2):
                (length,) = size.unpack_from(payload, at)
                names.append(payload[at + 4 : at + 4 + length])
                at += 4 + length
            numbers = payload[at : at + 56]
            at += 56
            if at > len(payload):
                raise MalformedMessageError("truncated", f"{len(payload)} bytes end inside of a transform")
            found.append(RawTransform(seconds, nanoseconds, names[0], names[1], numbers))
    except struct.error:
        raise MalformedMessageError("truncated", f"{len(payload)} bytes end inside of a transform") from None
    if at != len(payload):
        raise MalformedMessageError("oversized", f"{len(payload) - at} bytes behind the last transform")
    return found


def _parse_json(payload: bytes, single: bool) -> list[RawTransform]:
    try:
        content = json.loads(payload)
        transforms: list[dict[str, Any]] = [content] if single else content["transforms"]
        return [
            _raw(
                each["timestamp"]["sec"],
                each["timestamp"]["nsec"],
                each["parent_frame_id"],
                each["child_frame_id"],
                [each["translation"][axis] for axis in "xyz"] + [each["rotation"][axis] for axis in "xyzw"],
            )
            for each in transforms
        ]
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError, struct.error, OverflowError) as error:
        raise MalformedMessageError("encoding", f"it is no JSON of Foxglove's schema: {error!r}"[:200]) from None


def _protobuf_parser(channel: Channel, single: bool) -> Callable[[bytes], list[RawTransform]]:
    def parse(payload: bytes) -> list[RawTransform]:
        try:
            message = _protobuf_decoder(channel)(payload)
            transforms: Iterable[Any] = [message] if single else message.transforms
            return [
                _raw(
                    each.timestamp.seconds,
                    each.timestamp.nanos,
                    each.parent_frame_id,
                    each.child_frame_id,
                    [getattr(each.translation, axis) for axis in "xyz"]
                    + [getattr(each.rotation, axis) for axis in "xyzw"],
                )
                for each in transforms
            ]
        except ImportError as error:
            raise MalformedMessageError(
                "missing extra", f"to read it, tfbus needs a package more: {pip_install('foxglove')} ({error})"
            ) from None
        # The schema is in the file: a damaged one raises anything.
        except Exception as error:  # noqa: BLE001
            raise MalformedMessageError("encoding", f"it is no message of its schema: {error!r}"[:200]) from None

    return parse


@lru_cache(maxsize=64)
def _protobuf_decoder(channel: Channel) -> Callable[[bytes], Any]:
    from mcap.records import Schema
    from mcap_protobuf.decoder import DecoderFactory

    schema = Schema(id=1, name=channel.type, encoding="protobuf", data=channel.schema)
    decoder: Callable[[bytes], Any] | None = DecoderFactory().decoder_for("protobuf", schema)
    if decoder is None:
        raise ValueError("its schema is no protobuf")
    return decoder


def _raw(seconds: int, nanoseconds: int, parent: str, child: str, numbers: Sequence[float]) -> RawTransform:
    if not all(isinstance(number, int) for number in (seconds, nanoseconds)):
        raise TypeError("a stamp is no integer")
    return RawTransform(seconds, nanoseconds, parent.encode(), child.encode(), _NUMBERS.pack(*numbers))
