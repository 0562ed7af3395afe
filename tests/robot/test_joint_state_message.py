import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.joint_messages import KIND, TYPES, joint_state

from tfbus.robot.joint_state_message import decode_joint_state
from tfbus.tf_message import MalformedMessageError


@pytest.mark.parametrize("names", [[], ["a"], ["a", "bcd", "efghijk"]])
def test_all_encodings_are_those_of_rosbags(names: list[str]) -> None:
    positions = {name: float(at) + 0.5 for at, name in enumerate(names)}
    cdr = joint_state(1_500_000_001, positions)
    assert decode_joint_state(cdr, ros1=False) == (1_500_000_001, positions)
    big_endian = joint_state(1_500_000_001, positions, little_endian=False)
    assert decode_joint_state(big_endian, ros1=False) == (1_500_000_001, positions)
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


@pytest.mark.parametrize("positions", [{}, {"a": 0.5}])
def test_names_without_positions_are_refused(positions: dict[str, float]) -> None:
    cdr = joint_state(1, positions, more_names=["b", "c"])
    for payload, ros1 in ((cdr, False), (bytes(TYPES.cdr_to_ros1(cdr, KIND)), True)):
        with pytest.raises(MalformedMessageError) as caught:
            decode_joint_state(payload, ros1)
        names = len(positions) + 2
        assert caught.value.reason == "positions"
        assert caught.value.detail == f"there are {names} names, and {len(positions)} positions"


@pytest.mark.parametrize("ros1", [True, False])
def test_a_message_that_ends_before_its_last_position_is_truncated(ros1: bool) -> None:
    payload = joint_state(1, {"shoulder": 0.5, "elbow": 1.0})
    if ros1:
        payload = bytes(TYPES.cdr_to_ros1(payload, KIND))
    end = payload.index(struct.pack("<d", 1.0)) + 8
    assert decode_joint_state(payload[:end], ros1) == (1, {"shoulder": 0.5, "elbow": 1.0})
    for length in range(4 if ros1 else 8, end):
        with pytest.raises(MalformedMessageError) as caught:
            decode_joint_state(payload[:length], ros1)
        assert caught.value.reason == "truncated"


@pytest.mark.parametrize("count", [6, 2**31])
def test_a_count_that_no_message_can_hold_is_refused_at_once(count: int) -> None:
    # The header is followed by 20 bytes, and each name has at least 4 for its length.
    payload = b"\0\1\0\0" + struct.pack("<iII", 1, 2, 1) + b"\0" * 4 + struct.pack("<I", count)
    with pytest.raises(MalformedMessageError, match=f"cannot hold {count} names"):
        decode_joint_state(payload, ros1=False)
    with pytest.raises(MalformedMessageError, match="are too few"):
        decode_joint_state(payload[:-4] + struct.pack("<I", 5), ros1=False)
