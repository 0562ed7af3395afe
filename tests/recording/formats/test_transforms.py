"""Messages of transforms in every encoding, decoded one by one and at once."""

import json
import struct
from collections.abc import Callable, Sequence

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore
from support.samples import moving, static

from tfbus import TransformStamped
from tfbus.recording.formats import transforms
from tfbus.recording.formats.copies import foxglove_channel, write_protobuf
from tfbus.recording.formats.storage import Channel, Packed, StoredMessage, pack
from tfbus.recording.formats.transforms import (
    ChannelDecoder,
    ColumnDecoder,
    Columns,
    RawTransform,
    bounded,
    parser_of,
    write_cdr,
    write_ros1,
)
from tfbus.tf_message import MalformedMessageError, encode

NUMBERS = struct.pack("<7d", 1, 2, 3, 0, 0, 0, 1)
ONE = RawTransform(5, 6, b"map", b"base", NUMBERS)
TWO = RawTransform(7, 8, b"base", b"camera1", struct.pack("<7d", 4, 5, 6, 0, 0, 1, 0))
METADATA = {"tfbus.authorities": '[["odometry", 1], ["slam", 1]]'}
CDR = Channel("/tf", "tf2_msgs/msg/TFMessage", "cdr", metadata=METADATA)
ROS1 = Channel("/tf", "tf2_msgs/TFMessage", "ros1", metadata={"callerid": "/odometry"})
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


MALFORMED: list[dict[str, object]] = [
    {"timestamp": {"sec": 1.5, "nsec": 6}},
    {"translation": {"x": "1", "y": 2.0, "z": 3}},
    {"rotation": 3},
]


@pytest.mark.parametrize(
    "text",
    [
        *(b"", b"[", b"[" * 100_000, b"3", b'{"transforms": 3}', b'{"transforms": [{}]}', b"\xff", b"null"),
        *(json.dumps({"transforms": [{**AS_JSON, **wrong}]}).encode() for wrong in MALFORMED),
    ],
    ids=lambda text: repr(text[:60]),
)
def test_other_json_is_malformed(text: bytes) -> None:
    with pytest.raises(MalformedMessageError):
        parser_of(foxglove("json"))(text)


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


def test_cdr_is_read_in_either_byte_order_and_in_the_usual_one_bit_for_bit() -> None:
    swapped = struct.pack(">IiI", 1, 5, 6) + b"\0\0\0\4map\0" + b"\0\0\0\5base\0\0\0\0"
    swapped += bytes(-len(swapped) % 8) + struct.pack(">7d", 1, 2, 3, 0, 0, 0, 1)
    assert parser_of(CDR)(b"\0\0\0\0" + swapped) == [ONE]
    # A signalling NaN.
    odd = RawTransform(*ONE[:4], bytes.fromhex("010000000000f07f") + NUMBERS[8:])
    assert parser_of(CDR)(write_cdr([odd])) == [odd]


@pytest.mark.parametrize(("channel", "payload"), [(CDR, write_cdr([ONE, TWO])), (ROS1, write_ros1([ONE, TWO]))])
def test_a_message_that_is_cut_anywhere_is_malformed(channel: Channel, payload: bytes) -> None:
    reasons = set()
    for size in range(len(payload)):
        with pytest.raises(MalformedMessageError) as raised:
            parser_of(channel)(payload[:size])
        reasons.add(raised.value.reason)
    # Of CDR, the header may be cut, or a string may be without its NUL.
    assert reasons == ({"truncated"} if channel is ROS1 else {"truncated", "encoding", "text"})


def test_a_message_in_another_encoding_is_told_by_its_header() -> None:
    with pytest.raises(MalformedMessageError, match=r"its header is 00 07 00 00$"):
        parser_of(CDR)(b"\0\7\0\0\1\2\3\4")


@pytest.mark.parametrize(
    ("write", "channel", "low", "high"),
    [
        (write_cdr, CDR, -(2**31), 2**31),
        (write_ros1, ROS1, 0, 2**32),
        (write_protobuf, foxglove_channel(CDR, {}), -(2**63), 2**63),
    ],
)
def test_the_seconds_that_the_stamp_of_an_encoding_holds_are_written(
    write: Callable[[list[RawTransform]], bytes], channel: Channel, low: int, high: int
) -> None:
    for seconds in (low, min(0, low + 1), high - 1):
        edge = RawTransform(seconds, *ONE[1:])
        assert parser_of(channel)(write([edge])) == [edge]
    for seconds in (low - 1, high):
        with pytest.raises(MalformedMessageError, match=f"{seconds} s does not fit the stamp") as raised:
            write([RawTransform(seconds, *ONE[1:])])
        assert raised.value.reason == "stamp"


