"""Covariances in recordings: beside the transforms, which stay what they are for everybody else."""

import math
from collections import Counter
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from support.recorded import in_blocks, messages_in, write_recording
from support.samples import moving, static
from support.worlds import random_covariance, random_transform

from tfbus import SECOND, Buffer, Bus, Covariance, SimulatedClock, TransformStamped, UncertainSample
from tfbus.bus.queues import TimedBatch
from tfbus.geometry.covariance import KINDS, Kind
from tfbus.recording import (
    Edits,
    Player,
    Recorder,
    convert,
    examine,
    load,
    open_recording,
    summarise,
)
from tfbus.recording.formats.copies import McapCopy
from tfbus.recording.formats.covariances import RawCovariance, covariance_channel, write_covariances
from tfbus.recording.formats.storage import Channel
from tfbus.tf_message import encode

RNG = np.random.default_rng(1)
Told = tuple[TransformStamped, Covariance | None, str | None]


def uncertain(parent: str, child: str, stamp: int, kind: Kind = "drift", static: bool = False) -> UncertainSample:
    error = Covariance(random_covariance(RNG, 0.1, 0.05))
    return UncertainSample(parent, child, stamp, random_transform(RNG), "odometry", static, covariance=error, kind=kind)


BATCHES: list[tuple[TransformStamped, ...]] = [
    (uncertain("base", "lidar", 0, "constant", static=True), static("base", "imu"), moving("odom", "base", 1)),
    (uncertain("odom", "base", 2, KINDS[0]), moving("map", "odom", 2)),
    *[(uncertain("odom", "base", stamp, KINDS[stamp % 3]),) for stamp in range(3, 8)],
    (moving("odom", "base", 8), uncertain("odom", "a" * 7, 8), uncertain("müll", "b", 8)),
    # The same stamp again, with another error, and with none.
    (uncertain("odom", "base", 9),),
    (uncertain("odom", "base", 9),),
    (moving("odom", "base", 9),),
]
ENTRIES: list[TimedBatch] = [(SECOND + 10 * place, batch) for place, batch in enumerate(BATCHES)]


def told(sample: TransformStamped) -> Told:
    return (sample, sample.covariance, sample.kind) if isinstance(sample, UncertainSample) else (sample, None, None)


def in_file(path: Path, **options: Any) -> list[Told]:
    """All samples of a recording, in which nothing is wrong."""
    with open_recording(path, **options) as recording:
        messages = list(recording.messages())
    assert not any(message.errors for message in messages)
    return [told(sample) for message in messages for sample in message.batch]


def by_kind(batches: list[tuple[TransformStamped, ...]]) -> list[Told]:
    return [told(each) for batch in batches for each in sorted(batch, key=lambda sample: not sample.static)]


