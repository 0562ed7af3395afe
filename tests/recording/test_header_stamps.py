from pathlib import Path

import pytest
import zstandard
from rosbags.typesys import Stores, get_typestore
from support.processes import is_open
from support.recorded import Line, real, write_mcap

from tfbus import RecordingError
from tfbus.recording import header_stamps
from tfbus.recording.formats.storage import Channel
from tfbus.recording.header_stamps import begins_with_header

TYPES = get_typestore(Stores.ROS2_HUMBLE)
POINT = "geometry_msgs/msg/PointStamped"


def point(stamp: int) -> bytes:
    kinds = TYPES.types
    header = kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9), "map")
    return bytes(TYPES.serialize_cdr(kinds[POINT](header, kinds["geometry_msgs/msg/Point"](0.0, 0.0, 0.0)), POINT))


LINES: list[Line] = [(k, "/points", point(1_500_000_000 * k)) for k in range(3)]


def write(path: Path, schema: str, text: bytes, lines: list[Line] = LINES, encoding: str = "cdr") -> Path:
    return write_mcap(path, lines, schema=schema, encoding=encoding, definition=text)


@pytest.mark.parametrize("text", [b"# a point\nstd_msgs/Header header\ngeometry_msgs/Point point\n", b""])
def test_the_stamps_are_those_of_the_headers(tmp_path: Path, text: bytes) -> None:
    found = header_stamps(write(tmp_path / "run.mcap", POINT, text, [*LINES, (9, "/points", b"\0\1")]), "points")
    assert (found.stamps.tolist(), found.from_headers, found.unreadable) == ([0, 1_500_000_000, 3_000_000_000], True, 1)


@pytest.mark.parametrize("seconds", [0, 2**31 - 1])
@pytest.mark.parametrize(
    ("encoding", "payload"),
    [
        ("cdr", "00 01 00 00 {little} 05 00 00 00"),
        ("cdr", "00 00 00 00 {big} 00 00 00 05"),
        # The number that counts the messages comes first.
        ("ros1", "09 09 09 09 {little} 05 00 00 00"),
    ],
)
def test_the_stamp_is_found_in_either_encoding_and_byte_order(
    tmp_path: Path, encoding: str, payload: str, seconds: int
) -> None:
    data = bytes.fromhex(payload.format(little=seconds.to_bytes(4, "little").hex(), big=seconds.to_bytes(4).hex()))
    lines: list[Line] = [(7, "/points", data), (8, "/points", data[:-1])]
    found = header_stamps(write(tmp_path / "run.mcap", POINT, b"", lines, encoding), "/points")
    assert (found.stamps.tolist(), found.unreadable) == ([seconds * 10**9 + 5], 1)


def test_messages_that_the_recorder_has_compressed_are_unfolded_and_what_cannot_be_is_unreadable(
    tmp_path: Path,
) -> None:
    folded = zstandard.compress(point(1_500_000_000))
    lines: list[Line] = [(7, "/points", folded), (8, "/points", folded[:4] + b"\xff" * 30)]
    found = header_stamps(write(tmp_path / "run.mcap", POINT, b"", lines), "/points")
    assert (found.stamps.tolist(), found.unreadable) == ([1_500_000_000], 1)


def test_a_damaged_chunk_is_one_that_is_unreadable(path: Path) -> None:
    write_mcap(path, LINES, schema=POINT, definition=b"", chunk_size=1, use_statistics=False)
    data = bytearray(path.read_bytes())
    data[data.index(point(1_500_000_000))] ^= 1
    path.write_bytes(data)
    found = header_stamps(path, "/points")
    assert (found.stamps.tolist(), found.from_headers, found.unreadable) == ([0, 3_000_000_000], True, 1)


def test_a_cut_file_has_no_unreadable_message(path: Path) -> None:
    write_mcap(path, LINES, schema=POINT, definition=b"", chunk_size=1)
    path.write_bytes(path.read_bytes()[:-20])
    found = header_stamps(path, "/points")
    assert (found.stamps.tolist(), found.unreadable) == ([0, 1_500_000_000, 3_000_000_000], 0)


def test_a_topic_without_messages_is_an_error_that_names_the_others(tmp_path: Path) -> None:
    path = write(tmp_path / "run.mcap", POINT, b"")
    with pytest.raises(RecordingError, match="nothing is on topic '/point'; there are /points") as raised:
        header_stamps(path, "/point")
    # Its traceback still refers to the file.
    assert raised.value.reason == "no such topic"
    assert not is_open(path)


@pytest.mark.parametrize(
    ("channel", "expected"),
    [
        (Channel("/a", "my/msg/A", "cdr", "ros2msg", b"int8 X=1\nstd_msgs/msg/Header header"), True),
        (Channel("/a", "my/A", "ros1", "ros1msg", b"Header header"), True),
        (Channel("/a", "my/A", "ros1", "ros1msg", b"int32 x\nHeader header"), False),
        (Channel("/a", "my/msg/A", "cdr", "ros2msg", b"int8 X=1\n# Header header\n"), False),
        (Channel("/a", "std_msgs/msg/Header", "cdr", "jsonschema", b"Header header"), False),
        (Channel("/a", "my/A", "ros1", "ros1msg", b"Header header # not = a constant"), True),
        (Channel("/a", "my/A", "ros1", "ros1msg", b"\n=====\nMSG: my/B\nHeader header"), False),
        (Channel("/a", "sensor_msgs/LaserScan", "ros1"), True),
        (Channel("/a", "sensor_msgs/msg/LaserScan", "cdr"), True),
        (Channel("/a", "geometry_msgs/msg/Twist", "cdr"), False),
        (Channel("/a", "nonsense", "cdr"), False),
        (Channel("/a", "sensor_msgs/msg/LaserScan", "json"), False),
    ],
)
def test_a_header_is_known_from_the_definition_or_the_type(channel: Channel, expected: bool) -> None:
    assert begins_with_header(channel) is expected


def test_the_stamps_of_a_real_recording_are_those_of_its_transforms() -> None:
    found = header_stamps(real("pr2_tf.bag"), "/joint_states")
    assert found.from_headers
    assert len(found.stamps) > 100
