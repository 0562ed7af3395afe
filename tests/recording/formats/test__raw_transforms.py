import json
import struct
from collections.abc import Callable

import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from tfbus.recording.formats import transforms
from tfbus.recording.formats.storage import Channel
from tfbus.recording.formats.transforms import (
    RawTransform,
    bounded,
    holds_transforms,
    parser_of,
    write_cdr,
    write_ros1,
)
from tfbus.tf_message import MalformedMessageError

NUMBERS = struct.pack("<7d", 1, 2, 3, 0, 0, 0, 1)
ONE = RawTransform(5, 6, b"map", b"base", NUMBERS)
OTHER = RawTransform(7, 8, b"base", b"camera1", struct.pack("<7d", 4, 5, 6, 0, 0, 1, 0))
THIRD = RawTransform(9, 10, b"base", b"cam", struct.pack("<7d", 7, 8, 9, 0, 1, 0, 0))
CDR, ROS1 = Channel("/tf", "tf2_msgs/msg/TFMessage", "cdr"), Channel("/tf", "tf2_msgs/TFMessage", "ros1")
AS_JSON = {
    "timestamp": {"sec": 5, "nsec": 6},
    "parent_frame_id": "map",
    "child_frame_id": "base",
    "translation": {"x": 1, "y": 2.0, "z": 3},
    "rotation": {"x": 0, "y": 0, "z": 0, "w": 1},
}


def foxglove(encoding: str, name: str = "foxglove.FrameTransforms", schema: bytes = b"") -> Channel:
    return Channel("/tf", name, encoding, encoding, schema)


def test_json_of_one_transform_and_of_many_is_read() -> None:
    assert parser_of(foxglove("json"))(json.dumps({"transforms": [AS_JSON, AS_JSON]}).encode()) == [ONE, ONE]
    assert parser_of(foxglove("json", "foxglove.FrameTransform"))(json.dumps(AS_JSON).encode()) == [ONE]


@pytest.mark.parametrize(
    "text", [b"", b"[", b"[" * 100_000, b"3", b'{"transforms": 3}', b'{"transforms": [{}]}', b"\xff", b"null"]
)
def test_other_json_is_malformed(text: bytes) -> None:
    with pytest.raises(MalformedMessageError):
        parser_of(foxglove("json"))(text)


@pytest.mark.parametrize(
    ("path", "value"), [(("timestamp", "sec"), 1.5), (("translation", "x"), "1"), (("rotation",), 3)]
)
def test_json_with_wrong_values_is_malformed(path: tuple[str, ...], value: object) -> None:
    content = json.loads(json.dumps(AS_JSON))
    inner = content
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    with pytest.raises(MalformedMessageError):
        parser_of(foxglove("json", "foxglove.FrameTransform"))(json.dumps(content).encode())


def test_foxglove_messages_of_ros_have_the_layout_of_ros() -> None:
    many = foxglove("cdr", "foxglove_msgs/msg/FrameTransforms")
    assert parser_of(many)(write_cdr([ONE])) == [ONE]
    # A single one begins at the stamp, so its numbers are aligned otherwise.
    names = b"\4\0\0\0map\0" + b"\5\0\0\0base\0"
    single = b"\0\1\0\0" + struct.pack("<iI", 5, 6) + names
    single += bytes(-(len(single) - 4) % 8) + NUMBERS
    assert parser_of(foxglove("cdr", "foxglove_msgs/msg/FrameTransform"))(single) == [ONE]
    assert parser_of(many)(write_cdr([ONE]) + bytes(3)) == [ONE]
    with pytest.raises(MalformedMessageError, match=r": 4 bytes behind the last transform"):
        parser_of(many)(write_cdr([ONE]) + bytes(4))
    ros1 = struct.pack("<II", 5, 6) + b"\3\0\0\0map\4\0\0\0base" + NUMBERS
    assert parser_of(foxglove("ros1", "foxglove_msgs/FrameTransform"))(ros1) == [ONE]


def in_ros1(transform: RawTransform) -> bytes:
    seconds, nanoseconds, parent, child, numbers = transform
    names = b"".join(struct.pack("<I", len(name)) + name for name in (parent, child))
    return bytes(4) + struct.pack("<II", seconds, nanoseconds) + names + numbers


