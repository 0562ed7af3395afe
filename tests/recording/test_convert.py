"""A recording becomes another one, in another format or with edits."""

import json
import sqlite3
import struct
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags import rosbag1, rosbag2
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_typestore
from support.processes import is_open
from support.recorded import SMALL, Line, batches_in, messages_in, write_mcap
from support.samples import moving, static

from tfbus import RecordingError
from tfbus.recording import Conversion, Edits, convert, load, open_recording
from tfbus.recording.formats.copies import (
    BagCopy,
    CannotWriteError,
    Copy,
    FoxgloveCopy,
    McapCopy,
    MessageTypes,
    SqliteCopy,
)
from tfbus.recording.formats.mcap_output import TYPE_HASH
from tfbus.recording.formats.storage import Channel
from tfbus.recording.formats.transforms import RawTransform, parser_of, write_cdr, write_ros1
from tfbus.recording.recording import open_storage
from tfbus.tf_message import encode

TYPES = get_typestore(Stores.ROS2_HUMBLE)
TF = "tf2_msgs/msg/TFMessage"
ENDINGS = (".mcap", ".bag", ".db3")
CDR, ROS1 = Channel("/tf", TF, "cdr"), Channel("/tf", "tf2_msgs/TFMessage", "ros1")

HELLO = bytes(TYPES.serialize_cdr(TYPES.types["std_msgs/msg/String"]("hello"), "std_msgs/msg/String"))
LINES: list[Line] = [
    (10, "/tf_static", [static("base", "laser", 1.0), static("base", "camera", 2.0)]),
    *((100 + k, "/tf", [moving("odom", "base", k, float(k)), moving("base", "wheel", k)]) for k in range(20)),
]
EXPECTED = [(received, tuple(samples)) for received, _, samples in LINES]


def raw(path: Path) -> list[tuple[int, str, list[RawTransform]]]:
    """Log time, topic and the transforms of all messages, bit by bit."""
    with closing(open_storage(path)) as storage:
        return [
            (received, channel.topic, parser_of(channel)(payload))
            for received, channel, payload in storage.messages(lambda channel: channel.topic in ("/tf", "/tf_static"))
            if isinstance(channel, Channel)
        ]


@pytest.mark.parametrize("first", ENDINGS)
@pytest.mark.parametrize("second", ENDINGS)
def test_transforms_keep_every_bit_from_any_format_to_any_other(tmp_path: Path, first: str, second: str) -> None:
    one, two = tmp_path / f"one{first}", tmp_path / f"two{second}"
    # The small bag has numbers that are not finite, and quaternions that are not normalised.
    done = convert([SMALL], one)
    assert (done.messages, done.problems) == (len(messages_in(SMALL)), {})
    convert([one], two)
    assert raw(one) == raw(two) == raw(SMALL)
    assert sorted(tmp_path.iterdir()) == [one, two]


bits = st.binary(min_size=56, max_size=56)
names = st.text("ab/é\0", max_size=9).map(str.encode)
transforms = st.builds(RawTransform, st.integers(0, 2**31 - 1), st.integers(0, 2**32 - 1), names, names, bits)


@given(transforms=st.lists(transforms, max_size=5))
def test_what_is_written_is_what_rosbags_and_the_parser_read(transforms: list[RawTransform]) -> None:
    cdr, ros1 = write_cdr(transforms), write_ros1(transforms)
    assert parser_of(CDR)(cdr) == parser_of(ROS1)(ros1) == transforms
    assert bytes(TYPES.ros1_to_cdr(ros1, TF)) == cdr


def lines_of_others(path: Path) -> list[tuple[str, int, bytes]]:
    """Topic, log time and payload of all messages, by the official reader or by rosbags."""
    if path.suffix == ".mcap":
        with path.open("rb") as file:
            return [(channel.topic, each.log_time, each.data) for _, channel, each in make_reader(file).iter_messages()]
    if path.suffix == ".bag":
        with rosbag1.Reader(path) as reader:
            return [(connection.topic, time, bytes(data)) for connection, time, data in reader.messages()]
    folder = path.with_suffix("")
    folder.mkdir()
    database = sqlite3.connect(path)
    ((metadata,),) = database.execute("SELECT metadata FROM metadata")
    database.close()
    (folder / "metadata.yaml").write_text(metadata)
    path.rename(folder / path.name)
    with rosbag2.Reader(folder) as bag:
        return [(connection.topic, time, bytes(data)) for connection, time, data in bag.messages()]


