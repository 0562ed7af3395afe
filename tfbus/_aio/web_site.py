"""`WebSite`, the files and the websockets of a `WebServer`.

A connection is one request: a file is sent and the connection closes, or it becomes a websocket.
"""

from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from http import HTTPStatus
from typing import NamedTuple

import anyio
import anyio.abc

from tfbus._aio.web_door import HEAD_END
from tfbus._aio.websocket import WebSocket

PING_EVERY = 20.0
"""s; an end that has been silent for three times as long is let go."""


class WebFile(NamedTuple):
    """A file of a `WebSite`."""

    media_type: str
    content: bytes


class WebSite:
    """Files by their path, and a websocket at any path.

    Parameters
    ----------
    files : mapping of str to WebFile
        By path, such as ``/``; read at each request.
    serve : callable
        Talks over one websocket, as ``await serve(socket)``; the websocket closes when it returns. It may let through
        the `OSError` of an end that is gone.
    max_size : int
        The largest message that is received, in bytes or characters.
    policy : str
        The Content-Security-Policy of the files.
    """

    def __init__(
        self,
        files: Mapping[str, WebFile],
        serve: Callable[[WebSocket], Awaitable[None]],
        max_size: int,
        policy: str = "default-src 'self'",
    ) -> None:
        self._files = files
        self._serve = serve
        self._max_size = max_size
        self._policy = policy

    async def answer(self, stream: anyio.abc.SocketStream, head: bytes) -> None:
        """Answer a request, as the `Answer` of a `WebServer`."""
        lines = head.partition(HEAD_END)[0].lower().split(b"\r\n")
        if any(line.replace(b" ", b"") == b"upgrade:websocket" for line in lines):
            await self._open(stream, head)
            return
        method, target, _ = head.decode("latin-1").split(" ", 2)
        file = self._files.get(target.partition("?")[0])
        if method not in ("GET", "HEAD"):
            await stream.send(self._response(HTTPStatus.METHOD_NOT_ALLOWED, WebFile("text/plain", b"GET or HEAD\n")))
        elif file is None:
            await stream.send(self._response(HTTPStatus.NOT_FOUND, WebFile("text/plain", b"there is no such file\n")))
        else:
            await stream.send(self._response(HTTPStatus.OK, file, with_content=method == "GET"))

    def _response(self, status: HTTPStatus, file: WebFile, with_content: bool = True) -> bytes:
        head = (
            f"HTTP/1.1 {status.value} {status.phrase}\r\nContent-Type: {file.media_type}\r\n"
            f"Content-Length: {len(file.content)}\r\nCache-Control: no-cache\r\nX-Content-Type-Options: nosniff\r\n"
            f"Content-Security-Policy: {self._policy}\r\nReferrer-Policy: no-referrer\r\nConnection: close\r\n\r\n"
        ).encode("latin-1")
        return head + file.content if with_content else head

    async def _open(self, stream: anyio.abc.SocketStream, head: bytes) -> None:
        try:
            socket = await WebSocket.accept(stream, head, self._max_size)
        except ConnectionAbortedError as error:
            text = WebFile("text/plain", f"{error}\n".encode("ascii", "replace"))
            await stream.send(self._response(HTTPStatus.BAD_REQUEST, text))
            return
        try:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(self._keep_alive, socket, tasks.cancel_scope)
                with suppress(OSError):
                    await self._serve(socket)
                tasks.cancel_scope.cancel()
        finally:
            with anyio.CancelScope(shield=True):
                await socket.close()

    async def _keep_alive(self, socket: WebSocket, scope: anyio.CancelScope) -> None:
        """End a websocket whose other end does not answer any more, as a telephone that went out of reach."""
        while anyio.current_time() - socket.heard < 3 * PING_EVERY:
            await anyio.sleep(PING_EVERY)
            with anyio.move_on_after(PING_EVERY), suppress(OSError):
                await socket.ping()
        scope.cancel()
