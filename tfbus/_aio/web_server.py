"""`WebServer`, which listens behind a `WebDoor` and passes on the connections that the door lets in.

Connections have a bound, and the head of a request has a size and a time. A client disturbs its own connection only.
"""

import errno
from collections.abc import Awaitable, Callable
from contextlib import suppress
from types import TracebackType
from typing import Self

import anyio
import anyio.abc

from tfbus._aio.task_groups import close_task_group
from tfbus._aio.web_door import HEAD_END, HEAD_TIME, MAX_HEAD, WebDoor

MAX_CONNECTIONS = 100
_GONE = (anyio.EndOfStream, anyio.BrokenResourceError, anyio.ClosedResourceError, OSError)

Answer = Callable[[anyio.abc.SocketStream, bytes], Awaitable[None]]
"""Answers a request, from all bytes that were received so far; the head of the request is complete."""


class WebServer:
    """Listens, and passes on the connections that its door lets in: ``async with WebServer(…) as server``.

    Parameters
    ----------
    host : str
    port : int
        0 for any.
    door : WebDoor
    answer : callable
        Runs in a task of its own for each connection. The connection closes when it returns. The errors of a client
        that is gone are ignored; any other error ends the server.
    search : bool
        Whether a port that is taken is replaced by the next free one.

    Attributes
    ----------
    place : str
        The host and the port for an address, such as ``127.0.0.1:8080``.

    Raises
    ------
    TypeError, ValueError
        If the port is no int, or out of range.
    OSError
        On entering, if nobody can listen there.
    """

    def __init__(self, host: str, port: int, door: WebDoor, answer: Answer, search: bool = False) -> None:
        if isinstance(port, bool) or not isinstance(port, int):
            raise TypeError(f"a port must be an int, not {port!r}")
        if not 0 <= port <= 65_535:
            raise ValueError(f"a port must be from 0 to 65535, got {port}")
        self.place: str = ""
        self._host, self._port, self._search = host, port, search
        self._door = door
        self._answer = answer
        self._connections = self._too_many = 0
        self._listener: anyio.abc.Listener[anyio.abc.SocketStream]
        self._tasks: anyio.abc.TaskGroup

    @property
    def refused(self) -> int:
        """Connections that were refused, by the door or because there were too many."""
        return self._door.refused + self._too_many

    async def __aenter__(self) -> Self:
        self._listener = await self._listen()
        try:
            self._tasks = await anyio.create_task_group().__aenter__()
            self._tasks.start_soon(self._serve)
        except BaseException:
            await self._listener.aclose()
            raise
        port = self._listener.extra(anyio.abc.SocketAttribute.local_port)
        self.place = f"{f'[{self._host}]' if ':' in self._host else self._host}:{port}"
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._tasks.cancel_scope.cancel()
        try:
            await close_task_group(self._tasks)
        finally:
            self.place = ""
            with anyio.CancelScope(shield=True):
                await self._listener.aclose()

    async def _listen(self) -> anyio.abc.Listener[anyio.abc.SocketStream]:
        port = self._port
        while True:
            try:
                # A cancellation must not lose the listener.
                with anyio.CancelScope(shield=True):
                    return await anyio.create_tcp_listener(local_host=self._host, local_port=port)
            except OSError as error:
                if not self._search or port in (0, 65_535) or error.errno != errno.EADDRINUSE:
                    reason = error.strerror or error
                    raise OSError(error.errno, f"cannot listen at {self._host}:{port}: {reason}") from error
            port += 1

    async def _serve(self) -> None:
        await self._listener.serve(self._admit)

    async def _admit(self, stream: anyio.abc.SocketStream) -> None:
        async with stream:
            if self._connections == MAX_CONNECTIONS:
                self._too_many += 1
                return
            self._connections += 1
            try:
                with suppress(*_GONE):
                    head = await _head_of(stream)
                    refusal = self._door.answer(head)
                    if refusal is None:
                        await self._answer(stream, head)
                    else:
                        await stream.send(refusal)
            finally:
                self._connections -= 1


async def _head_of(stream: anyio.abc.ByteReceiveStream) -> bytes:
    """The first bytes of a stream, with the head of a request; without it, if that is too long or comes too late."""
    head = b""
    with anyio.move_on_after(HEAD_TIME):
        while HEAD_END not in head and len(head) <= MAX_HEAD:
            head += await stream.receive(MAX_HEAD)
    return head
