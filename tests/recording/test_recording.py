"""The files that are recordings, the topics of them that are read, and the reports about the rest."""

import errno
import gzip
import math
import os
import socket
import struct
import sys
from collections.abc import Iterable, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from support.processes import OPEN_FILES, is_open
from support.recorded import SMALL, Line, as_ros2, in_blocks, messages_in, without_unfinished, write_mcap
from support.samples import moving, static

from tfbus import InvalidTransformError, RecordingError, TransformStamped
from tfbus.recording import RecordedTopic, convert, open_recording
from tfbus.recording.formats.storage import Channel
from tfbus.recording.recording import Choice, Selection, looks_like_transforms
from tfbus.tf_message import encode

SECOND = 1_000_000_000
LINES = [
    (10, "/tf_static", [static("base", "laser", 1.0), static("base", "camera", 1.0)]),
    (20, "/tf", [moving("odom", "base", 20)]),
    (30, "/tf_static", [static("base", "laser", 2.0)]),
    (40, "/tf", [moving("odom", "base", 40)]),
    (50, "/tf_static", [static("base", "laser", 3.0)]),
]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write_mcap(tmp_path / "run.mcap", LINES)


def test_the_content_of_a_file_decides_its_format_not_its_name(tmp_path: Path, recording: Path) -> None:
    (sqlite,) = as_ros2(SMALL, tmp_path / "bag", StoragePlugin.SQLITE3).glob("*.db3")
    for source in (SMALL, recording, sqlite):
        renamed = tmp_path / "measurement.bin"
        renamed.write_bytes(source.read_bytes())
        named, unnamed = (
            [(message.received, message.batch) for message in messages_in(path)] for path in (source, renamed)
        )
        assert unnamed == named


OLD_LASER, NEW_LASER, CAMERA = static("base", "laser", 1.0), static("base", "laser", 2.0), static("base", "camera", 1.0)


@pytest.mark.parametrize(
    ("since", "until", "before", "times"),
    [
        (10, None, [], [10, 20, 30, 40, 50]),
        (11, None, [OLD_LASER, CAMERA], [20, 30, 40, 50]),
        # In the order in which they came last.
        (35, 50, [CAMERA, NEW_LASER], [40, 50]),
        (10 * SECOND, None, [CAMERA, static("base", "laser", 3.0)], []),
        (None, 9, [], []),
        (5, 3, [], []),
    ],
)
def test_a_range_begins_with_the_newest_static_transform_of_each_frame_from_before(
    recording: Path, since: int | None, until: int | None, before: list[TransformStamped], times: list[int]
) -> None:
    expected: list[tuple[int | None, tuple[TransformStamped, ...]]] = [(since, (sample,)) for sample in before]
    expected += [(received, tuple(samples)) for received, _, samples in LINES if received in times]
    assert [(message.received, message.batch) for message in messages_in(recording, since, until)] == expected


def test_good_transforms_come_with_the_errors_of_the_bad_ones(tmp_path: Path) -> None:
    payload = encode([moving("a", "b", 1), moving("a", "c", 1, 12_345.0), moving("a", "d", 1)])
    nan = payload.replace(struct.pack("<d", 12_345.0), struct.pack("<d", math.nan))
    (message,) = messages_in(write_mcap(tmp_path / "bad.mcap", [(7, "/tf", nan)]))
    assert message.received == 7
    assert message.batch == (moving("a", "b", 1), moving("a", "d", 1))
    (error,) = message.errors
    assert isinstance(error, InvalidTransformError)
    assert (error.reason, error.child) == ("not finite", "c")


