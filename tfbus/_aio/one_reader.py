"""What every stream has in common: one reader, who waits until there is something, and an end."""

from collections.abc import Callable
from types import TracebackType
from typing import Any, Generic, Self, TypeVar

import anyio
import anyio.lowlevel

ItemT = TypeVar("ItemT")


class OneReaderStream(Generic[ItemT]):
    """An async iterator for one reader at a time, fed by a bus.

    The iteration ends when the bus or the stream is closed and what was pending has been read. Whoever derives from
    this says what comes next.

    Parameters
    ----------
    check_thread : callable
        Raises unless the caller may read here.
    detach : callable
        Takes the stream off the bus.
    """

    def __init__(self, check_thread: Callable[[], object], detach: Callable[[Any], object]) -> None:
        self._check_thread = check_thread
        self._detach = detach
        self._one_reader = anyio.ResourceGuard("reading from")
        self._reader: anyio.Event | None = None
        self._ended = False

    @property
    def waiting(self) -> bool:
        """Whether a reader waits for something."""
        return self._reader is not None

    def wake(self) -> None:
        """Have the reader look again."""
        if self._reader is not None:
            self._reader.set()

    def end(self) -> None:
        """Let the reader finish what is pending, then stop."""
        self._ended = True
        self.wake()

    def close(self) -> None:
        """Take the stream off the bus; a second call does nothing."""
        self._detach(self)
        self.end()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> ItemT:
        self._check_thread()
        with self._one_reader:
            await anyio.lowlevel.checkpoint()
            while (item := self._next()) is None:
                if self._ended:
                    raise StopAsyncIteration
                self._reader = anyio.Event()
                try:
                    await self._wait(self._reader)
                finally:
                    self._reader = None
        return item

    def _next(self) -> ItemT | None:
        """The next item; None while there is none."""
        raise NotImplementedError

    async def _wait(self, woken: anyio.Event) -> None:
        """Wait until somebody calls `wake`, or until it is time to look again."""
        await woken.wait()
