"""The records of a bag of ROS 1, and the messages in its chunks (the format "ROSBAG V2.0").

A record is a header, which is a list of named fields, and data; each of the two has its length before it.
"""

import re
import struct
from typing import IO, Final, NamedTuple

import numpy as np

from tfbus.recording.formats._bounds import MAX_CHUNK, MAX_CHUNK_MESSAGES, MAX_INDEX
from tfbus.recording.formats._storage import in_words
from tfbus.recording.formats._unfold import unfold
from tfbus.stamps import SECOND

MESSAGE, BAG_HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = range(2, 8)
_KNOWN: Final = range(2, 8)

_LENGTH: Final = struct.Struct("<I")
_TIME: Final = struct.Struct("<II")
_COUNT: Final = struct.Struct("<II")
_INDEX_ENTRY: Final = 12
_MAX_HEADER: Final = 2**20
_CHUNK_MARK: Final = re.compile(rb"\x04\x00\x00\x00op=\x05")
_LOOK_BACK: Final = 96
_BLOCK: Final = 2**20

Fields = dict[bytes, bytes]
DAMAGE: Final = (struct.error, ValueError, LookupError)
"""The errors of damaged records."""


class CutOffError(ValueError):
    """The file ends inside of a record."""


class Record(NamedTuple):
    """The place and the header of a record; its data are in the file from `data` on, `size` bytes."""

    offset: int
    kind: int
    fields: Fields
    data: int
    size: int

    @property
    def end(self) -> int:
        """The offset of the next record."""
        return self.data + self.size

    def read(self, file: IO[bytes], limit: int = MAX_INDEX) -> bytes:
        """The data of the record, or as many of them as the file has.

        Raises
        ------
        ValueError
            If it claims more than `limit` bytes.
        """
        if self.size > limit:
            raise ValueError(f"a record claims {self.size:,} bytes, and {limit:,} is the bound")
        file.seek(self.data)
        return file.read(self.size)


def read_record(file: IO[bytes], offset: int) -> Record:
    """The record at an offset; raises one of `DAMAGE` if there is none."""
    file.seek(offset)
    (length,) = _LENGTH.unpack(_read(file, 4))
    if length > _MAX_HEADER:
        raise ValueError(f"a header claims {length:,} bytes")
    fields = parse_fields(_read(file, length))
    (size,) = _LENGTH.unpack(_read(file, 4))
    return Record(offset, kind_of(fields), fields, offset + 8 + length, size)


