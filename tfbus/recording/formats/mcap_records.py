"""The records of an MCAP file, and the messages in its chunks (MCAP's specification, sections "Records" and "Chunk").

The package `mcap` parses the rare records. This module only splits a file into records and a chunk into messages,
because an object for each message would take ten times as long. `split_chunk` goes from record to record and reports
damage; `record_places` and `scan_chunks` find the same messages in many whole chunks at once, with numpy.
"""

import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from itertools import pairwise
from typing import IO, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode

from tfbus.recording.formats.storage import (
    MAX_CHUNK,
    MAX_CHUNK_MESSAGES,
    MAX_INDEX,
    MAX_OTHER_MESSAGE,
    Channel,
    StoredMessage,
    UnfoldBudget,
    UnfoldError,
    unfold,
)

DAMAGE: Final = (
    McapError,
    struct.error,
    ValueError,
    LookupError,
    OverflowError,
    MemoryError,
    RuntimeError,
    AssertionError,
)
"""The errors that `mcap` raises for damaged bytes."""

MAGIC: Final = b"\x89MCAP0\r\n"
RECORD: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<HIQQ")
_MESSAGE_RECORD: Final = struct.Struct("<BQHIQQ")
_CHUNK: Final = struct.Struct("<QQQII")
_LENGTH: Final = struct.Struct("<Q")
_CHUNK_INDEX: Final = struct.Struct("<QQQQI")
_CHANNEL_OFFSET: Final = struct.Struct("<HQ")
_INDEX_LENGTH: Final = struct.Struct("<QI")
_SIZES: Final = struct.Struct("<QQ")
_MESSAGE_OPCODE: Final = int(Opcode.MESSAGE)
_SKIPPED: Final = frozenset(
    (Opcode.HEADER, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.ATTACHMENT_INDEX, Opcode.METADATA)
) | {Opcode.METADATA_INDEX, Opcode.SUMMARY_OFFSET}
_BOUND: Final = {Opcode.CHUNK: MAX_CHUNK, Opcode.MESSAGE: MAX_OTHER_MESSAGE}
_PRIVATE: Final = 0x80

_MESSAGE_HEAD: Final = np.dtype(
    {"names": ("channel", "received"), "formats": ("<u2", "<u8"), "offsets": (9, 15), "itemsize": 31}
)


def _chunk_index(data: bytes) -> records.ChunkIndex:
    # Large files have many of them, and `mcap` takes ten times as long.
    start, end, offset, length, size = _CHUNK_INDEX.unpack_from(data)
    at = _CHUNK_INDEX.size + size
    offsets = dict(_CHANNEL_OFFSET.iter_unpack(data[_CHUNK_INDEX.size : at]))
    index_length, name_length = _INDEX_LENGTH.unpack_from(data, at)
    at += _INDEX_LENGTH.size
    compression = data[at : at + name_length].decode()
    compressed, uncompressed = _SIZES.unpack_from(data, at + name_length)
    return records.ChunkIndex(
        message_start_time=start,
        message_end_time=end,
        chunk_start_offset=offset,
        chunk_length=length,
        message_index_offsets=offsets,
        message_index_length=index_length,
        compression=compression,
        compressed_size=compressed,
        uncompressed_size=uncompressed,
    )


def _streamed(read: Callable[[ReadDataStream], records.McapRecord]) -> Callable[[bytes], records.McapRecord]:
    return lambda data: read(ReadDataStream(BytesIO(data)))


_READ: Final[dict[int, Callable[[bytes], records.McapRecord]]] = {
    Opcode.SCHEMA: _streamed(records.Schema.read),
    Opcode.CHANNEL: _streamed(records.Channel.read),
    Opcode.CHUNK_INDEX: _chunk_index,
    Opcode.STATISTICS: _streamed(records.Statistics.read),
}


class Torn(NamedTuple):
    """The beginning of a record that goes on behind the end of the file."""

    opcode: int
    data: bytes


