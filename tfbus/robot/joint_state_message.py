"""The message ``sensor_msgs/JointState``, from recordings and from ROS, as its bytes."""

import struct

from tfbus.stamps import SECOND
from tfbus.tf_message import MalformedMessageError


def decode_joint_state(payload: bytes, ros1: bool) -> tuple[int, dict[str, float]]:
    """The stamp in ns, and the position of each joint in rad or m, of a ``sensor_msgs/JointState``.

    Raises
    ------
    MalformedMessageError
        If the payload ends too early, or has fewer positions than names.
    """
    # CDR counts its alignment from the end of its header; a header of ROS 1 begins with the number of the message.
    body = payload if ros1 else payload[4:]
    order = "<" if ros1 or payload[1:2] == b"\1" else ">"
    size = struct.Struct(f"{order}I")
    at = 4 if ros1 else 0

    def align(unit: int) -> None:
        nonlocal at
        at += 0 if ros1 else -at % unit

    def number() -> int:
        nonlocal at
        align(4)
        (value,) = size.unpack_from(body, at)
        at += 4
        return int(value)

    def text() -> str:
        nonlocal at
        length = number()
        part = body[at : at + length]
        if len(part) < length:
            raise MalformedMessageError("truncated", f"{len(payload)} bytes end inside of a string")
        at += length
        return part.rstrip(b"\0").decode(errors="replace")

    try:
        seconds, nanoseconds = struct.unpack_from(f"{order}{'I' if ros1 else 'i'}I", body, at)
        at += 8
        text()
        count = number()
        if count * 4 > len(body):
            raise MalformedMessageError("truncated", f"{len(payload)} bytes cannot hold {count} names")
        names = [text() for _ in range(count)]
        positions = number()
        if positions < count:
            raise MalformedMessageError("positions", f"there are {count} names, and {positions} positions")
        if positions:
            align(8)
        values = struct.unpack_from(f"{order}{count}d", body, at)
    except struct.error:
        raise MalformedMessageError("truncated", f"{len(payload)} bytes are too few") from None
    return seconds * SECOND + nanoseconds, dict(zip(names, values, strict=True))
