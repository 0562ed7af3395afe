import json
import math
import struct
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.joint_messages import ODOMETRY, TYPES, odometry
from support.ros import ros1, ros1_of
from support.samples import moving
from support.worlds import random_covariance

from tfbus import Transform, TransformStamped, UncertainSample
from tfbus.links.ros.messages import (
    as_mapping,
    decode_clock,
    decode_mapping,
    decode_odometry,
    decode_ros1,
    decode_text,
)
from tfbus.tf_message import MAX_NAME, MalformedMessageError

SAMPLES = [
    moving("map", "base", 5_000_000_007, 1.0),
    TransformStamped("base", "a", 2**31 * 10**9 + 999_999_999, Transform((1.5, -2.0, 0.25), (0.5, -0.5, 0.5, -0.5))),
]


UNIT = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def test_a_message_of_ros_1_gives_its_transforms() -> None:
    decoded = decode_ros1(ros1(*map(ros1_of, SAMPLES)))
    assert (decoded.samples, decoded.errors) == (SAMPLES, [])
    assert decode_ros1(ros1()).samples == []


@pytest.mark.parametrize(
    ("transform", "reason"),
    [
        ((b"map", b"/", 1, 0, UNIT), "frame name"),
        ((b"map", b"\xff", 1, 0, UNIT), "frame name"),
        ((b"x" * 1025, b"a", 1, 0, UNIT), "frame name"),
        ((b"a", b"//a", 1, 0, UNIT), "self transform"),
        ((b"map", b"a", 1, 10**9, UNIT), "stamp"),
        ((b"map", b"a", 1, 0, (*UNIT[:6], float("nan"))), "not finite"),
    ],
)
def test_a_transform_that_is_not_valid_is_refused_and_the_next_one_is_there(transform: Any, reason: str) -> None:
    decoded = decode_ros1(ros1(transform, (b"//map", b"/b", 2, 3, UNIT)))
    assert decoded.samples == [None, moving("map", "b", 2_000_000_003)]
    (error,) = decoded.errors
    assert error.reason == reason
    assert error.child in ("", "a", None)


def test_the_shortest_transforms_are_not_taken_for_too_few_bytes() -> None:
    # 76 bytes each, without a letter in their names.
    shortest = ros1(*[(b"", b"", 1, 0, UNIT)] * 100)
    assert len(shortest) == 4 + 100 * 76
    decoded = decode_ros1(shortest)
    assert decoded.samples == [None] * 100
    assert {error.reason for error in decoded.errors} == {"frame name"}


def test_no_bytes_raise_another_error_than_that_they_are_no_message() -> None:
    whole = ros1(*map(ros1_of, SAMPLES))
    for size in range(len(whole)):
        with pytest.raises(MalformedMessageError, match="truncated"):
            decode_ros1(whole[:size])
    with pytest.raises(MalformedMessageError, match="oversized") as oversized:
        decode_ros1(whole + bytes(3))
    assert "3 bytes behind the last transform" in str(oversized.value)
    with pytest.raises(MalformedMessageError, match="truncated"):
        decode_ros1(struct.pack("<I", 2**32 - 1) + bytes(1_000))


@given(st.binary(max_size=300))
def test_garbage_is_a_message_or_malformed(garbage: bytes) -> None:
    for decode in (decode_ros1, decode_clock, decode_text, partial(decode_odometry, ros1=True)):
        for content in (garbage, b"\0\1\0\0" + garbage):
            with suppress(MalformedMessageError):
                decode(content)


def test_a_mapping_gives_the_transforms_that_it_was_made_of_in_the_names_of_either_ros() -> None:
    rows = [as_mapping(sample) for sample in SAMPLES]
    assert rows[0]["header"] == {"stamp": {"secs": 5, "nsecs": 7}, "frame_id": "map"}
    assert decode_mapping(json.loads(json.dumps({"transforms": rows}))).samples == SAMPLES
    for row in rows:
        stamp = row["header"]["stamp"]
        row["header"]["stamp"] = {"sec": stamp["secs"], "nanosec": stamp["nsecs"]}
    assert decode_mapping({"transforms": rows}).samples == SAMPLES


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("header",), None),
        (("header", "stamp"), {"sec": 1}),
        (("header", "stamp"), {"sec": 1.5, "nanosec": 0}),
        (("header", "stamp"), {"sec": True, "nanosec": 0}),
        (("transform", "rotation"), {}),
        (("transform", "translation", "x"), "1"),
        (("transform", "translation", "x"), None),
        (("transform",), 5),
    ],
)
def test_a_mapping_without_the_fields_is_malformed(path: tuple[str, ...], value: object) -> None:
    row = as_mapping(SAMPLES[0])
    inner: Any = row
    for name in path[:-1]:
        inner = inner[name]
    inner[path[-1]] = value
    with pytest.raises(MalformedMessageError) as caught:
        decode_mapping({"transforms": [row]})
    assert caught.value.reason == "encoding"


@pytest.mark.parametrize(
    "message", [None, 5, [], {}, {"transforms": 5}, {"transforms": [5]}, "text", {"transforms": "x"}]
)
def test_what_is_no_mapping_of_transforms_is_malformed(message: Any) -> None:
    with pytest.raises(MalformedMessageError, match="encoding"):
        decode_mapping(message)


