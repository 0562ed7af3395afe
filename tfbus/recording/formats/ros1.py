"""Reading bags of ROS 1, finished or not (the format "ROSBAG V2.0").

A record of a bag consists of a header (a list of named fields) and data, each with its length before it. The first half
of this module parses records, and the messages in chunks; `Ros1Storage` is the second half.

The index at the end of a bag lists its chunks. If it is missing, because the writer was killed or the file was cut, the
chunks are found one after the other; after damage, by the bytes that begin a chunk. A damaged chunk is read up to the
damage, and reading continues with the next chunk.
"""

import re
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Final, NamedTuple

import numpy as np

from tfbus.errors import RecordingError
from tfbus.recording.formats.storage import (
    FINISHED_ONCE,
    MAX_CHUNK,
    MAX_CHUNK_MESSAGES,
    MAX_INDEX,
    NEVER_FINISHED,
    Channel,
    ChunkPlace,
    DescriptionBudget,
    StoredMessage,
    UnfoldBudget,
    Wanted,
    in_words,
    lost_message,
    merge_chunks,
    select,
    shortfalls,
    unfinished,
    unfold,
    wrong_descriptions,
)
from tfbus.stamps import SECOND, STAMP_MAX, STAMP_MIN

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
            raise ValueError("a field of a header is not a name with a value")
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
    """The reason why the rest is missing; empty if nothing is missing."""


def read_chunk(file: IO[bytes], record: Record, torn: bool = False, budget: UnfoldBudget | None = None) -> bytes:
    """The records in a chunk; with `torn`, as far as they can be decompressed.

    Raises
    ------
    One of `DAMAGE`
        If they cannot be decompressed, or are larger than `MAX_CHUNK`, or nothing is left of the budget.
    """
    size = number_in(record.fields, b"size")
    if size > MAX_CHUNK:
        raise ValueError(f"it claims {size:,} bytes, and {MAX_CHUNK:,} is the bound")
    data = record.read(file, MAX_CHUNK)
    # The header of an unfinished chunk claims no size.
    content = unfold(data, text_in(record.fields, b"compression"), size or MAX_CHUNK, torn, budget)
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


_VERSION: Final = b"#ROSBAG V2.0\n"


class _Chunk(NamedTuple):
    """A chunk of a bag, with the number of its messages by connection; None if no index tells."""

    start: int
    end: int
    offset: int
    counts: Mapping[int, int] | None


