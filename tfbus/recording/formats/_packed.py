"""`Packed`, many messages in one piece of memory: numpy decodes them without a Python object for each."""

from collections.abc import Iterator, Sequence
from itertools import accumulate, chain
from operator import itemgetter
from typing import Final, NamedTuple, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from tfbus.recording.formats._storage import Channel, Storage, StoredMessage, Wanted

BLOCK: Final = 8_192
BLOCK_BYTES: Final = 2**22
"""The greatest number of messages in a block of a storage that does not pack them; so many bytes fill it as well."""
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
        In the order of the file; a log time that is no stamp is negative.
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
