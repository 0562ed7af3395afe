"""`WebSocket`, one end of a websocket that takes no message beyond a size."""

import ssl
from collections.abc import Iterator
from io import StringIO
from typing import Self
from urllib.parse import SplitResult, urlsplit

import anyio
import anyio.abc
from wsproto import ConnectionType, WSConnection
from wsproto.events import (
    AcceptConnection,
    BytesMessage,
    CloseConnection,
    Event,
    Ping,
    RejectConnection,
    Request,
    TextMessage,
)
from wsproto.utilities import ProtocolError

from tfbus._aio.turn_budget import TurnBudget

_AT_ONCE = 2**16
_GONE = (anyio.EndOfStream, anyio.BrokenResourceError, anyio.ClosedResourceError)
_CLOSING_TIME = 1.0
"""s; this end tries so long to tell an end that reads nothing that it closes."""
_PORTS = {"ws": 9090, "wss": 443}


def check_url(url: str) -> SplitResult:
    """The parts of the URL of a websocket.

    Raises
    ------
    ValueError
        If it is no such URL.
    """
    parts = urlsplit(url)
    try:
        valid = parts.scheme in _PORTS and bool(parts.hostname) and parts.port != 0
    except ValueError:
        valid = False
    if not valid:
        raise ValueError(f"{url!r} is no URL of a websocket, such as ws://localhost:9090")
    return parts


class WebSocket:
    """An open websocket (RFC 6455); one task may receive while others send.

    One read may bring tens of thousands of frames. They are taken from it one by one, and other tasks get their turn in
    between, with `give_way`.

    Parameters
    ----------
    stream : anyio.abc.ByteStream
    max_size : int
        The largest message that is received, in bytes or characters.
    kind : ConnectionType
        Client or server. `connect` and `accept` make a websocket of each kind.

    Attributes
    ----------
    heard : float
        The time of the event loop in s when the last bytes came.
    """

    def __init__(
        self, stream: anyio.abc.ByteStream, max_size: int, kind: ConnectionType = ConnectionType.CLIENT
    ) -> None:
        self._stream = stream
        self._max_size = max_size
        self._connection = WSConnection(kind)
        self._received: Iterator[Event] = iter(())
        self._budget = TurnBudget()
        self._sending = anyio.Lock()
        self._cut_short = False
        self.heard: float = anyio.current_time()

    @classmethod
    async def connect(cls, url: str, max_size: int, timeout: float) -> Self:
        """Open a websocket.

        Raises
        ------
        OSError
            If nobody answers there, not within so many seconds, or the answer is no websocket.
        """
        parts = check_url(url)
        host, port = parts.hostname or "", parts.port or _PORTS[parts.scheme]
        stream: anyio.abc.ByteStream | None = None
        opened = False
        try:
            with anyio.fail_after(timeout):
                if parts.scheme == "wss":
                    context = ssl.create_default_context()
                    stream = await anyio.connect_tcp(host, port, ssl_context=context, tls_standard_compatible=False)
                else:
                    stream = await anyio.connect_tcp(host, port)
                socket = cls(stream, max_size)
                target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
                await socket._send(Request(host=parts.netloc.rpartition("@")[2], target=target))
                answer = await socket._next_event()
                if not isinstance(answer, AcceptConnection):
                    status = f", status {answer.status_code}" if isinstance(answer, RejectConnection) else ""
                    raise ConnectionRefusedError(f"{url} is no websocket{status}")
                opened = True
                return socket
        except TimeoutError:
            raise TimeoutError(f"{url} does not answer within {timeout:g} s") from None
        finally:
            if stream is not None and not opened:
                await anyio.aclose_forcefully(stream)

    @classmethod
    async def accept(cls, stream: anyio.abc.ByteStream, head: bytes, max_size: int) -> Self:
        """Open the server's end of a websocket, for a client that has sent the head of its request.

        Parameters
        ----------
        stream : anyio.abc.ByteStream
        head : bytes
            All bytes that the client has sent so far.
        max_size : int
            The largest message that is received, in bytes or characters.

        Raises
        ------
        OSError
            If the client is gone, or asks for no websocket. The caller closes the stream.
        """
        socket = cls(stream, max_size, ConnectionType.SERVER)
        try:
            socket._take(head)
        except Exception as error:  # noqa: BLE001 - the library raises errors of several kinds
            raise ConnectionAbortedError(f"it asks for no websocket: {error!r}"[:200]) from None
        request = await socket._next_event()
        if not isinstance(request, Request):
            raise ConnectionAbortedError("it asks for no websocket")
        await socket._send(AcceptConnection())
        return socket

    async def receive(self) -> str | bytes:
        """The next message.

        Raises
        ------
        OSError
            If the other end has closed or is gone, or sends a message that is too large, or no websocket.
        """
        text, data = StringIO(), bytearray()
        size = 0
        while True:
            event = await self._next_event()
            if isinstance(event, TextMessage | BytesMessage):
                size += len(event.data)
                if size > self._max_size:
                    raise ConnectionAbortedError(f"a message of more than {self._max_size} bytes")
                if isinstance(event, TextMessage):
                    text.write(event.data)
                else:
                    data += event.data
                if event.message_finished:
                    return text.getvalue() if isinstance(event, TextMessage) else bytes(data)
            elif isinstance(event, Ping):
                await self._send(event.response())
            elif isinstance(event, CloseConnection):
                raise ConnectionResetError(f"the other end has closed: {event.reason or event.code}")

    async def give_way(self) -> None:
        """Let other tasks have their turn, if what this websocket brings has kept the event loop for too long."""
        await self._budget.give_way()

    async def send(self, message: str | bytes) -> None:
        """Send a message; raises `OSError` if the other end is gone."""
        await self._send(TextMessage(message) if isinstance(message, str) else BytesMessage(message))

    async def ping(self) -> None:
        """Ask the other end for a sign, which moves `heard`; raises `OSError` if it is gone."""
        await self._send(Ping(b""))

    async def close(self) -> None:
        """Close, without waiting for the other end."""
        try:
            with anyio.move_on_after(_CLOSING_TIME):
                await self._send(CloseConnection(1000))
        except OSError:
            pass
        finally:
            await anyio.aclose_forcefully(self._stream)

    async def _next_event(self) -> Event:
        await self._budget.give_way()
        while True:
            try:
                event = next(self._received, None)
                if event is not None:
                    return event
                data = await self._stream.receive(_AT_ONCE)
                self._budget.begin()
                self._take(data)
            except _GONE:
                raise ConnectionResetError("the connection is gone") from None
            # The library also raises a few other errors for bytes that are no websocket.
            except Exception as error:
                if isinstance(error, OSError):
                    raise
                raise ConnectionAbortedError(f"it is no websocket: {error!r}"[:200]) from None

    def _take(self, data: bytes) -> None:
        self.heard = anyio.current_time()
        self._connection.receive_data(data)
        self._received = self._connection.events()

    async def _send(self, event: Event) -> None:
        try:
            data = self._connection.send(event)
        except ProtocolError:
            # The text of the error repeats the whole message.
            raise ConnectionResetError("the websocket is closed") from None
        async with self._sending:
            if self._cut_short:
                raise ConnectionResetError("a frame was cut short")
            # A cancelled send may have sent a part of the frame, and further bytes would be taken for its rest.
            self._cut_short = True
            try:
                await self._stream.send(data)
            except _GONE:
                raise ConnectionResetError("the connection is gone") from None
            self._cut_short = False
