"""The parts that all formats share: the bounds of a hostile file, channels and messages, and their order by log time.

A `Storage` is an open file. It gives `StoredMessage`, one by one, or `Packed`: many messages in one piece of memory,
which numpy decodes without a Python object for each. Nothing here knows a format, or the content of a message.

* Bounds. A few bytes can claim, or unfold to, more than any machine holds. A size beyond its bound is not read, and its
  place is reported. `tfbus.recording.open_recording` documents the bounds. `unfold` decompresses up to a bound.
* Losses. `lost_message`, `unfinished`, `shortfalls` and `wrong_descriptions` make the reports that stand in place of
  missing messages.
* Order. Chunks of a file may overlap in time. `merge_chunks` sorts their messages; `separate` finds the parts of an
  index that can be sorted by themselves, and `in_order` sorts packed messages.
"""

import bz2
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, chain, pairwise
from operator import itemgetter
from typing import BinaryIO, Final, NamedTuple, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from tfbus.stamps import STAMP_MAX, STAMP_MIN
from tfbus.tf_message import MalformedMessageError

MIB: Final = 2**20

MAX_CHUNK: Final = 256 * MIB
"""The size in bytes of a chunk of an MCAP file or a bag, compressed or not."""
MAX_CHUNK_MESSAGES: Final = 1_000_000
"""The number of messages in a chunk that are read at once."""
MESSAGE_SIZE: Final = 256
"""The size in bytes of a message in memory, beside its payload, roughly."""
MAX_MESSAGE: Final = 8 * MIB
"""The size in bytes of a message with transforms; about 80,000 transforms."""
MAX_OTHER_MESSAGE: Final = 256 * MIB
"""The size in bytes of any other message."""
MAX_INDEX: Final = 64 * MIB
"""The size in bytes of the index of a file; a file with a larger one is read from its beginning."""
MAX_DESCRIBED: Final = 64 * MIB
"""The size in bytes of all descriptions of channels and types of a file, each with `DESCRIPTION` bytes more."""
DESCRIPTION: Final = 1_024
MAX_PACKED: Final = 64 * MIB
"""The size in bytes of chunks that overlap and are decoded at once; others are decoded message by message."""
MAX_OVERLAPPING: Final = 512 * MIB
"""The size in bytes of the messages of chunks that overlap in time, which are sorted in memory."""
MAX_METADATA: Final = 4 * MIB
"""The size in bytes of ``metadata.yaml``."""
MAX_FACTOR: Final = 100
MIN_UNPACKED: Final = 64 * MIB
MAX_UNFOLD_FACTOR: Final = 1_000
MIN_UNFOLDED: Final = 1_024 * MIB


class DescriptionBudget:
    """Counts the descriptions that a reader keeps: the chunks of a small file could unfold to any number of them."""

    def __init__(self) -> None:
        self._left = MAX_DESCRIBED

    def take(self, *texts: bytes | str) -> None:
        """Count a description; raises `ValueError` if all together exceed `MAX_DESCRIBED`."""
        self._left -= DESCRIPTION + sum(map(len, texts))
        if self._left < 0:
            raise ValueError(f"the descriptions of channels take more than {MAX_DESCRIBED:,} bytes, which is the bound")


class UnfoldBudget:
    """Counts the bytes that one reading unfolds from compressed chunks: 208 bytes of bzip2 take three seconds.

    Parameters
    ----------
    left : int
        How many bytes may still be unfolded; the chunk that exceeds them is the last.
    """

    def __init__(self, left: int) -> None:
        self.left = left

    @classmethod
    def of_file(cls, size: int) -> "UnfoldBudget":
        """The budget for a file of a size: 1,000 times as much, or 1 GiB if that is more."""
        return cls(max(MIN_UNFOLDED, MAX_UNFOLD_FACTOR * size))


def max_unpacked(packed: int) -> int:
    """The size in bytes that a compressed file of a folder may unfold to: 100 times its own, or 64 MiB if more."""
    return max(MIN_UNPACKED, MAX_FACTOR * packed)