class Ros1Storage:
    """A `Storage` of one bag.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    finished : bool
        Whether the bag has its index.

    Raises
    ------
    RecordingError
        If there is not a single message in it, or it is of another version than 2.0.
    OSError
    """

    remarks: Final = ()

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("rb")
        try:
            self._size = self._file.seek(0, 2)
            self._file.seek(0)
            version = self._file.read(len(_VERSION))
            if version != _VERSION:
                text = version.decode("ascii", "replace").strip()
                raise RecordingError(
                    f"a bag of ROS 1 that begins with {text!r}, and only version 2.0 is read",
                    path=str(path),
                    reason="foreign",
                )
            self._numbered: dict[int, Channel] = {}
            self._budget = DescriptionBudget()
            self._chunks: list[_Chunk] = []
            self._damage: list[str] = []
            self._contradictions: set[int] = set()
            self._finished_once = False
            self._counted: Counter[int] | None = None
            self.finished: bool = self._read_index()
            if not self.finished:
                self._find_chunks()
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def start(self) -> int | None:
        """The log time of the first message, in ns."""
        return min((chunk.start for chunk in self._chunks if chunk.counts != {}), default=None)

    @property
    def end(self) -> int | None:
        """The log time of the last message, in ns."""
        return max((chunk.end for chunk in self._chunks if chunk.counts != {}), default=None)

    @property
    def complete(self) -> bool:
        """Whether an index lists all chunks, or the whole file has been read."""
        return self._promised is not None or self._counted is not None

    @property
    def channels(self) -> Mapping[Channel, int | None]:
        """All channels known so far, with counts from the index, or from a whole reading."""
        counts = self._counted if self._promised is None else self._promised
        return {channel: None if counts is None else counts[number] for number, channel in self._numbered.items()}

    @property
    def _promised(self) -> Counter[int] | None:
        """The number of messages by connection, if all chunks are in an index."""
        total: Counter[int] = Counter()
        for chunk in self._chunks:
            if chunk.counts is None:
                return None
            total.update(chunk.counts)
        return total

    def messages(self, wanted: Wanted, since: int | None = None, until: int | None = None) -> Iterator[StoredMessage]:
        """Iterate over messages, as `Storage.messages`."""
        low = STAMP_MIN if since is None else since
        high = STAMP_MAX if until is None else until
        now = max(low, self.start or 0)
        for damage in self._damage:
            yield lost_message(now, damage)
        chunks = {
            ChunkPlace(chunk.start, chunk.end, chunk.offset): chunk
            for chunk in self._chunks
            if chunk.start <= high
            and chunk.end >= low
            and (chunk.counts is None or any(self._may_be_wanted(number, wanted) for number in chunk.counts))
        }
        counts: Counter[int] = Counter()
        budget = UnfoldBudget.of_file(self._size)

        def read_place(place: ChunkPlace) -> list[StoredMessage]:
            content = self._content(place.offset, chunks[place].counts is None, budget)
            counts.update(number for _, number, _ in content.messages)
            channel_of = self._numbered.get
            found: list[StoredMessage] = [
                (received, channel, payload)
                for received, number, payload in content.messages
                if (channel := channel_of(number)) is not None and wanted(channel)
            ]
            if content.damage:
                last = found[-1][0] if found else max(place.start, low)
                found.append(lost_message(last, f"the chunk at byte {place.offset}: {content.damage}"))
            return found

        read: Counter[Channel] = Counter()
        for stored in select(merge_chunks(sorted(chunks), read_place), since, until, read):
            now = stored[0]
            yield stored
        unknown = sum(count for number, count in counts.items() if number not in self._numbered)
        yield from wrong_descriptions(now, "connection", unknown, self._contradictions)
        if since is None and until is None:
            known = {chunk.offset for chunk in chunks.values()}
            for chunk in self._chunks:
                # A chunk that was not read has an index.
                if chunk.offset not in known:
                    counts.update(chunk.counts or {})
            self._counted = counts
            promised = self._promised
            if promised is not None:
                # Even if another connection of the same topic is not described.
                yield from shortfalls(
                    now,
                    {channel: promised[number] for number, channel in self._numbered.items() if wanted(channel)},
                    read,
                )
        if not self.finished and (until is None or until >= (self.end or 0)):
            yield unfinished(now, read, FINISHED_ONCE if self._finished_once else NEVER_FINISHED)

    def _may_be_wanted(self, number: int, wanted: Wanted) -> bool:
        channel = self._numbered.get(number)
        return channel is None or wanted(channel)

    # Opening

    def _read_index(self) -> bool:
        """Read the connections and chunk infos at the end, and return whether all of them are there."""
        try:
            header = read_record(self._file, len(_VERSION))
            at = number_in(header.fields, b"index_pos", 8)
            # A writer leaves nothing there until it has written all chunks.
            self._finished_once = at != 0
            missing = [number_in(header.fields, name) for name in (b"conn_count", b"chunk_count")]
            if header.kind == BAG_HEADER and header.end <= at <= self._size and self._size - at <= MAX_INDEX:
                while at < self._size:
                    record = read_record(self._file, at)
                    at = record.end
                    if at > self._size:
                        raise CutOffError("the index goes on behind the end of the file")
                    self._use_index_record(record, missing)
                # An index that names one chunk again and again would make a small file cost any amount of reading.
                if not any(missing) and len({chunk.offset for chunk in self._chunks}) == len(self._chunks):
                    return True
        except DAMAGE:
            # The caller searches for the chunks.
            pass
        self._chunks.clear()
        self._numbered.clear()
        self._budget = DescriptionBudget()
        return False

    def _use_index_record(self, record: Record, missing: list[int]) -> None:
        """Note a connection or a chunk, and count it down in `missing`."""
        data = record.read(self._file)
        if record.kind == CONNECTION:
            self._register(record.fields, data)
            missing[0] -= 1
        elif record.kind == CHUNK_INFO:
            start, end = (time_in(record.fields[name]) for name in (b"start_time", b"end_time"))
            place = number_in(record.fields, b"chunk_pos", 8)
            self._chunks.append(_Chunk(start, end, place, counts_in(data)))
            missing[1] -= 1

    def _find_chunks(self) -> None:
        """Find the chunks of a file without an index, and the connections of their messages."""
        at = len(_VERSION)
        budget = UnfoldBudget.of_file(self._size)
        cause: Exception | None = None
        while at < self._size:
            try:
                record = read_record(self._file, at)
                if record.kind == CHUNK:
                    at = self._add_chunk(record, budget)
                    continue
                if record.end > self._size:
                    raise CutOffError("a record goes on behind the end of the file")
                at = record.end
            except DAMAGE as error:
                following = find_chunk(self._file, at + 1)
                if following is None:
                    # A file that was cut ends inside of a record.
                    cause = error
                    break
                self._damage.append(f"nothing can be read from byte {at} to byte {following}: {in_words(error)}")
                at = following
        if self._chunks:
            return
        why = next(iter(self._damage), None) if cause is None or isinstance(cause, CutOffError) else in_words(cause)
        if why is not None:
            raise RecordingError(f"it cannot be read as a bag of ROS 1: {why}", path=str(self._path), reason="damaged")
        raise RecordingError("the file ends before its first message", path=str(self._path), reason="truncated")

    def _add_chunk(self, record: Record, budget: UnfoldBudget) -> int:
        """Note a chunk, with the times and counts of the index records behind it; returns the offset behind them.

        Raises
        ------
        ValueError
            If the chunk claims a wrong size, and another chunk follows.
        """
        # While a chunk is written, its header claims nothing, and the rest of the file is in it.
        torn = record.size == 0 or record.end > self._size
        if torn and find_chunk(self._file, record.data) is not None:
            raise ValueError(f"a chunk claims {record.size:,} bytes")
        counts: dict[int, int] = {}
        ends: list[int] = []
        at = self._size if torn else record.end
        while at < self._size:
            try:
                following = read_record(self._file, at)
                if following.kind != INDEX or following.end > self._size:
                    break
                number = number_in(following.fields, b"conn")
                first, last, count = index_span(following.read(self._file))
            except DAMAGE:
                break
            counts[number] = count
            if count:
                ends = [min([first, *ends]), max([last, *ends])]
            at = following.end
        if not counts or not counts.keys() <= self._numbered.keys():
            content = self._content(record.offset, torn, budget)
            ends = ends or [received for received, _, _ in content.messages]
            if not ends and content.damage:
                # The damage has no log time, so it is reported at the start.
                self._damage.append(f"the chunk at byte {record.offset}: {content.damage}")
        if ends:
            self._chunks.append(_Chunk(min(ends), max(ends), record.offset, counts or None))
        return at

    # Reading

    def _content(self, offset: int, torn: bool, budget: UnfoldBudget) -> Content:
        """The content of a chunk; its connections are registered. With `torn`, its end may be missing."""
        try:
            record = read_record(self._file, offset)
            if record.kind != CHUNK:
                return Content([], [], "there is no chunk")
            if torn and (record.size == 0 or record.end > self._size):
                record = record._replace(size=self._size - record.data)
                content = split_chunk(read_chunk(self._file, record, True, budget))._replace(damage="")
            else:
                content = split_chunk(read_chunk(self._file, record, budget=budget))
        except DAMAGE as error:
            return Content([], [], in_words(error))
        for fields, data in content.connections:
            with suppress(*DAMAGE):
                self._register(fields, data)
        return content

    def _register(self, fields: Fields, data: bytes) -> None:
        """Note a connection, by its record; if several records have its number, the first one counts."""
        number = number_in(fields, b"conn")
        header = parse_fields(data)
        channel = Channel(
            text_in(fields, b"topic") or text_in(header, b"topic"),
            text_in(header, b"type"),
            "ros1",
            "ros1msg",
            header.get(b"message_definition", b""),
            {name: text_in(header, name.encode()) for name in ("callerid", "md5sum", "latching")},
        )
        if number not in self._numbered:
            self._budget.take(data)
        known = self._numbered.setdefault(number, channel)
        if (known.topic, known.type) != (channel.topic, channel.type):
            self._contradictions.add(number)