@pytest.mark.parametrize("suffix", ["mcap", "bag", "db3"])
@given(
    times=st.lists(st.integers(0, 30), max_size=40),
    lengths=st.lists(st.integers(1, 3), min_size=1, max_size=5),
    chunk_size=st.integers(1, 2_000),
    ends=st.tuples(*[st.integers(0, 30)] * 2),
)
# One chunk has all messages.
@example(times=[3, 1, 2], lengths=[1, 2], chunk_size=2_000, ends=(1, 2))
# Each chunk ends behind the beginning of the next one, or of very many.
@example(times=[k + (15 if k % 10 == 9 else 0) for k in range(200)], lengths=[1], chunk_size=500, ends=(40, 90))
@example(times=[k + (100 if k % 10 == 9 else 0) for k in range(200)], lengths=[1], chunk_size=500, ends=(40, 90))
def test_messages_are_ordered_by_log_time_wherever_they_are_in_the_file(
    tmp_path_factory: pytest.TempPathFactory,
    suffix: str,
    times: list[int],
    lengths: list[int],
    chunk_size: int,
    ends: tuple[int, int],
) -> None:
    # Frames with names of several lengths take turns, between messages of a topic that is not read.
    lines: list[Line] = [
        (time, "/tf", [moving("a", "b" * length, place)])
        for place, (time, length) in enumerate(zip(times, cycle(lengths), strict=False))
    ]
    mixed = [each for line in lines for each in (line, (line[0], "/camera", b"picture"))]
    folder = tmp_path_factory.mktemp("recording")
    path = write_mcap(folder / "run.mcap", mixed, chunk_size=chunk_size)
    if suffix != "mcap":
        convert([path], path.with_suffix(f".{suffix}"))
        path = path.with_suffix(f".{suffix}")
    by_time = sorted((time, place) for place, time in enumerate(times))
    for since, until in ((0, 300), ends):
        expected = [(time, place) for time, place in by_time if since <= time <= until]
        for messages in (messages_in(path, since, until), in_blocks(path, since, until)):
            assert [(message.received, message.batch[0].stamp) for message in messages] == expected


