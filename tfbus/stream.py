"""Batches as an async iterator, for a task that reads at its own pace."""

from collections.abc import Callable
from types import TracebackType

import anyio
import anyio.lowlevel

from tfbus.sample_queue import Overflow, SampleQueue
from tfbus.stamped import Batch


class Stream:
    """What `Bus.stream` gives: ``async for batch in stream``, for one reader.

    The iteration ends when the bus or the stream is closed and what was pending has been read.
    """

    def __init__(
        self,
        capacity: int,
        overflow: Overflow,
        check_thread: Callable[[], object],
        detach: Callable[["Stream"], object],
    ) -> None:
        self.queue = SampleQueue(capacity, overflow)
        self._check_thread = check_thread
        self._detach = detach
        self._reading = anyio.ResourceGuard("reading from")
        self._reader: anyio.Event | None = None
        self._ended = False

    @property
    def dropped(self) -> int:
        """Moving samples that the reader was too slow for."""
        return self.queue.dropped

    @property
    def waiting(self) -> bool:
        """Whether a reader waits for a batch."""
        return self._reader is not None

    def put(self, batch: Batch) -> None:
        """Add a batch and wake the reader."""
        self.queue.put(batch)
        self._wake()

    def end(self) -> None:
        """Let the reader finish what is pending, then stop."""
        self._ended = True
        self._wake()

    def close(self) -> None:
        """Take the stream off the bus; a second call does nothing."""
        self._detach(self)
        self.end()

    def __enter__(self) -> "Stream":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def __aiter__(self) -> "Stream":
        return self

    async def __anext__(self) -> Batch:
        self._check_thread()
        with self._reading:
            await anyio.lowlevel.checkpoint()
            while (batch := self.queue.get()) is None:
                if self._ended:
                    raise StopAsyncIteration
                self._reader = anyio.Event()
                try:
                    await self._reader.wait()
                finally:
                    self._reader = None
        return batch

    def _wake(self) -> None:
        if self._reader is not None:
            self._reader.set()
