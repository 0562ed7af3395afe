"""Batches as an async iterator, for a task that reads at its own pace."""

from collections.abc import Callable

from tfbus._aio.one_reader import OneReaderStream
from tfbus.bus.sample_queue import Overflow, SampleQueue
from tfbus.geometry.stamped import Batch


class Stream(OneReaderStream[Batch]):
    """The result of `Bus.stream`: ``async for batch in stream``, for one reader.

    The iteration ends when the bus or the stream is closed and what was pending has been read.
    """

    def __init__(
        self,
        capacity: int,
        overflow: Overflow,
        check_thread: Callable[[], object],
        detach: Callable[["Stream"], object],
    ) -> None:
        super().__init__(check_thread, detach)
        self.queue = SampleQueue(capacity, overflow)

    @property
    def dropped(self) -> int:
        """Moving samples that the reader was too slow for."""
        return self.queue.dropped

    def put(self, batch: Batch) -> None:
        """Add a batch and wake the reader."""
        self.queue.put(batch)
        self.wake()

    def _next(self) -> Batch | None:
        return self.queue.get()
