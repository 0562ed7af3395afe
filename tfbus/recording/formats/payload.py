"""The samples of a stored message, whatever it is wrapped in."""

from functools import cache
from typing import Final, Literal

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore
from zstandard import ZstdDecompressor, ZstdError

from tfbus.geometry.stamped import TransformStamped
from tfbus.recording.formats.storage import Channel
from tfbus.tf_message import Decoded, MalformedMessageError, decode

_COMPRESSED: Final = b"\x28\xb5\x2f\xfd"
"""How Zstandard begins (RFC 8878, section 3.1.1); a message in CDR begins with a zero."""


def samples_of(channel: Channel, payload: bytes) -> Decoded[TransformStamped]:
    """What a message holds, with authorities and without leading slashes.

    Raises
    ------
    MalformedMessageError
    """
    if channel.ros1:
        payload = _as_cdr(payload)
    elif payload[:4] == _COMPRESSED:
        payload = _decompressed(payload)
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


def _decompressed(payload: bytes) -> bytes:
    try:
        return ZstdDecompressor().decompress(payload)
    except ZstdError as error:
        raise MalformedMessageError("encoding", str(error)) from None