@pytest.mark.parametrize("ending", ENDINGS)
def test_the_readers_of_others_find_the_same_messages(tmp_path: Path, ending: str) -> None:
    source = write_mcap(tmp_path / "source.mcap", LINES)
    path = tmp_path / f"run{ending}"
    convert([source], path)
    payloads = [
        (topic, received, encode(samples)) for received, topic, samples in LINES if not isinstance(samples, bytes)
    ]
    if ending == ".bag":
        payloads = [(topic, time, bytes(TYPES.cdr_to_ros1(payload, TF))) for topic, time, payload in payloads]
    assert lines_of_others(path) == payloads


def test_a_bag_made_of_cdr_describes_its_types_as_ros_1_does(tmp_path: Path) -> None:
    convert([write_mcap(tmp_path / "source.mcap", LINES)], tmp_path / "run.bag")
    with rosbag1.Reader(tmp_path / "run.bag") as bag, rosbag1.Reader(SMALL) as recorded:
        assert {(each.msgtype, each.digest) for each in bag.connections} == {
            (each.msgtype, each.digest) for each in recorded.connections if each.topic in ("/tf", "/tf_static")
        }
    # By the definition in the bag, each message is as long as it is.
    with AnyReader([tmp_path / "run.bag"]) as reader:
        found: list[Any] = [reader.deserialize(data, each.msgtype) for each, _, data in reader.messages()]
    assert [[each.child_frame_id for each in message.transforms] for message in found] == [
        [each.child for each in samples] for _, _, samples in LINES if not isinstance(samples, bytes)
    ]


def test_other_topics_pass_through_untouched_or_are_converted_where_the_format_needs_it(
    tmp_path: Path, path: Path
) -> None:
    source = write_mcap(path, [(5, "/said", HELLO)], schema="std_msgs/msg/String")
    bag, back = tmp_path / "run.bag", tmp_path / "back.db3"
    convert([source], tmp_path / "same.mcap")
    assert lines_of_others(tmp_path / "same.mcap") == [("/said", 5, HELLO)]
    convert([source], bag)
    assert lines_of_others(bag) == [("/said", 5, b"\5\0\0\0hello")]
    convert([bag], back)
    assert lines_of_others(back) == [("/said", 5, HELLO)]


def test_what_a_format_cannot_hold_is_left_out_and_counted(tmp_path: Path, path: Path) -> None:
    lines: list[Line] = [(1, "/a", b"{}"), (2, "/a", b"{}")]
    source = write_mcap(path, lines, schema="my.Thing", encoding="json")
    for ending in (".bag", ".db3"):
        done = convert([source], tmp_path / f"run{ending}")
        assert (done.messages, done.problems) == (0, {"format": 2})
        assert "cannot hold the encoding 'json'" in done.details[0]
    unknown = write_mcap(tmp_path / "unknown.mcap", [(1, "/a", b"\0\1\0\0")], schema="my_msgs/msg/Thing")
    done = convert([unknown], tmp_path / "unknown.bag")
    assert (done.messages, done.problems) == (0, {"type": 1})
    for schema, definition in (("Thing", b""), ("my_msgs/msg/Thing", b"\xff{{")):
        write_mcap(unknown, [(1, "/a", b"\0\1\0\0")], schema=schema, definition=definition)
        done = convert([unknown], tmp_path / "unknown.bag", overwrite=True)
        assert (done.messages, done.problems) == (0, {"type": 1})


def test_what_the_recorder_has_compressed_is_unfolded_and_what_only_looks_like_it_is_not(tmp_path: Path) -> None:
    folded = zstandard.compress(HELLO)
    torn = folded[:4] + b"\xff" * 30
    lines: list[Line] = [(1, "/said", folded), (2, "/said", torn), (3, "/said", HELLO)]
    source = write_mcap(tmp_path / "run.mcap", lines, schema="std_msgs/msg/String")
    path = tmp_path / "copy.mcap"
    done = convert([source], path)
    assert lines_of_others(path) == [("/said", 1, HELLO), ("/said", 3, HELLO)]
    assert (done.messages, done.problems) == (2, {"damaged": 1})
    assert "cannot be decompressed" in done.details[0]
    # In another encoding, these may be the first bytes of anything.
    source = write_mcap(tmp_path / "other.mcap", lines, schema="my.Thing", encoding="protobuf")
    assert convert([source], path, overwrite=True).problems == {}
    assert [payload for _, _, payload in lines_of_others(path)] == [folded, torn, HELLO]


