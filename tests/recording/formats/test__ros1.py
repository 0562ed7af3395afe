from pathlib import Path

import pytest
from rosbags.rosbag1 import Reader, Writer
from rosbags.typesys import Stores, get_typestore
from support.recorded import SMALL, facts, messages_in, sender_of
from support.samples import moving

from tfbus import RecordingError
from tfbus.recording import open_recording
from tfbus.tf_message import encode

SECOND = 1_000_000_000


def test_a_bag_tells_its_ends_and_how_many_messages_there_are() -> None:
    with Reader(SMALL) as reader:
        count = reader.message_count
    # The first is a static transform a second before the start, the last the newest of the odometry, 2 ms late.
    with open_recording(SMALL) as recording:
        assert facts(recording) == (99 * SECOND, 109_982_000_000, count, True)
        assert len(list(recording.messages())) == count


def test_the_authority_is_the_node_that_sent_it() -> None:
    senders = {sample.child: sample.authority for message in messages_in(SMALL) for sample in message.batch}
    assert senders["odom"] == "slam"
    assert senders["base_link"] == "odometry"
    assert senders["laser"] == "calibration"
    with Reader(SMALL) as reader:
        recorded = {sender_of(connection) for connection in reader.connections}
    assert set(senders.values()) == {name.removeprefix("/") for name in recorded}


def test_leading_slashes_are_taken_off_the_names() -> None:
    with Reader(SMALL) as reader:
        assert any(b"\4\0\0\0/map" in raw for _, _, raw in reader.messages())
    pairs = {(sample.parent, sample.child) for message in messages_in(SMALL) for sample in message.batch}
    assert ("map", "odom") in pairs
    assert ("base_link", "laser") in pairs
    assert not any(name.startswith("/") for pair in pairs for name in pair)


def test_a_good_transform_beside_a_bad_one_is_read() -> None:
    beacons = [sample for message in messages_in(SMALL) for sample in message.batch if sample.child == "beacon"]
    assert [sample.transform.translation[0] for sample in beacons] == [float(place) for place in range(10)]


def test_a_range_includes_both_ends() -> None:
    times = [message.received for message in messages_in(SMALL)]
    low, high = times[100], times[200]
    within = [time for time in times if low <= time <= high]
    statics = {
        sample.child for message in messages_in(SMALL, until=low - 1) for sample in message.batch if sample.static
    }
    assert [message.received for message in messages_in(SMALL, low, high)] == [low] * len(statics) + within
    assert statics == {"laser", "camera", "arm", "table"}


def test_damage_inside_of_a_bag_is_counted(tmp_path: Path) -> None:
    path = tmp_path / "run.bag"
    data = bytearray(SMALL.read_bytes())
    middle = data.index(b"BZh", len(data) // 2)
    data[middle + 100 : middle + 110] = b"\xff" * 10
    path.write_bytes(data)
    *read, lost = messages_in(path)
    assert [error.reason for error in lost.errors] == ["damaged"]
    assert 100 < len(read) < len(messages_in(SMALL))