def test_the_longest_names_come_in() -> None:
    longest = [moving("p" * MAX_NAME, "c" * MAX_NAME, 5)]
    assert decode_ros1(ros1(*map(ros1_of, longest))).samples == longest
    assert decode_mapping({"transforms": list(map(as_mapping, longest))}).samples == longest


def test_names_of_a_mapping_are_checked_as_those_of_bytes() -> None:
    for name in (7, None, "x" * 1025, "\ud800"):
        row = {**as_mapping(SAMPLES[0]), "child_frame_id": name}
        decoded = decode_mapping({"transforms": [row]})
        assert decoded.samples == [None]
        assert [error.reason for error in decoded.errors] == ["frame name"]


def test_odometry_is_the_transform_of_its_pose_in_every_encoding() -> None:
    for size in range(8):
        # Names of all lengths, because the alignment depends on them.
        sample = TransformStamped("o" * (size + 1), "base", 5_000_000_007, SAMPLES[1].transform)
        for little_endian in (True, False):
            assert decode_odometry(odometry(sample, little_endian), ros1=False) == ([sample], [])
        assert decode_odometry(bytes(TYPES.cdr_to_ros1(odometry(sample), ODOMETRY)), ros1=True) == ([sample], [])
    row = as_mapping(sample)
    position, turn = row["transform"]["translation"], row["transform"]["rotation"]
    message = {**row, "pose": {"pose": {"position": position, "orientation": turn}}}
    assert decode_odometry(message, ros1=False) == ([sample], [])
    for content in (odometry(sample)[:60], odometry(sample)[:300], {}, {**message, "pose": {}}, 5):
        with pytest.raises(MalformedMessageError):
            decode_odometry(content, ros1=False)


KNOWN = random_covariance(np.random.default_rng(1), 0.1, 0.05).ravel()


def test_a_covariance_of_odometry_that_is_known_comes_as_that_of_a_drift_in_every_encoding() -> None:
    sample = TransformStamped("odom", "base", 7, SAMPLES[1].transform)
    in_ros2 = odometry(sample, covariance=KNOWN)
    row = as_mapping(sample)
    pose = {"position": row["transform"]["translation"], "orientation": row["transform"]["rotation"]}
    for found in (
        decode_odometry(in_ros2, ros1=False),
        decode_odometry(odometry(sample, little_endian=False, covariance=KNOWN), ros1=False),
        decode_odometry(bytes(TYPES.cdr_to_ros1(in_ros2, ODOMETRY)), ros1=True),
        decode_odometry({**row, "pose": {"pose": pose, "covariance": KNOWN.tolist()}}, ros1=False),
    ):
        (decoded,) = found.samples
        assert (decoded, found.errors) == (sample, [])
        assert isinstance(decoded, UncertainSample)
        assert decoded.kind == "drift"
        assert np.array_equal(decoded.covariance.matrix.ravel(), KNOWN)
    unknown: list[Any] = [[0.0] * 36, [-1.0, *KNOWN[1:]], [1e6, *KNOWN[1:]], [math.nan] * 36, [None] * 36, KNOWN[:35]]
    unknown += [{}, "guess", [10**400] * 36, None]
    for covariance in unknown:
        found = decode_odometry({**row, "pose": {"pose": pose, "covariance": covariance}}, ros1=False)
        (decoded,) = found.samples
        assert (decoded, found.errors) == (sample, [])
        assert not isinstance(decoded, UncertainSample)


KIND = "rosgraph_msgs/msg/Clock"


def test_a_time_is_read_from_every_encoding() -> None:
    kinds = TYPES.types
    cdr = bytes(TYPES.serialize_cdr(kinds[KIND](kinds["builtin_interfaces/msg/Time"](5, 7)), KIND))
    big = b"\0\0\0\0" + struct.pack(">iI", 5, 7)
    fields = [{"clock": {"sec": 5, "nanosec": 7}}, {"clock": {"secs": 5, "nsecs": 7}}]
    for content in (cdr, big, bytes(TYPES.cdr_to_ros1(cdr, KIND)), *fields):
        assert decode_clock(content) == 5_000_000_007


@pytest.mark.parametrize(
    "content", [b"", b"\0\1\0\0", bytes(9), b"\1" * 12, None, {}, {"clock": 5}, {"clock": {"sec": 1}}]
)
def test_what_holds_no_time_is_malformed(content: Any) -> None:
    with pytest.raises(MalformedMessageError):
        decode_clock(content)


@pytest.mark.parametrize("text", ["<robot name='\u00e4'/>", ""])
def test_a_text_is_read_from_every_encoding(text: str) -> None:
    raw = text.encode()
    little = b"\0\1\0\0" + struct.pack("<I", len(raw) + 1) + raw + b"\0"
    big = b"\0\0\0\0" + struct.pack(">I", len(raw) + 1) + raw + b"\0"
    # Some middlewares align the end to four bytes.
    for content in (struct.pack("<I", len(raw)) + raw, little, big, little + b"\0\0", {"data": text}):
        assert decode_text(content) == text
    assert decode_text(b"\0\1\0\0" + bytes(4)) == ""


@pytest.mark.parametrize(
    "content",
    [b"", b"\0\1\0\0", b"\7\7\0\0\0\0\0\0", b"\0\1\0\0\5\0\0\0a", b"\1\0\0\0\xff", {}, {"data": 5}, None, [1]],
)
def test_what_is_no_text_is_refused(content: Any) -> None:
    with pytest.raises(MalformedMessageError):
        decode_text(content)
