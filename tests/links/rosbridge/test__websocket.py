import ssl
from typing import Any

import anyio
import anyio.abc
import pytest

pytest.importorskip("wsproto", reason='pip install "tfbus[rosbridge]"')

from support.rosbridge import rosbridge_server
from wsproto import ConnectionType, WSConnection
from wsproto.events import AcceptConnection, BytesMessage, CloseConnection, Ping, Request, TextMessage

from tfbus.links.rosbridge.websocket import WebSocket, check_url

pytestmark = pytest.mark.anyio


@pytest.mark.parametrize("url", ["", "localhost:9090", "http://a", "ws://", "ws://a:0", "ws://a:70000", "ws://:9090"])
def test_what_is_no_url_of_a_websocket_is_refused(url: str) -> None:
    with pytest.raises(ValueError, match="no URL of a websocket"):
        check_url(url)


def test_a_url_has_a_host_and_perhaps_a_port() -> None:
    parts = check_url("ws://[::1]:9091/path?token=1")
    assert (parts.hostname, parts.port, parts.path, parts.query) == ("::1", 9091, "/path", "token=1")
    assert check_url("wss://robot").port is None


@pytest.mark.parametrize(
    ("url", "address"),
    [
        ("ws://robot", ("robot", 9090)),
        ("wss://robot/path", ("robot", 443)),
        ("ws://robot:7", ("robot", 7)),
        ("wss://[::1]:8", ("::1", 8)),
    ],
)
async def test_without_a_port_it_is_that_of_rosbridge_or_of_https(
    url: str, address: tuple[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, int]] = []

    async def connect(host: str, port: int, **_: object) -> None:
        asked.append((host, port))
        raise ConnectionRefusedError

    monkeypatch.setattr(anyio, "connect_tcp", connect)
    # To load the certificates of this machine takes long.
    monkeypatch.setattr(ssl, "create_default_context", lambda: None)
    with pytest.raises(ConnectionRefusedError):
        await WebSocket.connect(url, 100, 5)
    assert asked == [address]


async def test_messages_come_whole_and_a_ping_is_answered() -> None:
    async with rosbridge_server() as server:
        socket = await WebSocket.connect(server.url, 100_000, 5)
        (client,) = server.clients
        for event in (
            TextMessage("one", message_finished=False),
            TextMessage(" more"),
            Ping(b"!"),
            BytesMessage(b"two"),
            TextMessage("x" * 100_000),
        ):
            await client.send(event)
        assert [await socket.receive() for _ in range(2)] == ["one more", b"two"]
        assert await socket.receive() == "x" * 100_000
        before = socket.heard
        await socket.ping()
        await client.send(TextMessage("last"))
        assert await socket.receive() == "last"
        assert socket.heard > before
        await socket.close()


@pytest.mark.parametrize(
    ("path", "target"), [("", "/"), ("/ros", "/ros"), ("?token=1", "/?token=1"), ("/ros?a=1&b=2", "/ros?a=1&b=2")]
)
async def test_the_path_and_the_query_of_the_url_are_asked_for(path: str, target: str) -> None:
    asked: list[str] = []

    async def answer(stream: anyio.abc.SocketStream) -> None:
        async with stream:
            server = WSConnection(ConnectionType.SERVER)
            server.receive_data(await stream.receive())
            for event in server.events():
                assert isinstance(event, Request)
                asked.append(event.target)
            await stream.send(server.send(AcceptConnection()))

    listener = await anyio.create_tcp_listener(local_host="127.0.0.1")
    async with listener, anyio.create_task_group() as tasks:
        tasks.start_soon(listener.serve, answer)
        port = listener.extra(anyio.abc.SocketAttribute.local_port)
        socket = await WebSocket.connect(f"ws://127.0.0.1:{port}{path}", 100, 5)
        await socket.close()
        tasks.cancel_scope.cancel()
    assert asked == [target]


async def test_a_message_that_is_too_large_is_cut_off_before_it_has_come() -> None:
    async with rosbridge_server() as server:
        socket = await WebSocket.connect(server.url, 100_000, 5)
        (client,) = server.clients
        sent = 0

        async def flood() -> None:
            nonlocal sent
            while True:
                await client.send(BytesMessage(bytes(50_000), message_finished=False))
                sent += 50_000

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(flood)
            with pytest.raises(ConnectionAbortedError, match="100000"):
                await socket.receive()
            tasks.cancel_scope.cancel()
        await socket.close()
        assert sent < 20_000_000


@pytest.mark.parametrize("how", ["close", "cut", "garbage"])
async def test_the_end_of_a_connection_is_an_os_error(how: str) -> None:
    async with rosbridge_server() as server:
        socket = await WebSocket.connect(server.url, 1_000, 5)
        (client,) = server.clients
        if how == "close":
            await client.send(CloseConnection(1001, "good night"))
        elif how == "cut":
            await server.cut()
        else:
            async with client.sending:
                await client.stream.send(b"\xff" * 100)
        with pytest.raises(OSError, match="good night" if how == "close" else "gone|no websocket|has closed"):
            await socket.receive()
        await socket.close()
        with pytest.raises(OSError, match=r"closed|gone"):
            await socket.send("late")


@pytest.mark.thorough
async def test_closing_does_not_wait_for_an_end_that_reads_nothing() -> None:
    async def freeze(stream: anyio.abc.SocketStream) -> None:
        connection = WSConnection(ConnectionType.SERVER)
        async with stream:
            connection.receive_data(await stream.receive())
            assert isinstance(next(connection.events()), Request)
            await stream.send(connection.send(AcceptConnection()))
            await anyio.sleep_forever()

    async with await anyio.create_tcp_listener(local_host="127.0.0.1") as listener, anyio.create_task_group() as tasks:
        tasks.start_soon(listener.serve, freeze)
        url = f"ws://127.0.0.1:{listener.extra(anyio.abc.SocketAttribute.local_port)}"
        socket = await WebSocket.connect(url, 1_000, 5)
        with anyio.move_on_after(0.5):
            while True:
                await socket.send("x" * 1_000_000)
        with anyio.fail_after(20):
            await socket.close()
        tasks.cancel_scope.cancel()


async def test_nobody_a_page_and_a_silent_program_are_os_errors() -> None:
    async with rosbridge_server() as server:
        with pytest.raises(ConnectionRefusedError, match="status 404"):
            await WebSocket.connect(server.url + "/refused", 1_000, 5)
        server.silent = True
        with pytest.raises(TimeoutError, match=r"0\.05 s"):
            await WebSocket.connect(server.url, 1_000, 0.05)
        url = server.url
    with pytest.raises(OSError):
        await WebSocket.connect(url, 1_000, 5)


async def test_a_tls_server_is_spoken_to_in_tls() -> None:
    async with await anyio.create_tcp_listener(local_host="127.0.0.1") as listener:
        first: list[bytes] = []

        async def answer(stream: Any) -> None:
            async with stream:
                first.append(await stream.receive())
                await stream.send(b"no TLS here")

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(listener.serve, answer)
            port = listener.extra(anyio.abc.SocketAttribute.local_port)
            with pytest.raises(OSError):
                await WebSocket.connect(f"wss://127.0.0.1:{port}", 1_000, 5)
            tasks.cancel_scope.cancel()
        # A handshake record (RFC 8446, section 5.1).
        assert first[0][:2] == b"\x16\x03"
