import json
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.joint_messages import KIND, TYPES, joint_state
from support.ros import named, ros1, ros1_of
from support.samples import moving, static
from support.strategies import CHARACTERS

pytest.importorskip("cbor2", reason='pip install "tfbus[rosbridge]"')

import cbor2

from tfbus.links.rosbridge._protocol import (
    JOINT_TYPE,
    advertise,
    decode_content,
    decode_joints,
    is_of_ros2,
    publish,
    read,
    subscribe,
    unsubscribe,
)
from tfbus.tf_message import MalformedMessageError, encode


def test_requests_are_those_of_the_protocol() -> None:
    assert json.loads(subscribe("/tf", "cbor")) == {
        "op": "subscribe",
        "id": "tfbus:/tf",
        "topic": "/tf",
        "type": "tf2_msgs/TFMessage",
        "queue_length": 0,
        "compression": "cbor",
    }
    assert json.loads(unsubscribe("/tf")) == {"op": "unsubscribe", "id": "tfbus:/tf", "topic": "/tf"}
    latched = json.loads(advertise("/tf_static", static=True))
    assert (latched["op"], latched["latch"], latched["queue_size"]) == ("advertise", True, 1)
    each = json.loads(advertise("/tf", static=False))
    assert (each["latch"], each["queue_size"]) == (False, 100)


def test_a_published_message_has_the_fields_of_ros() -> None:
    assert json.loads(publish("/tf", [moving("map", "base", 5_000_000_007, 1.5)])) == {
        "op": "publish",
        "topic": "/tf",
        "msg": {
            "transforms": [
                {
                    "header": {"stamp": {"secs": 5, "nsecs": 7}, "frame_id": "map"},
                    "child_frame_id": "base",
                    "transform": {
                        "translation": {"x": 1.5, "y": 0.0, "z": 0.0},
                        "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
                    },
                }
            ]
        },
    }


def test_messages_are_read_in_every_encoding() -> None:
    samples = [moving("map", "base", 5, 1.5), moving("base", "arm", 6, 2.5)]
    text = publish("/tf", samples)
    raw = {"op": "publish", "topic": "/tf", "msg": {"secs": 1, "nsecs": 2, "bytes": encode(samples)}}
    for message, encoding in ((text, "none"), (cbor2.dumps(json.loads(text)), "cbor"), (cbor2.dumps(raw), "cbor-raw")):
        incoming = read(message)
        assert (incoming.topic, incoming.encoding) == ("/tf", encoding)
        assert decode_content(incoming.content).samples == samples


def test_leading_slashes_of_names_are_left_out_in_every_encoding() -> None:
    other = moving("-map", "--base", 5, 1.5)

    def slashed(message: bytes) -> bytes:
        return named(named(message, "-map", "/map"), "--base", "//base")

    fields = json.loads(slashed(publish("/tf", [other]).encode()))["msg"]
    for content in (fields, slashed(encode([other])), slashed(ros1(ros1_of(other)))):
        assert decode_content(content).samples == [moving("map", "base", 5, 1.5)]


def test_bytes_of_ros_1_are_told_from_those_of_ros_2() -> None:
    many = [static("map", f"f{number}") for number in range(256)]
    for samples in (many[:1], many, []):
        rows = [moving(sample.parent, sample.child, 0) for sample in samples]
        assert decode_content(ros1(*map(ros1_of, rows))).samples == rows
        assert decode_content(encode(rows)).samples == rows


@pytest.mark.parametrize(
    ("content", "ros2"),
    [
        (encode([moving("map", "base", 5)]), True),
        ({"transforms": [{"header": {"stamp": {"sec": 5, "nanosec": 0}}}]}, True),
        (json.loads(publish("/tf", [moving("map", "base", 5)]))["msg"], False),
        (ros1(ros1_of(moving("map", "base", 5))), False),
        (ros1(), False),
        (b"\0\1\0\0", False),
        ({"transforms": []}, False),
        ({"transforms": [5]}, False),
        (5, False),
    ],
)
def test_the_content_of_a_message_tells_whether_it_is_of_ros_2(content: Any, ros2: bool) -> None:
    assert is_of_ros2(content) is ros2


def test_the_status_of_a_server_has_no_topic() -> None:
    incoming = read('{"op": "status", "level": "error", "msg": "no such type"}')
    assert (incoming.topic, incoming.content) == ("", "status: no such type")
    for other in ('{"op": "status", "topic": "/tf", "msg": {}}', '{"op": "publish", "topic": 5, "msg": {}}'):
        assert read(other).topic == ""


@pytest.mark.parametrize("message", ["", "[1]", "nonsense", "5", b"\xff", b"\x05", "[" * 100_000, b"\x81" * 100_000])
def test_what_is_no_message_is_malformed(message: Any) -> None:
    with pytest.raises(MalformedMessageError, match="encoding"):
        read(message)


@given(st.one_of(st.text(CHARACTERS, max_size=50), st.binary(max_size=50)))
def test_garbage_is_a_message_or_malformed(garbage: str | bytes) -> None:
    try:
        incoming = read(garbage)
        decode_content(incoming.content)
    except MalformedMessageError:
        return


def test_positions_of_joints_are_read_in_every_encoding() -> None:
    cdr = joint_state(5, {"a": 0.5, "b": 1.5})
    fields: dict[str, Any] = {"header": {"stamp": {"secs": 0, "nsecs": 5}}, "name": ["a", "b"], "position": [0.5, 1.5]}
    tagged = {**fields, "position": cbor2.CBORTag(86, struct.pack("<2d", 0.5, 1.5))}
    ros1 = bytes(TYPES.cdr_to_ros1(cdr, KIND))
    numbered = struct.pack("<I", 256) + ros1[4:]
    for content in (cdr, ros1, numbered, fields, cbor2.loads(cbor2.dumps(tagged))):
        assert decode_joints(content) == (5, {"a": 0.5, "b": 1.5})
    assert decode_joints({**fields, "name": ["a"]}) == (5, {"a": 0.5})
    assert json.loads(subscribe("/j", "cbor", JOINT_TYPE))["type"] == "sensor_msgs/JointState"


@pytest.mark.parametrize(
    "content",
    [None, {}, {"header": {"stamp": {"sec": 1}}}, b"", {"name": 5}, {"header": {}, "name": [], "position": []}],
)
def test_what_holds_no_positions_is_malformed(content: Any) -> None:
    with pytest.raises(MalformedMessageError):
        decode_joints(content)
    strange = {"header": {"stamp": {"sec": 0, "nanosec": 5}}, "name": ["a"], "position": ["x" * 1_000]}
    with pytest.raises(MalformedMessageError) as raised:
        decode_joints(strange)
    assert str(raised.value).count("x") < 200
    assert str(raised.value).endswith("x")
    few = {"header": {"stamp": {"sec": 0, "nanosec": 5}}, "name": ["a"], "position": []}
    with pytest.raises(MalformedMessageError, match="1 names, and 0 positions"):
        decode_joints(few)
