"""Reading MCAP files of tfbus, ROS 2 and Foxglove, finished or not.

`McapStorage` holds the file and its index; each iteration over messages is a `McapReading`; `mcap_records` parses the
bytes. A reading takes one of three ways:

* By index, packed. A finished file has an index of its chunks at its end, so only the needed chunks are read. Chunks
  that do not overlap in time are joined, and `ChunkPacker` finds their messages with numpy.
* By index, one by one. Where many or large chunks overlap, their messages are merged by log time.
* In sequence. A file whose writer was killed, or whose index fails its checksum, is read from its beginning, in the
  order of the file, as far as possible.

A chunk that fails its checksum is left out and reported, and reading continues behind it.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from itertools import accumulate, chain
from operator import itemgetter
from pathlib import Path
from typing import IO, Final, NamedTuple

import numpy as np
from mcap import records
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode

from tfbus.errors import RecordingError
from tfbus.recording.formats.mcap_records import (
    DAMAGE,
    MAGIC,
    Chunk,
    Torn,
    parse_record,
    read_records,
    record_places,
    scan_chunks,
    split_chunk,
    split_message,
)
from tfbus.recording.formats.storage import (
    FINISHED_ONCE,
    MAX_CHUNK_MESSAGES,
    MAX_INDEX,
    MAX_PACKED,
    NEVER_FINISHED,
    Channel,
    ChunkPlace,
    DescriptionBudget,
    Packed,
    Stored,
    StoredMessage,
    UnfoldBudget,
    Wanted,
    batches,
    in_order,
    in_words,
    lost_message,
    merge_chunks,
    select,
    separate,
    shortfalls,
    unfinished,
    wrong_descriptions,
)
from tfbus.stamps import STAMP_MAX


class OpenChunk(NamedTuple):
    """A chunk, and its records."""

    place: ChunkPlace
    content: bytes


class ChunkPacker:
    """Packs chunks; all packed messages of one packer share a table of channels.

    Parameters
    ----------
    reading : McapReading
        Knows the wanted channels, and counts the messages in the chunks.
    """

    def __init__(self, reading: "McapReading") -> None:
        self._reading = reading
        self._table: list[Channel] = []
        self._places: dict[Channel, int] = {}

    def pack(self, chunks: list[OpenChunk], low: int, high: int) -> Iterator[Stored]:
        """The messages of some chunks; in the order of their log times, if no later chunk overlaps them."""
        if not chunks:
            return
        data = b"".join([chunk.content for chunk in chunks])
        bounds = np.fromiter(accumulate((len(chunk.content) for chunk in chunks), initial=0), np.int64)
        try:
            places = record_places(data)
            firsts = np.searchsorted(places, bounds)
            if not np.array_equal(places[firsts], bounds):
                raise ValueError("a record goes on behind the end of its chunk")
            if np.diff(firsts).max() > MAX_CHUNK_MESSAGES:
                raise ValueError("one has too many messages")
            numbers, received, starts, ends = scan_chunks(data, places[:-1], places[1:], self._reading.register)
        except DAMAGE:
            # One by one, to find out which of them is damaged.
            yield sorted(chain.from_iterable(self._split(chunk, low) for chunk in chunks), key=itemgetter(0))
            return
        present, which, counts = np.unique(numbers, return_inverse=True, return_counts=True)
        self._reading.count(dict(zip(present.tolist(), counts.tolist(), strict=True)))
        wanted = [self._place(self._reading.wanted_channel(number)) for number in present.tolist()]
        # A log time that is not a stamp becomes negative.
        whole = Packed(data, self._table, np.array(wanted, np.int64)[which], received.view(np.int64), starts, ends)
        yield from in_order(whole if min(wanted, default=0) >= 0 else whole.chosen(whole.numbers >= 0), low, high)

    def _split(self, chunk: OpenChunk, low: int) -> list[StoredMessage]:
        try:
            return self._reading.split(chunk.content)
        except DAMAGE as error:
            return lost_chunk(chunk.place, low, error)

    def _place(self, channel: Channel | None) -> int:
        """The place of a channel in the table of packed messages; -1 for a channel that is not read."""
        if channel is None:
            return -1
        if channel not in self._places:
            self._places[channel] = len(self._table)
            self._table.append(channel)
        return self._places[channel]


def lost_chunk(place: ChunkPlace, low: int, error: Exception) -> list[StoredMessage]:
    """A message in place of a chunk that cannot be read, at its first log time or at `low`, in ns."""
    return [lost_message(max(place.start, low), f"the chunk at byte {place.offset}: {in_words(error)}")]


_KINDS: Final[dict[int, str]] = {
    Opcode.CHUNK: "chunk",
    Opcode.MESSAGE: "message",
    Opcode.SCHEMA: "schema",
    Opcode.CHANNEL: "channel",
    Opcode.CHUNK_INDEX: "chunk index",
    Opcode.STATISTICS: "statistics",
}
"""The names of the records that are read."""
_FIRST_BLOCK: Final = 2**16
_BLOCK: Final = 2**21
"""Bytes that are decoded at once: few at first, because the first message of each frame has to be judged by itself."""


class IndexedChunk(NamedTuple):
    """An entry of the index: the place of a chunk, its length in bytes, and the numbers of the channels in it."""

    place: ChunkPlace
    length: int
    size: int
    """The size of its content, in bytes."""
    channels: tuple[int, ...]


class McapReading:
    """One iteration over the messages of a file, by its index or in sequence.

    Parameters
    ----------
    storage : McapStorage
    wants : callable
        Whether the messages of a channel are read.

    Attributes
    ----------
    wants
    counts : Counter of int
        All messages that were met, by the number of their channel.
    unknown : int
        Messages on channels that the file does not describe.
    contradictions : set of int
        Numbers of channels and schemas that are described in two ways.
    finished_once : bool
        Whether a reading in sequence has come to the end of the data, which a writer marks before its index.
    """

    def __init__(self, storage: "McapStorage", wants: Wanted) -> None:
        self._storage = storage
        self.wants = wants
        self.counts: Counter[int] = Counter()
        self._budget = UnfoldBudget.of_file(storage.size)
        self.unknown: int = 0
        self.contradictions: set[int] = set()
        self.finished_once: bool = False

    def by_index(self, low: int, high: int) -> Iterator[list[StoredMessage]]:
        """The messages of all chunks that overlap the range, in the order of their log times."""
        size = self._storage.size
        places, too_long = [], set()
        for place, length, _, numbers in self._storage.index:
            # An index without numbers of channels, or with unknown ones, does not tell whether the chunk is wanted.
            if place.start <= high and place.end >= low and (not numbers or any(map(self._may_be_wanted, numbers))):
                places.append(place)
                if place.offset + length > size:
                    too_long.add(place.offset)

        def read(place: ChunkPlace) -> list[StoredMessage]:
            try:
                if place.offset in too_long:
                    raise ValueError("it is behind the end of the file")
                return self.split(self._storage.read_chunk(place.offset).unfold(budget=self._budget))
            except (*DAMAGE, EndOfFile) as error:
                return lost_chunk(place, low, error)

        return merge_chunks(places, read)

    def packed(self, separated: list[slice], low: int, high: int) -> Iterator[Stored]:
        """The messages of parts of the index that do not overlap, several parts at once."""
        packer = ChunkPacker(self)
        chunks: list[OpenChunk] = []
        size, enough = 0, _FIRST_BLOCK
        for part in separated:
            for place, length, claimed, numbers in sorted(
                self._storage.index[part], key=lambda chunk: chunk.place.offset
            ):
                if place.start > high or place.end < low or (numbers and not any(map(self._may_be_wanted, numbers))):
                    continue
                try:
                    if place.offset + length > self._storage.size:
                        raise ValueError("it is behind the end of the file")
                    read = self._storage.read_chunk(place.offset)
                    if read.size > claimed:
                        raise ValueError(f"the index claims {claimed:,} bytes, and it has {read.size:,}")
                    chunk = OpenChunk(place, read.unfold(budget=self._budget))
                except (*DAMAGE, EndOfFile) as error:
                    yield from packer.pack(chunks, low, high)
                    chunks.clear()
                    yield lost_chunk(place, low, error)
                else:
                    chunks.append(chunk)
                    size += len(chunk.content)
            if size >= enough:
                yield from packer.pack(chunks, low, high)
                chunks.clear()
                size, enough = 0, min(4 * enough, _BLOCK)
        yield from packer.pack(chunks, low, high)

    def in_sequence(self, low: int) -> Iterator[list[StoredMessage]]:
        """All messages in the order of the file, up to its end; damage before `low` is reported at `low`."""
        now = low
        try:
            for offset, opcode, content in self._storage.records_from(len(MAGIC)):
                # Behind the data, schemas and channels come again, and these copies may be the damaged part.
                self.finished_once = self.finished_once or opcode == Opcode.DATA_END
                if self.finished_once and opcode not in (Opcode.CHUNK, Opcode.MESSAGE):
                    continue
                try:
                    found = self._in_record(opcode, content)
                except DAMAGE as error:
                    found = [
                        lost_message(now, f"the {_KINDS.get(opcode, 'record')} at byte {offset}: {in_words(error)}")
                    ]
                if found:
                    now = max(now, found[-1][0])
                    yield found
        except EndOfFile as end:
            for torn in end.args:
                yield self._in_torn(torn)
            if self._storage.finished:
                yield [lost_message(now, "a record goes on behind the end of the file")]
        self._storage.set_counts(self.counts)

    def _in_record(self, opcode: int, content: bytes | None) -> list[StoredMessage]:
        if content is None:
            raise ValueError("it exceeds its bound" if opcode in _KINDS else f"its kind, {opcode}, is unknown")
        if opcode == Opcode.CHUNK:
            return self.split(Chunk.parse(content).unfold(budget=self._budget))
        if opcode == Opcode.MESSAGE:
            received, number, payload = split_message(content)
            self.count({number: 1})
            channel = self.wanted_channel(number)
            return [] if channel is None else [(received, channel, payload)]
        if record := parse_record(opcode, content):
            self.register(record)
        return []

    def split(self, content: bytes, torn: bool = False) -> list[StoredMessage]:
        """The wanted messages in the content of a chunk, in its order; raises one of `DAMAGE`."""
        found, counts = split_chunk(content, self.wanted_channel, self.register, torn)
        self.count(counts)
        return found

    def count(self, counts: Mapping[int, int]) -> None:
        """Count messages, by the number of their channel."""
        self.counts.update(counts)
        self.unknown += sum(count for number, count in counts.items() if self._storage.channel(number) is None)

    def _in_torn(self, torn: Torn) -> list[StoredMessage]:
        """The readable part of the record in which the file ends."""
        with suppress(*DAMAGE):
            if torn.opcode == Opcode.CHUNK:
                chunk = Chunk.parse(torn.data, torn=True)
                return self.split(chunk.unfold(True, self._budget), torn=True)
        return []

    def wanted_channel(self, number: int) -> Channel | None:
        """The channel with a number; None if its messages are not read."""
        channel = self._storage.channel(number)
        return channel if channel is not None and self.wants(channel) else None

    def _may_be_wanted(self, number: int) -> bool:
        channel = self._storage.channel(number)
        return channel is None or self.wants(channel)

    def register(self, record: records.McapRecord) -> None:
        """Note a schema or a channel, and whether it contradicts another one of its number."""
        if not self._storage.register(record) and isinstance(record, (records.Channel, records.Schema)):
            self.contradictions.add(record.id)


_FOOTER = struct.Struct("<BQQQI8s")
_FOOTER_LENGTH: Final = 20
_ANY: Final = Channel("", "", "")
_PIECE: Final = 2**16
_MOST_OVERLAPPING: Final = 16
"""The greatest number of chunks in memory at once; if more overlap, their messages are merged one by one."""


class McapStorage:
    """A `Storage` of one MCAP file.

    Parameters
    ----------
    path : Path
    file : file, optional
        The open file to read; by default, the file at the path is opened.

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
            self.size: int = self._file.seek(0, 2)
            self._schemas: dict[int, records.Schema] = {}
            self._numbered: dict[int, Channel] = {}
            self._budget = DescriptionBudget()
            self._chunks: list[IndexedChunk] = []
            self._statistics: records.Statistics | None = None
            self._counted: Counter[int] | None = None
            self.finished: bool = self._read_index()
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
        """All channels known so far, with counts from the statistics, or from a whole reading."""
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
        yield from wrong_descriptions(now, "channel", reading.unknown, reading.contradictions)
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
            # Descriptions of a damaged index would contradict the descriptions in the chunks.
            self._schemas.clear()
            self._numbered.clear()
            self._budget = DescriptionBudget()
        return True

    def _checksum(self, start: int, end: int) -> int:
        # In pieces: after a large block is freed, `malloc` no longer returns large blocks to the system.
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
            # An index that names one chunk again and again would make a small file cost any amount of reading.
            and len({chunk.place.offset for chunk in chunks}) == len(chunks)
        ):
            self._statistics = statistics
            self._chunks = sorted(chunks)

    def register(self, record: records.McapRecord) -> bool:
        """Note a schema or a channel; returns whether it agrees with the known ones."""
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
        budget = UnfoldBudget.of_file(self.size)
        try:
            self._file.seek(len(MAGIC))
            for _, opcode, content in read_records(self._file, self.size):
                if content is not None and opcode == Opcode.MESSAGE:
                    received, _, _ = split_message(content)
                    yield received, received
                elif content is not None and opcode == Opcode.CHUNK:
                    with suppress(*DAMAGE):
                        chunk = Chunk.parse(content)
                        if chunk.end or self._times_in(chunk.unfold(budget=budget)):
                            yield chunk.start, chunk.end
        except EndOfFile as end:
            for torn in end.args:
                with suppress(*DAMAGE):
                    if torn.opcode == Opcode.CHUNK:
                        times = self._times_in(Chunk.parse(torn.data, torn=True).unfold(True, budget))
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
        """The records from an offset on, as `read_records`; other readers may move the file's position meanwhile."""
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
