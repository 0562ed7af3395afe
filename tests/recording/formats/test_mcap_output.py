"""The MCAP files that a recorder writes, read by others."""

import json
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosHistory, QosReliability
from rosbags.rosbag2 import Reader
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_typestore
from support.open_files import is_open
from support.samples import moving, static
from support.strategies import samples

from tfbus import Transform, TransformStamped
from tfbus.bus.queues import TimedBatch
from tfbus.recording.formats.mcap_output import (
    _MAX_RUNS,
    CHUNK_SIZE,
    MAX_CHANNELS,
    MAX_SHARED_CHANNELS,
    SCHEMA,
    SCHEMA_NAME,
    TYPE_HASH,
    Channels,
    McapOutput,
    Runs,
)
from tfbus.stamps import SECOND
from tfbus.tf_message import decode


def written(path: Path, *entries: TimedBatch) -> McapOutput:
    with closing(McapOutput(str(path), overwrite=True)) as output:
        output.write(entries)
        output.finish()
        assert not is_open(path)
    return output


def readable(path: Path) -> int:
    """The number of messages that the official reader finds in a file that may end anywhere."""
    count = 0
    with path.open("rb") as file:
        try:
            for record in StreamReader(file).records:
                count += isinstance(record, Message)
        except Exception:  # noqa: BLE001 - of any kind, and it says that the file ends
            pass
    return count


def plain(sample: TransformStamped) -> TransformStamped:
    """As ROS knows it."""
    return TransformStamped(sample.parent, sample.child, sample.stamp, sample.transform)


def test_the_schema_is_the_definition_that_ros_2_has() -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    assert store.generate_msgdef(SCHEMA_NAME, ros_version=2)[0] == SCHEMA
    assert store.hash_rihs01(SCHEMA_NAME) == TYPE_HASH


