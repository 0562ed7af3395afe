"""Writing messages of any topic to a new file: MCAP, a bag of ROS 1, or SQLite of ROS 2.

A payload is written as it is where the format can hold its encoding. Else it is converted between CDR and ROS 1, by
`rosbags` and the definition of its type.
"""

import json
import sqlite3
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any, Final, Protocol

from tfbus.recording.formats._channels import TYPE_HASH
from tfbus.recording.formats._foxglove import (
    FRAME_TRANSFORMS,
    foxglove_channel,
    transforms_schema,
    write_protobuf,
)
from tfbus.recording.formats._mcap_output import SCHEMA
from tfbus.recording.formats._raw_transforms import RawTransform, write_cdr, write_ros1
from tfbus.recording.formats._storage import Channel
from tfbus.recording.formats._types import MessageTypes

TF_TYPE: Final = "tf2_msgs/msg/TFMessage"
_CHUNK: Final = 2**20
_SQL: Final = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL);
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL,
    offered_qos_profiles TEXT NOT NULL, type_description_hash TEXT NOT NULL);
CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding TEXT NOT NULL,
    encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
    data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
INSERT INTO schema VALUES (4, 'humble');
"""
"""The tables of ROS 2's storage plugin for SQLite, version 4 of its schema."""


class CannotWriteError(ValueError):
    """A message that the format cannot hold."""


class Copy(Protocol):
    """A new file, made of its path and of the name that it gets when it is finished.

    Attributes
    ----------
    encoding : str
        The encoding of transforms in it: ``"cdr"``, ``"ros1"`` or ``"protobuf"``.
    """

    encoding: str

    def holds(self, channel: Channel) -> bool:
        """Whether payloads with transforms of a channel are written as they are."""
        ...

    def write(self, channel: Channel, received: int, payload: bytes) -> None:
        """Write a message; raises `CannotWriteError` if the format cannot hold it, and `OSError`."""
        ...

    def finish(self) -> None:
        """Write the index, and close the file."""
        ...

    def close(self) -> None:
        """Close the file, finished or not."""
        ...


def transform_channel(source: Channel, encoding: str, metadata: dict[str, str]) -> Channel:
    """The channel for transforms of another channel, in the encoding of a copy."""
    if encoding == "protobuf":
        return foxglove_channel(source, metadata)
    if encoding == "cdr":
        return Channel(source.topic, TF_TYPE, "cdr", "ros2msg", SCHEMA.encode(), metadata)
    return Channel(source.topic, "tf2_msgs/TFMessage", "ros1", "", b"", metadata)


def write_transforms(transforms: Sequence[RawTransform], encoding: str) -> bytes:
    """A message of transforms in the encoding of a copy; raises `MalformedMessageError` if it cannot hold them."""
    return _WRITERS[encoding](transforms)


_WRITERS: Final = {"cdr": write_cdr, "ros1": write_ros1, "protobuf": write_protobuf}


class McapCopy:
    """A `Copy` in MCAP, which holds every encoding."""

    encoding = "cdr"

    def __init__(self, path: Path, _: str) -> None:
        from mcap.writer import Writer

        self._file: IO[bytes] = path.open("wb")
        self._writer: Any = Writer(self._file, _CHUNK)
        self._writer.start(profile="ros2", library="tfbus")
        # As in the files of a `Recorder`.
        self._writer.add_metadata("rosbag2", {})
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[str, int, str, str], int] = {}
        self._known: dict[Channel, int] = {}

    def holds(self, _: Channel) -> bool:
        """True."""
        return True

    def write(self, channel: Channel, received: int, payload: bytes) -> None:
        """Write a message."""
        number = self._known.get(channel)
        if number is None:
            number = self._known[channel] = self._register(channel)
        if received < 0:
            raise CannotWriteError("MCAP has no time before 1970")
        self._writer.add_message(number, received, payload, received)

    def _register(self, channel: Channel) -> int:
        schema = 0
        if channel.type:
            key = channel.type, channel.schema_encoding, channel.schema
            if key not in self._schemas:
                self._schemas[key] = self._writer.register_schema(*key)
            schema = self._schemas[key]
        place = channel.topic, schema, channel.encoding, json.dumps(sorted(channel.metadata.items()))
        if place not in self._channels:
            self._channels[place] = self._writer.register_channel(
                channel.topic, channel.encoding, schema, dict(channel.metadata)
            )
        return self._channels[place]

    def finish(self) -> None:
        """Write the index, and close the file."""
        self._writer.finish()
        self._file.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class FoxgloveCopy(McapCopy):
    """A `Copy` in MCAP with all transforms in Foxglove's schema."""

    encoding = "protobuf"

    def __init__(self, path: Path, name: str) -> None:
        # Without the extra, before there is a file.
        transforms_schema()
        super().__init__(path, name)

    def holds(self, channel: Channel) -> bool:
        """Whether the channel has Foxglove's schema already."""
        return channel.type == FRAME_TRANSFORMS and channel.encoding == "protobuf"