def test_runs_of_authorities_keep_their_lengths_and_a_single_one_stands_for_any_number(tmp_path: Path) -> None:
    frames = [moving("map", name, 1) for name in "abc"]
    metadata = {"tfbus.authorities": '[["x", 2], ["y", 1]]'}
    source = write_mcap(tmp_path / "source.mcap", [(1, "/tf", frames), (2, "/tf", frames)], metadata=metadata)
    for keep, runs in (("abc", '[["x", 2], ["y", 1]]'), ("ac", '[["x", 1], ["y", 1]]'), ("ab", '[["x", 1]]')):
        _, found = edited(tmp_path, source, frames=list(keep), prefix="r/")
        names = {"a": "x", "b": "x", "c": "y"}
        assert [[(each.child, each.authority) for each in batch] for _, batch in found] == [
            [(f"r/{name}", names[name]) for name in keep]
        ] * 2
        with (tmp_path / "edited.mcap").open("rb") as file:
            ((written, *_),) = {tuple(channel.metadata.values()) for _, channel, _ in make_reader(file).iter_messages()}
        assert written == runs


def edited(tmp_path: Path, *inputs: Path, **arguments: Any) -> tuple[Conversion, list[Any]]:
    path = tmp_path / "edited.mcap"
    since, until = arguments.pop("since", None), arguments.pop("until", None)
    topics = arguments.pop("topics", None)
    done = convert(inputs, path, since, until, topics=topics, edits=Edits(**arguments), overwrite=True)
    return done, batches_in(path)


@pytest.fixture
def source(tmp_path: Path) -> Path:
    return write_mcap(tmp_path / "source.mcap", LINES, metadata={"tfbus.authorities": '[["a", 1], ["b", 1]]'})


def test_frames_are_renamed_and_get_a_prefix(tmp_path: Path, source: Path) -> None:
    _, found = edited(tmp_path, source, rename={"base": "body"}, prefix="r1/")
    assert {(each.parent, each.child) for _, batch in found for each in batch} == {
        ("body", "r1/laser"),
        ("body", "r1/camera"),
        ("r1/odom", "body"),
        ("body", "r1/wheel"),
    }
    assert {each.child: each.authority for _, batch in found for each in batch}["r1/wheel"] == "b"


def test_only_some_frames_stay_with_their_authorities_and_empty_messages_go(tmp_path: Path, source: Path) -> None:
    done, found = edited(tmp_path, source, frames=["wheel"])
    assert [(received, [(each.child, each.authority) for each in batch]) for received, batch in found] == [
        (100 + k, [("wheel", "b")]) for k in range(20)
    ]
    assert (done.messages, done.transforms) == (20, 20)


def test_a_message_without_transforms_stays_and_one_that_loses_all_of_them_goes(tmp_path: Path, path: Path) -> None:
    source = write_mcap(path, [(1, "/tf", []), (2, "/tf", [moving("a", "b", 2)])])
    told: list[int] = []
    done = convert([source], tmp_path / "some.mcap", edits=Edits(frames=["c"]), progress=told.append)
    assert batches_in(tmp_path / "some.mcap") == [(1, ())]
    assert (done.messages, done.transforms, told) == (1, 0, [1, 1])


def test_static_transforms_are_left_out_and_told(tmp_path: Path, source: Path) -> None:
    done, found = edited(tmp_path, source, drop_static=True, rename={"laser": "lidar"})
    assert not any(each.static for _, batch in found for each in batch)
    assert {name: (each.parent, each.translation) for name, each in done.statics.items()} == {
        "lidar": ("base", (1.0, 0.0, 0.0)),
        "camera": ("base", (2.0, 0.0, 0.0)),
    }


def test_static_transforms_from_before_a_part_come_once_each_in_the_order_in_which_they_came_last(
    tmp_path: Path, path: Path
) -> None:
    sent = [(k, static("base", name, x)) for k, name, x in ((1, "a", 1.0), (2, "b", 1.0), (3, "a", 1.0), (4, "b", 2.0))]
    source = write_mcap(path, [(k, "/tf_static", [sample]) for k, sample in sent])
    b, a, other = sent[1][1], sent[2][1], sent[3][1]
    for since, expected in (
        (1, [(k, (sample,)) for k, sample in sent]),
        (4, [(4, (b,)), (4, (a,)), (4, (other,))]),
        (5, [(5, (b,)), (5, (a,)), (5, (other,))]),
    ):
        _, found = edited(tmp_path, source, since=since)
        assert found == expected


