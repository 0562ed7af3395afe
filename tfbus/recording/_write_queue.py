"""The batches that wait to be written to the disk, with the instants at which they were published."""

from tfbus.bus.queues import SampleQueue, TimedBatch
from tfbus.geometry.stamped import TransformStamped


class WriteQueue(SampleQueue):
    """A `SampleQueue` that drops the oldest batches, and gives each batch with its time.

    Parameters
    ----------
    capacity : int
        The greatest number of pending moving samples, and of pending batches; the newest batch always stays. Of the
        static samples in dropped batches, the newest one of each child is kept beyond that.

    Attributes
    ----------
    dropped : int
        Moving samples lost to the capacity, and all samples that `clear` removed.
    conflated : int
        Static samples that were kept, and then replaced by a newer one of the same child.
    """

    def __init__(self, capacity: int) -> None:
        super().__init__(capacity, "drop_oldest")

    def get_slice(self, size: int) -> list[TimedBatch]:
        """Remove and return the oldest batches: at least one, and then as many as fit in `size` samples."""
        batches: list[TimedBatch] = [(published, (sample,)) for published, sample in self._kept.values()]
        self._kept.clear()
        count = len(batches)
        while self._batches and (not batches or count + len(self._batches[0][1]) <= size):
            published, batch = self._pop_batch()
            batches.append((published, batch))
            count += len(batch)
        return batches

    def clear(self) -> None:
        """Remove all samples, and count them as dropped."""
        self.dropped += len(self)
        self._kept.clear()
        self._batches.clear()
        self._size = self._moving = 0

    def _keep_static(self, published: int, sample: TransformStamped) -> None:
        self.conflated += sample.child in self._kept
        super()._keep_static(published, sample)
