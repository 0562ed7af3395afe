import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.joint_messages import KIND, TYPES, joint_state

from tfbus.robot.joint_state_message import decode_joint_state
from tfbus.tf_message import MalformedMessageError


@pytest.mark.parametrize("names", [[], ["a"], ["a", "bcd", "efghijk"]])
def test_both_encodings_are_those_of_rosbags(names: list[str]) -> None:
    positions = {name: float(at) + 0.5 for at, name in enumerate(names)}
    cdr = joint_state(1_500_000_001, positions)
    assert decode_joint_state(cdr, ros1=False) == (1_500_000_001, positions)
    assert decode_joint_state(bytes(TYPES.cdr_to_ros1(cdr, KIND)), ros1=True) == (1_500_000_001, positions)


@pytest.mark.parametrize("ros1", [True, False])
@given(data=st.data())
def test_any_bytes_are_positions_or_malformed(ros1: bool, data: st.DataObject) -> None:
    payload = bytearray(joint_state(1, {"shoulder": 0.5, "elbow": 1.0}))
    for place in data.draw(st.lists(st.integers(0, len(payload) - 1), max_size=3)):
        payload[place] = data.draw(st.integers(0, 255))
    try:
        decode_joint_state(bytes(payload[: data.draw(st.integers(0, len(payload)))]), ros1)
    except MalformedMessageError as error:
        assert error.reason


def test_a_count_that_no_message_can_hold_is_refused_at_once() -> None:
    payload = b"\0\1\0\0" + struct.pack("<iII", 1, 2, 1) + b"\0" * 4 + struct.pack("<I", 2**31)
    with pytest.raises(MalformedMessageError, match="cannot hold 2147483648 names"):
        decode_joint_state(payload, ros1=False)
