import struct

import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore
from support.samples import moving, static

from tfbus.recording.formats.storage import Channel
from tfbus.recording.formats.transforms import ChannelDecoder
from tfbus.tf_message import MalformedMessageError, encode

METADATA = {"tfbus.authorities": '[["odometry", 1]]'}
CDR = Channel("/tf", "tf2_msgs/msg/TFMessage", "cdr", metadata=METADATA)
ROS1 = Channel("/tf", "tf2_msgs/TFMessage", "ros1", metadata={"callerid": "/odometry"})
SAMPLES = [moving("odom", "base", 3, 1.5, "odometry"), moving("base", "wheel", 4, 2.5, "odometry")]
PAYLOAD = encode(SAMPLES)
BY_ROS_1 = bytes(get_typestore(Stores.ROS2_HUMBLE).cdr_to_ros1(PAYLOAD, "tf2_msgs/msg/TFMessage"))


@pytest.mark.parametrize(
    ("channel", "payload"), [(CDR, PAYLOAD), (CDR, zstandard.compress(PAYLOAD)), (ROS1, BY_ROS_1)], ids=str
)
def test_the_samples_are_those_that_were_sent_in_whatever_they_are_wrapped(channel: Channel, payload: bytes) -> None:
    found = ChannelDecoder(channel, static=False).decode(payload)
    assert (found.samples, found.errors) == (SAMPLES, [])


@pytest.mark.parametrize(
    ("metadata", "authorities"),
    [
        ('[["x", 1]]', ["x", "x", "x"]),
        ('[["x", 2], ["y", 1]]', ["x", "x", "y"]),
        ('[["x", 1], ["y", 2]]', ["x", "y", "y"]),
        ('[["x", 2], ["y", 2]]', ["", "", ""]),
        ('[["x", 1], ["y", 1]]', ["", "", ""]),
        ('[["x", 3], ["y", 0]]', ["", "", ""]),
        ("[]", ["", "", ""]),
    ],
)
def test_each_transform_has_the_authority_of_its_run_if_there_are_as_many_as_the_runs_have(
    metadata: str, authorities: list[str]
) -> None:
    channel = Channel("/tf", "tf2_msgs/msg/TFMessage", "cdr", metadata={"tfbus.authorities": metadata})
    decoder = ChannelDecoder(channel, static=True, prefix="r/")
    samples = [static("map", name) for name in "abc"]
    found = decoder.decode(encode(samples)).samples
    assert found == [static("r/map", f"r/{name}", authority=who) for name, who in zip("abc", authorities, strict=True)]
    assert [decoder.authority_of(place, 3) for place in range(3)] == authorities


def test_a_refused_transform_stays_refused_under_a_prefix() -> None:
    payload = encode([moving("map", "a", 1), moving("map", "b", 1, 12_345.0)])
    payload = payload.replace(struct.pack("<d", 12_345.0), struct.pack("<d", float("nan")))
    found = ChannelDecoder(CDR, static=False, prefix="r/").decode(payload)
    assert found.samples == [moving("r/map", "r/a", 1, authority="odometry"), None]
    assert [error.reason for error in found.errors] == ["not finite"]


def test_in_the_other_byte_order_every_transform_has_its_authority_too() -> None:
    # One transform, between frames with names of three letters, stamped 1 s and 2 ns, at x = 1 m.
    name = b"\0\0\0\4abc\0", b"\0\0\0\4xyz\0"
    numbers = struct.pack(">7d", 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    one = struct.pack(">iI", 1, 2) + b"".join(name)
    payload = b"\0\0\0\0" + struct.pack(">I", 2) + one + b"\0" * 4 + numbers + one + numbers
    found = ChannelDecoder(CDR, static=False).decode(payload)
    assert found.samples == [moving("abc", "xyz", 1_000_000_002, 1.0, "odometry")] * 2


@pytest.mark.parametrize("channel", [CDR, ROS1])
@given(payload=st.binary(max_size=300))
def test_any_bytes_are_samples_or_malformed(channel: Channel, payload: bytes) -> None:
    try:
        ChannelDecoder(channel, static=False).decode(payload)
    except MalformedMessageError as error:
        assert error.reason


@pytest.mark.parametrize("channel", [CDR, ROS1])
@given(data=st.data())
def test_a_message_that_is_cut_or_turned_over_is_samples_or_malformed(channel: Channel, data: st.DataObject) -> None:
    payload = bytearray(PAYLOAD if channel is CDR else BY_ROS_1)
    payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    end = data.draw(st.integers(0, len(payload)))
    try:
        ChannelDecoder(channel, static=False).decode(bytes(payload[:end]))
    except MalformedMessageError as error:
        assert error.reason


def test_what_only_looks_compressed_is_malformed() -> None:
    with pytest.raises(MalformedMessageError) as raised:
        ChannelDecoder(CDR, static=False).decode(b"\x28\xb5\x2f\xfd" + b"\xff" * 30)
    assert raised.value.reason == "encoding"
