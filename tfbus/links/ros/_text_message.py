"""The message ``std_msgs/String``, in which a robot is described."""

import struct
from typing import Any

from tfbus.tf_message import MalformedMessageError

_HEADERS = {b"\0\1": "<", b"\0\0": ">"}
_SIZE = 4


def decode_text(content: Any) -> str:
    """The text of a message, in bytes of either ROS or as a mapping.

    Raises
    ------
    MalformedMessageError
        If it holds none.
    """
    if isinstance(content, bytes):
        # That of ROS 1 is its length and as many bytes; that of ROS 2 has a header, and a zero at the end.
        if len(content) >= _SIZE and struct.unpack_from("<I", content)[0] == len(content) - _SIZE:
            return _as_text(content[_SIZE:])
        order = _HEADERS.get(content[:2])
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
