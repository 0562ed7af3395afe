import struct
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.joint_messages import joint_state
from support.samples import moving, static

pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')

from cyclonedds.idl._support import Endianness

from tfbus.links.dds.types import (
    Gid,
    Header,
    NodeEntitiesInfo,
    ParticipantEntitiesInfo,
    Quaternion,
    RawEntitiesInfo,
    RawJointState,
    RawTFMessage,
    Time,
    Transform,
    TransformStamped,
    Vector3,
)
from tfbus.tf_message import encode


def test_the_bytes_of_a_message_are_those_that_the_library_writes_and_reads() -> None:
    samples = [moving("map", "base", 5_000_000_007, 1.0), static("base", "a camera", 2.0)]
    rows: Any = [
        TransformStamped(
            Header(Time(*divmod(sample.stamp, 10**9)), sample.parent),
            sample.child,
            Transform(Vector3(*sample.transform.translation), Quaternion(*sample.transform.rotation)),
        )
        for sample in samples
    ]
    declared: Any = RawTFMessage.__idl__
    assert bytes(declared.serialize(RawTFMessage(rows))) == encode(samples)
    assert declared.deserialize(encode(samples)).transforms == rows


def test_positions_of_joints_come_as_the_bytes_that_rosbags_reads() -> None:
    payload = joint_state(5, {"a": 0.5, "b": 1.5})
    declared: Any = RawJointState.__idl__
    read = declared.deserialize(payload)
    assert (read.name, read.position) == (["a", "b"], [0.5, 1.5])


@pytest.mark.parametrize("order", ["Little", "Big"])
def test_the_nodes_of_a_participant_are_read_as_the_library_writes_them(order: str) -> None:
    gids: list[Any] = [Gid([number] * 16) for number in range(5)]  # type: ignore[arg-type]
    make: Any = NodeEntitiesInfo
    nodes: Any = [make("/robot", "driver", gids[1:2], gids[2:4]), make("/", "a", [], gids[4:])]
    written = bytes(ParticipantEntitiesInfo(gids[0], nodes).serialize(endianness=Endianness[order]))
    own, second, third, fourth = (f"{number:02d}" * 16 for number in (0, 2, 3, 4))
    assert RawEntitiesInfo.deserialize(written).read() == (own, [("/robot/driver", [second, third]), ("/a", [fourth])])


def test_a_false_count_of_publishers_ends_at_once() -> None:
    with pytest.raises(ValueError, match="4294967295 entries in 4 bytes"):
        RawEntitiesInfo.deserialize(b"\0\1\0\0" + bytes(16) + b"\xff" * 4 + bytes(4)).read()


@given(st.binary(max_size=100), st.binary(max_size=8), st.integers(0, 100))
def test_garbage_has_names_of_nodes_or_is_told(rest: bytes, changed: bytes, at: int) -> None:
    good = b"\0\1\0\0" + bytes(16) + struct.pack("<II2s2xI2s2xII", 1, 2, b"/\0", 2, b"a\0", 0, 1) + bytes(16)
    for payload in (rest, good[:at] + changed + good[at + len(changed) :], good[:at] + rest):
        with suppress(ValueError, struct.error):
            RawEntitiesInfo.deserialize(payload).read()
