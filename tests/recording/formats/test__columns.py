import struct
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore
from support.samples import moving, static

from tfbus import TransformStamped
from tfbus.recording.formats.storage import Channel, Packed, StoredMessage, pack
from tfbus.recording.formats.transforms import (
    ChannelDecoder,
    ColumnDecoder,
    Columns,
    RawTransform,
    write_cdr,
    write_ros1,
)
from tfbus.tf_message import MAX_NAME, encode

TYPES = get_typestore(Stores.ROS2_HUMBLE)
TF = "tf2_msgs/msg/TFMessage"
METADATA = {"tfbus.authorities": '[["odometry", 1], ["slam", 1]]'}
CDR = Channel("/tf", TF, "cdr", metadata=METADATA)
ROS1 = Channel("/tf", "tf2_msgs/TFMessage", "ros1", metadata={"callerid": "/odometry"})
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


def samples_in(columns: Columns) -> list[TransformStamped]:
    found = []
    for stamp, row in zip(columns.stamps.tolist(), columns.rows.tolist(), strict=True):
        sample = TransformStamped.__new__(TransformStamped)
        sample._fields = columns.parent, columns.child, stamp, tuple(row), columns.authority, columns.static
        found.append(sample)
    return found


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
    found = [sample for each in columns for sample in samples_in(each)]
    for child, samples in one_by_one.items():
        for authority in {sample.authority for sample in samples}:
            its = [sample for sample in samples if sample.authority == authority]
            assert [each for each in found if (each.child, each.authority) == (child, authority)] == its
    assert len(found) == sum(map(len, one_by_one.values()))
    for each in columns:
        assert each.received.tolist() == [stored[at][0] for at in each.order.tolist()]
        assert each.order.tolist() == sorted(each.order.tolist())


GOOD = (1, CDR, encode([moving("map", "odom", 1), moving("odom", "base", 1)]))


@pytest.mark.parametrize(
    "other",
    [
        (2, CDR, raw([("map", "odom")], 1, [(float("nan"), 0, 0, 0, 0, 0, 1)])),
        (2, CDR, raw([("map", "odom")], 1, [(1e10, 0, 0, 0, 0, 0, 1)])),
        (2, CDR, raw([("map", "odom")], 1, [(0, 0, 0, 0, 0, 0, 1.02)])),
        (2, CDR, raw([("map", "odom")], 1, [(0, 0, 0, 0, 0, 0, 0)])),
        (2, CDR, raw([("map", "odom")], 1, [(0, 0, 0, 1e300, 0, 0, 0)])),
        (2, CDR, raw([("map", "odom")], 1, [(0, 0, 0, float("inf"), 0, 0, 0)])),
        (2, CDR, encode([moving("map", "odom", 1)])[:-8]),
        (2, CDR, encode([moving("map", "odom", 1)]) + b"\0"),
        (2, CDR, b"\0\0\0\0" + encode([])[4:]),
        (2, CDR, b""),
        (2, CDR, encode([moving("abc", "abd", 1)]).replace(b"abd", b"abc")),
        (2, CDR, encode([moving("map", "odom", 1)]).replace(b"odom\0", b"odom!")),
        (2, CDR, encode([moving("map", "odom", 1)]).replace(b"odom\0", b"od\xffm\0")),
        (2, CDR, encode([moving("map", "odom", 999_999_999)]).replace(struct.pack("<I", 999_999_999), b"\xff" * 4)),
        (
            2,
            ROS1,
            payload_of(ROS1, [moving("map", "odom", 0)]).replace(b"\0" * 12, b"\0" * 4 + b"\xff" * 4 + b"\0" * 4),
        ),
        (2, CDR, encode([moving("earth", "odom", 2), moving("x", "y", 2)])),
        (2, Channel("/tf", "foxglove.FrameTransform", "json"), b"{}"),
        # Nobody has decided how a channel of that kind is read.
        (2, Channel("/tf", TF, "cdr"), encode([moving("map", "odom", 1)])),
    ],
)
def test_what_may_be_invalid_or_needs_a_judgement_is_left_to_the_slow_path(other: StoredMessage) -> None:
    columns, _ = both([GOOD, (3, CDR, GOOD[2])])
    assert columns is not None
    decoders = {channel: ChannelDecoder(channel, static=False) for channel in (CDR, ROS1, OTHER)}
    assert ColumnDecoder(decoders).decode(packed([GOOD, other])) is None


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
        assert sorted((s for each in columns for s in samples_in(each)), key=str) == sorted(whole, key=str)


def test_leading_slashes_and_static_flags_are_those_of_the_channel() -> None:
    payload = encode([moving("mmap", "bbase", 5)]).replace(b"mmap", b"/map").replace(b"bbase", b"/base")
    decoder = ColumnDecoder({CDR: ChannelDecoder(CDR, static=True)})
    columns = decoder.decode(packed([(1, CDR, payload)]))
    assert columns is not None
    (found,) = columns
    assert found[:4] == ("map", "base", "", True)
    assert samples_in(found) == [static("map", "base", stamp=5)]


