import json
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from support.recorded import messages_in
from support.samples import moving

from tfbus.recording.formats._channels import TYPE_HASH
from tfbus.recording.formats._copies import BagCopy, CannotWriteError, McapCopy, SqliteCopy, transform_channel
from tfbus.recording.formats._storage import Channel
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
    assert [(message.received, message.batch) for message in messages_in(path)] == [
        (received, (moving("a", "b", 5),)) for received in (1, 2, 3)
    ]


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
    topics = json.loads(metadata)["rosbag2_bagfile_information"]["topics_with_message_count"]
    told = {topic["topic_metadata"]["name"]: topic["topic_metadata"]["type_description_hash"] for topic in topics}
    assert told == columns == {"/tf": TYPE_HASH, "/talk": ""}
