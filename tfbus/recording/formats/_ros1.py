"""Reading bags of ROS 1, finished or not.

The index at the end of a bag lists its chunks. Without it, because the writer was killed or the file was cut, the
chunks are found one after the other; behind damage, by the bytes that begin each of them. A chunk that is damaged is
read up to the damage, and reading continues with the next.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from tfbus.errors import RecordingError
from tfbus.recording.formats._bag_records import (
    BAG_HEADER,
    CHUNK,
    CHUNK_INFO,
    CONNECTION,
    DAMAGE,
    INDEX,
    Content,
    CutOffError,
    Fields,
    Record,
    counts_in,
    find_chunk,
    index_span,
    number_in,
    parse_fields,
    read_chunk,
    read_record,
    split_chunk,
    text_in,
    time_in,
)
from tfbus.recording.formats._bounds import MAX_INDEX, DescriptionBudget
from tfbus.recording.formats._chunks import ChunkPlace, merge_chunks
from tfbus.recording.formats._storage import (
    FINISHED_ONCE,
    NEVER_FINISHED,
    Channel,
    StoredMessage,
    Wanted,
    in_words,
    lost_message,
    select,
    shortfalls,
    unfinished,
)
from tfbus.stamps import STAMP_MAX, STAMP_MIN

MAGIC: Final = b"#ROSBAG V"
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
            self.finished = self._read_index()
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
        """All channels known so far; their counts are those of the index, or of a whole reading."""
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

        def read_place(place: ChunkPlace) -> list[StoredMessage]:
            content = self._content(place.offset, torn=chunks[place].counts is None)
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
        if unknown:
            yield lost_message(now, f"{unknown:,} messages are on connections that the file does not describe")
        if self._contradictions:
            numbers = ", ".join(map(str, sorted(self._contradictions)))
            yield lost_message(now, f"the descriptions of connection {numbers} contradict each other")
        if since is None and until is None:
            known = {chunk.offset for chunk in chunks.values()}
            for chunk in self._chunks:
                # What was not read is in an index.
                if chunk.offset not in known:
                    counts.update(chunk.counts or {})
            self._counted = counts
            promised = self._promised
            if promised is not None:
                # Also where another connection of the same topic is not described.
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
                # Else a small file could have one chunk read any number of times.
                if not any(missing) and len({chunk.offset for chunk in self._chunks}) == len(self._chunks):
                    return True
        except DAMAGE:
            # Then the chunks tell all of it.
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
        cause: Exception | None = None
        while at < self._size:
            try:
                record = read_record(self._file, at)
                if record.kind == CHUNK:
                    at = self._add_chunk(record)
                    continue
                if record.end > self._size:
                    raise CutOffError("a record goes on behind the end of the file")
                at = record.end
            except DAMAGE as error:
                following = find_chunk(self._file, at + 1)
                if following is None:
                    # As every file that was cut, it ends inside of a record.
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

    def _add_chunk(self, record: Record) -> int:
        """Note a chunk, with the times and counts of the index records behind it; returns the offset of what follows.

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
            content = self._content(record.offset, torn)
            ends = ends or [received for received, _, _ in content.messages]
            if not ends and content.damage:
                # It has no log time, so it is told at the start.
                self._damage.append(f"the chunk at byte {record.offset}: {content.damage}")
        if ends:
            self._chunks.append(_Chunk(min(ends), max(ends), record.offset, counts or None))
        return at

    # Reading

    def _content(self, offset: int, torn: bool) -> Content:
        """The content of a chunk; its connections are registered. With `torn`, its end may be missing."""
        try:
            record = read_record(self._file, offset)
            if record.kind != CHUNK:
                return Content([], [], "there is no chunk")
            if torn and (record.size == 0 or record.end > self._size):
                record = record._replace(size=self._size - record.data)
                content = split_chunk(read_chunk(self._file, record, torn=True))._replace(damage="")
            else:
                content = split_chunk(read_chunk(self._file, record))
        except DAMAGE as error:
            return Content([], [], in_words(error))
        for fields, data in content.connections:
            with suppress(*DAMAGE):
                self._register(fields, data)
        return content

    def _register(self, fields: Fields, data: bytes) -> None:
        """Note a connection, by its record; the first record of a number holds."""
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
