"""Task groups that belong to an object with an ``async with`` of its own."""

import math
from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, AsyncIterable, Awaitable, Callable
from types import TracebackType
from typing import Any, Generic, NoReturn, Self, TypeVar

import anyio
import anyio.abc
import anyio.lowlevel

from tfbus._aio.loops import checkpoint

ItemT = TypeVar("ItemT")


class OneReader(anyio.ResourceGuard):
    """A ``with`` for the one task that reads and waits; a second task gets `anyio.BusyResourceError`.

    No wake-up is lost between the search for an item and `wait`: the reader and the code that calls `wake` run in one
    thread, and the reader does not pass a checkpoint in between.
    """

    def __init__(self) -> None:
        super().__init__("reading from")
        self._woken: anyio.Event | None = None
        self._was_woken = False

    @property
    def waiting(self) -> bool:
        """Whether the reader waits."""
        return self._woken is not None

    @property
    def was_woken(self) -> bool:
        """Whether `wake` was called during the last wait, also if that was cancelled in the same turn of the loop."""
        return self._was_woken

    def wake(self) -> None:
        """End the wait of the reader, if it waits."""
        if self._woken is not None:
            self._woken.set()

    async def wait(self) -> None:
        """Wait for the next call of `wake`."""
        self._woken = woken = anyio.Event()
        try:
            await woken.wait()
        finally:
            self._was_woken = woken.is_set()
            self._woken = None


class OneReaderStream(ABC, Generic[ItemT]):
    """An async iterator that one task at a time may read, filled by a bus.

    The iteration ends when the stream is closed and all pending items have been read. A subclass implements `_next`.

    Parameters
    ----------
    check_thread : callable
        Raises unless the calling thread may read here.
    detach : callable
        Takes the stream off the bus.
    """

    def __init__(self, check_thread: Callable[[], object], detach: Callable[[Any], object]) -> None:
        self._check_thread = check_thread
        self._detach = detach
        self._reader = OneReader()
        self._ended = False
        self.wake: Callable[[], None] = self._reader.wake
        """Makes a waiting reader look for the next item again."""

    @property
    def waiting(self) -> bool:
        """Whether a reader waits for an item."""
        return self._reader.waiting

    def end(self) -> None:
        """Let the reader read all pending items, then end the iteration."""
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
        with self._reader:
            await anyio.lowlevel.checkpoint()
            while (item := self._next()) is None:
                if self._ended:
                    raise StopAsyncIteration
                await self._wait()
        return item

    @abstractmethod
    def _next(self) -> ItemT | None:
        """The next item; None while there is none."""

    async def _wait(self) -> None:
        """Wait until `wake` is called, or until it is time to look again."""
        await self._reader.wait()


async def read_source(source: AsyncIterable[ItemT], take: Callable[[ItemT], Awaitable[object]]) -> BaseException | None:
    """Hand over all items of a source; the error that ended it, if there was one. An async generator is closed.

    A source may also be cancelled by itself, as a task of asyncio can be; this task is not cancelled then.
    """
    try:
        await checkpoint()
        items = aiter(source)
        try:
            async for item in items:
                await take(item)
        finally:
            if isinstance(items, AsyncGenerator):
                await items.aclose()
    except anyio.get_cancelled_exc_class() as error:
        if anyio.current_effective_deadline() == -math.inf:
            raise
        return error
    except Exception as error:  # noqa: BLE001 - the caller has it raised elsewhere
        return error
    return None


async def close_task_group(tasks: anyio.abc.TaskGroup) -> None:
    """Wait until all tasks have ended, and raise the error of a single failed task without an `ExceptionGroup`.

    The group was entered by hand. It is not told of an error in the body of the ``async with``, because it would wrap
    that error as well. On trio, Ctrl-C may be raised in a task of a group within this one, and is raised as itself too.
    """
    try:
        await tasks.__aexit__(None, None, None)
    except BaseExceptionGroup as group:
        if len(group.exceptions) > 1:
            raise
        error = innermost = group.exceptions[0]
        while isinstance(innermost, BaseExceptionGroup) and len(innermost.exceptions) == 1:
            innermost = innermost.exceptions[0]
        if isinstance(innermost, KeyboardInterrupt):
            error = innermost
    else:
        return
    raise_unchanged(error)


def raise_unchanged(error: BaseException) -> NoReturn:
    """Raise an error that was caught before, with the context that it had then."""
    context = error.__context__
    try:
        raise error
    finally:
        # `raise` has replaced the context by the exception that is being handled.
        error.__context__ = context
        del error
