"""Reading a recording while what was read before is being used."""

import math
from collections.abc import Generator, Iterator
from itertools import islice
from types import TracebackType

import anyio
import anyio.abc
import anyio.streams.memory
import anyio.to_thread

from tfbus._aio.task_groups import close_task_group
from tfbus.recording.recording import RecordedMessage

_BLOCK = 256

Block = list[RecordedMessage]


class ReadAhead:
    """The messages of a recording in blocks: ``async with ReadAhead(...) as blocks: async for block in blocks``.

    A worker thread reads them.

    Parameters
    ----------
    messages : iterator of RecordedMessage
        Of a recording that is not closed before the ``async with`` has ended; a generator is closed at its end.
    ahead : int
        How many blocks are read before they are asked for. With 0, nothing goes on behind the back of who uses a block.

    Notes
    -----
    What reading raises, such as an `OSError`, comes out of the iteration behind what could be read.
    """

    def __init__(self, messages: Iterator[RecordedMessage], ahead: int) -> None:
        self._messages = messages
        self._wanted = anyio.Semaphore(ahead)
        self._error: Exception | None = None
        self._tasks: anyio.abc.TaskGroup
        self._receive: anyio.streams.memory.MemoryObjectReceiveStream[Block]

    async def __aenter__(self) -> "ReadAhead":
        # Never more than what is wanted.
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
                except Exception as error:  # noqa: BLE001 - who iterates raises it
                    self._error = error
                if not block:
                    return
                send.send_nowait(block)
        finally:
            send.close()
            if isinstance(self._messages, Generator):
                self._messages.close()
