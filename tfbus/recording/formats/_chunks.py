"""Messages of chunks in the order of their log times, for the formats that store messages in chunks."""

from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from operator import itemgetter
from typing import NamedTuple

from tfbus.recording.formats._bounds import MAX_OVERLAPPING, MESSAGE_SIZE
from tfbus.recording.formats._storage import StoredMessage, lost_message

_log_time = itemgetter(0)
_END = 2**64


class ChunkPlace(NamedTuple):
    """A chunk in an index: its log times in ns, and where it begins in the file."""

    start: int
    end: int
    offset: int


def merge_chunks(
    places: Sequence[ChunkPlace], read: Callable[[ChunkPlace], list[StoredMessage]]
) -> Iterator[list[StoredMessage]]:
    """Iterate over the messages of all chunks, many at once, in the order of their log times even if chunks overlap.

    Messages of the same log time stay in the order of the file. Only the messages of chunks that overlap are in memory;
    beyond `MAX_OVERLAPPING` they come before it is known that they are in order, and that is told once.

    Parameters
    ----------
    places : sequence of ChunkPlace
        In the order of their starts.
    read : callable
        Gives the messages of a chunk in the order of the file.
    """
    # Then equal log times need not wait for the next chunk.
    in_file_order = all(before.offset < after.offset for before, after in pairwise(places))
    waiting: list[StoredMessage] = []
    origins: list[int] = []
    told = False
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
            if not told:
                told = True
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
