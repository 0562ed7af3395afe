"""Reading MCAP files of tfbus, ROS 2 and Foxglove, finished or not.

A finished file has an index of its chunks at its end, so only the needed chunks are read, by log time. A file whose
writer was killed, or whose index fails its checksum, is read from its beginning, as far as possible. A chunk that fails
its checksum is left out and reported, and reading continues behind it.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import IO, Final

from mcap import records
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode

from tfbus.errors import RecordingError
from tfbus.recording.formats._bounds import MAX_INDEX, MAX_PACKED, DescriptionBudget
from tfbus.recording.formats._chunks import ChunkPlace, separate
from tfbus.recording.formats._mcap_reading import IndexedChunk, McapReading
from tfbus.recording.formats._mcap_records import (
    DAMAGE,
    MAGIC,
    Chunk,
    parse_record,
    read_records,
    split_chunk,
    split_message,
)
from tfbus.recording.formats._packed import Packed, Stored, batches
from tfbus.recording.formats._storage import (
    FINISHED_ONCE,
    NEVER_FINISHED,
    Channel,
    StoredMessage,
    Wanted,
    lost_message,
    select,
    shortfalls,
    unfinished,
)
from tfbus.stamps import STAMP_MAX

_FOOTER = struct.Struct("<BQQQI8s")
_FOOTER_LENGTH: Final = 20
_ANY: Final = Channel("", "", "")
_PIECE: Final = 2**16
_MOST_OVERLAPPING: Final = 16
"""Chunks; if more have to be in memory at once, their messages are merged one by one."""


class McapStorage:
    """A `Storage` of one MCAP file.

    Parameters
    ----------
    path : Path
    file : file, optional
        The open file to read; by default that of the path.

    Attributes
    ----------
    size : int
        The length of the file in bytes.

    Raises
    ------
    RecordingError
        If the file is unfinished and ends before its first message.
    OSError
    """

    remarks: Final = ()

    def __init__(self, path: Path, file: IO[bytes] | None = None) -> None:
        self._path = path
        self._file = path.open("rb") if file is None else file
        try:
            self.size = self._file.seek(0, 2)
            self._schemas: dict[int, records.Schema] = {}
            self._numbered: dict[int, Channel] = {}
            self._budget = DescriptionBudget()
            self._chunks: list[IndexedChunk] = []
            self._statistics: records.Statistics | None = None
            self._counted: Counter[int] | None = None
            self.finished = self._read_index()
            if not self.finished and next(self._log_times(), None) is None:
                raise RecordingError("the file ends before its first message", path=str(path), reason="truncated")
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def start(self) -> int | None:
        """The log time of the first message, in ns."""
        return None if self._span is None else self._span[0]

    @property
    def end(self) -> int | None:
        """The log time of the last message, in ns."""
        return None if self._span is None else self._span[1]

    @property
    def complete(self) -> bool:
        """Whether there are statistics, or the whole file has been read."""
        return self._statistics is not None or self._counted is not None

    @property
    def channels(self) -> Mapping[Channel, int | None]:
        """All channels known so far; their counts are those of the statistics, or of a whole reading."""
        counts = self._counted if self._statistics is None else self._statistics.channel_message_counts
        return {
            channel: None if counts is None else counts.get(number, 0) for number, channel in self._numbered.items()
        }

    def messages(self, wanted: Wanted, since: int | None = None, until: int | None = None) -> Iterator[StoredMessage]:
        """Iterate over messages, as `Storage.messages`; without an index, in the order of the file."""
        low = 0 if since is None else since
        high = STAMP_MAX if until is None else until
        reading = McapReading(self, wanted)
        read: Counter[Channel] = Counter()
        now = low
        for stored in select(
            reading.by_index(low, high) if self._chunks else reading.in_sequence(low), since, until, read
        ):
            now = stored[0]
            yield stored
        yield from self._reports(reading, now, None if since is not None or until is not None else read)
        if not self.finished and (until is None or self.end is None or until >= self.end):
            yield unfinished(now, read, FINISHED_ONCE if reading.finished_once else NEVER_FINISHED)

    def packed(self, wanted: Wanted, since: int | None = None, until: int | None = None) -> Iterator[Stored]:
        """The messages of `messages`, many at once."""
        parts = separate([chunk.place for chunk in self._chunks])
        if not parts or any(self._is_large(self._chunks[part]) for part in parts):
            yield from batches(self.messages(wanted, since, until))
            return
        low = 0 if since is None else since
        high = STAMP_MAX if until is None else until
        reading = McapReading(self, wanted)
        read: Counter[Channel] = Counter()
        now = low
        for found in reading.packed(parts, low, high):
            if isinstance(found, Packed):
                read.update(found.counts())
                now = max(now, int(found.received[-1]))
                yield found
            elif block := list(select([found], since, until, read)):
                now = max(now, block[-1][0])
                yield block
        reports = self._reports(reading, now, None if since is not None or until is not None else read)
        yield from batches(reports)

    @staticmethod
    def _is_large(chunks: list[IndexedChunk]) -> bool:
        """Whether chunks that overlap are too many, or too large, to be in memory at once."""
        return len(chunks) > _MOST_OVERLAPPING or sum(chunk.size for chunk in chunks) > MAX_PACKED

    def _reports(self, reading: McapReading, now: int, read: Counter[Channel] | None) -> Iterator[StoredMessage]:
        """The faults that a reading has found; `read` has the number of the messages, if none was left out."""
        if reading.unknown:
            yield lost_message(now, f"{reading.unknown:,} messages are on channels that the file does not describe")
        if reading.contradictions:
            numbers = ", ".join(map(str, sorted(reading.contradictions)))
            yield lost_message(now, f"the descriptions of channel {numbers} contradict each other")
        if read is not None and self._statistics is not None:
            promised = {channel: count or 0 for channel, count in self.channels.items() if reading.wants(channel)}
            yield from shortfalls(now, promised, read)

    def _read_index(self) -> bool:
        """Read the index behind the messages, and return whether the file was finished."""
        if self.size < len(MAGIC) + _FOOTER.size:
            return False
        self._file.seek(self.size - _FOOTER.size)
        footer = self._file.read()
        opcode, length, start, _, checksum, magic = _FOOTER.unpack(footer)
        if (opcode, length, magic) != (Opcode.FOOTER, _FOOTER_LENGTH, MAGIC):
            return False
        there_is_one = start and start <= self.size and self.size - start <= MAX_INDEX
        # The checksum covers the index up to the checksum itself.
        if there_is_one and checksum in (0, self._checksum(start, self.size - len(MAGIC) - 4)):
            with suppress(*DAMAGE, EndOfFile):
                self._use_index(start)
        if self._statistics is None:
            # They would contradict what the chunks say.
            self._schemas.clear()
            self._numbered.clear()
            self._budget = DescriptionBudget()
        return True

    def _checksum(self, start: int, end: int) -> int:
        # In pieces: a large one in memory would, once it is freed, keep `malloc` from giving large ones back.
        self._file.seek(start)
        checksum = 0
        while start < end and (piece := self._file.read(min(_PIECE, end - start))):
            checksum = zlib.crc32(piece, checksum)
            start += len(piece)
        return checksum

    def _use_index(self, start: int) -> None:
        chunks: list[IndexedChunk] = []
        statistics: records.Statistics | None = None
        # Nearly all chunks have the same channels: one tuple for all of them saves most of the memory.
        shared: dict[tuple[int, ...], tuple[int, ...]] = {}
        kinds = set[int]()
        self._file.seek(start)
        for _, opcode, content in read_records(self._file, self.size):
            record = None if content is None else parse_record(opcode, content)
            if isinstance(record, records.ChunkIndex):
                numbers = tuple(record.message_index_offsets)
                place = ChunkPlace(record.message_start_time, record.message_end_time, record.chunk_start_offset)
                chunks.append(
                    IndexedChunk(
                        place, record.chunk_length, record.uncompressed_size, shared.setdefault(numbers, numbers)
                    )
                )
            elif isinstance(record, records.Statistics):
                statistics = record
            elif record is not None:
                self.register(record)
                if isinstance(record, records.Channel):
                    kinds.add(record.schema_id)
        # A writer may leave schemas and channels out of its index; then the index is of no use.
        if (
            statistics is not None
            and statistics.channel_message_counts.keys() <= self._numbered.keys()
            and kinds <= {0, *self._schemas}
            # Else a small file could have one chunk read any number of times.
            and len({chunk.place.offset for chunk in chunks}) == len(chunks)
        ):
            self._statistics = statistics
            self._chunks = sorted(chunks)

    def register(self, record: records.McapRecord) -> bool:
        """Note a schema or a channel; returns whether it agrees with what is known already."""
        if isinstance(record, records.Schema):
            if record.id not in self._schemas:
                self._budget.take(record.name, record.data)
            return self._schemas.setdefault(record.id, record) == record
        if not isinstance(record, records.Channel):
            return True
        schema = self._schemas.get(record.schema_id)
        channel = Channel(
            record.topic,
            "" if schema is None else schema.name,
            record.message_encoding,
            "" if schema is None else schema.encoding,
            b"" if schema is None else schema.data,
            record.metadata,
        )
        if record.id not in self._numbered:
            self._budget.take(record.topic, *record.metadata, *record.metadata.values())
        known = self._numbered.setdefault(record.id, channel)
        return all(getattr(known, name) == getattr(channel, name) for name in ("topic", "type", "encoding", "metadata"))

    def channel(self, number: int) -> Channel | None:
        """The channel with a number."""
        return self._numbered.get(number)

    @cached_property
    def _span(self) -> tuple[int, int] | None:
        if self._statistics is None:
            span: tuple[int, int] | None = None
            for first, last in self._log_times():
                span = (first, last) if span is None else (min(span[0], first), max(span[1], last))
            return span
        if not self._statistics.message_count:
            return None
        return self._statistics.message_start_time, self._statistics.message_end_time

    def _log_times(self) -> Iterator[tuple[int, int]]:
        """First and last log time of each chunk and of each message outside of chunks, as far as the file is good."""
        try:
            self._file.seek(len(MAGIC))
            for _, opcode, content in read_records(self._file, self.size):
                if content is not None and opcode == Opcode.MESSAGE:
                    received, _, _ = split_message(content)
                    yield received, received
                elif content is not None and opcode == Opcode.CHUNK:
                    with suppress(*DAMAGE):
                        chunk = Chunk.parse(content)
                        if chunk.end or self._times_in(chunk.unfold()):
                            yield chunk.start, chunk.end
        except EndOfFile as end:
            for torn in end.args:
                with suppress(*DAMAGE):
                    if torn.opcode == Opcode.CHUNK:
                        times = self._times_in(Chunk.parse(torn.data, torn=True).unfold(torn=True))
                        if times:
                            yield min(times), max(times)
        except DAMAGE:
            return

    def _times_in(self, content: bytes) -> list[int]:
        found, _ = split_chunk(content, lambda _: _ANY, lambda _: None, torn=True)
        return [received for received, _, _ in found]

    def read_chunk(self, offset: int) -> Chunk:
        """The chunk at an offset; raises one of `DAMAGE`."""
        self._file.seek(offset)
        for _, opcode, content in read_records(self._file, self.size):
            if opcode == Opcode.CHUNK and content is not None:
                return Chunk.parse(content)
            break
        raise ValueError("there is no chunk, or it is too large")

    @property
    def index(self) -> list[IndexedChunk]:
        """The entries of the index, in the order of their first log times."""
        return self._chunks

    def records_from(self, at: int) -> Iterator[tuple[int, int, bytes | None]]:
        """The records from an offset on, as `read_records`; other readers of the file may come between."""
        while True:
            self._file.seek(at)
            try:
                record = next(read_records(self._file, self.size))
            except StopIteration:
                return
            at = self._file.tell()
            yield record

    def set_counts(self, counts: Counter[int]) -> None:
        """Note the number of messages of each channel, counted by a reading of the whole file."""
        self._counted = counts