def test_several_transforms_are_one_message_in_either_encoding() -> None:
    ros1 = write_ros1([ONE, OTHER, THIRD])
    assert ros1 == b"\3\0\0\0" + in_ros1(ONE) + in_ros1(OTHER) + in_ros1(THIRD)
    assert parser_of(ROS1)(ros1) == [ONE, OTHER, THIRD]
    cdr = write_cdr([ONE, OTHER, THIRD])
    # Each string ends at a multiple of 4: the names at 32, 120 and 204, of which only the last is no multiple of 8.
    first = struct.pack("<iI", 5, 6) + b"\4\0\0\0map\0" + b"\5\0\0\0base\0\0\0\0" + NUMBERS
    second = struct.pack("<iI", 7, 8) + b"\5\0\0\0base\0\0\0\0" + b"\x08\0\0\0camera1\0" + OTHER.numbers
    third = struct.pack("<iI", 9, 10) + b"\5\0\0\0base\0\0\0\0" + b"\4\0\0\0cam\0" + bytes(4) + THIRD.numbers
    assert cdr == b"\0\1\0\0\3\0\0\0" + first + second + third
    assert parser_of(CDR)(cdr) == [ONE, OTHER, THIRD]


def test_cdr_is_read_in_either_byte_order_and_in_the_usual_one_bit_for_bit() -> None:
    swapped = struct.pack(">IiI", 1, 5, 6) + b"\0\0\0\4map\0" + b"\0\0\0\5base\0\0\0\0"
    swapped += bytes(-len(swapped) % 8) + struct.pack(">7d", 1, 2, 3, 0, 0, 0, 1)
    assert parser_of(CDR)(b"\0\0\0\0" + swapped) == [ONE]
    # A signalling NaN.
    odd = ONE._replace(numbers=bytes.fromhex("010000000000f07f") + NUMBERS[8:])
    assert parser_of(CDR)(write_cdr([odd])) == [odd]


@pytest.mark.parametrize(("channel", "payload"), [(CDR, write_cdr([ONE, OTHER])), (ROS1, write_ros1([ONE, OTHER]))])
def test_a_message_that_is_cut_anywhere_is_malformed(channel: Channel, payload: bytes) -> None:
    reasons = set()
    for size in range(len(payload)):
        with pytest.raises(MalformedMessageError) as raised:
            parser_of(channel)(payload[:size])
        reasons.add(raised.value.reason)
    # Of CDR, the header may be cut, or a string may be without its NUL.
    assert reasons == ({"truncated"} if channel is ROS1 else {"truncated", "encoding", "text"})


def test_what_is_behind_a_message_of_ros_1_is_told() -> None:
    with pytest.raises(MalformedMessageError, match=r"\(oversized\): 1 bytes behind the last transform"):
        parser_of(ROS1)(write_ros1([ONE]) + bytes(1))


@pytest.mark.parametrize(
    ("write", "channel", "low", "high"), [(write_cdr, CDR, -(2**31), 2**31), (write_ros1, ROS1, 0, 2**32)]
)
def test_the_seconds_that_the_stamp_of_an_encoding_holds_are_written(
    write: Callable[[list[RawTransform]], bytes], channel: Channel, low: int, high: int
) -> None:
    for seconds in (low, high - 1):
        edge = ONE._replace(seconds=seconds)
        assert parser_of(channel)(write([edge])) == [edge]
    for seconds in (low - 1, high):
        with pytest.raises(MalformedMessageError, match=f"{seconds} s does not fit the stamp") as raised:
            write([ONE._replace(seconds=seconds)])
        assert raised.value.reason == "stamp"


