"""The MCAP files that a recorder writes, read by others."""

from contextlib import closing
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rosbags.interfaces import QosDurability, QosHistory, QosReliability
from rosbags.rosbag2 import Reader
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_typestore
from support.processes import is_open
from support.samples import moving, static

from tfbus import Transform, TransformStamped
from tfbus.bus.queues import TimedBatch
from tfbus.recording.formats.mcap_output import CHUNK_SIZE, SCHEMA, SCHEMA_NAME, TYPE_HASH, McapOutput
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


def as_decoded(sample: TransformStamped) -> TransformStamped:
    """The sample that `decode` gives: a message has neither an authority nor a kind."""
    return TransformStamped(sample.parent, sample.child, sample.stamp, sample.transform)


def test_the_schema_is_the_definition_that_ros_2_has() -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    assert store.generate_msgdef(SCHEMA_NAME, ros_version=2)[0] == SCHEMA
    assert store.hash_rihs01(SCHEMA_NAME) == TYPE_HASH


def test_the_official_reader_reads_topics_times_and_transforms(path: Path) -> None:
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
    assert decode(found[1][6]).samples == [moving("map", "a", 3, x=0.1), as_decoded(turned)]


def test_a_child_that_changes_its_kind_within_a_batch_has_the_last_one(path: Path) -> None:
    written(path, (5, (moving("map", "a", 1), static("map", "b"), static("map", "a"), moving("map", "b", 2))))
    with Reader(path) as reader:
        assert [(each.topic, decode(raw).samples) for each, _, raw in reader.messages()] == [
            ("/tf", [moving("map", "a", 1)]),
            ("/tf_static", [moving("map", "b", 0), moving("map", "a", 0)]),
            ("/tf", [moving("map", "b", 2)]),
        ]


def test_an_instant_before_1970_is_recorded_as_1970(path: Path) -> None:
    written(path, (-5, (moving("map", "a", -5),)))
    with Reader(path) as reader:
        assert [(time, decode(raw).samples) for _, time, raw in reader.messages()] == [(0, [moving("map", "a", -5)])]


def authorities_in(path: Path) -> list[tuple[str | None, list[str]]]:
    """For each message, what its channel tells of authorities, and the children in it."""
    with path.open("rb") as file:
        messages = list(make_reader(file).iter_messages(log_time_order=False))
    told = [channel.metadata.get("tfbus.authorities") for _, channel, _ in messages]
    children = [[sample.child for sample in decode(each.data).samples if sample] for _, _, each in messages]
    return list(zip(told, children, strict=True))


def test_the_channel_of_a_message_has_its_authorities(path: Path) -> None:
    a, b, c = (moving("map", child, 1, authority=who) for child, who in (("a", "x"), ("b", "x"), ("c", "y")))
    written(path, (1, (a,)), (2, (a, b)), (3, (a, b, c)), (4, (moving("map", "d", 1),)))
    assert authorities_in(path) == [
        ('[["x", 1]]', ["a"]),
        ('[["x", 1]]', ["a", "b"]),
        ('[["x", 2], ["y", 1]]', ["a", "b", "c"]),
        (None, ["d"]),
    ]


@pytest.mark.parametrize("runs", [32, 33])
def test_a_message_with_too_many_authorities_is_split(path: Path, runs: int) -> None:
    crowd = tuple(moving("map", f"f{number}", 1, authority=f"a{number // 2}") for number in range(2 * runs))
    output = written(path, (1, crowd))
    if runs == 32:
        ((_, children),) = authorities_in(path)
        assert len(children) == 64
    else:
        assert authorities_in(path) == [
            (f'[["a{number}", 1]]', [f"f{2 * number}", f"f{2 * number + 1}"]) for number in range(33)
        ]
    assert (output.samples, output.unattributed) == (2 * runs, 0)


def test_with_a_thousand_authorities_the_rest_is_recorded_without_and_counted(path: Path) -> None:
    output = written(path, *((k, (moving("map", "a", k, authority=f"a{k}"),)) for k in range(1_010)))
    told = [authorities for authorities, _ in authorities_in(path)]
    assert told == [f'[["a{k}", 1]]' for k in range(1_000)] + [None] * 10
    assert (output.samples, output.unattributed) == (1_010, 10)
    # Ways to share a message leave half of the room to single authorities.
    shared = [(moving("map", "a", k, authority=f"a{k}"), moving("map", "b", k, authority="b")) for k in range(501)]
    output = written(path, *((k, batch) for k, batch in enumerate(shared)))
    assert (output.messages, output.unattributed) == (502, 0)
    assert authorities_in(path)[-3:] == [
        ('[["a499", 1], ["b", 1]]', ["a", "b"]),
        ('[["a500", 1]]', ["a"]),
        ('[["b", 1]]', ["b"]),
    ]


def test_the_quality_of_service_is_that_of_tf2s_broadcasters(path: Path) -> None:
    written(path, (5, (moving("map", "a", 1), static("a", "b"))))
    with path.open("rb") as file:
        channels = {channel.topic: channel.metadata for _, channel, _ in make_reader(file).iter_messages()}
    for topic, depth, durability in (
        ("/tf", 100, QosDurability.VOLATILE),
        ("/tf_static", 1, QosDurability.TRANSIENT_LOCAL),
    ):
        (offered,) = parse_qos(channels[topic]["offered_qos_profiles"])
        assert (offered.history, offered.depth) == (QosHistory.KEEP_LAST, depth)
        assert (offered.reliability, offered.durability) == (QosReliability.RELIABLE, durability)


def test_samples_counted_as_written_can_be_read_at_any_moment(path: Path) -> None:
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
