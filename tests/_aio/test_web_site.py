from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio
import anyio.abc
import httpx
import pytest

pytest.importorskip("wsproto", reason="websockets need wsproto")

import anyio.lowlevel
from hypothesis import given
from hypothesis import strategies as st

from tfbus._aio import web_site
from tfbus._aio.web_door import WebDoor
from tfbus._aio.web_server import MAX_CONNECTIONS, WebServer
from tfbus._aio.web_site import WebFile, WebSite
from tfbus._aio.websocket import WebSocket

pytestmark = pytest.mark.anyio

PAGE = WebFile("text/html; charset=utf-8", b"<p>page</p>" * 100_000)
UPGRADE = b"GET /socket HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"

KEY = b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"


async def echo(socket: WebSocket) -> None:
    while True:
        await socket.send(await socket.receive())


@asynccontextmanager
async def serving() -> AsyncIterator[WebServer]:
    site = WebSite({"/": PAGE}, echo, max_size=1_000)
    async with WebServer("127.0.0.1", 0, WebDoor("127.0.0.1"), site.answer) as server:
        yield server


async def connect(server: WebServer) -> anyio.abc.SocketStream:
    return await anyio.connect_tcp("127.0.0.1", int(server.place.rpartition(":")[2]))


async def test_files_and_websockets_are_served_and_nothing_else() -> None:
    async with serving() as server, httpx.AsyncClient(base_url=f"http://{server.place}", trust_env=False) as client:
        page = await client.get("/?token=1")
        assert (page.status_code, page.content) == (200, PAGE.content)
        assert page.headers["Content-Security-Policy"] == "default-src 'self'"
        head = await client.head("/")
        assert (head.content, head.headers["Content-Length"]) == (b"", str(len(PAGE.content)))
        assert (await client.get("/../etc/passwd")).status_code == 404
        assert (await client.post("/")).status_code == 405
        evil = await client.get("/", headers={"Origin": "http://evil.example"})
        assert (evil.status_code, server.refused) == (403, 1)
        socket = await WebSocket.connect(f"ws://{server.place}/socket", 1_000, timeout=30.0)
        for message in ("text", b"bytes", "x" * 1_000):
            await socket.send(message)
            assert await socket.receive() == message
        await socket.send("x" * 1_001)
        with pytest.raises(ConnectionResetError):
            await socket.receive()
        await socket.close()


@pytest.mark.parametrize("rest", [b"", b"Sec-WebSocket-Version: 12\r\nSec-WebSocket-Key: a\r\n"])
async def test_a_wrong_handshake_is_told(rest: bytes) -> None:
    async with serving() as server, await connect(server) as stream:
        await stream.send(UPGRADE + rest + b"\r\n")
        assert b"400 Bad Request" in await stream.receive()


async def test_an_end_that_answers_no_ping_is_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_site, "PING_EVERY", 0.01)
    async with serving() as server, await connect(server) as stream:
        await stream.send(UPGRADE + KEY)
        with pytest.raises(anyio.EndOfStream):
            while True:
                await stream.receive()


class Stuck(anyio.abc.ByteStream):
    """Sends the answer to the handshake, and one byte of each message after it."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []

    async def send(self, item: bytes) -> None:
        self.sent.append(item[:1])
        if len(self.sent) > 1:
            await anyio.sleep_forever()

    async def receive(self, _: int = 65_536) -> bytes:
        raise anyio.EndOfStream

    async def send_eof(self) -> None: ...

    async def aclose(self) -> None: ...


@pytest.mark.every_loop
async def test_nothing_is_sent_after_a_frame_that_was_cut_short() -> None:
    stream = Stuck()
    socket = await WebSocket.accept(stream, UPGRADE + KEY, 1_000)
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(socket.ping)
        await anyio.wait_all_tasks_blocked()
        tasks.cancel_scope.cancel()
    await socket.close()
    assert stream.sent == [b"H", b"\x89"]


async def test_connections_have_a_bound_and_the_end_of_one_makes_room() -> None:
    async with serving() as server:
        idle = [await connect(server) for _ in range(MAX_CONNECTIONS)]
        async with await connect(server) as late:
            with pytest.raises((anyio.EndOfStream, anyio.BrokenResourceError)):
                await late.receive()
        assert server.refused == 1
        for each in idle:
            await each.aclose()
        with anyio.fail_after(30.0):
            while True:
                try:
                    await (await WebSocket.connect(f"ws://{server.place}", 1_000, timeout=30.0)).close()
                    break
                except OSError:
                    # The server has not read yet that the others have left.
                    await anyio.lowlevel.checkpoint()


@given(st.lists(st.binary(min_size=1, max_size=40), max_size=5), st.booleans())
async def test_garbage_disturbs_nobody_else(pieces: list[bytes], opened: bool) -> None:
    async with serving() as server:
        async with await connect(server) as stream:
            try:
                await stream.send(UPGRADE + KEY if opened else b"GET ")
                for piece in pieces:
                    await stream.send(piece)
            except anyio.BrokenResourceError:
                pass
        socket = await WebSocket.connect(f"ws://{server.place}", 1_000, timeout=30.0)
        await socket.send("still here")
        assert await socket.receive() == "still here"
        await socket.close()


async def test_a_taken_port_is_told_or_replaced_by_the_next_free_one() -> None:
    async with serving() as server:
        port = int(server.place.rpartition(":")[2])
        site = WebSite({}, echo, max_size=1)
        with pytest.raises(OSError, match=f"cannot listen at 127.0.0.1:{port}: "):
            await WebServer("127.0.0.1", port, WebDoor("127.0.0.1"), site.answer).__aenter__()
        async with WebServer("127.0.0.1", port, WebDoor("127.0.0.1"), site.answer, search=True) as other:
            assert int(other.place.rpartition(":")[2]) > port