def _read(file: IO[bytes], size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise CutOffError("the file ends inside of a record")
    return data


def parse_fields(header: bytes) -> Fields:
    """The fields of a header; raises one of `DAMAGE`."""
    fields: Fields = {}
    at = 0
    while at < len(header):
        (length,) = _LENGTH.unpack_from(header, at)
        name, equals, value = header[at + 4 : at + 4 + length].partition(b"=")
        at += 4 + length
        if not equals or at > len(header):
            raise ValueError("a field of a header is no name with a value")
        fields[name] = value
    return fields


def kind_of(fields: Fields) -> int:
    """The kind of a record; raises one of `DAMAGE` if it is none of the known ones."""
    kind = fields[b"op"][0]
    if kind not in _KNOWN:
        raise ValueError(f"a record of kind {kind} is unknown")
    return kind


def number_in(fields: Fields, name: bytes, size: int = 4) -> int:
    """An unsigned number in a header; raises one of `DAMAGE` if it is not there or has another size."""
    value = fields[name]
    if len(value) != size:
        raise ValueError(f"the field {name.decode(errors='replace')} has {len(value)} bytes")
    return int.from_bytes(value, "little")


def time_in(value: bytes) -> int:
    """A time in ns; raises `struct.error` if it has another size."""
    seconds, nanoseconds = _TIME.unpack(value)
    return int(seconds * SECOND + nanoseconds)


def text_in(fields: Fields, name: bytes) -> str:
    """A text in a header; empty if it is not there."""
    return fields.get(name, b"").decode(errors="replace")


def find_chunk(file: IO[bytes], offset: int) -> int | None:
    """The offset of the next chunk at or behind an offset, found by its bytes; None if there is none."""
    kept = b""
    while True:
        file.seek(offset)
        block = file.read(_BLOCK)
        if not block:
            return None
        text = kept + block
        first = offset - len(kept)
        for mark in _CHUNK_MARK.finditer(text):
            place = first + mark.start()
            for start in range(max(first, place - _LOOK_BACK), place - 3):
                try:
                    record = read_record(file, start)
                    number_in(record.fields, b"size")
                except DAMAGE:
                    continue
                if record.kind == CHUNK and place < record.data:
                    return start
        kept = text[-_LOOK_BACK - 8 :]
        offset += len(block)


def index_span(data: bytes) -> tuple[int, int, int]:
    """The first and the last log time, in ns, of the messages in the data of an index record, and their number."""
    count = len(data) // _INDEX_ENTRY
    if not count:
        return 0, 0, 0
    entries = np.frombuffer(data, "<u4", 3 * count).reshape(count, 3)
    times = entries[:, 0].astype(np.int64) * SECOND + entries[:, 1]
    return int(times.min()), int(times.max()), count


def counts_in(data: bytes) -> dict[int, int]:
    """The number of messages by connection in the data of a chunk info."""
    return dict(_COUNT.iter_unpack(data[: len(data) // 8 * 8]))


class Content(NamedTuple):
    """The records of a chunk."""

    messages: list[tuple[int, int, bytes]]
    """Log time in ns, connection and payload."""
    connections: list[tuple[Fields, bytes]]
    """Header and data of each connection."""
    damage: str
    """The reason why the rest is missing; empty if nothing is."""


def read_chunk(file: IO[bytes], record: Record, torn: bool = False) -> bytes:
    """The records in a chunk; with `torn`, as far as they can be decompressed.

    Raises
    ------
    One of `DAMAGE`
        If they cannot be decompressed, or are larger than `MAX_CHUNK`.
    """
    size = number_in(record.fields, b"size")
    if size > MAX_CHUNK:
        raise ValueError(f"it claims {size:,} bytes, and {MAX_CHUNK:,} is the bound")
    data = record.read(file, MAX_CHUNK)
    # While a chunk is written, its header claims nothing.
    content = unfold(data, text_in(record.fields, b"compression"), size or MAX_CHUNK, torn)
    if not torn and len(content) != size:
        raise ValueError(f"it claims {size:,} bytes, and holds {len(content):,}")
    return content


def split_chunk(data: bytes) -> Content:
    """Split the records of a chunk, up to the first that is damaged or cut off."""
    content: Content = Content([], [], "")
    messages = content.messages
    at, end = 0, len(data)
    layout: _Layout | None = None
    try:
        while at < end:
            (length,) = _LENGTH.unpack_from(data, at)
            start = at + 4
            body = start + length
            (size,) = _LENGTH.unpack_from(data, body)
            body += 4
            at = body + size
            if at > end:
                raise ValueError("it ends inside of a record")
            header = data[start : start + length]
            if layout is not None and layout.fits(header):
                messages.append((*layout.values(header), data[body:at]))
            else:
                fields = parse_fields(header)
                kind = kind_of(fields)
                if kind == MESSAGE:
                    messages.append((time_in(fields[b"time"]), number_in(fields, b"conn"), data[body:at]))
                    layout = _Layout(header)
                elif kind == CONNECTION:
                    content.connections.append((fields, data[body:at]))
            if len(messages) > MAX_CHUNK_MESSAGES:
                raise ValueError(f"it has more than {MAX_CHUNK_MESSAGES:,} messages, which is the bound")
    except DAMAGE as error:
        return content._replace(damage=in_words(error))
    return content


class _Layout:
    """The places of the fields in the header of a message; nearly all headers of a bag have the same ones."""

    def __init__(self, header: bytes) -> None:
        self._size = len(header)
        self._time = header.index(b"time=") + 5
        self._connection = header.index(b"conn=") + 5
        first, second = sorted([(self._time, 8), (self._connection, 4)])
        self._ends = first[0], sum(first), second[0], sum(second)
        self._fixed = self._parts(header)

    def fits(self, header: bytes) -> bool:
        """Whether a header has the same fields in the same places."""
        return len(header) == self._size and self._parts(header) == self._fixed

    def values(self, header: bytes) -> tuple[int, int]:
        """Log time in ns, and connection."""
        seconds, nanoseconds = _TIME.unpack_from(header, self._time)
        (connection,) = _LENGTH.unpack_from(header, self._connection)
        return seconds * SECOND + nanoseconds, connection

    def _parts(self, header: bytes) -> tuple[bytes, bytes, bytes]:
        a, b, c, d = self._ends
        return header[:a], header[b:c], header[d:]
