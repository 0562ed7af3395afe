"""Writing Foxglove's ``FrameTransforms`` in Protocol Buffers, bit by bit.

The numbers of a message stay bytes, as in the other formats, so that a transform keeps every bit. The wire format is
that of Protocol Buffers' "Encoding" page; the numbers of the fields are those of Foxglove's schemas.
"""

import struct
from collections.abc import Sequence
from typing import Final

from tfbus.recording.formats._raw_transforms import RawTransform
from tfbus.recording.formats._storage import Channel
from tfbus.tf_message import MalformedMessageError

FRAME_TRANSFORMS: Final = "foxglove.FrameTransforms"
_VARINT, _FIXED64, _BYTES = 0, 1, 2
_SECONDS: Final = range(-(2**63), 2**63)


def write_protobuf(transforms: Sequence[RawTransform]) -> bytes:
    """A ``foxglove.FrameTransforms``.

    Raises
    ------
    MalformedMessageError
        If a name is no UTF-8, or a stamp does not fit.
    """
    return b"".join(_field(1, _transform(each)) for each in transforms)


def transforms_schema() -> bytes:
    """The definition of ``foxglove.FrameTransforms``; `ImportError` without the extra."""
    from foxglove.messages import FrameTransforms

    return bytes(FrameTransforms.get_schema().data)


def foxglove_channel(source: Channel, metadata: dict[str, str]) -> Channel:
    """The channel for transforms of another channel, in Foxglove's schema."""
    return Channel(source.topic, FRAME_TRANSFORMS, "protobuf", "protobuf", transforms_schema(), metadata)


def _transform(transform: RawTransform) -> bytes:
    seconds, nanoseconds, parent, child, numbers = transform
    if seconds not in _SECONDS:
        raise MalformedMessageError("stamp", f"{seconds} s does not fit the stamp of a message")
    for name in (parent, child):
        try:
            name.decode()
        except UnicodeDecodeError:
            raise MalformedMessageError("text", f"the name {name[:40]!r} is no UTF-8") from None
    values = struct.unpack("8s8s8s8s8s8s8s", numbers)
    return b"".join(
        (
            _field(1, _number(1, seconds) + _number(2, nanoseconds)),
            _field(2, parent),
            _field(3, child),
            _field(4, _doubles(values[:3])),
            _field(5, _doubles(values[3:])),
        )
    )


def _doubles(values: Sequence[bytes]) -> bytes:
    return b"".join(bytes([number << 3 | _FIXED64]) + value for number, value in enumerate(values, 1))


def _number(field: int, value: int) -> bytes:
    return bytes([field << 3 | _VARINT]) + _varint(value % 2**64)


def _field(field: int, content: bytes) -> bytes:
    return bytes([field << 3 | _BYTES]) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    parts = bytearray()
    while value > 0x7F:
        parts.append(value & 0x7F | 0x80)
        value >>= 7
    parts.append(value)
    return bytes(parts)
