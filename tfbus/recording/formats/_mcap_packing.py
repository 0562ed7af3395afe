"""`ChunkPacker`, which packs the messages of many chunks of an MCAP file at once."""

from collections.abc import Callable, Iterator, Mapping
from itertools import accumulate, chain
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from mcap import records

from tfbus.recording.formats._bounds import MAX_CHUNK_MESSAGES
from tfbus.recording.formats._chunks import ChunkPlace
from tfbus.recording.formats._mcap_records import DAMAGE, scan_chunks, split_chunk
from tfbus.recording.formats._packed import Packed, Stored, in_order
from tfbus.recording.formats._record_places import record_places
from tfbus.recording.formats._storage import Channel, StoredMessage, in_words, lost_message


class OpenChunk(NamedTuple):
    """A chunk, and its records."""

    place: ChunkPlace
    content: bytes


class ChunkPacker:
    """Packs chunks; all packed messages of one packer share a table of channels.

    Parameters
    ----------
    wanted : callable
        Gives the channel with a number, None if its messages are not read.
    register : callable
        Gets each schema and channel in the chunks.
    count : callable
        Gets the number of the messages in some chunks, by the number of the channel.
    """

    def __init__(
        self,
        wanted: Callable[[int], Channel | None],
        register: Callable[[records.McapRecord], object],
        count: Callable[[Mapping[int, int]], object],
    ) -> None:
        self._wanted = wanted
        self._register = register
        self._count = count
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
            numbers, received, starts, ends = scan_chunks(data, places[:-1], places[1:], self._register)
        except DAMAGE:
            # One by one, to find out which of them is damaged.
            yield sorted(chain.from_iterable(self._split(chunk, low) for chunk in chunks), key=itemgetter(0))
            return
        present, which, counts = np.unique(numbers, return_inverse=True, return_counts=True)
        self._count(dict(zip(present.tolist(), counts.tolist(), strict=True)))
        wanted = [self._place(self._wanted(number)) for number in present.tolist()]
        # A log time that is no stamp becomes negative.
        whole = Packed(data, self._table, np.array(wanted, np.int64)[which], received.view(np.int64), starts, ends)
        yield from in_order(whole if min(wanted, default=0) >= 0 else whole.chosen(whole.numbers >= 0), low, high)

    def _split(self, chunk: OpenChunk, low: int) -> list[StoredMessage]:
        try:
            found, counts = split_chunk(chunk.content, self._wanted, self._register)
        except DAMAGE as error:
            return lost_chunk(chunk.place, low, error)
        self._count(counts)
        return found

    def _place(self, channel: Channel | None) -> int:
        """The place of a channel in the table of packed messages; -1 for one that is not read."""
        if channel is None:
            return -1
        if channel not in self._places:
            self._places[channel] = len(self._table)
            self._table.append(channel)
        return self._places[channel]


def lost_chunk(place: ChunkPlace, low: int, error: Exception) -> list[StoredMessage]:
    """A message in place of a chunk that cannot be read, at its first log time or at `low`, in ns."""
    return [lost_message(max(place.start, low), f"the chunk at byte {place.offset}: {in_words(error)}")]
