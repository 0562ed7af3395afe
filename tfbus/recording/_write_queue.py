"""Batches that wait for the disk, with the instants at which they were published."""

from collections import deque

from tfbus.bus.sample_queue import check_capacity
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.statistics import QueueStatistics

Entry = tuple[int, Batch]
"""When a batch was published, in ns, and the batch."""


class Backlog:
    """A bounded queue that gives up the oldest batches, but none of their static samples.

    Parameters
    ----------
    capacity : int
        How many moving samples may be pending, and how many batches; the newest batch always stays. Of the static
        samples in batches that are given up, the newest one of each child is kept beyond that.

    Attributes
    ----------
    dropped : int
        Moving samples lost to the capacity, and whatever `clear` took out.
    conflated : int
        Static samples that were kept and then gave way to a newer one of the same child.
    """

    def __init__(self, capacity: int) -> None:
        check_capacity(capacity)
        self.capacity = capacity
        self.dropped = 0
        self.conflated = 0
        self._entries: deque[Entry] = deque()
        self._statics: dict[str, tuple[int, TransformStamped]] = {}
        self._size = 0
        self._moving = 0

    def __len__(self) -> int:
        return self._size + len(self._statics)

    def put(self, received: int, batch: Batch) -> int:
        """Add a batch; how many moving samples were lost for it."""
        self._entries.append((received, batch))
        self._size += len(batch)
        self._moving += sum(not sample.static for sample in batch)
        before = self.dropped
        while max(self._moving, len(self._entries)) > self.capacity and len(self._entries) > 1:
            self._drop_oldest()
        return self.dropped - before

    def take(self, size: int) -> list[Entry]:
        """Take out the oldest batches: as many whole ones as have `size` samples together, and at least one."""
        entries: list[Entry] = [(received, (sample,)) for received, sample in self._statics.values()]
        self._statics.clear()
        taken = len(entries)
        while self._entries and (not entries or taken + len(self._entries[0][1]) <= size):
            entry = self._entries.popleft()
            entries.append(entry)
            taken += len(entry[1])
            self._forget(entry[1])
        return entries

    def clear(self) -> None:
        """Take out everything; it counts as dropped."""
        self.dropped += len(self)
        self._entries.clear()
        self._statics.clear()
        self._size = self._moving = 0

    def _drop_oldest(self) -> None:
        received, batch = self._entries.popleft()
        self._forget(batch)
        for sample in batch:
            if not sample.static:
                self.dropped += 1
                continue
            # At its new place, so that the order is that of time.
            self.conflated += self._statics.pop(sample.child, None) is not None
            self._statics[sample.child] = received, sample

    def _forget(self, batch: Batch) -> None:
        self._size -= len(batch)
        self._moving -= sum(not sample.static for sample in batch)

    def statistics(self, in_hand: int, lost: int) -> QueueStatistics:
        """The queue's counters; with what is being written, and what was lost while it was."""
        pending = len(self) + in_hand
        return QueueStatistics("recording", "drop_oldest", self.capacity, pending, self.dropped + lost, self.conflated)