def test_samples_of_several_authorities_are_told_apart() -> None:
    columns, _ = both([GOOD, (2, OTHER, encode([moving("map", "odom", 2)]))])
    assert columns is not None
    assert {(each.child, each.authority): each.stamps.tolist() for each in columns} == {
        ("odom", "odometry"): [1],
        ("base", "slam"): [1],
        ("odom", "other"): [2],
    }


IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def stamped(
    channel: Channel, seconds: int, nanoseconds: int, row: Sequence[float] = IDENTITY, child: bytes = b"odom"
) -> bytes:
    """A message of one transform, of which nothing is checked."""
    write = write_ros1 if channel is ROS1 else write_cdr
    return write([RawTransform(seconds, nanoseconds, b"map", child, struct.pack("<7d", *row))])


@pytest.mark.parametrize(
    ("channel", "seconds", "nanoseconds", "valid"),
    [
        (CDR, 2**31 - 1, 999_999_999, True),
        (CDR, -(2**31), 0, True),
        (CDR, 1, 1_000_000_000, False),
        (ROS1, 2**31 - 1, 999_999_999, True),
        (ROS1, 2**31, 0, False),
        (ROS1, 2**32 - 1, 0, False),
        (ROS1, 1, 1_000_000_000, False),
    ],
)
def test_stamps_are_decoded_at_once_up_to_their_bounds(
    channel: Channel, seconds: int, nanoseconds: int, valid: bool
) -> None:
    decoder = ColumnDecoder({channel: ChannelDecoder(channel, static=False)})
    columns = decoder.decode(packed([(1, channel, stamped(channel, seconds, nanoseconds))]))
    if valid:
        assert columns is not None
        assert columns[0].stamps.tolist() == [seconds * 10**9 + nanoseconds]
    else:
        assert columns is None


@pytest.mark.parametrize(
    ("norm", "valid"), [(0.99 - 1e-9, False), (0.99 + 1e-9, True), (1.01 - 1e-9, True), (1.01 + 1e-9, False)]
)
def test_a_quaternion_is_normalised_at_once_if_its_norm_is_off_by_no_more_than_a_hundredth(
    norm: float, valid: bool
) -> None:
    columns, one_by_one = both([(1, CDR, stamped(CDR, 0, 5, (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, -norm)))])
    assert (columns is not None) == valid == bool(one_by_one)
    if columns is not None:
        assert columns[0].rows.tolist() == [[1.0, 2.0, 3.0, 0.0, 0.0, 0.0, -1.0]]


@pytest.mark.parametrize("channel", [CDR, ROS1])
def test_names_are_decoded_at_once_up_to_the_longest(channel: Channel) -> None:
    for size, valid in ((MAX_NAME - 1, True), (MAX_NAME + 1, False)):
        data = stamped(channel, 0, 1, child=b"n" * size)
        decoders = {channel: ChannelDecoder(channel, static=False)}
        assert (ColumnDecoder(decoders).decode(packed([(1, channel, data)])) is not None) == valid


def test_messages_are_decoded_at_once_up_to_their_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tfbus.recording.formats.transforms.MAX_MESSAGE", len(GOOD[2]))
    assert both([GOOD])[0] is not None
    monkeypatch.setattr("tfbus.recording.formats.transforms.MAX_MESSAGE", len(GOOD[2]) - 1)
    assert ColumnDecoder({CDR: ChannelDecoder(CDR, static=False)}).decode(packed([GOOD])) is None


@pytest.mark.parametrize("names", [[f"f{k:03}" for k in range(200)], ["f" * k for k in range(1, 64)]])
def test_many_frames_that_take_turns_are_decoded_at_once(names: list[str]) -> None:
    stored: list[StoredMessage] = [(k, CDR, encode([moving("map", name, k)])) for k, name in enumerate(2 * names)]
    columns, one_by_one = both(stored)
    assert columns is not None
    assert {each.child: samples_in(each) for each in columns} == one_by_one


def test_a_channel_with_more_layouts_than_are_kept_is_left_to_the_slow_path(monkeypatch: pytest.MonkeyPatch) -> None:
    stored: list[StoredMessage] = [(k, CDR, encode([moving("map", f"f{k}", k)])) for k in range(4)]
    monkeypatch.setattr("tfbus.recording.formats.transforms._MAX_LAYOUTS", 3)
    assert both(stored[:3])[0] is not None
    assert both(stored)[0] is None


def test_messages_of_one_size_with_more_structures_than_are_kept_are_left_to_the_slow_path(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # The longer one name is, the shorter is the other.
    stored: list[StoredMessage] = [
        (k, CDR, encode([moving("map", "a" * (8 * k + 3), k), moving("map", "b" * (8 * (4 - k) + 3), k)]))
        for k in range(4)
    ]
    assert len({len(payload) for _, _, payload in stored}) == 1
    monkeypatch.setattr("tfbus.recording.formats.transforms._MAX_STRUCTURES", 3)
    assert both(stored[:3])[0] is not None
    assert both(stored)[0] is None
