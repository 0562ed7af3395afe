"""The message ``rosgraph_msgs/Clock``, the time of a simulation."""

import struct
from typing import Any

from tfbus.links.ros._transforms import stamp_of
from tfbus.stamps import SECOND
from tfbus.tf_message import MalformedMessageError

_ROS1 = struct.Struct("<II")
_CDR = {b"\0\1": struct.Struct("<4xiI"), b"\0\0": struct.Struct(">4xiI")}


def decode_clock(content: Any) -> int:
    """The time in ns of a message, in bytes of either ROS or as a mapping.

    Raises
    ------
    MalformedMessageError
        If it holds none.
    """
    if isinstance(content, bytes):
        # Only that of ROS 1 has no header.
        layout = _ROS1 if len(content) == _ROS1.size else _CDR.get(content[:2])
        if layout is None or len(content) < layout.size:
            raise MalformedMessageError("truncated", f"{len(content)} bytes are no time")
        seconds, nanoseconds = layout.unpack_from(content)
        return int(seconds * SECOND + nanoseconds)
    try:
        return stamp_of(content["clock"])
    except (LookupError, TypeError) as error:
        raise MalformedMessageError("encoding", f"it has not the fields of a Clock: {error!r}"[:200]) from None
