import struct

import pytest
from foxglove.messages import FrameTransform, FrameTransforms, Quaternion, Timestamp, Vector3
from hypothesis import given
from hypothesis import strategies as st
from support.strategies import CHARACTERS

from tfbus.recording.formats.copies import foxglove_channel, write_protobuf
from tfbus.recording.formats.storage import Channel
from tfbus.recording.formats.transforms import RawTransform, parser_of
from tfbus.tf_message import MalformedMessageError

CHANNEL = foxglove_channel(Channel("/tf", "tf2_msgs/msg/TFMessage", "cdr"), {})

numbers = st.lists(st.floats(), min_size=7, max_size=7).map(lambda values: struct.pack("<7d", *values))
names = st.text(CHARACTERS, max_size=200).filter(lambda text: text.isprintable()).map(str.encode)
transforms = st.builds(RawTransform, st.integers(-(2**31), 2**40), st.integers(0, 2**31 - 1), names, names, numbers)


@given(transforms=st.lists(transforms, max_size=4))
def test_what_is_written_is_what_the_parser_reads(transforms: list[RawTransform]) -> None:
    assert parser_of(CHANNEL)(write_protobuf(transforms)) == transforms


def test_the_bytes_are_those_of_foxglove_s_own_encoder() -> None:
    theirs = FrameTransforms(
        transforms=[
            FrameTransform(
                timestamp=Timestamp(1_700_000_000, 300),
                parent_frame_id="map",
                child_frame_id="base",
                translation=Vector3(x=1.0, y=-2.0, z=0.1),
                rotation=Quaternion(x=0.1, y=0.2, z=0.3, w=0.9),
            )
        ]
    ).encode()
    ours = RawTransform(1_700_000_000, 300, b"map", b"base", struct.pack("<7d", 1.0, -2.0, 0.1, 0.1, 0.2, 0.3, 0.9))
    assert write_protobuf([ours]) == theirs


def test_a_name_that_is_no_text_is_refused() -> None:
    with pytest.raises(MalformedMessageError, match="UTF-8"):
        write_protobuf([RawTransform(0, 0, b"map", b"\xff", bytes(56))])


def test_the_seconds_that_a_stamp_of_foxglove_holds_are_written() -> None:
    for seconds in (-(2**63), -1, 2**63 - 1):
        edge = RawTransform(seconds, 0, b"map", b"base", bytes(56))
        assert parser_of(CHANNEL)(write_protobuf([edge])) == [edge]
    # A negative number has ten bytes, as one of 64 bits in two's complement.
    before = RawTransform(-1, 0, b"map", b"base", bytes(56))
    assert b"\x08" + b"\xff" * 9 + b"\x01\x10" in write_protobuf([before])
    for seconds in (-(2**63) - 1, 2**63):
        with pytest.raises(MalformedMessageError, match=f"{seconds} s does not fit the stamp") as raised:
            write_protobuf([RawTransform(seconds, 0, b"map", b"base", bytes(56))])
        assert raised.value.reason == "stamp"
