"""The message ``sensor_msgs/JointState``, from recordings and from ROS, as its bytes."""

import struct

from tfbus.tf_message import FieldReader, MalformedMessageError


def decode_joint_state(payload: bytes, ros1: bool) -> tuple[int, dict[str, float]]:
    """The stamp in ns, and the position of each joint in rad or m, of a ``sensor_msgs/JointState``.

    Raises
    ------
    MalformedMessageError
        If the payload ends too early, or has fewer positions than names.
    """
    fields = FieldReader(payload, ros1)
    try:
        stamp, _ = fields.header()
        count = fields.count()
        if count * 4 > len(payload) - 4:
            raise MalformedMessageError("truncated", f"{len(payload)} bytes cannot hold {count} names")
        names = [fields.text() for _ in range(count)]
        positions = fields.count()
        if positions < count:
            raise MalformedMessageError("positions", f"there are {count} names, and {positions} positions")
        values = fields.doubles(count)
    except struct.error:
        raise MalformedMessageError("truncated", f"{len(payload)} bytes are too few") from None
    return stamp, {name.decode(errors="replace"): value for name, value in zip(names, values, strict=True)}