def test_protobuf_is_read_by_the_schema_in_the_file() -> None:
    foxglove_sdk = pytest.importorskip("foxglove.messages")
    one = foxglove_sdk.FrameTransform(
        timestamp=foxglove_sdk.Timestamp(5, 6),
        parent_frame_id="map",
        child_frame_id="base",
        translation=foxglove_sdk.Vector3(x=1.0, y=2.0, z=3.0),
        rotation=foxglove_sdk.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
    )
    payload, schema = foxglove_sdk.FrameTransforms(transforms=[one]).encode(), foxglove_sdk.FrameTransforms.get_schema()
    assert parser_of(foxglove("protobuf", schema=schema.data))(payload) == [ONE]
    for wrong in (foxglove("protobuf"), foxglove("protobuf", schema=b"\xff" * 9)):
        with pytest.raises(MalformedMessageError):
            parser_of(wrong)(payload)
    with pytest.raises(MalformedMessageError):
        parser_of(foxglove("protobuf", schema=schema.data))(b"\xff" * 20)


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


BY_ODOMETRY = Channel("/tf", "tf2_msgs/msg/TFMessage", "cdr", metadata={"tfbus.authorities": '[["odometry", 1]]'})
SAMPLES = [moving("odom", "base", 3, 1.5, "odometry"), moving("base", "wheel", 4, 2.5, "odometry")]
PAYLOAD = encode(SAMPLES)
BY_ROS_1 = bytes(get_typestore(Stores.ROS2_HUMBLE).cdr_to_ros1(PAYLOAD, "tf2_msgs/msg/TFMessage"))


def test_a_refused_transform_stays_refused_under_a_prefix() -> None:
    payload = encode([moving("map", "a", 1), moving("map", "b", 1, 12_345.0)])
    payload = payload.replace(struct.pack("<d", 12_345.0), struct.pack("<d", float("nan")))
    found = ChannelDecoder(BY_ODOMETRY, static=False, prefix="r/").decode(payload)
    assert found.samples == [moving("r/map", "r/a", 1, authority="odometry"), None]
    assert [error.reason for error in found.errors] == ["not finite"]


@pytest.mark.parametrize("channel", [BY_ODOMETRY, ROS1])
@given(payload=st.binary(max_size=300))
def test_any_bytes_are_samples_or_malformed(channel: Channel, payload: bytes) -> None:
    try:
        ChannelDecoder(channel, static=False).decode(payload)
    except MalformedMessageError as error:
        assert error.reason


TYPES = get_typestore(Stores.ROS2_HUMBLE)
TF = "tf2_msgs/msg/TFMessage"
OTHER = Channel("/tf", TF, "cdr", metadata={"tfbus.authorities": '[["other", 1]]'})


def payload_of(channel: Channel, samples: Sequence[TransformStamped]) -> bytes:
    data = encode(samples)
    return bytes(TYPES.cdr_to_ros1(data, TF)) if channel is ROS1 else data


def both(
    stored: list[StoredMessage], prefix: str = ""
) -> tuple[list[Columns] | None, dict[str, list[TransformStamped]]]:
    """The samples that are decoded at once, and one by one."""
    decoders = {channel: ChannelDecoder(channel, static=False, prefix=prefix) for channel in (CDR, ROS1, OTHER)}
    one_by_one: dict[str, list[TransformStamped]] = {}
    for _, channel, payload in stored:
        if isinstance(channel, Channel):
            for sample in decoders[channel].decode(payload).samples:
                if sample is not None:
                    one_by_one.setdefault(sample.child, []).append(sample)
    return ColumnDecoder(decoders).decode(packed(stored)), one_by_one


def packed(stored: Sequence[StoredMessage]) -> Packed:
    found = pack(stored)
    assert found is not None
    return found


Fields = tuple[str, str, int, tuple[float, ...], str, bool]


def fields_of(sample: TransformStamped) -> Fields:
    row = (*sample.transform.translation, *sample.transform.rotation)
    return sample.parent, sample.child, sample.stamp, row, sample.authority, sample.static


