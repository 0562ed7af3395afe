"""The samples that a stream was offered, and the fate of each."""

from tfbus import Stream, TransformStamped
from tfbus.geometry.stamped import Batch


class Ledger:
    """The samples that a stream was offered while it was open, and the fate of each moving one.

    What a conflating stream gives up for something newer of the same child is `superseded` here, and `pending` is what
    such a stream must hold.
    """

    def __init__(self, stream: Stream) -> None:
        self.stream = stream
        self.conflates = stream.queue.overflow == "conflate"
        self.open = True
        self.offered = self.read = self.lost = self.superseded = 0
        self.pending: dict[str, TransformStamped] = {}
        self.statics: dict[str, TransformStamped] = {}
        self.statics_read: dict[str, TransformStamped] = {}

    def offer(self, batch: Batch) -> None:
        for sample in batch:
            if sample.static:
                self.statics[sample.child] = sample
            else:
                self.offered += 1
            if self.conflates:
                self._conflate(sample)
        while len(self.pending) > self.stream.queue.capacity:
            self._lose(next(iter(self.pending)))

    def forget(self, child: str) -> None:
        self.statics.pop(child, None)
        self._lose(child)

    def discard_moving(self) -> None:
        for child in tuple(self.pending):
            self._lose(child)

    def note(self, batch: Batch) -> None:
        moving = [sample for sample in batch if not sample.static]
        self.read += len(moving)
        self.statics_read.update((sample.child, sample) for sample in batch if sample.static)
        if self.conflates:
            assert [id(sample) for sample in moving] == [id(sample) for sample in self.pending.values()]
            self.pending.clear()

    def check(self) -> None:
        left = self.offered - self.read - self.stream.dropped - self.stream.queue.conflated
        assert 0 <= left <= len(self.stream.queue)
        if self.conflates:
            assert (left, self.stream.dropped) == (len(self.pending), self.lost)
        assert self.stream.queue.conflated == self.superseded

    async def check_to_the_end(self) -> None:
        """Read what the reader has left behind when it went."""
        async for batch in self.stream:
            self.note(batch)
        self.check()
        assert self.offered == self.read + self.stream.dropped + self.superseded
        for child, sample in self.statics.items():
            assert self.statics_read.get(child) is sample, "the newest static sample is never dropped"

    def close(self) -> None:
        self.open = False
        self.stream.close()

    def _conflate(self, sample: TransformStamped) -> None:
        before = self.pending.get(sample.child)
        self.superseded += before is not None
        if not sample.static:
            self.statics.pop(sample.child, None)
        if sample.static or before is None or before.stamp <= sample.stamp:
            self.pending.pop(sample.child, None)
            if not sample.static:
                self.pending[sample.child] = sample

    def _lose(self, child: str) -> None:
        self.lost += self.pending.pop(child, None) is not None
