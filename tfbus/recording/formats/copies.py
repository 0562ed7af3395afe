"""Writing messages of any topic to a new file: MCAP, a bag of ROS 1, or SQLite of ROS 2.

A payload is written unchanged if the format can hold its encoding. Otherwise `rosbags` converts it between CDR and
ROS 1 by the definition of its type (`MessageTypes`). Transforms keep every bit in each format, because their numbers
stay bytes, also in Foxglove's ``FrameTransforms`` (wire format: the "Encoding" page of Protocol Buffers).
"""

import json
import sqlite3
import struct
from collections import Counter
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import IO, Any, Final, Protocol

from tfbus.recording.formats.mcap_output import SCHEMA, TYPE_HASH
from tfbus.recording.formats.storage import Channel
from tfbus.recording.formats.transforms import RawTransform, write_cdr, write_ros1
from tfbus.tf_message import MalformedMessageError

FRAME_TRANSFORMS: Final = "foxglove.FrameTransforms"
_VARINT, _FIXED64, _BYTES = 0, 1, 2
_SECONDS: Final = range(-(2**63), 2**63)


def write_protobuf(transforms: Sequence[RawTransform]) -> bytes:
    """A ``foxglove.FrameTransforms``.

    Raises
    ------
    MalformedMessageError
        If a name is not UTF-8, or a stamp does not fit.
    """
    return b"".join(_field(1, _transform(each)) for each in transforms)


def transforms_schema() -> bytes:
    """The definition of ``foxglove.FrameTransforms``; `ImportError` without the extra."""
    from foxglove.messages import FrameTransforms

    return bytes(FrameTransforms.get_schema().data)


def foxglove_channel(source: Channel, metadata: dict[str, str]) -> Channel:
    """A channel in Foxglove's schema, for the transforms of another channel."""
    return Channel(source.topic, FRAME_TRANSFORMS, "protobuf", "protobuf", transforms_schema(), metadata)


def _transform(transform: RawTransform) -> bytes:
    seconds, nanoseconds, parent, child, numbers = transform
    if seconds not in _SECONDS:
        raise MalformedMessageError("stamp", f"{seconds} s does not fit the stamp of a message")
    for name in (parent, child):
        try:
            name.decode()
        except UnicodeDecodeError:
            raise MalformedMessageError("text", f"the name {name[:40]!r} is no UTF-8") from None
    values = struct.unpack("8s8s8s8s8s8s8s", numbers)
    return b"".join(
        (
            _field(1, _number(1, seconds) + _number(2, nanoseconds)),
            _field(2, parent),
            _field(3, child),
            _field(4, _doubles(values[:3])),
            _field(5, _doubles(values[3:])),
        )
    )


def _doubles(values: Sequence[bytes]) -> bytes:
    return b"".join(bytes([number << 3 | _FIXED64]) + value for number, value in enumerate(values, 1))


def _number(field: int, value: int) -> bytes:
    return bytes([field << 3 | _VARINT]) + _varint(value % 2**64)


def _field(field: int, content: bytes) -> bytes:
    return bytes([field << 3 | _BYTES]) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    parts = bytearray()
    while value > 0x7F:
        parts.append(value & 0x7F | 0x80)
        value >>= 7
    parts.append(value)
    return bytes(parts)


_HEADER: Final = "std_msgs/msg/Header"
_HEADER_OF_ROS1: Final = "uint32 seq\ntime stamp\nstring frame_id\n"


class MessageTypes:
    """The types of messages: all of ROS 2 Humble, and the types that files define."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore

        self._store: Any = get_typestore(Stores.ROS2_HUMBLE)
        self._known: set[Channel] = set()

    @staticmethod
    def name(kind: str) -> str:
        """The name of a type in ROS 2; raises `ValueError` if it has no package."""
        package, _, last = kind.rpartition("/")
        if not package:
            raise ValueError(f"{kind!r} is not the name of a type of ROS")
        return f"{package.removesuffix('/msg')}/msg/{last}"

    def read(self, channel: Channel, payload: bytes) -> object:
        """The message of a payload, as an object with its fields; raises `ValueError` as `convert`."""
        # Only the conversion knows of the sequence number in a header of ROS 1.
        cdr = self.convert(channel, payload) if channel.encoding == "ros1" else payload
        self._register(channel)
        try:
            found: object = self._store.deserialize_cdr(cdr, self.name(channel.type))
        except Exception as error:  # noqa: BLE001
            raise ValueError(f"a message of type {channel.type} cannot be read: {error!r}"[:200]) from None
        return found

    def convert(self, channel: Channel, payload: bytes) -> bytes:
        """A payload in the other of the two encodings.

        Raises
        ------
        ValueError
            If the type is not known, or the payload is not of that type.
        """
        self._register(channel)
        kind = self.name(channel.type)
        try:
            convert = self._store.ros1_to_cdr if channel.encoding == "ros1" else self._store.cdr_to_ros1
            return bytes(convert(payload, kind))
        # For damaged bytes and definitions, rosbags raises more than its own errors.
        except Exception as error:  # noqa: BLE001
            raise ValueError(f"a message of type {channel.type} cannot be converted: {error!r}"[:200]) from None

    def ros1_definition(self, channel: Channel) -> tuple[str, str]:
        """The definition of a channel's type in ROS 1, and its MD5 sum; raises `ValueError` if it is not known."""
        digest = channel.metadata.get("md5sum")
        if channel.schema_encoding == "ros1msg" and digest:
            return channel.schema.decode(errors="replace"), digest
        self._register(channel)
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        store: Any = get_typestore(Stores.EMPTY)
        # The payloads of `convert` have the sequence number too.
        store.fielddefs.update(self._store.fielddefs, **get_types_from_msg(_HEADER_OF_ROS1, _HEADER))
        try:
            definition, digest = store.generate_msgdef(self.name(channel.type), ros_version=1)
        except Exception as error:  # noqa: BLE001
            raise ValueError(f"the type {channel.type} has no definition: {error!r}"[:200]) from None
        return definition, digest

    def _register(self, channel: Channel) -> None:
        """Add the types that the store lacks and the definition of a channel has."""
        if channel in self._known:
            return
        self._known.add(channel)
        if channel.schema_encoding in ("ros1msg", "ros2msg") and channel.schema:
            from rosbags.typesys import get_types_from_msg

            try:
                found = get_types_from_msg(channel.schema.decode(errors="replace"), self.name(channel.type))
                self._store.register({name: each for name, each in found.items() if name not in self._store.fielddefs})
            except Exception as error:  # noqa: BLE001
                raise ValueError(f"the definition of {channel.type} cannot be read: {error!r}"[:200]) from None


@cache
def types_with_header() -> frozenset[str]:
    """The types of ROS 2 Humble that begin with a header."""
    from rosbags.typesys import Stores, get_typestore

    definitions = get_typestore(Stores.ROS2_HUMBLE).fielddefs
    return frozenset(kind for kind, (_, fields) in definitions.items() if fields and _HEADER in str(fields[0]))


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
    """A new file. It is made with its path, and with the name that it gets when it is finished.

    Attributes
    ----------
    encoding : str
        The encoding of transforms in it: ``"cdr"``, ``"ros1"`` or ``"protobuf"``.
    """

    encoding: str

    def holds(self, channel: Channel) -> bool:
        """Whether payloads with transforms of a channel are written unchanged."""
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
    """A channel in the encoding of a copy, for the transforms of another channel."""
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
        # Raises without the extra, before the file exists.
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