class Chunk(NamedTuple):
    """A chunk record."""

    start: int
    end: int
    size: int
    crc: int
    compression: str
    data: bytes

    @classmethod
    def parse(cls, data: bytes, torn: bool = False) -> "Chunk":
        """Parse the content of a chunk record; with `torn`, the record may end too early.

        Raises
        ------
        struct.error, ValueError
        """
        start, end, size, crc, length = _CHUNK.unpack_from(data)
        if length > 32:
            raise ValueError(f"the name of the compression has {length} bytes")
        at = _CHUNK.size + length
        compression = data[_CHUNK.size : at].decode("ascii")
        (stored,) = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size
        if not torn and stored != len(data) - at:
            raise ValueError(f"{stored} bytes are announced, and there are {len(data) - at}")
        return cls(start, end, size, crc, compression, data[at : at + stored])

    def unfold(self, torn: bool = False, budget: UnfoldBudget | None = None) -> bytes:
        """The records in the chunk; with `torn`, as far as they can be decompressed.

        Raises
        ------
        UnfoldError
            If the data are damaged, or larger than `MAX_CHUNK`, or nothing is left of the budget.
        """
        if self.size > MAX_CHUNK:
            raise UnfoldError(f"it claims {self.size:,} bytes, and {MAX_CHUNK:,} is the bound")
        content = unfold(self.data, self.compression, self.size, torn, budget)
        if len(content) < self.size and not torn:
            raise UnfoldError(f"it claims {self.size:,} bytes, and holds {len(content):,}")
        if len(content) == self.size and self.crc and zlib.crc32(content) != self.crc:
            raise UnfoldError("its checksum does not match")
        return content


def parse_record(opcode: int, data: bytes) -> records.McapRecord | None:
    """The schema, channel, chunk index or statistics in a record; None for the other kinds.

    Raises
    ------
    One of `DAMAGE`.
    """
    read = _READ.get(opcode)
    return None if read is None else read(data)


def read_records(file: IO[bytes], size: int) -> Iterator[tuple[int, int, bytes | None]]:
    """Offset, opcode and content of each record from the current position to the footer, without the kinds not needed.

    The content is None if it exceeds its bound, or the opcode is unknown.

    Raises
    ------
    EndOfFile
        If the file of `size` bytes ends before the footer. Its argument is the `Torn` record there, if there is one.
    """
    while True:
        offset = file.tell()
        head = file.read(RECORD.size)
        left = size - offset - RECORD.size
        # A writer may have put more behind the end meanwhile.
        if len(head) < RECORD.size or left < 0:
            raise EndOfFile
        opcode, length = RECORD.unpack(head)
        if length > left:
            raise EndOfFile(Torn(opcode, file.read(min(MAX_CHUNK, left))))
        if opcode == Opcode.FOOTER:
            return
        known = opcode in _READ or opcode in _BOUND or opcode == Opcode.DATA_END
        if known and length <= _BOUND.get(opcode, MAX_INDEX):
            yield offset, opcode, file.read(length)
        else:
            file.seek(offset + RECORD.size + length)
            if known or not (opcode in _SKIPPED or opcode >= _PRIVATE):
                yield offset, opcode, None


def split_message(data: bytes) -> tuple[int, int, bytes]:
    """Log time in ns, channel and payload of a message outside of a chunk; `struct.error` if it is too short."""
    number, _, received, _ = _MESSAGE.unpack_from(data)
    return received, number, data[_MESSAGE.size :]


def split_chunk(
    data: bytes,
    wanted: Callable[[int], Channel | None],
    register: Callable[[records.McapRecord], object],
    torn: bool = False,
) -> tuple[list[StoredMessage], dict[int, int]]:
    """Split the records of a chunk.

    Parameters
    ----------
    data : bytes
    wanted : callable
        Gives a channel by its number, None if its messages are not returned. Called again after each record that is
        not a message.
    register : callable
        Gets each schema and channel before the messages that follow it.
    torn : bool
        Whether the data may end inside of a record.

    Returns
    -------
    The wanted messages in the order of the chunk, and the number of all messages by channel.

    Raises
    ------
    One of `DAMAGE`.
    """
    length = len(data)
    found: list[StoredMessage] = []
    counts: dict[int, int] = {}
    channels: dict[int, Channel | None] = {}
    at = 0
    # A message has at least this many bytes; the records behind `last` are checked below.
    last = length - _MESSAGE_RECORD.size
    unpack = _MESSAGE_RECORD.unpack_from
    while at < length:
        if at > last:
            if torn and length - at < RECORD.size:
                break
            opcode, size = RECORD.unpack_from(data, at)
            number = received = 0
        else:
            opcode, size, number, _, received, _ = unpack(data, at)
        start = at + RECORD.size
        at = start + size
        if at > length:
            if torn:
                break
            raise ValueError("a record goes on behind the end of the chunk")
        if opcode == _MESSAGE_OPCODE:
            if size < _MESSAGE.size:
                raise ValueError("a message is too short")
            if number in counts:
                counts[number] += 1
            else:
                counts[number] = 1
            if number not in channels:
                channels[number] = wanted(number)
            channel = channels[number]
            if channel is not None:
                found.append((received, channel, data[start + _MESSAGE.size : at]))
                if len(found) > MAX_CHUNK_MESSAGES:
                    raise ValueError(f"it has more than {MAX_CHUNK_MESSAGES:,} messages, which is the bound")
        elif record := parse_record(opcode, data[start:at]):
            register(record)
            channels.clear()
    return found, counts