def protobuf_schema() -> tuple[bytes, bytes]:
    """The definition of ``foxglove.FrameTransforms``, and a message of it."""
    pb2 = pytest.importorskip("google.protobuf.descriptor_pb2")
    from google.protobuf import descriptor_pool, message_factory, timestamp_pb2

    file = pb2.FileDescriptorProto(name="frames.proto", package="foxglove", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    kind = pb2.FieldDescriptorProto
    fields: dict[str, list[tuple[str, int, str]]] = {
        "Vector3": [(axis, kind.TYPE_DOUBLE, "") for axis in "xyz"],
        "Quaternion": [(axis, kind.TYPE_DOUBLE, "") for axis in "xyzw"],
        "FrameTransform": [
            ("timestamp", kind.TYPE_MESSAGE, ".google.protobuf.Timestamp"),
            ("parent_frame_id", kind.TYPE_STRING, ""),
            ("child_frame_id", kind.TYPE_STRING, ""),
            ("translation", kind.TYPE_MESSAGE, ".foxglove.Vector3"),
            ("rotation", kind.TYPE_MESSAGE, ".foxglove.Quaternion"),
        ],
        "FrameTransforms": [("transforms", kind.TYPE_MESSAGE, ".foxglove.FrameTransform")],
    }
    for name, parts in fields.items():
        message = file.message_type.add(name=name)
        for number, (part, type_, type_name) in enumerate(parts, 1):
            label = kind.LABEL_REPEATED if part == "transforms" else kind.LABEL_OPTIONAL
            message.field.add(name=part, number=number, type=type_, type_name=type_name or None, label=label)
    pool = descriptor_pool.DescriptorPool()
    timestamp = pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(timestamp)
    pool.Add(timestamp)
    pool.Add(file)
    content = message_factory.GetMessageClass(pool.FindMessageTypeByName("foxglove.FrameTransforms"))()
    each = content.transforms.add(parent_frame_id="map", child_frame_id="base")
    each.timestamp.seconds, each.timestamp.nanos = 5, 6
    each.translation.x, each.translation.y, each.translation.z, each.rotation.w = 1, 2, 3, 1
    return pb2.FileDescriptorSet(file=[timestamp, file]).SerializeToString(), content.SerializeToString()


def test_protobuf_is_read_by_the_schema_in_the_file() -> None:
    schema, payload = protobuf_schema()
    assert parser_of(foxglove("protobuf", schema=schema))(payload) == [ONE]
    for wrong in (foxglove("protobuf"), foxglove("protobuf", schema=b"\xff" * 9)):
        with pytest.raises(MalformedMessageError):
            parser_of(wrong)(payload)
    with pytest.raises(MalformedMessageError):
        parser_of(foxglove("protobuf", schema=schema))(b"\xff" * 20)


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
@given(payload=st.binary(max_size=200))
def test_any_bytes_are_transforms_or_malformed(encoding: str, payload: bytes) -> None:
    try:
        parser_of(Channel("/tf", "tf2_msgs/msg/TFMessage", encoding))(payload)
    except MalformedMessageError as error:
        assert error.reason


def test_a_message_in_another_encoding_is_told_by_its_header() -> None:
    parse = parser_of(Channel("/tf", "tf2_msgs/msg/TFMessage", "cdr"))
    with pytest.raises(MalformedMessageError, match=r"its header is 00 07 00 00$"):
        parse(b"\0\7\0\0\1\2\3\4")


def test_of_a_long_text_the_error_shows_the_beginning() -> None:
    body = struct.pack("<I", 1) + bytes(8) + struct.pack("<I", 50) + b"x" * 50 + bytes(80)
    with pytest.raises(MalformedMessageError, match=f"the string b'{'x' * 40}' does not end with NUL"):
        parser_of(CDR)(b"\0\1\0\0" + body)
    with pytest.raises(MalformedMessageError) as raised:
        parser_of(foxglove("json"))(b"\xff" * 300)
    assert len(raised.value.detail) == 200


def test_a_message_is_bounded_compressed_or_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transforms, "MAX_MESSAGE", 300)
    compress = zstandard.compress
    assert bounded(bytes(300)) == bounded(compress(bytes(300))) == bytes(300)
    for payload, reason in (
        (bytes(301), "oversized"),
        (compress(bytes(301)), "oversized"),
        (compress(b"")[:4] + b"\xff" * 30, "encoding"),
    ):
        with pytest.raises(MalformedMessageError) as raised:
            bounded(payload)
        assert raised.value.reason == reason


def test_only_known_types_in_known_encodings_hold_transforms() -> None:
    assert holds_transforms(Channel("/x", "tf2_msgs/msg/TFMessage", "cdr"))
    assert not holds_transforms(Channel("/x", "tf2_msgs/msg/TFMessage", "json"))
    assert holds_transforms(foxglove("json"))
    assert not holds_transforms(foxglove("cbor"))
    assert not holds_transforms(Channel("/tf", "std_msgs/msg/String", "cdr"))
