import struct
from typing import Any

import pytest

from tfbus.links.ros.messages import decode_text
from tfbus.tf_message import MalformedMessageError

URDF = "<robot name='\u00e4'/>"
RAW = URDF.encode()


@pytest.mark.parametrize(
    "content",
    [
        struct.pack("<I", len(RAW)) + RAW,
        b"\0\1\0\0" + struct.pack("<I", len(RAW) + 1) + RAW + b"\0",
        b"\0\0\0\0" + struct.pack(">I", len(RAW) + 1) + RAW + b"\0",
        # Aligned to four bytes, as some middlewares do.
        b"\0\1\0\0" + struct.pack("<I", len(RAW) + 1) + RAW + b"\0\0\0",
        {"data": URDF},
    ],
)
def test_the_text_of_either_ros(content: Any) -> None:
    assert decode_text(content) == URDF


@pytest.mark.parametrize("content", [bytes(4), b"\0\1\0\0" + bytes(4), b"\0\1\0\0\1\0\0\0\0", {"data": ""}])
def test_a_text_may_be_empty(content: Any) -> None:
    assert decode_text(content) == ""


@pytest.mark.parametrize(
    "content",
    [b"", b"\0\1\0\0", b"\7\7\0\0\0\0\0\0", b"\0\1\0\0\5\0\0\0a", b"\1\0\0\0\xff", {}, {"data": 5}, None, [1]],
)
def test_what_is_no_text_is_refused(content: Any) -> None:
    with pytest.raises(MalformedMessageError):
        decode_text(content)
