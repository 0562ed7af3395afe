"""`McapReading`, one iteration over the messages of an MCAP file."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Final, NamedTuple, Protocol

from mcap import records
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode

from tfbus.recording.formats._chunks import ChunkPlace, merge_chunks
from tfbus.recording.formats._mcap_packing import ChunkPacker, OpenChunk, lost_chunk
from tfbus.recording.formats._mcap_records import (
    DAMAGE,
    MAGIC,
    Chunk,
    Torn,
    parse_record,
    split_chunk,
    split_message,
)
from tfbus.recording.formats._packed import Stored
from tfbus.recording.formats._storage import Channel, StoredMessage, Wanted, in_words, lost_message

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
"""Bytes that are decoded at once: few at first, for the first message of each frame has to be judged by itself."""


class IndexedChunk(NamedTuple):
    """An entry of the index: the place of a chunk, its length in bytes, and the numbers of the channels in it."""

    place: ChunkPlace
    length: int
    size: int
    """Of its content, in bytes."""
    channels: tuple[int, ...]


class McapSource(Protocol):
    """The file that is read."""

    size: int

    @property
    def finished(self) -> bool: ...

    @property
    def index(self) -> Sequence[IndexedChunk]: ...

    def read_chunk(self, offset: int) -> Chunk: ...

    def records_from(self, at: int) -> Iterator[tuple[int, int, bytes | None]]: ...

    def register(self, record: records.McapRecord) -> bool: ...

    def channel(self, number: int) -> Channel | None: ...

    def set_counts(self, counts: Counter[int]) -> None: ...


class McapReading:
    """One iteration over the messages of a file.

    Attributes
    ----------
    wants : callable
        Whether the messages of a channel are read.
    unknown : int
        Messages on channels that the file does not describe.
    contradictions : set of int
        Numbers of channels and schemas that are described in two ways.
    finished_once : bool
        Whether a reading in sequence has come to the end of the data, which a writer marks before its index.
    """

    def __init__(self, source: McapSource, wanted: Wanted) -> None:
        self._source = source
        self.wants = wanted
        self._counts: Counter[int] = Counter()
        self.unknown = 0
        self.contradictions: set[int] = set()
        self.finished_once = False

    def by_index(self, low: int, high: int) -> Iterator[list[StoredMessage]]:
        """The messages of all chunks that overlap the range, in the order of their log times."""
        size = self._source.size
        places, too_long = [], set()
        for place, length, _, numbers in self._source.index:
            # Without numbers, or with unknown ones, only reading the chunk tells what is in it.
            if place.start <= high and place.end >= low and (not numbers or any(map(self._may_be_wanted, numbers))):
                places.append(place)
                if place.offset + length > size:
                    too_long.add(place.offset)

        def read(place: ChunkPlace) -> list[StoredMessage]:
            try:
                if place.offset in too_long:
                    raise ValueError("it is behind the end of the file")
                return self._in_chunk(self._source.read_chunk(place.offset))
            except (*DAMAGE, EndOfFile) as error:
                return lost_chunk(place, low, error)

        return merge_chunks(places, read)

    def packed(self, separated: list[slice], low: int, high: int) -> Iterator[Stored]:
        """The messages of parts of the index that do not overlap, several parts at once."""
        packer = ChunkPacker(self._wanted_channel, self._register, self._count)
        chunks: list[OpenChunk] = []
        size, enough = 0, _FIRST_BLOCK
        for part in separated:
            for place, length, claimed, numbers in sorted(
                self._source.index[part], key=lambda chunk: chunk.place.offset
            ):
                if place.start > high or place.end < low or (numbers and not any(map(self._may_be_wanted, numbers))):
                    continue
                try:
                    if place.offset + length > self._source.size:
                        raise ValueError("it is behind the end of the file")
                    read = self._source.read_chunk(place.offset)
                    if read.size > claimed:
                        raise ValueError(f"the index claims {claimed:,} bytes, and it has {read.size:,}")
                    chunk = OpenChunk(place, read.unfold())
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
            for offset, opcode, content in self._source.records_from(len(MAGIC)):
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
            if self._source.finished:
                yield [lost_message(now, "a record goes on behind the end of the file")]
        self._source.set_counts(self._counts)

    def _in_record(self, opcode: int, content: bytes | None) -> list[StoredMessage]:
        if content is None:
            raise ValueError("it exceeds its bound" if opcode in _KINDS else f"its kind, {opcode}, is unknown")
        if opcode == Opcode.CHUNK:
            return self._in_chunk(Chunk.parse(content))
        if opcode == Opcode.MESSAGE:
            received, number, payload = split_message(content)
            self._count({number: 1})
            channel = self._wanted_channel(number)
            return [] if channel is None else [(received, channel, payload)]
        if record := parse_record(opcode, content):
            self._register(record)
        return []

    def _in_chunk(self, chunk: Chunk, torn: bool = False) -> list[StoredMessage]:
        found, counts = split_chunk(chunk.unfold(torn), self._wanted_channel, self._register, torn)
        self._count(counts)
        return found

    def _count(self, counts: Mapping[int, int]) -> None:
        self._counts.update(counts)
        self.unknown += sum(count for number, count in counts.items() if self._source.channel(number) is None)

    def _in_torn(self, torn: Torn) -> list[StoredMessage]:
        """The readable part of the record in which the file ends."""
        with suppress(*DAMAGE):
            if torn.opcode == Opcode.CHUNK:
                return self._in_chunk(Chunk.parse(torn.data, torn=True), torn=True)
        return []

    def _wanted_channel(self, number: int) -> Channel | None:
        channel = self._source.channel(number)
        return channel if channel is not None and self.wants(channel) else None

    def _may_be_wanted(self, number: int) -> bool:
        channel = self._source.channel(number)
        return channel is None or self.wants(channel)

    def _register(self, record: records.McapRecord) -> None:
        if not self._source.register(record) and isinstance(record, (records.Channel, records.Schema)):
            self.contradictions.add(record.id)