class BagCopy:
    """A `Copy` as a bag of ROS 1; messages in CDR are converted."""

    encoding = "ros1"

    def __init__(self, path: Path, _: str) -> None:
        from rosbags.rosbag1 import Writer

        path.unlink(missing_ok=True)
        self._writer: Any = Writer(path)
        self._writer.open()
        self._types = MessageTypes()
        self._connections: dict[tuple[str, str, str], Any] = {}
        self._known: dict[Channel, Any] = {}

    def holds(self, channel: Channel) -> bool:
        """Whether the channel is encoded as in ROS 1."""
        return channel.encoding == "ros1"

    def write(self, channel: Channel, received: int, payload: bytes) -> None:
        """Write a message."""
        if channel.encoding not in ("ros1", "cdr"):
            raise CannotWriteError(f"a bag cannot hold the encoding {channel.encoding!r}")
        if received < 0:
            raise CannotWriteError("a bag has no time before 1970")
        if channel.encoding == "cdr":
            payload = self._types.convert(channel, payload)
        connection = self._known.get(channel)
        if connection is None:
            connection = self._known[channel] = self._connect(channel)
        self._writer.write(connection, received, payload)

    def _connect(self, channel: Channel) -> Any:
        sender = channel.metadata.get("callerid", "")
        key = channel.topic, channel.type, sender
        if key not in self._connections:
            definition, digest = self._types.ros1_definition(channel)
            latching = 1 if channel.topic.endswith("_static") else None
            self._connections[key] = self._writer.add_connection(
                channel.topic,
                self._types.name(channel.type),
                msgdef=definition,
                md5sum=digest,
                callerid=sender or None,
                latching=latching,
            )
        return self._connections[key]

    def finish(self) -> None:
        """Write the index, and close the file."""
        self._writer.close()

    def close(self) -> None:
        """Close the file."""
        if self._writer.bio:
            self._writer.bio.close()


class SqliteCopy:
    """A `Copy` as an SQLite file of ROS 2; messages of ROS 1 are converted."""

    encoding = "cdr"

    def __init__(self, path: Path, name: str) -> None:
        self._name = name
        path.unlink(missing_ok=True)
        self._file = sqlite3.connect(path)
        self._file.executescript(_SQL)
        self._types = MessageTypes()
        self._topics: dict[tuple[str, str], int] = {}
        self._counts: Counter[tuple[str, str]] = Counter()
        self._span: tuple[int, int] | None = None

    def holds(self, channel: Channel) -> bool:
        """Whether the channel is encoded in CDR."""
        return channel.encoding == "cdr"

    def write(self, channel: Channel, received: int, payload: bytes) -> None:
        """Write a message."""
        if channel.encoding not in ("ros1", "cdr"):
            raise CannotWriteError(f"ROS 2 cannot hold the encoding {channel.encoding!r}")
        if channel.encoding == "ros1":
            payload = self._types.convert(channel, payload)
        kind = self._types.name(channel.type)
        key = channel.topic, kind
        if key not in self._topics:
            self._topics[key] = number = len(self._topics) + 1
            profiles = channel.metadata.get("offered_qos_profiles", "")
            digest = TYPE_HASH if kind == TF_TYPE else ""
            self._execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', ?, ?)", number, *key, profiles, digest)
            if channel.schema_encoding == "ros2msg":
                definition = channel.schema.decode(errors="replace")
                self._execute(
                    "INSERT INTO message_definitions VALUES (NULL, ?, 'ros2msg', ?, ?)", kind, definition, digest
                )
        self._execute("INSERT INTO messages VALUES (NULL, ?, ?, ?)", self._topics[key], received, payload)
        self._counts[key] += 1
        first, last = self._span or (received, received)
        self._span = min(first, received), max(last, received)

    def _execute(self, statement: str, *values: object) -> None:
        try:
            self._file.execute(statement, values)
        except sqlite3.Error as error:
            raise OSError(str(error)) from error

    def finish(self) -> None:
        """Write the metadata, and close the file."""
        self._execute("INSERT INTO metadata VALUES (NULL, 8, ?)", self._metadata())
        try:
            self._file.commit()
        except sqlite3.Error as error:
            raise OSError(str(error)) from error
        self._file.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _metadata(self) -> str:
        """The content of ``metadata.yaml``; JSON is YAML."""
        start, end = self._span or (0, 0)
        count = sum(self._counts.values())
        duration = {"nanoseconds": end - start}
        begin = {"nanoseconds_since_epoch": start}
        topics = [
            {
                "topic_metadata": {
                    "name": name,
                    "type": kind,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": "",
                    "type_description_hash": TYPE_HASH if kind == TF_TYPE else "",
                },
                "message_count": number,
            }
            for (name, kind), number in self._counts.items()
        ]
        file = {"path": self._name, "starting_time": begin, "duration": duration, "message_count": count}
        return json.dumps(
            {
                "rosbag2_bagfile_information": {
                    "version": 8,
                    "storage_identifier": "sqlite3",
                    "duration": duration,
                    "starting_time": begin,
                    "message_count": count,
                    "topics_with_message_count": topics,
                    "compression_format": "",
                    "compression_mode": "",
                    "relative_file_paths": [self._name],
                    "files": [file],
                    "custom_data": None,
                    "ros_distro": "humble",
                }
            }
        )
