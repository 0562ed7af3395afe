import json
import struct
from typing import Any

import anyio
import anyio.lowlevel
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.joint_messages import KIND, TYPES, joint_state
from support.ros import named, ros1, ros1_of
from support.samples import moving, static
from support.strategies import CHARACTERS

pytest.importorskip("cbor2", reason='pip install "tfbus[rosbridge]"')

import cbor2

from tfbus.links.ros.messages import as_mapping
from tfbus.links.rosbridge.protocol import (
    JOINT_TYPE,
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
    count = 200
    rows = b"\x98" + bytes([count]) + TRANSFORM * (count - 1) + content
    with pytest.raises(MalformedMessageError, match="encoding"):
        await read_large(enveloped(b"\xa1\x6atransforms" + rows), anyio.lowlevel.checkpoint)


@asynchronous
async def test_a_text_of_json_is_read_up_to_its_bound() -> None:
    def message(size: int) -> str:
        return json.dumps({"op": "status", "level": "error", "msg": "x" * size})

    assert (await read_large(message(3 * 2**20 - 2), anyio.lowlevel.checkpoint)) is not None
    with pytest.raises(MalformedMessageError, match="encoding"):
        await read_large(message(3 * 2**20 - 1), anyio.lowlevel.checkpoint)


def large_message(count: int, encoding: str, last: bool = False) -> str | bytes:
    fields = {"transforms": [as_mapping(moving("map", f"frame{number}", number)) for number in range(count)]}
    message: dict[str, Any] = {"op": "publish", "topic": "/tf", "msg": fields}
    if last:
        # The order of fields that have been sorted.
        message = dict(sorted(message.items()))
    if encoding == "cbor":
        return bytes(cbor2.dumps(message))
    return json.dumps(message, indent=1 if last else None)


@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("encoding", ["none", "cbor"])
@asynchronous
async def test_a_large_message_is_read_in_pieces_and_gives_way_after_each(encoding: str, last: bool) -> None:
    turns = 0

    async def give_way() -> None:
        nonlocal turns
        turns += 1

    message = large_message(500, encoding, last)
    assert is_large(message)
    incoming = await read_large(message, give_way)
    assert (incoming.topic, incoming.encoding) == ("/tf", encoding)
    assert turns >= 500
    parts = list(decode_content_in_parts(incoming.content))
    found = [sample for part in parts for sample in part.samples]
    assert found == [moving("map", f"frame{number}", number) for number in range(500)]
    assert max(len(part.samples) for part in parts) <= 40


@given(st.data())
def test_a_damaged_large_message_is_read_or_malformed(data: st.DataObject) -> None:
    message = large_message(60, data.draw(st.sampled_from(["none", "cbor"])))
    at = data.draw(st.integers(0, len(message) - 1))
    piece = data.draw(st.binary(max_size=6))
    end = min(len(message), at + data.draw(st.sampled_from([0, 1, 5, 10**6])))
    damaged: str | bytes
    if isinstance(message, str):
        damaged = message[:at] + piece.decode("latin-1") + message[end:]
    else:
        damaged = message[:at] + piece + message[end:]

    async def check() -> None:
        try:
            incoming = await read_large(damaged, anyio.lowlevel.checkpoint)
            list(decode_content_in_parts(incoming.content)) if incoming.topic and incoming.content else None
        except MalformedMessageError:
            return

    anyio.run(check)


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
    pieces = 0

    async def give_way() -> None:
        nonlocal pieces
        pieces += 1

    with pytest.raises(MalformedMessageError, match=reason):
        await read_large(message, give_way)
    assert pieces <= 150


@asynchronous
async def test_a_long_text_and_long_bytes_are_read_whole() -> None:
    text = "<robot/>\n" * 200_000
    for message in (
        json.dumps({"op": "publish", "topic": "/robot_description", "msg": {"data": text}}),
        bytes(cbor2.dumps({"op": "publish", "topic": "/robot_description", "msg": {"data": text}})),
    ):
        assert (await read_large(message, anyio.lowlevel.checkpoint)).content == {"data": text}
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
