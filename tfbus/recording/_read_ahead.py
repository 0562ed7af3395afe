"""A worker thread that reads blocks of a recording before the event loop needs them."""

import math
from collections.abc import Generator, Iterator
from itertools import islice
from types import TracebackType

import anyio
import anyio.abc
import anyio.streams.memory
import anyio.to_thread

from tfbus._aio.task_groups import close_task_group
from tfbus.recording.message import RecordedMessage

_BLOCK = 256

Block = list[RecordedMessage]


class ReadAhead:
    """Reads messages in a worker thread: ``async with ReadAhead(...) as blocks: async for block in blocks``.

    Parameters
    ----------
    messages : iterator of RecordedMessage
        The messages of a recording, which must stay open until the ``async with`` has ended. A generator is closed at
        that end.
    ahead : int
        How many blocks the thread reads before they are requested. With 0 it only reads while the iterating task waits.

    Notes
    -----
    An error of reading, such as an `OSError`, is raised by the iteration after the last block that could be read.
    """

    def __init__(self, messages: Iterator[RecordedMessage], ahead: int) -> None:
        self._messages = messages
        self._wanted = anyio.Semaphore(ahead)
        self._error: Exception | None = None
        self._tasks: anyio.abc.TaskGroup
        self._receive: anyio.streams.memory.MemoryObjectReceiveStream[Block]

    async def __aenter__(self) -> "ReadAhead":
        # The semaphore bounds it: nothing is read that is not wanted.
        send, self._receive = anyio.create_memory_object_stream[Block](math.inf)
        self._tasks = await anyio.create_task_group().__aenter__()
        self._tasks.start_soon(self._read, send)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._tasks.cancel_scope.cancel()
        try:
            await close_task_group(self._tasks)
        finally:
            self._receive.close()

    def __aiter__(self) -> "ReadAhead":
        return self

    async def __anext__(self) -> Block:
        self._wanted.release()
        try:
            return await self._receive.receive()
        except anyio.EndOfStream:
            if self._error is not None:
                raise self._error from None
            raise StopAsyncIteration from None

    async def _read(self, send: anyio.streams.memory.MemoryObjectSendStream[Block]) -> None:
        thread = anyio.CapacityLimiter(1)
        try:
            while self._error is None:
                await self._wanted.acquire()
                block: Block = []
                try:
                    await anyio.to_thread.run_sync(block.extend, islice(self._messages, _BLOCK), limiter=thread)
                except Exception as error:  # noqa: BLE001 - the iteration raises it
                    self._error = error
                if not block:
                    return
                send.send_nowait(block)
        finally:
            send.close()
            if isinstance(self._messages, Generator):
                self._messages.close()
