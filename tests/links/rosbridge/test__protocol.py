import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.ros import ros1, ros1_of
from support.samples import moving, static

pytest.importorskip("cbor2", reason='pip install "tfbus[rosbridge]"')

import cbor2

from tfbus.links.rosbridge._protocol import advertise, decode_content, publish, read, subscribe, unsubscribe
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
    assert json.loads(advertise("/tf", static=False))["latch"] is False


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


def test_bytes_of_ros_1_are_told_from_those_of_ros_2() -> None:
    many = [static("map", f"f{number}") for number in range(256)]
    for samples in (many[:1], many, []):
        rows = [moving(sample.parent, sample.child, 0) for sample in samples]
        assert decode_content(ros1(*map(ros1_of, rows))).samples == rows
        assert decode_content(encode(rows)).samples == rows


def test_the_status_of_a_server_has_no_topic() -> None:
    incoming = read('{"op": "status", "level": "error", "msg": "no such type"}')
    assert (incoming.topic, incoming.content) == ("", "status: no such type")


@pytest.mark.parametrize("message", ["", "[1]", "nonsense", "5", b"\xff", b"\x05", "[" * 100_000, b"\x81" * 100_000])
def test_what_is_no_message_is_malformed(message: Any) -> None:
    with pytest.raises(MalformedMessageError, match="encoding"):
        read(message)


@given(st.one_of(st.text(max_size=50), st.binary(max_size=50)))
def test_garbage_is_a_message_or_malformed(garbage: str | bytes) -> None:
    try:
        incoming = read(garbage)
        decode_content(incoming.content)
    except MalformedMessageError:
        return
