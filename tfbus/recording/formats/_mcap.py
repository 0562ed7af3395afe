"""Reading MCAP files of tfbus, ROS 2 and Foxglove, finished or not.

A finished file has an index of its chunks at its end, so only the needed chunks are read, by log time. A file whose
writer was killed, or whose index fails its checksum, is read from its beginning, as far as possible. A chunk that fails
its checksum is left out and reported, and reading continues behind it.

The package `mcap` parses the records. This module only splits a file into records and a chunk into messages (MCAP's
specification, sections "Records" and "Message"): to build an object for each message would take ten times as long.
"""

import struct
import zlib
from bisect import bisect_left
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cached_property
from io import SEEK_CUR, BytesIO
from operator import itemgetter
from pathlib import Path
from typing import IO, Final

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.stream_reader import get_chunk_data_stream
from zstandard import ZstdError

from tfbus.errors import RecordingError
from tfbus.recording.formats._storage import Channel, StoredMessage, channel_of, lost_message
from tfbus.stamps import STAMP_MAX

MAGIC: Final = b"\x89MCAP0\r\n"

_DAMAGE = (McapError, struct.error, ValueError, LookupError, OverflowError, MemoryError, RuntimeError, ZstdError)
"""The errors that `mcap` and its decompressors raise for damaged bytes."""

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_FOOTER = struct.Struct("<BQQQI8s")
_FOOTER_LENGTH: Final = 20
_MESSAGE_OPCODE: Final = int(Opcode.MESSAGE)
_READ: dict[int, Callable[[ReadDataStream], records.McapRecord]] = {
    Opcode.SCHEMA: records.Schema.read,
    Opcode.CHANNEL: records.Channel.read,
    Opcode.CHUNK: records.Chunk.read,
    Opcode.CHUNK_INDEX: records.ChunkIndex.read,
    Opcode.STATISTICS: records.Statistics.read,
}