def test_the_official_reader_reads_topics_times_and_transforms(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    turned = TransformStamped("map", "b", 12 * SECOND + 7, Transform((1.0, 2.0, 3.0), (0.0, 0.6, 0.0, 0.8)), "slam")
    written(path, (5, (static("map", "c", x=3.0),)), (9, (moving("map", "a", 3, x=0.1), turned)))
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        assert [(entry.name, entry.metadata) for entry in reader.iter_metadata()] == [("rosbag2", {})]
        found = [
            (
                *(schema.name, schema.encoding, channel.message_encoding, channel.topic),
                *(message.log_time, message.publish_time, message.data),
            )
            for schema, channel, message in reader.iter_messages()
            if schema is not None
        ]
    kind = ("tf2_msgs/msg/TFMessage", "ros2msg", "cdr")
    assert [entry[:6] for entry in found] == [(*kind, "/tf_static", 5, 5), (*kind, "/tf", 9, 9)]
    assert decode(found[0][6]).samples == [moving("map", "c", 0, x=3.0)]
    assert decode(found[1][6]).samples == [moving("map", "a", 3, x=0.1), plain(turned)]


def test_rosbags_finds_topics_types_counts_times_and_transforms(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    written(
        path, (5, (static("map", "c", x=3.0),)), *((9 + k, (moving("map", "a", k, x=k / 7),)) for k in range(1_000))
    )
    with AnyReader([path]) as reader:
        assert {(each.topic, each.msgtype, each.msgcount) for each in reader.connections} == {
            ("/tf_static", "tf2_msgs/msg/TFMessage", 1),
            ("/tf", "tf2_msgs/msg/TFMessage", 1_000),
        }
        messages: list[tuple[int, Any]] = [
            (time, reader.deserialize(raw, each.msgtype)) for each, time, raw in reader.messages()
        ]
    assert [time for time, _ in messages] == [5, *range(9, 1_009)]
    for number, (_, message) in enumerate(messages[1:]):
        (transform,) = message.transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("map", "a")
        assert transform.header.stamp.nanosec == number
        assert transform.transform.translation.x == number / 7


def test_a_batch_of_both_kinds_is_a_message_on_each_topic(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    written(path, (5, (moving("map", "a", 1), static("a", "b"), moving("a", "c", 2), static("a", "d"))))
    with Reader(path) as reader:
        found = {each.topic: (time, decode(raw).samples) for each, time, raw in reader.messages()}
    assert found == {
        "/tf_static": (5, [moving("a", "b", 0), moving("a", "d", 0)]),
        "/tf": (5, [moving("map", "a", 1), moving("a", "c", 2)]),
    }


def test_a_child_that_changes_its_kind_within_a_batch_has_the_last_one(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    written(path, (5, (moving("map", "a", 1), static("map", "b"), static("map", "a"), moving("map", "b", 2))))
    with Reader(path) as reader:
        assert [(each.topic, decode(raw).samples) for each, _, raw in reader.messages()] == [
            ("/tf", [moving("map", "a", 1)]),
            ("/tf_static", [moving("map", "b", 0), moving("map", "a", 0)]),
            ("/tf", [moving("map", "b", 2)]),
        ]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(samples(at=st.integers(-(2**31) * SECOND, 2**31 * SECOND - 1)), min_size=1, max_size=5))
def test_transforms_come_back_bit_for_bit(tmp_path: Path, batch: list[TransformStamped]) -> None:
    path = tmp_path / "run.mcap"
    output = written(path, (5, tuple(batch)))
    found: dict[str, list[str]] = {"/tf": [], "/tf_static": []}
    with Reader(path) as reader:
        for each, _, raw in reader.messages():
            found[each.topic] += map(repr, decode(raw).samples)
    # The text tells negative zeros too.
    assert found["/tf"] == [repr(plain(sample)) for sample in batch if not sample.static]
    assert found["/tf_static"] == [repr(plain(sample)) for sample in batch if sample.static]
    assert output.samples == len(batch)


def test_samples_that_a_message_cannot_hold_are_counted_by_reason(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    late, long = moving("map", "a", 2**31 * SECOND), moving("map", "a" * 2_000, 1)
    output = written(path, (5, (late, moving("map", "b", 1), long)), (6, (late,)))
    with Reader(path) as reader:
        assert [(time, decode(raw).samples) for _, time, raw in reader.messages()] == [(5, [moving("map", "b", 1)])]
    assert output.refused == Counter({"stamp": 2, "frame name": 1})
    assert (output.samples, output.messages) == (1, 1)


def test_an_instant_before_1970_is_recorded_as_1970(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    written(path, (-5, (moving("map", "a", -5),)))
    with Reader(path) as reader:
        assert [(time, decode(raw).samples) for _, time, raw in reader.messages()] == [(0, [moving("map", "a", -5)])]


def authorities_in(path: Path) -> list[tuple[str | None, list[str]]]:
    """For each message, what its channel tells of authorities, and the children in it."""
    with path.open("rb") as file:
        return [
            (
                channel.metadata.get("tfbus.authorities"),
                [sample.child for sample in decode(message.data).samples if sample is not None],
            )
            for _, channel, message in make_reader(file).iter_messages(log_time_order=False)
        ]


def test_the_channel_of_a_message_has_its_authorities(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    a, b, c = (moving("map", child, 1, authority=who) for child, who in (("a", "x"), ("b", "x"), ("c", "y")))
    written(path, (1, (a,)), (2, (a, b)), (3, (a, b, c)), (4, (moving("map", "d", 1),)))
    assert authorities_in(path) == [
        ('[["x", 1]]', ["a"]),
        ('[["x", 1]]', ["a", "b"]),
        ('[["x", 2], ["y", 1]]', ["a", "b", "c"]),
        (None, ["d"]),
    ]


def test_a_message_with_too_many_authorities_is_split(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    crowd = tuple(moving("map", f"f{number}", 1, authority=f"a{number // 2}") for number in range(100))
    output = written(path, (1, crowd))
    assert authorities_in(path) == [
        (f'[["a{number}", 1]]', [f"f{2 * number}", f"f{2 * number + 1}"]) for number in range(50)
    ]
    assert (output.samples, output.messages, output.unattributed) == (100, 50, 0)


def test_with_a_thousand_authorities_the_rest_is_recorded_without_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    output = written(path, *((k, (moving("map", "a", k, authority=f"a{k}"),)) for k in range(1_010)))
    told = [authorities for authorities, _ in authorities_in(path)]
    assert told == [f'[["a{k}", 1]]' for k in range(1_000)] + [None] * 10
    assert (output.samples, output.unattributed) == (1_010, 10)


def test_samples_counted_as_written_can_be_read_at_any_moment(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    seen = set()
    with closing(McapOutput(str(path), overwrite=False)) as output:
        for k in range(2_000):
            output.write([(k, (moving("map", "a", k, authority=f"a{k // 100}"),))])
            assert output.samples + output.buffered == k + 1
            if output.samples not in seen:
                seen.add(output.samples)
                assert output.samples == output.messages == readable(path)
        # A message of one transform has 100 to 200 bytes.
        assert 2_000 * 100 / CHUNK_SIZE < len(seen) < 2_000 * 200 / CHUNK_SIZE + 2
        assert output.samples < 2_000
        output.write((), flush=True)
        assert output.samples == readable(path) == 2_000


def test_a_message_that_fills_a_chunk_is_counted_at_once(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    # A transform has more than 56 bytes.
    many = tuple(moving("map", f"f{k}", 1) for k in range(CHUNK_SIZE // 56))
    with closing(McapOutput(str(path), overwrite=False)) as output:
        output.write([(1, (moving("map", "a", 1),))])
        assert (output.samples, output.messages, output.buffered) == (0, 0, 1)
        output.write([(2, many)])
        assert (output.samples, output.messages, output.buffered) == (len(many) + 1, 2, 0)
        assert readable(path) == 2


def test_a_chunk_ended_by_a_new_channel_is_not_counted_too_early(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with closing(McapOutput(str(path), overwrite=False)) as output:
        counted = 0
        for k in range(400):
            output.write([(k, (moving("map", "a", k, authority=f"a{k}"),))])
            if output.samples > counted:
                counted = output.samples
                assert counted <= readable(path)
        assert counted > 0


def test_an_existing_file_is_kept_unless_overwrite_is_set(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("precious")
    with pytest.raises(FileExistsError):
        McapOutput(str(path), overwrite=False)
    assert path.read_text() == "precious"
    written(path, (1, (moving("map", "a", 1),)))
    assert readable(path) == 1


@pytest.mark.parametrize("make", [Path.mkdir, lambda path: path.symlink_to("/dev/full")], ids=["folder", "full disk"])
def test_a_file_that_cannot_be_written_raises_at_once(tmp_path: Path, make: Callable[[Path], None]) -> None:
    path = tmp_path / "run.mcap"
    make(path)
    with pytest.raises(OSError, match=r"directory|space"):
        McapOutput(str(path), overwrite=True)


@dataclass
class Registered:
    topic: str
    metadata: dict[str, str]


def registered(*wanted: tuple[str, Runs]) -> tuple[list[int | None], list[Registered]]:
    """The channels that were registered when some were looked for, and their numbers; None if there was no room."""
    made: list[Registered] = []

    def register(topic: str, metadata: dict[str, str]) -> int:
        made.append(Registered(topic, metadata))
        return len(made) - 1

    channels = Channels(register)
    return [channels.find(topic, runs) for topic, runs in wanted], made


@pytest.mark.parametrize(
    ("topic", "depth", "durability"),
    [("/tf", 100, QosDurability.VOLATILE), ("/tf_static", 1, QosDurability.TRANSIENT_LOCAL)],
)
def test_the_quality_of_service_is_that_of_tf2s_broadcasters(topic: str, depth: int, durability: QosDurability) -> None:
    (number,), channels = registered((topic, [("odometry", 1)]))
    assert number is not None
    assert channels[number].topic == topic
    (offered,) = parse_qos(channels[number].metadata["offered_qos_profiles"])
    assert (offered.history, offered.depth) == (QosHistory.KEEP_LAST, depth)
    assert (offered.reliability, offered.durability) == (QosReliability.RELIABLE, durability)


def test_each_authority_has_one_channel_for_messages_of_any_length() -> None:
    found, channels = registered(
        ("/tf", [("odometry", 1)]), ("/tf", [("odometry", 7)]), ("/tf", [("slam", 1)]), ("/tf_static", [("slam", 2)])
    )
    assert found[0] == found[1]
    assert len(set(found)) == len(channels) == 3
    assert [json.loads(channel.metadata["tfbus.authorities"]) for channel in channels] == [
        [["odometry", 1]],
        [["slam", 1]],
        [["slam", 1]],
    ]


def test_authorities_that_share_a_message_are_told_run_by_run() -> None:
    (number,), channels = registered(("/tf", [("slam", 2), ("", 1), ("\ud800", 3)]))
    assert number is not None
    assert json.loads(channels[number].metadata["tfbus.authorities"]) == [["slam", 2], ["", 1], ["\ud800", 3]]


def test_what_nobody_has_said_is_on_a_channel_as_ros_has_it() -> None:
    found, channels = registered(("/tf", [("", 1)]), ("/tf", [("", 5)]))
    assert found[0] == found[1]
    assert ["tfbus.authorities" in channel.metadata for channel in channels] == [False]


def test_there_is_room_for_so_many_authorities_and_always_for_none() -> None:
    found, channels = registered(
        *(("/tf", [(f"a{number}", 1)]) for number in range(MAX_CHANNELS + 1)), ("/tf", [("", 1)])
    )
    assert found[-2] is None
    assert None not in found[:-2]
    assert found[-1] is not None
    assert len(channels) == MAX_CHANNELS + 1


def test_ways_to_share_a_message_leave_half_of_the_room_to_single_authorities() -> None:
    found, _ = registered(
        *(("/tf", [("a", number), ("b", 1)]) for number in range(1, MAX_SHARED_CHANNELS + 2)), ("/tf", [("a", 1)])
    )
    assert found[-2] is None
    assert None not in found[:-2]
    assert found[-1] is not None


def test_a_message_of_very_many_authorities_has_no_channel_of_its_own() -> None:
    for count, has_one in ((_MAX_RUNS, True), (_MAX_RUNS + 1, False)):
        (number,), _ = registered(("/tf", [(f"a{number}", 1) for number in range(count)]))
        assert (number is not None) == has_one