@pytest.mark.anyio
@pytest.mark.every_loop
async def test_samples_come_back_from_a_recording_with_their_covariances_and_kinds(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Bus(SimulatedClock(SECOND)) as bus:
        async with Recorder(bus, path) as recorder:
            for batch in BATCHES:
                bus.publish(batch)
                await recorder.flush()
    assert (recorder.error, recorder.statistics().samples) == (None, sum(map(len, BATCHES)))
    assert in_file(path) == by_kind(BATCHES)
    with Bus(SimulatedClock()) as bus, Buffer(bus, keep=None) as buffer:
        await Player(bus, path, rate=math.inf).play()
        for tree in (buffer.tree, load(path)):
            found = tree.lookup("odom", "lidar", 6, covariance=True)
            assert found.exact == ()
            (mount,) = [link.error for link in found.links if link.child == "lidar"]
            (drive,) = [link.error for link in found.links if link.child == "base"]
            assert mount is not None
            assert drive is not None
            sample = BATCHES[5][0]
            assert isinstance(sample, UncertainSample)
            assert np.array_equal(drive.matrix, sample.covariance.matrix)
            assert (mount.kind, drive.kind) == ("constant", sample.kind)
            assert tree.lookup("odom", "base", 9, covariance=True).exact == (("odom", "base"),)


def test_transforms_stay_plain_messages_for_all_other_programs(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", *ENTRIES)
    bare = [(at, tuple(TransformStamped.replace(sample) for sample in batch)) for at, batch in ENTRIES]
    plain = write_recording(tmp_path / "plain.mcap", *bare)
    contents = []
    for each in (path, plain):
        with each.open("rb") as file:
            messages = [(c.topic, s and s.name, m.log_time, m.data) for s, c, m in make_reader(file).iter_messages()]
        contents.append([message for message in messages if message[1] == "tf2_msgs/msg/TFMessage"])
        more = {"/tf_covariance", "/tf_static_covariance"} if each is path else set()
        assert {topic for topic, *_ in messages} == {"/tf", "/tf_static"} | more
    assert contents[0] == contents[1]
    with open_recording(path) as recording, open_recording(plain) as other:
        assert (recording.count, recording.remarks) == (other.count, ())
        assert examine(recording) == examine(other)
        summary = summarise(recording)
        assert (summary.messages, summary.frames) == (other.count, summarise(other).frames)


def test_ros_reads_the_numbers_of_a_covariance_by_the_definition_in_the_file(tmp_path: Path) -> None:
    write_recording(tmp_path / "run.mcap", *ENTRIES)
    convert([tmp_path / "run.mcap"], tmp_path / "run.bag")
    with AnyReader([tmp_path / "run.bag"]) as reader:
        connections = [each for each in reader.connections if each.topic == "/tf_static_covariance"]
        ((_, received, raw),) = reader.messages(connections)
        message: Any = reader.deserialize(raw, connections[0].msgtype)
        (found,) = message.covariances
    sample = BATCHES[0][0]
    assert isinstance(sample, UncertainSample)
    assert (received, found.header.frame_id, found.child_frame_id, found.kind) == (SECOND, "base", "lidar", "constant")
    assert np.array_equal(found.covariance, sample.covariance.matrix.ravel())


@pytest.mark.parametrize(
    ("name", "schema"), [("new.mcap", "ros"), ("new.bag", "ros"), ("new.db3", "ros"), ("new.mcap", "foxglove")]
)
def test_every_format_keeps_covariances_and_parts_edits_and_merges_do(
    tmp_path: Path, name: str, schema: Literal["ros", "foxglove"]
) -> None:
    path, new = write_recording(tmp_path / "run.mcap", *ENTRIES), tmp_path / name
    assert convert([path], new, schema=schema).problems == {}
    assert [each[1:] for each in in_file(new)] == [each[1:] for each in by_kind(BATCHES)]
    edits = Edits(frames=["base", "lidar"], rename={"base": "b"}, prefix="r/")
    convert([path, path], new, SECOND + 30, edits=edits, schema=schema, overwrite=True)
    found = in_file(new)
    lidar = BATCHES[0][0]
    assert isinstance(lidar, UncertainSample)
    assert [(each[0].parent, each[0].child, each[1], each[2]) for each in found[:2]] == [
        ("b", "r/lidar", lidar.covariance, "constant")
    ] * 2
    both = [each for each in by_kind(BATCHES[3:]) if each[0].child == "base" for _ in range(2)]
    assert [each[1:] for each in found[2:]] == [each[1:] for each in both]
    for edits, topics in ((Edits(drop_static=True), None), (Edits(), ["tf"])):
        convert([path], new, edits=edits, topics=topics, schema=schema, overwrite=True)
        with open_recording(new) as recording:
            assert {topic.name for topic in recording.topics} == {"/tf", "/tf_covariance"}


def test_a_trajectory_says_that_it_has_no_covariances(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", (SECOND, (uncertain("map", "base", 5),)))
    done = convert([path], tmp_path / "run.tum")
    assert (done.transforms, done.problems, done.details) == (1, {"format": 1}, ["a trajectory has no covariances"])


def test_a_topic_in_a_namespace_and_a_prefix_have_their_covariances(tmp_path: Path) -> None:
    sample = uncertain("odom", "base", 5)
    path = tmp_path / "run.mcap"
    with closing(McapCopy(path, "")) as copy:
        copy.write(covariance_channel("/r1/tf_covariance", {}), 7, write_covariances([raw_of(sample)]))
        copy.write(Channel("/r1/tf", "tf2_msgs/msg/TFMessage", "cdr"), 7, encode([sample]))
        copy.finish()
    for options in ({"namespaces": True}, {"topics": {"/r1/tf": "r1/"}}):
        (found,) = in_file(path, **options)
        assert (found[0].parent, found[0].child, found[1]) == ("r1/odom", "r1/base", sample.covariance)
    assert in_file(path) == []


def test_covariances_find_their_transforms_across_blocks_and_from_any_log_time(tmp_path: Path) -> None:
    samples = [uncertain("odom", "base", stamp) for stamp in range(1, 5)]
    path = tmp_path / "run.mcap"
    plain, errors, camera = (
        Channel("/tf", "tf2_msgs/msg/TFMessage", "cdr"),
        covariance_channel("/tf_covariance", {}),
        (Channel("/camera", "x/msg/Image", "cdr")),
    )
    with closing(McapCopy(path, "")) as copy:
        for sample in samples:
            copy.write(errors, sample.stamp, write_covariances([raw_of(sample)]))
            # A picture fills a chunk, so each of the others is in a block of its own.
            copy.write(camera, sample.stamp, bytes(2**21))
            copy.write(plain, sample.stamp, encode([sample]))
            copy.write(camera, sample.stamp, bytes(2**21))
        copy.finish()
    for read in (messages_in, in_blocks):
        for since in (None, 3):
            found = [told(sample)[1:] for message in read(path, since) for sample in message.batch]
            assert found == [told(sample)[1:] for sample in samples[2 if since else 0 :]]
    assert load(path).lookup("odom", "base", 3, covariance=True).covariance == samples[2].covariance


def test_a_batch_of_any_size_is_written_in_messages_that_can_be_read(tmp_path: Path) -> None:
    error = Covariance.of(xyz=0.5)
    names, place = [f"{number:0900}" for number in range(4_501)], random_transform(RNG)
    batch = tuple(UncertainSample(a, b, 5, place, covariance=error) for a, b in pairwise(names))
    path = write_recording(tmp_path / "run.mcap", (SECOND, batch))
    assert in_file(path) == list(map(told, batch))


# Strangers


def raw_of(sample: UncertainSample, **changes: Any) -> RawCovariance:
    numbers = tuple(sample.covariance.to_dict())
    known = RawCovariance(sample.stamp, sample.parent.encode(), sample.child.encode(), sample.kind.encode(), numbers)
    return known._replace(**changes)


SAMPLE = uncertain("odom", "base", 5)
GOOD = write_covariances([raw_of(SAMPLE)])
BAD = {
    "cut": GOOD[:-1],
    "empty": b"",
    "header": GOOD[:4],
    "many": GOOD[:4] + b"\xff\xff\xff\xff" + GOOD[8:],
    "kind": write_covariances([raw_of(SAMPLE, kind=b"guess")]),
    "name": write_covariances([raw_of(SAMPLE, child=b"\xff")]),
    "long name": write_covariances([raw_of(SAMPLE, child=b"x" * 1_025)]),
    "NaN": write_covariances([raw_of(SAMPLE, numbers=(float("nan"),) * 36)]),
    "negative": write_covariances([raw_of(SAMPLE, numbers=(-1.0,) + (0.0,) * 35)]),
    "asymmetric": write_covariances([raw_of(SAMPLE, numbers=(0.0, 1.0) + (0.0,) * 34)]),
}


@pytest.mark.parametrize("bad", BAD)
def test_a_message_of_covariances_that_is_none_is_told_and_takes_no_transform_away(tmp_path: Path, bad: str) -> None:
    path = tmp_path / "run.mcap"
    with closing(McapCopy(path, "")) as copy:
        for received, payload in ((7, GOOD), (8, BAD[bad]), (9, GOOD)):
            copy.write(covariance_channel("/tf_covariance", {}), received, payload)
            copy.write(Channel("/tf", "tf2_msgs/msg/TFMessage", "cdr"), received, encode([SAMPLE]))
        copy.finish()
    messages = messages_in(path)
    assert [error.reason for message in messages for error in message.errors] == ["covariance"]
    found = [told(sample)[1] for message in messages for sample in message.batch]
    assert found == [SAMPLE.covariance, None, SAMPLE.covariance]
    problems: Counter[str] = Counter()
    load(path, problems=problems)
    assert problems == {"covariance": 1}


def test_covariances_without_transforms_are_dropped_beyond_a_bound_and_told(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    many = write_covariances([raw_of(SAMPLE, stamp=stamp) for stamp in range(10, 5_010)])
    more = many.replace(b"base\0", b"bass\0")
    with closing(McapCopy(path, "")) as copy:
        for payload in (many, more, GOOD):
            copy.write(covariance_channel("/tf_covariance", {}), 7, payload)
        copy.write(Channel("/tf", "tf2_msgs/msg/TFMessage", "cdr"), 7, encode([SAMPLE]))
        copy.write(covariance_channel("/tf_covariance", {}), 7, many)
        copy.finish()
    messages = messages_in(path)
    assert [str(error) for message in messages for error in message.errors] == [
        "no message of transforms (covariance): 10,000 covariances have come without their transforms"
    ]
    assert [told(sample)[1] for message in messages for sample in message.batch] == [SAMPLE.covariance]
