"""Decoding stored messages: plain CDR, CDR compressed by Zstandard, and ROS 1."""

from functools import cache
from typing import Final, Literal

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore
from zstandard import ZstdDecompressor, ZstdError

from tfbus.geometry.stamped import TransformStamped
from tfbus.recording.formats._storage import Channel
from tfbus.tf_message import Decoded, MalformedMessageError, decode

_COMPRESSED: Final = b"\x28\xb5\x2f\xfd"
"""The first bytes of Zstandard data (RFC 8878, section 3.1.1); a message in CDR begins with a zero."""


def decode_payload(channel: Channel, payload: bytes) -> Decoded[TransformStamped]:
    """Decode the samples of a message, with the authorities of its channel and without leading slashes.

    Raises
    ------
    MalformedMessageError
    """
    if channel.ros1:
        payload = _as_cdr(payload)
    elif payload[:4] == _COMPRESSED:
        payload = _decompress(payload)
    order: Literal["little", "big"] = "little" if payload[1:2] == b"\1" else "big"
    count = int.from_bytes(payload[4:8], order)
    return decode(payload, channel.tags(count), bare_names=True)


def _as_cdr(payload: bytes) -> bytes:
    try:
        return bytes(_types().ros1_to_cdr(payload, "tf2_msgs/msg/TFMessage"))
    except (SerdeError, ValueError, LookupError) as error:
        raise MalformedMessageError("truncated", str(error)) from None


@cache
def _types() -> Typestore:
    return get_typestore(Stores.ROS2_HUMBLE)


def _decompress(payload: bytes) -> bytes:
    try:
        return ZstdDecompressor().decompress(payload)
    except ZstdError as error:
        raise MalformedMessageError("encoding", str(error)) from None
