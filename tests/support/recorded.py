"""Recordings to read in tests: the repository's own, real ones, and files made by the writers of others."""

import json
import os
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import CompressionType, Writer
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import ConnectionExtRosbag1
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore

from tfbus import TransformStamped
from tfbus.bus.queues import TimedBatch
from tfbus.recording import Recording, open_recording
from tfbus.recording.formats.mcap_output import McapOutput
from tfbus.recording.recording import RecordedMessage
from tfbus.tf_message import encode

SMALL = Path(__file__).parents[1] / "recordings" / "small.bag"
ANSWERS = SMALL.with_suffix(".json")
REAL = Path(os.environ.get("RECORDINGS", "/nowhere"))
"""The folder of real recordings, which are no part of this repository."""

WRONG_IN_SMALL = {
    "not finite": 3,
    "frame name": 2,
    "zero quaternion": 1,
    "not a unit quaternion": 1,
    "self transform": 1,
    "cycle": 1,
}
"""The invalid transforms in it."""

TF_MESSAGE = "tf2_msgs/msg/TFMessage"

Line = tuple[int, str, Sequence[TransformStamped] | bytes]
"""Log time in ns, topic, and samples or a payload."""


def real(name: str) -> Path:
    """A real recording; the test is skipped where it is not there."""
    path = REAL / name
    if not path.is_file():
        pytest.skip(f"no {name}: set RECORDINGS to a folder that has it")
    return path


def write_mcap(
    path: Path,
    lines: Iterable[Line],
    *,
    finish: bool = True,
    chunk_size: int = 1_024,
    compression: CompressionType = CompressionType.NONE,
    metadata: dict[str, str] | None = None,
    schema: str = TF_MESSAGE,
    encoding: str = "cdr",
    definition: bytes = b"geometry_msgs/TransformStamped[] transforms",
    **options: Any,
) -> Path:
    """A file by the official writer; a channel for each topic."""
    with path.open("wb") as file:
        writer: Any = Writer(file, chunk_size, compression, **options)
        writer.start("ros2", "tests")
        kind = writer.register_schema(schema, "ros2msg", definition)
        channels: dict[str, int] = {}
        for received, topic, samples in lines:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, encoding, kind, metadata or {})
            payload = samples if isinstance(samples, bytes) else encode(samples)
            writer.add_message(channels[topic], received, payload, received)
        if finish:
            writer.finish()
        else:
            writer.flush()
    return path


def write_blocks(path: Path, lines: Iterable[Line]) -> Path:
    """A file whose messages are read in a block each, as each shares its chunk with a large picture."""
    spaced = [each for line in lines for each in (line, (line[0], "/camera", bytes(2**21)))]
    return write_mcap(path, spaced, chunk_size=2**21, compression=CompressionType.ZSTD)


def write_recording(path: Path, *entries: TimedBatch) -> Path:
    """A recording as a `Recorder` makes it, with batches at log times."""
    with closing(McapOutput(str(path), overwrite=True)) as output:
        output.write(entries)
        output.finish()
    return path


def as_ros2(bag: Path, folder: Path, storage: StoragePlugin, **options: Any) -> Path:
    """The transforms of a bag of ROS 1 as ROS 2 records them, in a folder, by the writer of `rosbags`."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    writer = rosbag2.Writer(folder, version=9, storage_plugin=storage)
    if options:
        writer.set_compression(**options)
    with rosbag1.Reader(bag) as reader, writer:
        connections = [connection for connection in reader.connections if connection.topic in ("/tf", "/tf_static")]
        names = sorted({connection.topic for connection in connections})
        topics = {name: writer.add_connection(name, TF_MESSAGE, typestore=types) for name in names}
        for connection, received, raw in reader.messages(connections):
            writer.write(topics[connection.topic], received, types.ros1_to_cdr(raw, TF_MESSAGE))
    return folder


def sender_of(connection: Any) -> str:
    """The name of the recorder in a bag, as the bag has it."""
    assert isinstance(connection.ext, ConnectionExtRosbag1)
    return connection.ext.callerid or ""


def messages_in(path: Path, since: int | None = None, until: int | None = None) -> list[RecordedMessage]:
    """All messages of a recording, without the report that its index is missing."""
    with open_recording(path) as recording:
        return without_unfinished(recording.messages(since, until))


def in_blocks(path: Path, since: int | None = None, until: int | None = None) -> list[RecordedMessage]:
    """The same messages, as they are in the blocks of the recording."""
    with open_recording(path) as recording:
        return without_unfinished(message for block in recording.blocks(since, until) for message in block.messages())


def without_unfinished(messages: Iterable[RecordedMessage]) -> list[RecordedMessage]:
    """The messages without the report that the index of their file is missing."""
    return [message for message in messages if [error.reason for error in message.errors] != ["unfinished"]]


def batches_in(path: Path) -> list[tuple[int, tuple[TransformStamped, ...]]]:
    """All samples of a recording with their log times; nothing may be wrong with it."""
    messages = messages_in(path)
    assert not any(message.errors for message in messages)
    return [(message.received, message.batch) for message in messages]


def facts(recording: Recording) -> tuple[int | None, int | None, int | None, bool]:
    """The facts that a recording tells without being read."""
    return recording.start, recording.end, recording.count, recording.finished


def answers() -> list[dict[str, Any]]:
    """The answers of tf2 to the small bag."""
    found: list[dict[str, Any]] = json.loads(ANSWERS.read_text(encoding="utf-8"))
    return found
