import struct
from typing import Any

import pytest
from support.joint_messages import TYPES

from tfbus.links.ros.messages import decode_clock
from tfbus.tf_message import MalformedMessageError

KIND = "rosgraph_msgs/msg/Clock"


def test_a_time_is_read_from_every_encoding() -> None:
    kinds = TYPES.types
    cdr = bytes(TYPES.serialize_cdr(kinds[KIND](kinds["builtin_interfaces/msg/Time"](5, 7)), KIND))
    big = b"\0\0\0\0" + struct.pack(">iI", 5, 7)
    fields = [{"clock": {"sec": 5, "nanosec": 7}}, {"clock": {"secs": 5, "nsecs": 7}}]
    for content in (cdr, big, bytes(TYPES.cdr_to_ros1(cdr, KIND)), *fields):
        assert decode_clock(content) == 5_000_000_007


@pytest.mark.parametrize(
    "content", [b"", b"\0\1\0\0", bytes(9), b"\1" * 12, None, {}, {"clock": 5}, {"clock": {"sec": 1}}]
)
def test_what_holds_no_time_is_malformed(content: Any) -> None:
    with pytest.raises(MalformedMessageError):
        decode_clock(content)