def fields_in(columns: Columns) -> list[Fields]:
    return [
        (columns.parent, columns.child, stamp, tuple(row), columns.authority, columns.static)
        for stamp, row in zip(columns.stamps.tolist(), columns.rows.tolist(), strict=True)
    ]


numbers = st.floats(-1e8, 1e8, allow_nan=False)
quaternions = st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: sum(x * x for x in q) > 0.1)


@st.composite
def unnormalised(draw: st.DrawFn) -> tuple[float, ...]:
    """Seven numbers whose quaternion is normalised only nearly."""
    quaternion = np.array(draw(quaternions))
    quaternion *= draw(st.sampled_from([1.0, 1.0 + 1e-15, 1.0 + 1e-9, 0.992, 1.009])) / np.linalg.norm(quaternion)
    return (*draw(st.tuples(numbers, numbers, numbers)), *quaternion.tolist())


def raw(names: Sequence[tuple[str, str]], stamp: int, rows: Sequence[tuple[float, ...]]) -> bytes:
    """A message in CDR whose numbers are as they are given."""
    data = bytearray(encode([moving(parent, child, stamp) for parent, child in names]))
    at = 0
    for row in rows:
        at = data.index(struct.pack("<7d", 0, 0, 0, 0, 0, 0, 1), at)
        data[at : at + 56] = struct.pack("<7d", *row)
    return bytes(data)


NAMES = ([("map", "odom"), ("odom", "base")], [("map", "odom")], [("a", "b"), ("b", "c")])


@given(
    lines=st.lists(
        st.tuples(st.sampled_from([CDR, ROS1]), st.sampled_from(NAMES), st.integers(0, 10**18), unnormalised()),
        max_size=12,
    ),
    prefix=st.sampled_from(["", "r1/"]),
)
def test_the_bits_are_those_of_decoding_one_by_one(
    lines: list[tuple[Channel, list[tuple[str, str]], int, tuple[float, ...]]], prefix: str
) -> None:
    stored: list[StoredMessage] = []
    for at, (channel, names, stamp, row) in enumerate(lines):
        data = raw(names, stamp, [row] * len(names))
        stored.append((at, channel, bytes(TYPES.cdr_to_ros1(data, TF)) if channel is ROS1 else data))
    columns, one_by_one = both(stored, prefix)
    if columns is None:
        # A frame has several parents.
        assert any(len({sample.parent for sample in samples}) > 1 for samples in one_by_one.values())
        return
    found = {(each.child, each.authority): fields_in(each) for each in columns}
    for child, samples in one_by_one.items():
        for authority in {sample.authority for sample in samples}:
            its = [fields_of(sample) for sample in samples if sample.authority == authority]
            assert found[child, authority] == its
    assert sum(map(len, found.values())) == sum(map(len, one_by_one.values()))
    for each in columns:
        assert each.received.tolist() == [stored[at][0] for at in each.order.tolist()]
        assert each.order.tolist() == sorted(each.order.tolist())


GOOD = (1, CDR, encode([moving("map", "odom", 1), moving("odom", "base", 1)]))
IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def stamped(channel: Channel, seconds: int, nanoseconds: int, row: Sequence[float] = IDENTITY) -> StoredMessage:
    """A message of one transform, of which nothing is checked."""
    write = write_ros1 if channel is ROS1 else write_cdr
    return 2, channel, write([RawTransform(seconds, nanoseconds, b"map", b"odom", struct.pack("<7d", *row))])


