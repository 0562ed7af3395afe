import json
import struct
from typing import Any

import anyio
import anyio.lowlevel
import pytest
from support.joint_messages import KIND, TYPES, joint_state
from support.ros import ros1, ros1_of
from support.samples import moving, static

pytest.importorskip("cbor2", reason='pip install "tfbus[rosbridge]"')

import cbor2

from tfbus.links.ros.messages import as_mapping
from tfbus.links.rosbridge.protocol import (
    OTHER_TYPES,
    advertise,
    decode_content,
    decode_content_in_parts,
    decode_joints,
    is_large,
    is_of_ros2,
    publish,
    read,
    read_large,
    subscribe,
    unsubscribe,
)
from tfbus.tf_message import MalformedMessageError, encode

asynchronous = pytest.mark.anyio


@pytest.mark.parametrize(
    ("request_", "fields"),
    [
        (
            subscribe("/tf", "cbor"),
            {"op": "subscribe", "type": "tf2_msgs/TFMessage", "queue_length": 0, "compression": "cbor"},
        ),
        (
            subscribe("/tf", "none", OTHER_TYPES["joints"]),
            {"op": "subscribe", "type": "sensor_msgs/JointState", "queue_length": 0, "compression": "none"},
        ),
        (unsubscribe("/tf"), {"op": "unsubscribe"}),
        (
            advertise("/tf", static=True),
            {"op": "advertise", "type": "tf2_msgs/TFMessage", "latch": True, "queue_size": 1},
        ),
        (
            advertise("/tf", static=False),
            {"op": "advertise", "type": "tf2_msgs/TFMessage", "latch": False, "queue_size": 100},
        ),
    ],
)
def test_requests_are_those_of_the_protocol(request_: str, fields: dict[str, Any]) -> None:
    assert json.loads(request_) == {"id": "tfbus:/tf", "topic": "/tf", **fields}