def test_a_part_includes_both_ends_and_has_the_chosen_topics(tmp_path: Path, source: Path) -> None:
    _, found = edited(tmp_path, source, since=105, until=107, topics=["tf"])
    assert [received for received, _ in found] == [105, 106, 107]


def test_several_recordings_are_merged_by_their_log_times(tmp_path: Path) -> None:
    even = write_mcap(tmp_path / "even.mcap", LINES[::2])
    odd = write_mcap(tmp_path / "odd.mcap", LINES[1::2])
    _, found = edited(tmp_path, odd, even)
    assert found == EXPECTED


def test_what_is_lost_of_an_input_is_told(tmp_path: Path) -> None:
    lines = [*LINES, (200, "/tf", b"nonsense")]
    source = write_mcap(tmp_path / "source.mcap", lines)
    done = convert([source], tmp_path / "same.mcap")
    # It is passed through as it is.
    assert (done.messages, done.problems) == (len(lines), {})
    done = convert([source], tmp_path / "other.mcap", edits=Edits(prefix="r/"))
    assert (done.messages, done.problems) == (len(LINES), {"encoding": 1})


def test_a_wrong_output_is_refused_and_nothing_is_left_behind(tmp_path: Path, source: Path) -> None:
    with pytest.raises(ValueError, match=r"must end in \.mcap, \.bag, \.db3, .*, not 'run\.csv'"):
        convert([source], tmp_path / "run.csv")
    with pytest.raises(ValueError, match="is an input as well"):
        convert([source], source, overwrite=True)
    there = tmp_path / "there.mcap"
    there.write_text("precious")
    with pytest.raises(FileExistsError):
        convert([source], there)
    with pytest.raises(RecordingError, match="no such file"):
        convert([source, tmp_path / "missing.bag"], there, overwrite=True)
    with pytest.raises(OSError, match="No such file"):
        convert([source], tmp_path / "missing" / "run.mcap")
    assert there.read_text() == "precious"
    assert sorted(tmp_path.iterdir()) == [source, there]
    convert([source], there, overwrite=True)
    assert len(load(there).frames()) == 5


def test_foxglove_transforms_become_those_of_ros(tmp_path: Path, path: Path) -> None:
    text = (
        b'{"transforms": [{"timestamp": {"sec": 1, "nsec": 2}, "parent_frame_id": "a", "child_frame_id": "b", '
        b'"translation": {"x": 1, "y": 2, "z": 0.1}, "rotation": {"x": 0, "y": 0, "z": 0, "w": 1}}]}'
    )
    source = write_mcap(path, [(5, "/tf", text)], schema="foxglove.FrameTransforms", encoding="json")
    convert([source], tmp_path / "run.bag")
    ((received, topic, (found,)),) = raw(tmp_path / "run.bag")
    assert (received, topic, found[:4]) == (5, "/tf", (1, 2, b"a", b"b"))
    assert struct.unpack("<7d", found.numbers) == (1.0, 2.0, 0.1, 0.0, 0.0, 0.0, 1.0)
    convert([source], tmp_path / "same.mcap")
    with open_recording(tmp_path / "same.mcap") as recording:
        assert [topic.type for topic in recording.topics] == ["foxglove.FrameTransforms"]


def raw_of(found: Any) -> RawTransform:
    """A decoded transform of Foxglove's."""
    numbers = [getattr(found.translation, axis) for axis in "xyz"] + [getattr(found.rotation, axis) for axis in "xyzw"]
    names = found.parent_frame_id.encode(), found.child_frame_id.encode()
    return RawTransform(found.timestamp.seconds, found.timestamp.nanos, *names, struct.pack("<7d", *numbers))


def test_transforms_are_written_in_foxglove_s_schema_to_the_last_bit(tmp_path: Path, path: Path) -> None:
    done = convert([SMALL], path, schema="foxglove")
    assert done.problems == {}
    assert raw(path) == raw(SMALL)
    with open_recording(path) as recording:
        assert {(each.type, each.read) for each in recording.topics if each.name in ("/tf", "/tf_static")} == {
            ("foxglove.FrameTransforms", True)
        }
    # The official decoder, with the definition in the file.
    from mcap_protobuf.decoder import DecoderFactory

    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        decoded = [list(map(raw_of, message.transforms)) for *_, message in reader.iter_decoded_messages()]
    assert decoded == [transforms for _, _, transforms in raw(SMALL)]
    convert([path], tmp_path / "back.bag")
    assert raw(tmp_path / "back.bag") == raw(SMALL)