@pytest.mark.parametrize(
    "other",
    [
        stamped(CDR, 1, 0, (float("nan"), 0, 0, 0, 0, 0, 1)),
        stamped(CDR, 1, 0, (1e10, 0, 0, 0, 0, 0, 1)),
        stamped(CDR, 1, 0, (0, 0, 0, 0, 0, 0, 0.99 - 1e-9)),
        stamped(CDR, 1, 0, (0, 0, 0, 0, 0, 0, 1.01 + 1e-9)),
        stamped(CDR, 1, 0, (0, 0, 0, 0, 0, 0, 0)),
        stamped(CDR, 1, 0, (0, 0, 0, 1e300, 0, 0, 0)),
        stamped(CDR, 1, 0, (0, 0, 0, float("inf"), 0, 0, 0)),
        stamped(CDR, 1, 1_000_000_000),
        stamped(ROS1, 1, 1_000_000_000),
        stamped(ROS1, 2**31, 0),
        stamped(ROS1, 2**32 - 1, 0),
        (2, CDR, encode([moving("map", "odom", 1)])[:-8]),
        (2, CDR, encode([moving("map", "odom", 1)]) + b"\0"),
        (2, CDR, b"\0\0\0\0" + encode([])[4:]),
        (2, CDR, b""),
        (2, CDR, encode([moving("abc", "abd", 1)]).replace(b"abd", b"abc")),
        (2, CDR, encode([moving("map", "odom", 1)]).replace(b"odom\0", b"odom!")),
        (2, CDR, encode([moving("map", "odom", 1)]).replace(b"odom\0", b"od\xffm\0")),
        (2, CDR, encode([moving("earth", "odom", 2), moving("x", "y", 2)])),
        (2, Channel("/tf", "foxglove.FrameTransform", "json"), b"{}"),
        # Nobody has decided how a channel of that kind is read.
        (2, Channel("/tf", TF, "cdr"), encode([moving("map", "odom", 1)])),
    ],
)
def test_a_message_that_may_be_invalid_or_needs_a_judgement_is_left_to_the_slow_path(other: StoredMessage) -> None:
    columns, _ = both([GOOD, (3, CDR, GOOD[2])])
    assert columns is not None
    decoders = {channel: ChannelDecoder(channel, static=False) for channel in (CDR, ROS1, OTHER)}
    assert ColumnDecoder(decoders).decode(packed([GOOD, other])) is None


@pytest.mark.parametrize(
    "message",
    [
        stamped(CDR, 2**31 - 1, 999_999_999),
        stamped(CDR, -(2**31), 0),
        stamped(ROS1, 2**31 - 1, 999_999_999),
        stamped(CDR, 1, 0, (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, -0.99 - 1e-9)),
        stamped(CDR, 1, 0, (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.01 - 1e-9)),
    ],
)
def test_a_message_at_the_bounds_of_a_stamp_or_of_a_norm_is_decoded_at_once(message: StoredMessage) -> None:
    columns, one_by_one = both([message])
    assert columns is not None
    assert fields_in(columns[0]) == [fields_of(sample) for sample in one_by_one["odom"]]


@pytest.mark.parametrize("channel", [CDR, ROS1])
def test_a_message_with_a_wrong_bit_is_left_to_the_slow_path_or_decoded_to_the_same(channel: Channel) -> None:
    payload = payload_of(channel, [moving("map", "odom", 1), moving("odom", "base", 1)])
    decoders = {channel: ChannelDecoder(channel, static=False)}
    for place in range(len(payload)):
        damaged = bytearray(payload)
        damaged[place] ^= 1 << place % 8
        columns = ColumnDecoder(decoders).decode(packed([(1, channel, payload), (2, channel, bytes(damaged))]))
        if columns is None:
            continue
        found = decoders[channel].decode(bytes(damaged))
        assert found.errors == []
        whole = decoders[channel].decode(payload).samples + found.samples
        assert sorted(s for each in columns for s in fields_in(each)) == sorted(map(fields_of, filter(None, whole)))


def test_leading_slashes_and_static_flags_are_those_of_the_channel() -> None:
    payload = encode([moving("mmap", "bbase", 5)]).replace(b"mmap", b"/map").replace(b"bbase", b"/base")
    decoder = ColumnDecoder({CDR: ChannelDecoder(CDR, static=True)})
    columns = decoder.decode(packed([(1, CDR, payload)]))
    assert columns is not None
    (found,) = columns
    assert found[:4] == ("map", "base", "", True)
    assert fields_in(found) == [fields_of(static("map", "base", stamp=5))]


@pytest.mark.parametrize("names", [[f"f{k:03}" for k in range(200)], ["f" * k for k in range(1, 64)]])
def test_many_frames_that_take_turns_are_decoded_at_once(names: list[str]) -> None:
    stored: list[StoredMessage] = [(k, CDR, encode([moving("map", name, k)])) for k, name in enumerate(2 * names)]
    columns, one_by_one = both(stored)
    assert columns is not None
    assert {each.child: fields_in(each) for each in columns} == {
        child: [fields_of(sample) for sample in samples] for child, samples in one_by_one.items()
    }