def test_a_published_message_has_the_fields_of_ros() -> None:
    transform = {"translation": {"x": 1.5, "y": 0.0, "z": 0.0}, "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    header = {"stamp": {"secs": 5, "nsecs": 7}, "frame_id": "map"}
    row = {"header": header, "child_frame_id": "base", "transform": transform}
    request = json.loads(publish("/tf", [moving("map", "base", 5_000_000_007, 1.5)]))
    assert request == {"op": "publish", "topic": "/tf", "msg": {"transforms": [row]}}


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


class Turns:
    """Counts how often others had their turn."""

    count = 0

    async def give_way(self) -> None:
        self.count += 1


def enveloped(content: bytes) -> bytes:
    """A message in CBOR with some content."""
    return b"\xa3\x62op\x67publish\x65topic\x63/tf\x63msg" + content


TRANSFORM = cbor2.dumps(as_mapping(moving("map", "base", 5)))


@pytest.mark.parametrize(
    "content",
    [
        cbor2.dumps({5: 0}),
        cbor2.dumps({2**64 * (2**61 - 1): 0}),
        cbor2.dumps({0.5: 0}),
        b"\xa1\x80\x00",
        *(
            cbor2.dumps(cbor2.CBORTag(tag, value))
            for tag, value in [(258, [1, 2]), (30, [1, 2]), (35, "(a)"), (2, b"123")]
        ),
        *(cbor2.dumps(cbor2.CBORTag(tag, value)) for tag, value in [(4, [1, 2]), (5, [9, 2]), (28, [1]), (256, ["a"])]),
        b"\x81" * 50,
        b"\xd8\x40" * 50,
    ],
)
@asynchronous
async def test_what_costs_a_decoder_more_than_its_bytes_is_refused_in_small_and_in_large_messages(
    content: bytes,
) -> None:
    with pytest.raises(MalformedMessageError, match="encoding"):
        read(enveloped(content))
    large = b"\xa2\x64more" + content + b"\x64fill\x59\x40\x00" + bytes(2**14)
    with pytest.raises(MalformedMessageError, match="encoding"):
        await read_large(enveloped(large), anyio.lowlevel.checkpoint)
    rows = b"\x98\xc8" + TRANSFORM * 199 + content
    with pytest.raises(MalformedMessageError, match="encoding"):
        await read_large(enveloped(b"\xa1\x6atransforms" + rows), anyio.lowlevel.checkpoint)


@asynchronous
async def test_a_text_of_json_is_read_up_to_its_bound() -> None:
    def message(size: int) -> str:
        return json.dumps({"op": "status", "level": "error", "msg": "x" * size})

    assert (await read_large(message(3 * 2**20 - 2), anyio.lowlevel.checkpoint)) is not None
    with pytest.raises(MalformedMessageError, match="encoding"):
        await read_large(message(3 * 2**20 - 1), anyio.lowlevel.checkpoint)


@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("encoding", ["none", "cbor"])
@asynchronous
async def test_a_large_message_is_read_in_pieces_and_gives_way_after_each(encoding: str, last: bool) -> None:
    samples = [moving("map", f"frame{number}", number) for number in range(500)]
    request = json.loads(publish("/tf", samples))
    if last:
        # The order of fields that have been sorted.
        request = dict(sorted(request.items()))
    message = bytes(cbor2.dumps(request)) if encoding == "cbor" else json.dumps(request, indent=1 if last else None)
    assert is_large(message)
    turns = Turns()
    incoming = await read_large(message, turns.give_way)
    assert (incoming.topic, incoming.encoding) == ("/tf", encoding)
    assert turns.count >= 500
    parts = list(decode_content_in_parts(incoming.content))
    assert [sample for part in parts for sample in part.samples] == samples
    assert max(len(part.samples) for part in parts) <= 40


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (enveloped(b"\xa1\x6atransforms\x9a\x00\x3f\x00\x00" + b"\x80" * 0x3F0000), "encoding"),
        (enveloped(b"\xa1\x61a" + b"\x9a\x00\x0f\x00\x00" + b"\x80" * 0xF0000), "encoding"),
        ('{"op": "publish", "msg": {"transforms": [' + "{}," * 1_000_000 + "{}]}}", "encoding"),
        ("[" * 2**20, "encoding"),
        ('{"op": ' + "9" * 2**20 + "}", "encoding"),
        ('{"op": ' + " " * 2**20 + "1}", "encoding"),
        (cbor2.dumps({f"field{number}": 0 for number in range(5_000)}), "oversized"),
        ('{"op": "publish"} ' + "x" * 2**15, "encoding"),
    ],
)
@asynchronous
async def test_a_large_message_that_is_none_is_given_up_at_the_first_piece_that_tells_it(
    message: str | bytes, reason: str
) -> None:
    turns = Turns()
    with pytest.raises(MalformedMessageError, match=reason):
        await read_large(message, turns.give_way)
    assert turns.count <= 150


@asynchronous
async def test_a_long_text_and_long_bytes_are_read_whole() -> None:
    described = {"op": "publish", "topic": "/robot_description", "msg": {"data": "<robot/>\n" * 200_000}}
    for message in (json.dumps(described), bytes(cbor2.dumps(described))):
        assert (await read_large(message, anyio.lowlevel.checkpoint)).content == described["msg"]
    rows = [moving("map", f"frame{number}", 0) for number in range(1_000)]
    for payload in (encode(rows), ros1(*map(ros1_of, rows))):
        raw = bytes(cbor2.dumps({"op": "publish", "topic": "/tf", "msg": {"secs": 1, "nsecs": 2, "bytes": payload}}))
        incoming = await read_large(raw, anyio.lowlevel.checkpoint)
        assert incoming.encoding == "cbor-raw"
        assert [sample for part in decode_content_in_parts(incoming.content) for sample in part.samples] == rows


def test_positions_of_joints_are_read_in_every_encoding() -> None:
    cdr = joint_state(5, {"a": 0.5, "b": 1.5})
    fields: dict[str, Any] = {"header": {"stamp": {"secs": 0, "nsecs": 5}}, "name": ["a", "b"], "position": [0.5, 1.5]}
    tagged = {**fields, "position": cbor2.CBORTag(86, struct.pack("<2d", 0.5, 1.5))}
    ros1 = bytes(TYPES.cdr_to_ros1(cdr, KIND))
    numbered = struct.pack("<I", 256) + ros1[4:]
    for content in (cdr, ros1, numbered, fields, cbor2.loads(cbor2.dumps(tagged))):
        assert decode_joints(content) == (5, {"a": 0.5, "b": 1.5})
    assert decode_joints({**fields, "name": ["a"]}) == (5, {"a": 0.5})


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