class McapStorage:
    """A `Storage` of one MCAP file.

    Parameters
    ----------
    path : Path

    Raises
    ------
    RecordingError
        If the file is unfinished and ends before its first message.
    OSError
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._size = path.stat().st_size
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, Channel | None] = {}
        self._chunks: list[records.ChunkIndex] = []
        self._statistics: records.Statistics | None = None
        self.finished = self._read_index()
        if not self.finished and next(self._log_times(), None) is None:
            raise RecordingError("the file ends before its first message", path=str(path), reason="truncated")

    def close(self) -> None:
        """Do nothing: the file is open only while messages are read."""

    @property
    def start(self) -> int | None:
        """The log time of the first message, in ns."""
        return None if self._span is None else self._span[0]

    @property
    def end(self) -> int | None:
        """The log time of the last message, in ns."""
        return None if self._span is None else self._span[1]

    @property
    def count(self) -> int | None:
        """The number of messages with transforms, if there is an index."""
        if self._statistics is None:
            return None
        counts = self._statistics.channel_message_counts
        return sum(counts.get(number, 0) for number, channel in self._channels.items() if channel is not None)

    def messages(self, since: int | None, until: int | None, only_static: bool = False) -> Iterator[StoredMessage]:
        """Iterate over messages, as `Storage.messages`; without an index, in the order of the file."""
        low = 0 if since is None else since
        high = STAMP_MAX if until is None else until
        now = low
        for stored in self._by_index(low, high, only_static) if self._chunks else self._in_sequence(low):
            received, channel, _ = stored
            if received > STAMP_MAX:
                received, channel, _ = stored = lost_message(now, f"a message has the log time {received} ns")
            now = max(now, received)
            if low <= received <= high and (not only_static or (isinstance(channel, Channel) and channel.static)):
                yield stored

    def _read_index(self) -> bool:
        """Read the index behind the messages, and return whether the file was finished."""
        with self._path.open("rb") as file:
            if self._size < len(MAGIC) + _FOOTER.size:
                return False
            file.seek(self._size - _FOOTER.size)
            footer = file.read()
            opcode, length, start, _, checksum, magic = _FOOTER.unpack(footer)
            if (opcode, length, magic) != (Opcode.FOOTER, _FOOTER_LENGTH, MAGIC):
                return False
            file.seek(min(start, self._size))
            index = file.read()
        # The checksum covers the index up to the checksum itself.
        if start and checksum in (0, zlib.crc32(index[: -len(MAGIC) - 4])):
            with suppress(*_DAMAGE):
                self._use_index(list(_records(BytesIO(index), len(index))))
        return True

    def _use_index(self, index: list[records.McapRecord]) -> None:
        for record in index:
            self._register(record)
        statistics = next((record for record in index if isinstance(record, records.Statistics)), None)
        kinds = {record.schema_id for record in index if isinstance(record, records.Channel)} - {0}
        # A writer may leave schemas and channels out of its index; then the index is of no use.
        if (
            statistics is not None
            and statistics.channel_message_counts.keys() <= self._channels.keys()
            and kinds <= self._schemas.keys()
        ):
            self._statistics = statistics
            chunks = [record for record in index if isinstance(record, records.ChunkIndex)]
            self._chunks = sorted(chunks, key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset))

    def _register(self, record: records.McapRecord) -> None:
        if isinstance(record, records.Schema):
            self._schemas[record.id] = record.name
        elif isinstance(record, records.Channel):
            ros1 = record.message_encoding == "ros1"
            kind = self._schemas.get(record.schema_id, "") if ros1 or record.message_encoding == "cdr" else ""
            self._channels[record.id] = channel_of(record.topic, kind, record.metadata, ros1)

    @cached_property
    def _span(self) -> tuple[int, int] | None:
        if self._statistics is None:
            spans = list(self._log_times())
            return (min(first for first, _ in spans), max(last for _, last in spans)) if spans else None
        if not self._statistics.message_count:
            return None
        return self._statistics.message_start_time, self._statistics.message_end_time

    def _log_times(self) -> Iterator[tuple[int, int]]:
        """First and last log time of each chunk and of each message outside of chunks, as far as the file is good."""
        with self._path.open("rb") as file, suppress(*_DAMAGE):
            file.seek(len(MAGIC))
            for record in _records(file, self._size):
                if isinstance(record, records.Message):
                    yield record.log_time, record.log_time
                elif isinstance(record, records.Chunk) and (record.message_end_time or self._in_chunk(record)):
                    yield record.message_start_time, record.message_end_time

    def _by_index(self, low: int, high: int, only_static: bool) -> Iterator[StoredMessage]:
        """Messages of all chunks that overlap the range, in the order of their log times even if the chunks overlap."""
        wanted = {
            number
            for number, channel in self._channels.items()
            if channel is not None and (channel.static or not only_static)
        }
        chunks = [
            chunk
            for chunk in self._chunks
            if chunk.message_start_time <= high
            and chunk.message_end_time >= low
            and not (chunk.message_index_offsets and wanted.isdisjoint(chunk.message_index_offsets))
        ]
        starts = [*(chunk.message_start_time for chunk in chunks), 2**64]
        waiting: list[tuple[int, int, StoredMessage]] = []
        with self._path.open("rb") as file:
            for chunk, following in zip(chunks, starts[1:], strict=True):
                waiting += [
                    (stored[0], chunk.chunk_start_offset, stored) for stored in self._read_chunk(file, chunk, low)
                ]
                # Messages of the same log time stay in the order of the file.
                waiting.sort(key=itemgetter(0, 1))
                ready = bisect_left(waiting, following, key=itemgetter(0))
                yield from map(itemgetter(2), waiting[:ready])
                del waiting[:ready]

    def _read_chunk(self, file: IO[bytes], index: records.ChunkIndex, low: int) -> list[StoredMessage]:
        """The messages of a chunk in the index."""
        if index.chunk_start_offset + index.chunk_length <= self._size:
            file.seek(index.chunk_start_offset)
            with suppress(*_DAMAGE):
                for chunk in _records(BytesIO(file.read(index.chunk_length)), index.chunk_length):
                    if isinstance(chunk, records.Chunk):
                        return self._in_chunk(chunk)
        return [
            lost_message(max(index.message_start_time, low), f"the chunk at byte {index.chunk_start_offset} is damaged")
        ]

    def _in_sequence(self, low: int) -> Iterator[StoredMessage]:
        """All messages in the order of the file, up to its end or damage; damage before `low` is reported at `low`."""
        now = low
        with self._path.open("rb") as file:
            file.seek(len(MAGIC))
            try:
                for record in _records(file, self._size):
                    found: list[StoredMessage] = []
                    if isinstance(record, records.Chunk):
                        try:
                            found = self._in_chunk(record)
                        except _DAMAGE:
                            found = [lost_message(now, f"the chunk before byte {file.tell()} is damaged")]
                    elif isinstance(record, records.Message):
                        channel = self._channels.get(record.channel_id)
                        found = [] if channel is None else [(record.log_time, channel, record.data)]
                    else:
                        self._register(record)
                    for stored in found:
                        now = max(now, stored[0])
                        yield stored
            except EndOfFile:
                if self.finished:
                    yield lost_message(now, "a record goes on behind the end of the file")
            except _DAMAGE:
                yield lost_message(now, f"nothing can be read from byte {file.tell()} on")

    def _in_chunk(self, chunk: records.Chunk) -> list[StoredMessage]:
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        data = stream.read(length)
        channels = self._channels
        found: list[StoredMessage] = []
        at = 0
        while at < length:
            opcode, size = _RECORD.unpack_from(data, at)
            start = at + _RECORD.size
            at = start + size
            if opcode == _MESSAGE_OPCODE:
                number, _, received, _ = _MESSAGE.unpack_from(data, start)
                channel = channels.get(number)
                if channel is not None:
                    found.append((received, channel, data[start + _MESSAGE.size : at]))
            elif opcode in _READ:
                self._register(_READ[opcode](ReadDataStream(BytesIO(data[start:at]))))
        return found


def _records(file: IO[bytes], size: int) -> Iterator[records.McapRecord]:
    """The records from the current position to the footer, without the kinds that are not needed here.

    Raises
    ------
    EndOfFile
        If the file of `size` bytes ends before the footer.
    """
    while True:
        head = file.read(_RECORD.size)
        if len(head) < _RECORD.size:
            raise EndOfFile
        opcode, length = _RECORD.unpack(head)
        if file.tell() + length > size:
            raise EndOfFile
        if opcode == Opcode.FOOTER:
            return
        if opcode == Opcode.MESSAGE:
            yield records.Message.read(ReadDataStream(BytesIO(file.read(length))), length)
        elif opcode in _READ:
            yield _READ[opcode](ReadDataStream(BytesIO(file.read(length))))
        else:
            file.seek(length, SEEK_CUR)