@pytest.mark.parametrize(
    ("suffix", "options"),
    [
        ("mcap", {}),
        ("mcap", {"compression": CompressionType.ZSTD}),
        ("mcap", {"use_chunking": False}),
        ("mcap", {"enable_crcs": False}),
        ("bag", {}),
    ],
    ids=str,
)
@given(data=st.data())
def test_one_flipped_bit_never_loses_a_message_in_silence(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject, suffix: str, options: dict[str, Any]
) -> None:
    folder = tmp_path_factory.mktemp("recording")
    lines = [(k, "/tf", [moving("odom", "base", k)]) for k in range(15)]
    path = write_mcap(folder / "source.mcap", lines, chunk_size=500, **options)
    if suffix == "bag":
        convert([path], folder / "run.bag")
        path = folder / "run.bag"
    whole = bytearray(path.read_bytes())
    whole[data.draw(st.integers(0, len(whole) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(whole)
    try:
        messages = messages_in(path)
    except RecordingError:
        return
    with open_recording(path) as recording:
        told = recording.remarks or not recording.finished
    read = [(message.received, "/tf", list(message.batch)) for message in messages if message.batch]
    if suffix == "mcap" and "enable_crcs" not in options and "use_chunking" not in options:
        # A checksum holds the content of each chunk.
        assert all(line in lines for line in read)
    assert len(read) == 15 or told or any(message.errors for message in messages)


def test_a_closed_recording_cannot_be_read(recording: Path) -> None:
    with open_recording(recording) as opened:
        pass
    opened.close()
    with pytest.raises(ValueError, match="is closed"):
        opened.messages()
    with pytest.raises(ValueError, match="is closed"):
        _ = opened.start


@pytest.mark.skipif(not OPEN_FILES.is_dir(), reason="this system does not show the open files of a process")
def test_the_files_are_closed(recording: Path, tmp_path: Path) -> None:
    folder = as_ros2(SMALL, tmp_path / "bag", StoragePlugin.SQLITE3)
    compressed = as_ros2(
        SMALL, tmp_path / "zstd", StoragePlugin.MCAP, mode=CompressionMode.FILE, fmt=CompressionFormat.ZSTD
    )
    # Of one whose second file cannot be opened, the first one is closed too.
    unreadable = tmp_path / "unreadable"
    unreadable.mkdir()
    write_mcap(unreadable / "run_0.mcap", LINES)
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(unreadable / "run_1.mcap"))
    before = len(list(OPEN_FILES.iterdir()))
    for path in (SMALL, recording, folder, compressed):
        with open_recording(path) as opened:
            next(opened.messages())
    with pytest.raises(RecordingError, match="it cannot be read") as raised:
        open_recording(unreadable)
    # Its traceback still refers to all that was opened.
    assert raised.tb is not None
    assert len(list(OPEN_FILES.iterdir())) == before


TEXT = b"Dear diary,\ntoday I have driven a robot.\n"


@pytest.mark.parametrize(
    ("content", "reason", "says"),
    [
        (b"", "empty", "the file is empty"),
        (TEXT, "foreign", "it is not a recording of ROS 1 (.bag) or ROS 2 (.mcap, .db3)"),
        (gzip.compress(TEXT * 100, mtime=0), "foreign", "it is not a recording"),
        (bytes(range(256)) * 100, "foreign", "it is not a recording"),
        (b"\0" * 10_000, "foreign", "it is not a recording"),
        (b"\x89MCAP0\r\n", "truncated", "ends before its first message"),
        (b"\x89MCAP0\r\n" + TEXT * 100, "truncated", "ends before its first message"),
        (b"\x89MC", "truncated", "the file ends after 3 bytes"),
        (b"#ROSBAG V2.0\n", "truncated", "ends before its first message"),
        (b"#ROSBAG V2.0\n" + TEXT * 100, "damaged", "it cannot be read as a bag of ROS 1"),
        (b"#ROSBAG V1.2\n" + TEXT, "foreign", "a bag of ROS 1 that begins with '#ROSBAG V1.2'"),
        (b"#ROS", "truncated", "the file ends after 4 bytes"),
        (b"SQLite format 3\0", "damaged", "it cannot be read as a recording of ROS 2"),
        (b"SQLite format 3\0" + TEXT * 100, "damaged", "it cannot be read as a recording of ROS 2"),
    ],
    ids=lambda value: repr(value[:24]),
)
def test_other_files_are_refused_with_an_error_of_one_line(path: Path, content: bytes, reason: str, says: str) -> None:
    path.write_bytes(content)
    with pytest.raises(RecordingError) as raised:
        open_recording(path)
    assert (raised.value.path, raised.value.reason) == (str(path), reason)
    assert str(raised.value).startswith(f"recording {str(path)!r}: ")
    assert says in str(raised.value)
    assert "\n" not in str(raised.value)
    # Its traceback still refers to all that was opened.
    assert raised.tb is not None
    assert not is_open(path)


def test_a_topic_that_is_not_there_is_refused_with_ten_that_are(tmp_path: Path) -> None:
    lines = [(number, f"/robot_{number:02}/tf", [moving("odom", "base", number)]) for number in range(12)]
    path = write_mcap(tmp_path / "run.mcap", lines)
    with pytest.raises(RecordingError) as raised:
        open_recording(path, topics=["/gone"])
    assert raised.value.reason == "no such topic"
    there = ", ".join(f"/robot_{number:02}/tf" for number in range(10))
    assert str(raised.value).endswith(f"topic 'gone' is not there; topics with transforms: {there}")
    assert raised.tb is not None
    assert not is_open(path)


def test_a_file_that_cannot_be_opened_is_missing_or_unreadable(tmp_path: Path) -> None:
    for path in (tmp_path / "run.mcap", tmp_path / "no folder" / "run.mcap"):
        with pytest.raises(RecordingError, match="there is no such file") as raised:
            open_recording(path)
        assert raised.value.reason == "missing"
    path = tmp_path / "run.mcap"
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        with pytest.raises(RecordingError) as raised:
            open_recording(str(path))
    assert str(raised.value) == f"recording {str(path)!r}: it cannot be read: {os.strerror(errno.ENXIO)}"
    assert raised.value.reason == "unreadable"


def test_without_a_package_the_error_names_the_extra_and_other_formats_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_mcap(tmp_path / "run.mcap", [(1, "/tf", [moving("map", "base", 1)])])
    for name in {"mcap", *(name for name in sys.modules if name.startswith("mcap."))}:
        monkeypatch.setitem(sys.modules, name, None)
    for name in [name for name in sys.modules if name.startswith("tfbus.recording.formats.mcap")]:
        monkeypatch.delitem(sys.modules, name)
    open_recording(SMALL).close()
    with pytest.raises(RecordingError, match=r'pip install "tfbus\[bag\]"') as raised:
        open_recording(path)
    assert raised.value.reason == "missing extra"


def write_channels(path: Path, topics: Sequence[str], lines: Iterable[tuple[int, int]]) -> Path:
    """A file with a channel for each of some topics, and a message for each stamp and place of a channel."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("tf2_msgs/msg/TFMessage", "ros2msg", b"")
        channels = [
            writer.register_channel(topic, "cdr", schema, {"number": str(number)})
            for number, topic in enumerate(topics)
        ]
        for stamp, channel in lines:
            writer.add_message(channels[channel], stamp, encode([moving("map", "base", stamp)]), stamp)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


TF = "tf2_msgs/msg/TFMessage"


@pytest.mark.parametrize("finish", [True, False])
def test_all_topics_are_told_and_those_that_may_hold_transforms_and_are_not_read_are_remarked(
    tmp_path: Path, finish: bool
) -> None:
    one = [moving("map", "base", 1)]
    path = write_mcap(tmp_path / "run.mcap", [(1, "/tf", one), (2, "/r/tf", one), (3, "/r/tf", one)], finish=finish)
    with open_recording(path) as recording:
        assert len(without_unfinished(recording.messages())) == 1
        assert recording.topics == (
            RecordedTopic("/r/tf", TF, 2, read=False, ignored=True),
            RecordedTopic("/tf", TF, 1, read=True, ignored=False),
        )
        assert recording.remarks == (f"not read: 2 messages on topic /r/tf of type {TF}",)
    with open_recording(path) as recording:
        next(recording.messages())
        count = "2 messages on " if finish else ""
        assert recording.remarks == (f"not read: {count}topic /r/tf of type {TF}",)
    with open_recording(write_mcap(path, [(1, "/camera/tf", one), (2, "/camera", b"")], schema="")) as recording:
        assert [(topic.name, topic.ignored) for topic in recording.topics] == [("/camera", False), ("/camera/tf", True)]
        assert recording.remarks == ("not read: 1 messages on topic /camera/tf of type unknown",)


def test_positions_of_joints_are_remarked_where_there_are_no_transforms(tmp_path: Path, path: Path) -> None:
    hint = "/joint_states has the positions of joints: load_joint_states reads them with a URDF"
    for kind in ("sensor_msgs/msg/JointState", "sensor_msgs/JointState"):
        write_mcap(path, [(1, "/joint_states", b"")], schema=kind)
        with open_recording(path) as recording:
            assert recording.remarks == (f"no transforms, but {hint}",)
    folder = tmp_path / "folder"
    folder.mkdir()
    path.rename(folder / "joints.mcap")
    write_mcap(folder / "more.mcap", LINES)
    with open_recording(folder) as recording:
        assert recording.remarks == ()


def test_a_topic_that_was_asked_for_is_there_with_transforms(tmp_path: Path) -> None:
    path = write_channels(tmp_path / "run.mcap", ("/tf", "/r/tf", "/r/tf_static"), [(1, 0), (2, 1)])
    with open_recording(path, topics=["r/tf", "/r/tf_static"]) as recording:
        assert [message.received for message in recording.messages()] == [2]
    path = write_mcap(tmp_path / "other.mcap", [(1, "/camera", b"")], schema="sensor_msgs/msg/Image")
    with pytest.raises(RecordingError) as raised:
        open_recording(path, topics="/camera")
    assert str(raised.value).endswith("topic 'camera' has type sensor_msgs/msg/Image, which holds no transforms")
    assert raised.value.reason == "no such topic"
    # Only reading an unfinished file tells which topics it has.
    path = write_mcap(path, [(1, "/camera", b"")], schema="sensor_msgs/msg/Image", finish=False)
    with open_recording(path, topics="/camera") as recording:
        assert without_unfinished(recording.messages()) == []


def test_channels_of_one_topic_and_type_are_one_topic_and_a_silent_one_adds_nothing(tmp_path: Path) -> None:
    path = write_channels(tmp_path / "run.mcap", ("/tf", "/tf", "/tf_static"), [(1, 0), (2, 1), (3, 1)])
    with open_recording(path) as recording:
        assert recording.count == 3
        assert [(topic.name, topic.count) for topic in recording.topics] == [("/tf", 3), ("/tf_static", 0)]
        assert [(message.received, message.errors) for message in recording.messages()] == [(k, ()) for k in (1, 2, 3)]


@pytest.mark.parametrize("names", [("a.mcap", "b.mcap"), ("b.mcap", "a.mcap")])
def test_the_number_of_messages_of_a_topic_is_not_known_if_one_of_its_files_does_not_tell(
    tmp_path: Path, names: tuple[str, str]
) -> None:
    for name, finish in zip(names, (True, False), strict=True):
        write_mcap(tmp_path / name, LINES[1:2], finish=finish)
    with open_recording(tmp_path) as recording:
        messages = recording.messages()
        next(messages)
        assert [(topic.name, topic.count) for topic in recording.topics] == [("/tf", None)]
        assert len(without_unfinished(messages)) == 1
        # Now both have been read.
        assert [(topic.name, topic.count) for topic in recording.topics] == [("/tf", 2)]


TF = "tf2_msgs/msg/TFMessage"


def tf(topic: str, kind: str = TF, encoding: str = "cdr") -> Channel:
    return Channel(topic, kind, encoding)


KINDS = [TF, "tf2_msgs/TFMessage", "tf/tfMessage", "tf/msg/tfMessage"]
MANY, SINGLE = ("foxglove.FrameTransforms", "protobuf"), ("foxglove_msgs/msg/FrameTransform", "cdr")
SEVERAL = {"topics": {"/robot1/tf": "r1/", "/fixed_static": "f/"}, "prefix": "fleet/"}
EVERYTHING = {"namespaces": True, "prefix": "x/"}


@pytest.mark.parametrize(
    ("arguments", "channel", "choice"),
    [
        *(({}, tf(topic, kind), Choice(False, "")) for topic in ("/tf", "tf") for kind in KINDS),
        *(({"prefix": "r/"}, tf(topic), Choice(True, "r/")) for topic in ("/tf_static", "tf_static")),
        *(({}, tf(topic), None) for topic in ("/robot1/tf", "/TF", "/tf/", "//tf", "", "/", "/tf_stat", "/my_tf")),
        *(({}, tf(topic, *MANY), Choice(False, "")) for topic in ("/tf", "/transforms", "/robot1/transforms")),
        *(({}, tf("/transforms", *SINGLE), Choice(False, "")), ({}, tf("/robot1/tf", *SINGLE), None)),
        *(({"topics": topics}, tf("/robot1/tf"), Choice(False, "")) for topics in ("/robot1/tf", ["robot1/tf"])),
        *(({"topics": topics}, tf("/tf"), None) for topics in ("/robot1/tf", {"/robot1/tf": ""})),
        (SEVERAL, tf("robot1/tf"), Choice(False, "fleet/r1/")),
        (SEVERAL, tf("/fixed_static"), Choice(True, "fleet/f/")),
        (EVERYTHING, tf("/tf"), Choice(False, "x/")),
        (EVERYTHING, tf("/robot1/tf"), Choice(False, "x/robot1/")),
        (EVERYTHING, tf("/a/b/tf_static"), Choice(True, "x/a/b/")),
        (EVERYTHING, tf("/my_tf"), None),
    ],
)
def test_topics_are_read_by_default_or_as_chosen_with_prefixes(
    arguments: dict[str, Any], channel: Channel, choice: Choice | None
) -> None:
    assert Selection(**arguments).choose(channel) == choice


@pytest.mark.parametrize(
    ("channel", "mentioned"),
    [
        (tf("/tf", ""), True),
        (tf("/tf", "geometry_msgs/msg/TransformStamped"), True),
        (tf("/tf", "tf2_msgs/msg/tfmessage"), True),
        (tf("/tf", TF, "protobuf"), True),
        (tf("/tf", "foxglove.FrameTransform", "cbor"), True),
        (tf("/robot1/tf", "std_msgs/msg/String"), True),
        (tf("/x"), True),
        (tf("/x", "std_msgs/msg/String"), False),
    ],
)
def test_what_may_be_transforms_and_is_not_read_is_mentioned(channel: Channel, mentioned: bool) -> None:
    assert Selection().choose(channel) is None
    assert looks_like_transforms(channel) == mentioned


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ({"topics": ["/tf"], "namespaces": True}, ValueError),
        ({"prefix": "/r"}, ValueError),
        ({"topics": {"/tf": "/r"}}, ValueError),
        ({"topics": [3]}, TypeError),
        ({"topics": {"/tf": 3}}, TypeError),
    ],
)
def test_wrong_choices_are_refused(arguments: dict[str, Any], error: type[Exception]) -> None:
    with pytest.raises(error):
        Selection(**arguments)