_FIRST_STEPS: Final = 16
"""The number of records that are read one by one to find their period; more, if a guess was of little use."""
_GUESSED: Final = 2**16
"""The number of places that are guessed at once, roughly."""


def record_places(data: bytes) -> npt.NDArray[np.int64]:
    """The beginnings of all records of whole chunks, and the end of the last one.

    Only the length of a record tells where the next one begins. But most recordings repeat the same few lengths, so
    many places are guessed at once: if the first guess is right, and each record is as long as guessed, all are right.

    Raises
    ------
    struct.error, ValueError
        If the last record is cut off.
    """
    length = len(data)
    found: list[npt.NDArray[np.int64]] = []
    at, steps = 0, _FIRST_STEPS
    while at < length:
        places: list[int] = []
        while at < length and len(places) < steps:
            places.append(at)
            at += RECORD.size + _LENGTH.unpack_from(data, at + 1)[0]
        found.append(np.array(places, np.int64))
        if at < length and (cycle := _cycle([after - before for before, after in pairwise([*places, at])])):
            guessed = _follow(data, at, cycle)
            if len(guessed) > 1:
                found.append(guessed[:-1])
                at = int(guessed[-1])
            steps = steps * 2 if len(guessed) <= steps else _FIRST_STEPS
        else:
            steps *= 2
    if at != length:
        raise ValueError("a record goes on behind the end of the chunks")
    return np.concatenate([*found, np.array([at], np.int64)])


def _cycle(lengths: list[int]) -> list[int] | None:
    """The shortest cycle that the lengths have gone through at least twice."""
    for period in range(1, len(lengths) // 2 + 1):
        if lengths[period:] == lengths[:-period]:
            # In phase: each length comes again one period later.
            return lengths[-period:]
    return None


def _follow(data: bytes, at: int, cycle: list[int]) -> npt.NDArray[np.int64]:
    """The places of successive records from `at` on, as long as their lengths go through a cycle, and the end."""
    last = len(data) - RECORD.size
    count = min((last - at) // sum(cycle) + 1, _GUESSED // len(cycle) + 1)
    lengths = np.tile(np.array(cycle, np.int64), max(count, 0))
    places = at + np.cumsum(lengths) - lengths
    places = places[: np.searchsorted(places, last, side="right")]
    lengths = lengths[: len(places)]
    announced = np.ndarray((max(last, 0) + 1,), "<u8", data, offset=1, strides=(1,))[places]
    wrong = np.flatnonzero(announced != (lengths - RECORD.size).astype(np.uint64))
    right = int(wrong[0]) if len(wrong) else len(places)
    return np.append(places[:right], at if not right else places[right - 1] + lengths[right - 1])


class ChunkMessages(NamedTuple):
    """The messages of some chunks, in columns."""

    numbers: npt.NDArray[np.uint16]
    """The numbers of the channels."""
    received: npt.NDArray[np.uint64]
    """The log times, in ns."""
    starts: npt.NDArray[np.int64]
    ends: npt.NDArray[np.int64]
    """The begin and the end of each payload."""


def scan_chunks(
    data: bytes,
    begins: npt.NDArray[np.int64],
    ends: npt.NDArray[np.int64],
    register: Callable[[records.McapRecord], object],
) -> ChunkMessages:
    """The messages of some chunks, as `split_chunk` finds them; all their schemas and channels are registered first.

    Parameters
    ----------
    data : bytes
        The contents of all chunks.
    begins, ends : array of int
        Where each record begins and ends.
    register : callable
        Gets each schema and channel.

    Raises
    ------
    One of `DAMAGE`.
    """
    # The padding lets numpy read a whole head at the last record, however short that is.
    padded = np.frombuffer(data + bytes(_MESSAGE_HEAD.itemsize), np.uint8)
    opcodes = padded[begins]
    is_message = opcodes == _MESSAGE_OPCODE
    if not is_message.all():
        for other in np.flatnonzero(~is_message).tolist():
            content = data[int(begins[other]) + RECORD.size : int(ends[other])]
            if record := parse_record(int(opcodes[other]), content):
                register(record)
        begins, ends = begins[is_message], ends[is_message]
    if (ends - begins < _MESSAGE_RECORD.size).any():
        raise ValueError("a message is too short")
    heads = np.ndarray((len(data) + 1,), _MESSAGE_HEAD, padded, strides=(1,))[begins]
    return ChunkMessages(heads["channel"], heads["received"], begins + _MESSAGE_RECORD.size, ends)
