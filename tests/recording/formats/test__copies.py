import json
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.rosbag1 import Reader
from support.processes import is_open
from support.recorded import messages_in
from support.samples import moving

from tfbus.recording.formats.copies import (
    FRAME_TRANSFORMS,
    BagCopy,
    CannotWriteError,
    FoxgloveCopy,
    McapCopy,
    SqliteCopy,
    transform_channel,
)
from tfbus.recording.formats.mcap_output import TYPE_HASH
from tfbus.recording.formats.storage import Channel
from tfbus.tf_message import encode

TF = Channel("/tf", "tf2_msgs/msg/TFMessage", "cdr")
PAYLOAD = encode([moving("a", "b", 5)])


@pytest.mark.parametrize("kind", [McapCopy, BagCopy, SqliteCopy])
def test_a_message_is_written_once_for_each_of_two_channels_of_one_topic(
    tmp_path: Path, kind: type[McapCopy] | type[BagCopy] | type[SqliteCopy]
) -> None:
    path = tmp_path / "run"
    copy = kind(path, "run")
    same = Channel("/tf", "tf2_msgs/msg/TFMessage", "cdr")
    for received, channel in ((1, TF), (2, same), (3, TF)):
        copy.write(channel, received, PAYLOAD)
    copy.finish()
    assert not is_open(path)
    assert [(message.received, message.batch) for message in messages_in(path)] == [
        (received, (moving("a", "b", 5),)) for received in (1, 2, 3)
    ]


def test_a_copy_in_mcap_is_a_recording_of_ros_2(tmp_path: Path) -> None:
    path = tmp_path / "run"
    copy = McapCopy(path, "run")
    copy.write(Channel("/log", "", "json"), 5, b"{}")
    copy.write(TF, 6, PAYLOAD)
    copy.finish()
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
            copy.write(TF, -1, PAYLOAD)
        # 1970 begins with 0.
        copy.write(TF, 0, PAYLOAD)
        copy.close()


def test_transforms_get_a_channel_in_the_encoding_of_the_copy() -> None:
    assert transform_channel(TF, "cdr", {"a": "b"}).type == "tf2_msgs/msg/TFMessage"
    ros1 = transform_channel(TF, "ros1", {})
    assert (ros1.topic, ros1.type, ros1.encoding) == ("/tf", "tf2_msgs/TFMessage", "ros1")


def test_a_copy_holds_transforms_in_its_own_encoding(tmp_path: Path) -> None:
    pytest.importorskip("foxglove")
    ros1, json_ = Channel("/tf", "tf2_msgs/TFMessage", "ros1"), Channel("/tf", FRAME_TRANSFORMS, "json")
    foxglove, other = (Channel("/tf", kind, "protobuf") for kind in (FRAME_TRANSFORMS, "foxglove.FrameTransform"))
    channels = (TF, ros1, json_, foxglove, other)
    for kind, held in ((McapCopy, channels), (BagCopy, [ros1]), (SqliteCopy, [TF]), (FoxgloveCopy, [foxglove])):
        copy = kind(tmp_path / "run", "run")
        assert [channel for channel in channels if copy.holds(channel)] == list(held)
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
    copy = SqliteCopy(path, "run.db3")
    for kind, encoding in (("a/msg/A", "ros2msg"), ("b/msg/B", "ros2idl"), ("c/msg/C", "")):
        copy.write(Channel(f"/{kind}", kind, "cdr", encoding, b"int8 x"), 1, b"")
    copy.write(Channel("/tf", TF.type, "cdr", "ros2msg", b"int8 y"), 1, b"")
    copy.finish()
    with closing(sqlite3.connect(path)) as file:
        found = file.execute("SELECT * FROM message_definitions ORDER BY id").fetchall()
    assert found == [(1, "a/msg/A", "ros2msg", "int8 x", ""), (2, TF.type, "ros2msg", "int8 y", TYPE_HASH)]


def test_a_bag_is_latching_where_transforms_are_static(tmp_path: Path) -> None:
    path = tmp_path / "run.bag"
    copy = BagCopy(path, "run.bag")
    for topic in ("/tf", "/tf_static"):
        copy.write(Channel(topic, TF.type, "cdr"), 1, PAYLOAD)
    copy.finish()
    with Reader(path) as bag:
        # As a publisher of ROS 1 says it: not at all, or 1.
        found = {each.topic: getattr(each.ext, "latching", "") for each in bag.connections}
    assert found == {"/tf": None, "/tf_static": 1}


@pytest.mark.parametrize(
    ("times", "start", "duration"),
    [([], 0, 0), ([0], 0, 0), ([7, 5, 9], 5, 4), ([-9, -5, -7], -9, 4)],
)
def test_the_metadata_have_the_first_time_and_the_duration(
    tmp_path: Path, times: list[int], start: int, duration: int
) -> None:
    path = tmp_path / "run.db3"
    copy = SqliteCopy(path, "run.db3")
    for time in times:
        copy.write(TF, time, PAYLOAD)
    copy.finish()
    with closing(sqlite3.connect(path)) as file:
        ((text,),) = file.execute("SELECT metadata FROM metadata")
    metadata = json.loads(text)["rosbag2_bagfile_information"]
    (of_file,) = metadata["files"]
    for each in (metadata, of_file):
        assert each["starting_time"] == {"nanoseconds_since_epoch": start}
        assert each["duration"] == {"nanoseconds": duration}
        assert each["message_count"] == len(times)
    assert [topic["message_count"] for topic in metadata["topics_with_message_count"]] == [len(times)] * bool(times)


def test_the_metadata_have_the_hash_of_a_type_where_it_is_known(tmp_path: Path) -> None:
    path = tmp_path / "run.db3"
    copy = SqliteCopy(path, "run.db3")
    copy.write(TF, 1, PAYLOAD)
    copy.write(Channel("/talk", "std_msgs/msg/String", "cdr"), 2, b"")
    copy.finish()
    with closing(sqlite3.connect(path)) as file:
        (metadata,) = file.execute("SELECT metadata FROM metadata").fetchone()
        columns = dict(file.execute("SELECT name, type_description_hash FROM topics"))
        assert [number for (number,) in file.execute("SELECT id FROM topics ORDER BY id")] == [1, 2]
        ((version,),) = file.execute("SELECT metadata_version FROM metadata")
    assert json.loads(metadata)["rosbag2_bagfile_information"]["version"] == version
    topics = json.loads(metadata)["rosbag2_bagfile_information"]["topics_with_message_count"]
    told = {topic["topic_metadata"]["name"]: topic["topic_metadata"]["type_description_hash"] for topic in topics}
    assert told == columns == {"/tf": TYPE_HASH, "/talk": ""}