AUTHORITIES = "tfbus.authorities"
"""The key in a channel's metadata for the authorities: JSON pairs of an authority and a count.

They describe the transforms of every message on the channel, in order: ``[["odometry", 1]]``.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """A stream of messages of one topic and type. Channels are equal only to themselves.

    Parameters
    ----------
    topic, type : str
    encoding : str
        The encoding of the messages: ``"cdr"``, ``"ros1"``, ``"json"``, ``"protobuf"``.
    schema_encoding : str
        The encoding of `schema`: ``"ros2msg"``, ``"ros1msg"``, ``"jsonschema"``, ``"protobuf"``; empty without one.
    schema : bytes
        The definition of the type; empty if the file has none.
    metadata : mapping of str to str
    """

    topic: str
    type: str
    encoding: str
    schema_encoding: str = ""
    schema: bytes = field(default=b"", repr=False)
    metadata: Mapping[str, str] = field(default_factory=dict, repr=False)


StoredMessage = tuple[int, Channel | MalformedMessageError, bytes]
"""Log time in ns, channel and payload of a message; an error in place of the channel describes a loss there."""
Wanted = Callable[[Channel], bool]
"""Whether the messages of a channel are read."""


def lost_message(received: int, detail: str) -> StoredMessage:
    """The report that stands in place of messages that cannot be read."""
    return received, MalformedMessageError("damaged", detail), b""


FINISHED_ONCE = "it was finished once and is cut or damaged: its index is missing"
NEVER_FINISHED = "it is cut, or its writer did not finish it: its index is missing"


def unfinished(received: int, read: Counter[Channel], why: str) -> StoredMessage:
    """The report of a file without the end that its writer gives it.

    Parameters
    ----------
    received : int
        The log time of the report, in ns.
    read : Counter of Channel
        The number of messages that were read of each channel.
    why : str
        The evidence.
    """
    count = sum(number for channel, number in read.items() if isinstance(channel, Channel))
    return received, MalformedMessageError("unfinished", f"{count:,} messages were read of the file; {why}"), b""


def in_words(error: Exception) -> str:
    """The error of a parser in words for people; only a `ValueError` has such words already."""
    if isinstance(error, UnicodeDecodeError):
        return "a text in it is not UTF-8"
    return str(error) if isinstance(error, ValueError) else "it ends inside of a record, or a record is damaged"


_log_time = itemgetter(0)
_channel = itemgetter(1)


def select(
    blocks: Iterable[list[StoredMessage]], since: int | None, until: int | None, read: Counter[Channel]
) -> Iterator[StoredMessage]:
    """Iterate over the messages from one log time to another, inclusive, and count them by channel.

    A message whose log time is not a stamp becomes a lost one.
    """
    low = STAMP_MIN if since is None else since
    high = STAMP_MAX if until is None else until
    now = 0 if since is None else since
    for block in filter(None, blocks):
        times = list(map(_log_time, block))
        if max(times) > STAMP_MAX:
            for at, time in enumerate(times):
                if time > STAMP_MAX:
                    block[at] = lost_message(now, f"a message has the log time {time} ns")
                now = max(now, block[at][0])
        if min(times) < low or max(times) > high:
            block = [stored for stored in block if low <= stored[0] <= high]
            if not block:
                continue
        now = max(now, block[-1][0])
        # Lost messages are counted too; nobody reads their number.
        read.update(map(_channel, block))
        yield from block


def shortfalls(received: int, promised: Mapping[Channel, int], read: Counter[Channel]) -> Iterator[StoredMessage]:
    """A lost message for each topic with fewer or more messages than the file promises.

    Parameters
    ----------
    received : int
        The log time of the reports, in ns.
    promised : mapping of Channel to int
        The number of messages of each channel, as an index or the metadata have it.
    read : Counter of Channel
    """
    # By topic, because a damaged number may turn a message into one of another channel.
    expected: Counter[str] = Counter()
    found: Counter[str] = Counter()
    for channel, count in promised.items():
        expected[channel.topic] += count
        found[channel.topic] += read[channel]
    for topic, count in expected.items():
        if found[topic] != count:
            detail = f"the file promises {count:,} messages on {topic!r}, and {found[topic]:,} were found"
            yield lost_message(received, detail)


def wrong_descriptions(received: int, kind: str, unknown: int, contradictory: set[int]) -> Iterator[StoredMessage]:
    """The reports of channels that a file does not describe, or describes in two ways.

    Parameters
    ----------
    received : int
        The log time of the reports, in ns.
    kind : str
        The word of the format for a channel.
    unknown : int
        The number of messages on channels without a description.
    contradictory : set of int
        The numbers of channels with two descriptions.
    """
    if unknown:
        yield lost_message(received, f"{unknown:,} messages are on {kind}s that the file does not describe")
    if contradictory:
        numbers = ", ".join(map(str, sorted(contradictory)))
        yield lost_message(received, f"the descriptions of {kind} {numbers} contradict each other")


class Storage(Protocol):
    """An open file, or several, with messages on channels.

    Attributes
    ----------
    finished : bool
        Whether the writer finished the file; if not, the last messages may be missing.
    start, end : int or None
        The log times of the first and the last message on any channel, in ns; None if there is none.
    channels : mapping of Channel to int or None
        All channels that are known so far, with the number of their messages, as far as it is known.
    complete : bool
        Whether `channels` has all channels and all counts; if not, only reading the whole file would tell.
    remarks : sequence of str
        Notes for a user on the choice of files, such as ignored ones.
    """

    @property
    def finished(self) -> bool: ...

    @property
    def start(self) -> int | None: ...

    @property
    def end(self) -> int | None: ...

    @property
    def channels(self) -> Mapping[Channel, int | None]: ...

    @property
    def complete(self) -> bool: ...

    @property
    def remarks(self) -> Sequence[str]: ...

    def messages(self, wanted: Wanted, since: int | None = None, until: int | None = None) -> Iterator[StoredMessage]:
        """Iterate over the messages of some channels from one log time to another, inclusive, in their order.

        An iteration without limits ends with a report of the messages that the file promises and does not have. At the
        end of a file without its index, an iteration ends with `unfinished`.
        """
        ...

    def close(self) -> None:
        """Release files and memory."""
        ...


_END = 2**64


class ChunkPlace(NamedTuple):
    """A chunk in an index: its log times in ns, and its offset in the file."""

    start: int
    end: int
    offset: int


def merge_chunks(
    places: Sequence[ChunkPlace], read: Callable[[ChunkPlace], list[StoredMessage]]
) -> Iterator[list[StoredMessage]]:
    """Iterate over the messages of all chunks, many at once, in the order of their log times even if chunks overlap.

    Messages of the same log time stay in the order of the file. Only the messages of chunks that overlap are in memory;
    beyond `MAX_OVERLAPPING` they may come out of order, and this is reported once.

    Parameters
    ----------
    places : sequence of ChunkPlace
        In the order of their starts.
    read : callable
        Gives the messages of a chunk in the order of the file.
    """
    # In the order of the file, a message does not wait for a later chunk that begins at its log time.
    in_file_order = all(before.offset < after.offset for before, after in pairwise(places))
    waiting: list[StoredMessage] = []
    origins: list[int] = []
    reported = False
    for number, place in enumerate(places, 1):
        following = places[number].start + in_file_order if number < len(places) else _END
        found = read(place)
        if not waiting and found and _in_order(found) and found[-1][0] < following:
            # The usual case: nothing overlaps.
            yield found
            continue
        waiting += found
        origins += [place.offset] * len(found)
        order = sorted(range(len(waiting)), key=lambda at: (waiting[at][0], origins[at]))
        waiting = [waiting[at] for at in order]
        origins = [origins[at] for at in order]
        ready = bisect_left(waiting, following, key=_log_time)
        if sum(MESSAGE_SIZE + len(payload) for _, _, payload in waiting[ready:]) > MAX_OVERLAPPING:
            ready = len(waiting)
            if not reported:
                reported = True
                detail = f"chunks of more than {MAX_OVERLAPPING:,} bytes overlap: their messages are not in order"
                yield [lost_message(waiting[0][0], detail)]
        yield waiting[:ready]
        del waiting[:ready], origins[:ready]


def separate(places: Sequence[ChunkPlace]) -> list[slice]:
    """The parts of an index between which no two chunks overlap, so that each can be sorted by itself.

    Parameters
    ----------
    places : sequence of ChunkPlace
        In the order of their starts.
    """
    in_file_order = all(before.offset < after.offset for before, after in pairwise(places))
    parts = []
    first, end = 0, 0
    for at, place in enumerate(places):
        if at > first and end < place.start + in_file_order:
            parts.append(slice(first, at))
            first = at
        end = max(end, place.end)
    return [*parts, slice(first, len(places))] if places else []


def _in_order(messages: list[StoredMessage]) -> bool:
    times = list(map(_log_time, messages))
    return times == sorted(times)


_BLOCK: Final = 2**20


class UnfoldError(ValueError):
    """Compressed bytes that are damaged, or unfold to more than their bound."""


def unfold(data: bytes, compression: str, limit: int, torn: bool = False, budget: UnfoldBudget | None = None) -> bytes:
    """Decompress bytes.

    Parameters
    ----------
    data : bytes
    compression : str
        ``"zstd"``, ``"lz4"``, ``"bz2"``; ``""`` and ``"none"`` for bytes that are not compressed.
    limit : int
        The greatest size of the result, in bytes.
    torn : bool
        Whether the data may end too early; then the result is their content up to the end.
    budget : UnfoldBudget, optional
        Counts the result down; damaged data count as `limit`.

    Raises
    ------
    UnfoldError
        If the data are damaged or end too early, the result exceeds `limit`, the compression is unknown, or nothing is
        left of the budget.
    """
    if compression in ("", "none"):
        return _within(data, limit)
    if compression not in _UNFOLD:
        raise UnfoldError(f"the compression {compression!r} is unknown")
    if budget is not None and budget.left <= 0:
        raise UnfoldError("the chunks before it hold more bytes than the bound for a file of its size")
    size = limit
    try:
        unfolded, complete = _UNFOLD[compression](data, limit + 1)
        size = len(unfolded)
    except (OSError, RuntimeError, ValueError, EOFError, MemoryError) as error:
        raise UnfoldError(f"it cannot be decompressed: {error}") from None
    finally:
        if budget is not None:
            budget.left -= size
    if not torn and not complete and len(unfolded) <= limit:
        raise UnfoldError("its compressed data end too early")
    return _within(unfolded, limit)


def unfold_file(source: BinaryIO, target: BinaryIO, limit: int) -> None:
    """Decompress a file of Zstandard into another one.

    Raises
    ------
    UnfoldError
        If the file is damaged, or unfolds to more than `limit` bytes.
    OSError
    """
    from zstandard import ZstdDecompressor, ZstdError

    size = 0
    try:
        with ZstdDecompressor().stream_reader(source, read_across_frames=True, closefd=False) as reader:
            while block := reader.read(_BLOCK):
                size += len(block)
                if size > limit:
                    raise UnfoldError(_too_large(limit))
                target.write(block)
    except ZstdError as error:
        raise UnfoldError(f"it cannot be decompressed: {error}") from None


def _within(data: bytes, limit: int) -> bytes:
    if len(data) > limit:
        raise UnfoldError(_too_large(limit))
    return data


def _too_large(limit: int) -> str:
    return f"it holds more than {limit:,} bytes, which is the bound"


def _unfold_zstd(data: bytes, size: int) -> tuple[bytes, bool]:
    from zstandard import ZstdDecompressor, ZstdError

    parts = []
    with ZstdDecompressor().stream_reader(data) as reader:
        try:
            while size > 0 and (part := reader.read(min(size, _BLOCK))):
                parts.append(part)
                size -= len(part)
        except ZstdError as error:
            raise ValueError(str(error)) from None
    # The reader does not tell whether the frame has ended; its checksum and the caller do.
    return b"".join(parts), True


def _unfold_lz4(data: bytes, size: int) -> tuple[bytes, bool]:
    from lz4.frame import LZ4FrameDecompressor

    decompressor = LZ4FrameDecompressor()
    return decompressor.decompress(data, max_length=size), decompressor.eof


def _unfold_bz2(data: bytes, size: int) -> tuple[bytes, bool]:
    decompressor = bz2.BZ2Decompressor()
    return decompressor.decompress(data, max_length=size), decompressor.eof


_UNFOLD: Final = {"zstd": _unfold_zstd, "lz4": _unfold_lz4, "bz2": _unfold_bz2}


BLOCK: Final = 8_192
BLOCK_BYTES: Final = 2**22
"""The greatest number of messages, and of bytes, in a block of a storage that does not pack messages."""
_UNSIGNED: Final = 2**64

Places = npt.NDArray[np.int64]


class Packed(NamedTuple):
    """Successive messages."""

    data: bytes
    channels: Sequence[Channel]
    numbers: Places
    """The place of the channel of each message among the channels."""
    received: Places
    """The log times, in ns."""
    starts: Places
    ends: Places
    """The begin and the end of the payload of each in the data."""

    def counts(self) -> dict[Channel, int]:
        """The number of messages of each channel."""
        counts = np.bincount(self.numbers, minlength=len(self.channels)).tolist()
        return {channel: count for channel, count in zip(self.channels, counts, strict=True) if count}

    @property
    def size(self) -> int:
        """The number of messages."""
        return len(self.received)

    def stored(self) -> list[StoredMessage]:
        """The messages, one by one."""
        columns = (self.received, self.numbers, self.starts, self.ends)
        return [
            (received, self.channels[number], self.data[start:end])
            for received, number, start, end in zip(*(column.tolist() for column in columns), strict=True)
        ]

    def chosen(self, which: npt.NDArray[np.bool_] | npt.NDArray[np.intp]) -> "Packed":
        """Some of the messages, by a mask or by their places."""
        return Packed(
            self.data,
            self.channels,
            self.numbers[which],
            self.received[which],
            self.starts[which],
            self.ends[which],
        )


Stored = Packed | list[StoredMessage]
"""Successive messages, packed or one by one."""


@runtime_checkable
class PackingStorage(Storage, Protocol):
    """A `Storage` that can give its messages packed."""

    def packed(self, wanted: Wanted, since: int | None = None, until: int | None = None) -> Iterator[Stored]:
        """The messages of `messages`, many at once."""
        ...


def blocks_of(storage: Storage, wanted: Wanted, since: int | None = None, until: int | None = None) -> Iterator[Stored]:
    """The messages of a storage, many at once: packed if it can."""
    if isinstance(storage, PackingStorage):
        yield from storage.packed(wanted, since, until)
    else:
        yield from batches(storage.messages(wanted, since, until))


def batches(messages: Iterator[StoredMessage]) -> Iterator[list[StoredMessage]]:
    """The messages in lists of at most `BLOCK`, or of `BLOCK_BYTES`."""
    block: list[StoredMessage] = []
    size = 0
    for stored in messages:
        block.append(stored)
        size += len(stored[2])
        if len(block) == BLOCK or size >= BLOCK_BYTES:
            yield block
            block, size = [], 0
    if block:
        yield block


def pack(messages: Sequence[StoredMessage]) -> Packed | None:
    """Pack messages; None if one of them is lost."""
    numbers: dict[Channel, int] = {}
    found = []
    for _, channel, _ in messages:
        if not isinstance(channel, Channel):
            return None
        found.append(numbers.setdefault(channel, len(numbers)))
    bounds = np.fromiter(accumulate(chain((0,), (len(payload) for _, _, payload in messages))), np.int64)
    return Packed(
        b"".join([payload for _, _, payload in messages]),
        tuple(numbers),
        np.array(found, np.int64),
        np.fromiter((received for received, _, _ in messages), np.int64, len(messages)),
        bounds[:-1],
        bounds[1:],
    )


def in_order(messages: Packed, low: int, high: int) -> Iterator[Stored]:
    """The messages from one log time to another, inclusive, in the order of their log times; nothing if there are none.

    Parameters
    ----------
    messages : Packed
        In the order of the file; a log time that is not a stamp is negative.
    low, high : int
        In ns.
    """
    received = messages.received
    if (received < 0).any():
        unsigned = [(time % _UNSIGNED, channel, payload) for time, channel, payload in messages.stored()]
        yield sorted(unsigned, key=itemgetter(0))
        return
    if (received[1:] < received[:-1]).any():
        messages = messages.chosen(np.argsort(received, kind="stable"))
        received = messages.received
    if messages.size and (received[0] < low or received[-1] > high):
        messages = messages.chosen((low <= received) & (received <= high))
    if messages.size:
        yield messages