def test_wrong_edits_and_schemas_are_refused(tmp_path: Path, path: Path, source: Path) -> None:
    for arguments in ({"rename": {"a": "/b"}}, {"rename": {"a": ""}}, {"prefix": "/r"}):
        with pytest.raises(ValueError, match="a frame name"):
            Edits(**arguments)
    with pytest.raises(ValueError, match=r"must end in \.mcap"):
        convert([source], tmp_path / "run.bag", schema="foxglove")
    with pytest.raises(ValueError, match="'ros' or 'foxglove'"):
        convert([source], path, schema="json")  # type: ignore[arg-type]
    convert([source], path, schema="foxglove")
    assert batches_in(path) == batches_in(source)


@pytest.mark.parametrize("ending", ["mcap", "bag", "db3"])
def test_a_conversion_that_fails_leaves_no_file_and_keeps_none_open(tmp_path: Path, ending: str) -> None:
    def fail(_: int) -> None:
        raise EOFError

    with pytest.raises(EOFError) as raised:
        convert([SMALL], tmp_path / f"copy.{ending}", progress=fail)
    # Its traceback still refers to all that was opened.
    assert raised.tb is not None
    assert list(tmp_path.iterdir()) == []
    assert not is_open(tmp_path)
    assert not is_open(SMALL)


@pytest.mark.parametrize("suffix", ["mcap", "bag", "db3"])
def test_a_link_that_somebody_has_made_beside_the_output_leads_nowhere(tmp_path: Path, suffix: str) -> None:
    precious = tmp_path / "precious"
    precious.write_bytes(b"precious")
    output = tmp_path / f"run.{suffix}"
    for name in (f".run.part.{suffix}", f".run.{suffix}.part", f".run.part.{suffix}-journal"):
        (tmp_path / name).symlink_to(precious)
    before = sorted(tmp_path.iterdir())
    convert([SMALL], output)
    # Also where the output is a link: it is replaced, and not followed.
    output.unlink()
    output.symlink_to(precious)
    convert([SMALL], output, overwrite=True)
    assert precious.read_bytes() == b"precious"
    assert not output.is_symlink()
    assert sorted(tmp_path.iterdir()) == sorted([*before, output])


SLASHED = RawTransform(1, 2, b"/odom", b"/base", bytes(56))


def test_names_are_compared_without_their_slashes() -> None:
    assert Edits(rename={"base": "body"}).apply(SLASHED)[2:4] == (b"/odom", b"body")
    assert Edits(prefix="r/").apply(SLASHED)[2:4] == (b"r/odom", b"r/base")
    assert Edits(frames=["base"]).keeps(SLASHED)
    assert not Edits(frames=["odom"]).keeps(SLASHED)
    # A name that is no text keeps its bytes.
    assert Edits(prefix="r/").apply(RawTransform(1, 2, b"/odom", b"\xffbase", bytes(56))).child == b"r/\xffbase"


PAYLOAD = encode([moving("a", "b", 5)])


def write_all(copy: Copy, *messages: tuple[Channel, int, bytes]) -> None:
    for channel, received, payload in messages:
        copy.write(channel, received, payload)
    copy.finish()


def test_a_copy_in_mcap_is_a_recording_of_ros_2(tmp_path: Path) -> None:
    path = tmp_path / "run"
    write_all(McapCopy(path, "run"), (Channel("/log", "", "json"), 5, b"{}"), (CDR, 6, PAYLOAD))
    with path.open("rb") as file:
        reader = make_reader(file)
        assert [(entry.name, entry.metadata) for entry in reader.iter_metadata()] == [("rosbag2", {})]
        assert (reader.get_header().profile, reader.get_header().library) == ("ros2", "tfbus")
        # A message without a type has no schema.
        found = [
            (schema and schema.name, channel.topic, each.log_time, each.publish_time, each.data)
            for schema, channel, each in reader.iter_messages()
        ]
    assert found == [(None, "/log", 5, 5, b"{}"), ("tf2_msgs/msg/TFMessage", "/tf", 6, 6, PAYLOAD)]


def test_times_before_1970_are_refused_where_a_format_has_none(tmp_path: Path) -> None:
    for kind in (McapCopy, BagCopy):
        copy = kind(tmp_path / "run", "run")
        with pytest.raises(CannotWriteError, match="no time before 1970"):
            copy.write(CDR, -1, PAYLOAD)
        # 1970 begins with 0.
        copy.write(CDR, 0, PAYLOAD)
        copy.close()


