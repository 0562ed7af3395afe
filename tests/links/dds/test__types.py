from typing import Any

import pytest
from support.joint_messages import joint_state
from support.samples import moving, static

pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')

from tfbus.links.dds._types import (
    Header,
    Quaternion,
    RawJointState,
    RawTFMessage,
    Time,
    Transform,
    TransformStamped,
    Vector3,
)
from tfbus.tf_message import decode, encode


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


def test_a_message_keeps_its_bytes() -> None:
    payload = encode([moving("map", "base", 5)])
    message = RawTFMessage.deserialize(payload)
    assert message.serialize() == payload
    assert decode(message.payload).samples == [moving("map", "base", 5)]
    assert RawTFMessage.deserialize_key(b"").serialize() == b""


def test_positions_of_joints_come_as_the_bytes_that_rosbags_reads() -> None:
    payload = joint_state(5, {"a": 0.5, "b": 1.5})
    declared: Any = RawJointState.__idl__
    read = declared.deserialize(payload)
    assert (read.name, read.position) == (["a", "b"], [0.5, 1.5])
    assert RawJointState.deserialize(payload).payload == payload
    assert RawJointState.deserialize_key(b"").payload == b""