def test_without_the_extra_a_copy_in_foxglove_s_schema_makes_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "foxglove.messages", None)
    with pytest.raises(ImportError):
        FoxgloveCopy(tmp_path / "run", "run")
    assert list(tmp_path.iterdir()) == []


def test_the_definition_of_a_type_stays_where_it_is_one_of_ros_2(tmp_path: Path) -> None:
    path = tmp_path / "run.db3"
    kinds = [("a/msg/A", "ros2msg"), ("b/msg/B", "ros2idl"), ("c/msg/C", ""), (TF, "ros2msg")]
    channels = [Channel(f"/{kind}", kind, "cdr", encoding, b"int8 x") for kind, encoding in kinds]
    write_all(SqliteCopy(path, "run.db3"), *((channel, 1, b"") for channel in channels))
    with closing(sqlite3.connect(path)) as file:
        found = file.execute("SELECT * FROM message_definitions ORDER BY id").fetchall()
    assert found == [(1, "a/msg/A", "ros2msg", "int8 x", ""), (2, CDR.type, "ros2msg", "int8 x", TYPE_HASH)]


def test_a_bag_is_latching_where_transforms_are_static(tmp_path: Path) -> None:
    path = tmp_path / "run.bag"
    topics = ("/tf", "/tf_static")
    write_all(BagCopy(path, "run.bag"), *((Channel(topic, TF, "cdr"), 1, PAYLOAD) for topic in topics))
    with Reader(path) as bag:
        # As a publisher of ROS 1 says it: not at all, or 1.
        found = {each.topic: getattr(each.ext, "latching", "") for each in bag.connections}
    assert found == {"/tf": None, "/tf_static": 1}


@pytest.mark.parametrize(
    ("times", "start", "duration"), [([], 0, 0), ([0], 0, 0), ([7, 5, 9], 5, 4), ([-9, -5, -7], -9, 4)]
)
def test_the_metadata_have_the_first_time_and_the_duration(
    tmp_path: Path, times: list[int], start: int, duration: int
) -> None:
    path = tmp_path / "run.db3"
    write_all(SqliteCopy(path, "run.db3"), *((CDR, time, PAYLOAD) for time in times))
    with closing(sqlite3.connect(path)) as file:
        ((text,),) = file.execute("SELECT metadata FROM metadata")
    metadata = json.loads(text)["rosbag2_bagfile_information"]
    (of_file,) = metadata["files"]
    for each in (metadata, of_file):
        assert each["starting_time"] == {"nanoseconds_since_epoch": start}
        assert each["duration"] == {"nanoseconds": duration}
        assert each["message_count"] == len(times)
    assert [topic["message_count"] for topic in metadata["topics_with_message_count"]] == [len(times)] * bool(times)


def test_a_type_that_the_file_defines_is_converted() -> None:
    cdr = Channel("/a", "my_msgs/msg/Pair", "cdr", "ros2msg", b"uint8 a\nuint32 b\n")
    ros1 = Channel("/a", "my_msgs/Pair", "ros1", "ros1msg", b"uint8 a\nuint32 b\n")
    payload = b"\0\1\0\0\7\0\0\0\5\0\0\0"
    assert MessageTypes().convert(cdr, payload) == b"\7\5\0\0\0"
    assert MessageTypes().convert(ros1, b"\7\5\0\0\0") == payload
    definition, digest = MessageTypes().ros1_definition(cdr)
    assert "uint32 b" in definition
    assert len(digest) == 32


@pytest.mark.parametrize(
    ("kind", "digest"),
    [
        ("std_msgs/msg/String", "992ce8a1687cec8c8bd883ec73ca41d1"),
        ("std_msgs/msg/Header", "2176decaecbce78abc3b96ef049fabed"),
        ("geometry_msgs/msg/PointStamped", "c63aecb41bfdfd6b7e1fac37c7cbe7bf"),
        ("nav_msgs/msg/Odometry", "cd5e73d190d741a2f92e81eda573aca7"),
        ("tf2_msgs/msg/TFMessage", "94810edda583a504dfda3829e70d7eec"),
    ],
)
def test_the_definition_of_a_type_of_ros_2_has_the_digest_of_ros_1(kind: str, digest: str) -> None:
    definition, found = MessageTypes().ros1_definition(Channel("/a", kind, "cdr"))
    assert found == digest
    # A header counts the messages there, which ROS 2 has given up.
    assert ("uint32 seq\ntime stamp\nstring frame_id\n" in definition) == (kind != "std_msgs/msg/String")
