import asyncio
import json
import random
import socket
import struct
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import anyio
import anyio.to_thread
import pytest

pytest.importorskip("foxglove", reason="serving Foxglove needs foxglove-sdk")

import foxglove
from support.processes import free_ports, is_free
from support.samples import moving, static
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.sync.connection import Connection
from websockets.typing import Origin, Subprotocol

from tfbus import SECOND, Bus, BusClosedError, Registration, SimulatedClock, Transform, TransformStamped
from tfbus._aio.web_server import MAX_CONNECTIONS
from tfbus.links.foxglove import FoxgloveServer

pytestmark = pytest.mark.anyio

START = 1_000 * SECOND


class Application:
    """A stand-in for the Foxglove application: it subscribes to the one channel, and reads messages."""

    def __init__(self, address: str) -> None:
        self._ending = ExitStack()
        opening = connect(address, subprotocols=[Subprotocol("foxglove.sdk.v1")], proxy=None)
        self._socket: Connection = self._ending.enter_context(opening)
        self.channel: dict[str, Any] = {}
        while not self.channel:
            message = self._socket.recv(timeout=30.0)
            if isinstance(message, str) and json.loads(message)["op"] == "advertise":
                [self.channel] = json.loads(message)["channels"]

    def subscribe(self) -> None:
        wanted = {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": self.channel["id"]}]}
        self._socket.send(json.dumps(wanted))

    def transforms(self) -> list[tuple[Any, ...]]:
        """The next message: for each transform its stamp, frames, translation and rotation."""
        while True:
            message = self._socket.recv(timeout=30.0)
            if isinstance(message, bytes) and message[0] == 1:
                return [decoded(each) for each in decode_fields(message[13:]).get(1, [])]

    def close(self) -> None:
        self._ending.close()


def decode_fields(data: bytes) -> dict[int, list[Any]]:
    """The fields of a protobuf message by their number (protobuf.dev, "Encoding")."""
    fields: dict[int, list[Any]] = {}
    place = 0

    def varint() -> int:
        nonlocal place
        value = shift = 0
        while True:
            byte = data[place]
            place += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    while place < len(data):
        number, kind = divmod(varint(), 8)
        value: Any
        if kind == 0:
            value = varint()
        elif kind == 1:
            value = data[place : place + 8]
            place += 8
        else:
            length = varint()
            value = data[place : place + length]
            place += length
        fields.setdefault(number, []).append(value)
    return fields


def decoded(data: bytes) -> tuple[Any, ...]:

    fields = decode_fields(data)

    def floats(number: int, count: int) -> tuple[float, ...]:
        parts = decode_fields(fields[number][0])
        return tuple(struct.unpack("<d", parts[i][0])[0] if i in parts else 0.0 for i in range(1, count + 1))

    stamp = decode_fields(fields[1][0])
    nanoseconds = stamp.get(1, [0])[0] * SECOND + stamp.get(2, [0])[0]
    return nanoseconds, fields[2][0].decode(), fields[3][0].decode(), floats(4, 3), floats(5, 4)


async def until(holds: Callable[[], bool]) -> None:
    """Wait for what the threads of the library bring about."""
    with anyio.fail_after(30.0):
        while not holds():  # noqa: ASYNC110 - there is no event to wait for
            await anyio.sleep(0.01)


@asynccontextmanager
async def application(server: FoxgloveServer) -> AsyncIterator[Application]:
    found = await anyio.to_thread.run_sync(Application, server.address)
    try:
        yield found
    finally:
        await anyio.to_thread.run_sync(found.close)


class CountingBus(Bus):
    """A bus that counts its open subscriptions: in this file, those of the server."""

    subscriptions = 0

    def subscribe(self, callback: Callable[..., object], removed: Callable[..., object] | None = None) -> Registration:
        registration = super().subscribe(callback, removed)
        self.subscriptions += 1

        def close() -> None:
            registration.close()
            self.subscriptions -= 1

        return Registration(close)


@pytest.fixture
def bus() -> CountingBus:
    return CountingBus(SimulatedClock(START))


@pytest.mark.every_loop
async def test_an_application_gets_the_static_frames_and_then_what_is_published(bus: CountingBus) -> None:
    bus.publish([static("base", "lidar", 2.0, stamp=START), moving("map", "old", START, 9.0)])
    turned = Transform.from_xyz_rpy((1.0, -2.0, 0.5), (0.1, 0.2, 0.3))
    async with FoxgloveServer(bus, 0) as server, application(server) as app:
        assert (app.channel["topic"], app.channel["schemaName"]) == ("/tf", "foxglove.FrameTransforms")
        app.subscribe()
        assert await anyio.to_thread.run_sync(app.transforms) == [
            (START, "base", "lidar", (2.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        ]
        bus.publish([TransformStamped("map", "base", START + 5, turned), moving("map", "arm", START + 7, 3.0)])
        base, arm = await anyio.to_thread.run_sync(app.transforms)
        assert base == (START + 5, "map", "base", turned.translation, turned.rotation)
        assert arm == (START + 7, "map", "arm", (3.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        assert (server.sent, server.not_sent) == (3, 0)
        assert bus.subscriptions == 1
    assert bus.subscriptions == 0


async def test_a_second_application_gets_the_static_frames_of_now(bus: Bus) -> None:
    bus.publish(
        [static("base", "lidar", 2.0, START), static("base", "gone", 1.0, START), static("base", "b", 1.0, START)]
    )
    async with FoxgloveServer(bus, 0) as server, application(server) as first:
        first.subscribe()
        assert len(await anyio.to_thread.run_sync(first.transforms)) == 3
        bus.remove_frame("gone")
        bus.publish([static("base", "lidar", 3.0, START), moving("base", "b", START)])
        async with application(server) as second:
            second.subscribe()
            [lidar] = await anyio.to_thread.run_sync(second.transforms)
            assert lidar[2:4] == ("lidar", (3.0, 0.0, 0.0))


async def test_static_frames_that_went_while_nobody_had_subscribed_are_not_sent_later(bus: CountingBus) -> None:
    bus.publish([static("base", "lidar", 2.0, START), static("base", "gone", 1.0, START)])
    async with FoxgloveServer(bus, 0) as server:
        async with application(server) as first:
            first.subscribe()
            assert len(await anyio.to_thread.run_sync(first.transforms)) == 2
        await until(lambda: bus.subscriptions == 0)
        bus.remove_frame("gone")
        async with application(server) as second, application(server) as third:
            for later in (second, third):
                later.subscribe()
                assert [each[2] for each in await anyio.to_thread.run_sync(later.transforms)] == ["lidar"]


async def test_while_nobody_has_subscribed_the_bus_is_not_listened_to(bus: CountingBus) -> None:
    async with FoxgloveServer(bus, 0) as server:
        bus.publish(moving("map", "base", START))
        assert bus.subscriptions == 0
        async with application(server) as app:
            app.subscribe()
            await until(lambda: bus.subscriptions == 1)
        await until(lambda: bus.subscriptions == 0)
        assert server.sent == 0
    assert server.address == ""


async def test_stamps_and_names_that_foxglove_cannot_hold_are_counted(bus: Bus) -> None:
    end = 2**32 * SECOND
    bus.publish([static("map", "early", stamp=-1), static("map", "late", stamp=end), static("map", "ok", 1.0)])
    bus.publish([static("map", "\ud800"), static("\udfff", "child")])
    bus.publish(static("map", "last", stamp=end - 1))
    async with FoxgloveServer(bus, 0) as server, application(server) as app:
        app.subscribe()
        assert [each[2] for each in await anyio.to_thread.run_sync(app.transforms)] == ["ok", "last"]
        assert (server.sent, server.not_sent) == (2, 4)


async def test_a_port_that_is_taken_is_an_error(bus: Bus) -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        pytest.raises(OSError, match=r"cannot listen at 127\.0\.0\.1"),
    ):
        async with FoxgloveServer(bus, taken.getsockname()[1]):
            pytest.fail("entered")


async def test_after_its_end_a_server_has_no_address_and_its_port_is_free(bus: Bus) -> None:
    # One that the system gives to nobody else meanwhile.
    (port,) = free_ports(1)
    async with FoxgloveServer(bus, port) as server:
        assert not is_free(port)
    assert server.address == ""
    # The threads of the library may take a moment to end.
    await until(lambda: is_free(port))


async def test_a_server_that_ends_before_its_applications_leaves_the_bus(bus: CountingBus) -> None:
    async with FoxgloveServer(bus, 0) as server:
        app = await anyio.to_thread.run_sync(Application, server.address)
        app.subscribe()
        await until(lambda: bus.subscriptions == 1)
    assert bus.subscriptions == 0
    await anyio.to_thread.run_sync(app.close)


async def test_a_server_whose_task_is_cancelled_ends_too(bus: Bus) -> None:
    with anyio.CancelScope() as scope:
        async with FoxgloveServer(bus, 0) as server:
            port = int(server.address.rpartition(":")[2])
            scope.cancel()
    await until(lambda: is_free(port))


def test_a_server_that_asyncio_cancels_while_it_begins_listens_nowhere(
    bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    start, places = foxglove.start_server, list[tuple[str, int]]()

    def start_server(*, host: str, **options: Any) -> Any:
        server = start(host=host, **options)
        places.append((host, server.port))
        return server

    def is_listening() -> bool:
        with suppress(ConnectionRefusedError), socket.create_connection(places[0]):
            return True
        return False

    async def cancel() -> None:
        task = asyncio.create_task(FoxgloveServer(bus, 0).__aenter__())
        await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        await until(lambda: bool(places))
        await until(lambda: not is_listening())

    monkeypatch.setattr(foxglove, "start_server", start_server)
    asyncio.run(cancel())


async def test_a_server_is_entered_once_and_not_on_a_closed_bus(bus: Bus) -> None:
    server = FoxgloveServer(bus, 0)
    async with server:
        bus.close()
    with pytest.raises(RuntimeError, match="once"):
        await server.__aenter__()
    with pytest.raises(BusClosedError):
        await FoxgloveServer(bus, 0).__aenter__()


async def test_the_bus_of_another_thread_is_not_served(bus: Bus) -> None:
    async def enter() -> None:
        with pytest.raises(RuntimeError, match="thread"):
            await FoxgloveServer(bus, 0).__aenter__()

    with bus.threadsafe():
        # This event loop has a claim on the bus now.
        await anyio.to_thread.run_sync(anyio.run, enter)


@pytest.mark.parametrize(
    ("port", "error"), [(-1, ValueError), (65_536, ValueError), (1.0, TypeError), (True, TypeError)]
)
def test_an_invalid_port_is_refused_at_once(bus: Bus, port: Any, error: type[Exception]) -> None:
    with pytest.raises(error):
        FoxgloveServer(bus, port)


# Strangers


def status_of(address: str, origin: str | None, host: str | None = None) -> int:
    """The status that a page of this origin gets when it connects; 101 if it is let in."""
    opening = {
        "origin": None if origin is None else Origin(origin),
        "additional_headers": None if host is None else {"Host": host},
        "subprotocols": [Subprotocol("foxglove.sdk.v1")],
        "proxy": None,
    }
    try:
        with connect(address, **opening):  # type: ignore[arg-type]
            return 101
    except InvalidStatus as error:
        return error.response.status_code


@pytest.mark.every_loop
async def test_of_web_pages_only_the_application_may_connect(bus: Bus) -> None:
    async with FoxgloveServer(bus, 0) as server:

        async def status(origin: str | None) -> int:
            return await anyio.to_thread.run_sync(status_of, server.address, origin)

        for origin in (None, "https://app.foxglove.dev", "file://"):
            assert await status(origin) == 101
        for origin in ("http://evil.example", "https://evil.app.foxglove.dev", "http://app.foxglove.dev", "null"):
            assert await status(origin) == 403
        assert server.refused == 4


async def test_other_pages_are_named_by_the_user(bus: Bus) -> None:
    async with FoxgloveServer(bus, 0, origins=["https://robot.example"]) as server:
        assert await anyio.to_thread.run_sync(status_of, server.address, "https://robot.example") == 101
        assert await anyio.to_thread.run_sync(status_of, server.address, "https://app.foxglove.dev") == 403
    with pytest.raises(ValueError, match=r"robot\.example"):
        FoxgloveServer(bus, 0, origins=["robot.example"])


def sockets() -> tuple[list[list[str]], set[str]]:
    """The rows of the system's table of sockets, and the names of those of this process."""
    own = set()
    for entry in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):
            own.add(str(entry.readlink()))
    return [row.split() for row in Path("/proc/self/net/tcp").read_text().splitlines()[1:]], own


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells what listens in a file")
async def test_the_library_itself_listens_where_no_page_finds_it(bus: Bus) -> None:
    async with FoxgloveServer(bus, 0) as server:
        rows, own = await anyio.to_thread.run_sync(sockets)
        # The state 0A is that of a socket that listens; addresses are in the order of the machine.
        listening = [row[1] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in own]
        front = f"0100007F:{int(server.address.rpartition(':')[2]):04X}"
        assert front in listening
        [hidden] = [place for place in listening if place != front]
        assert hidden[6:8] == "7F"
        assert hidden[:8] != "0100007F"


async def test_connections_have_a_bound_and_those_that_say_nothing_count(bus: Bus) -> None:
    async with FoxgloveServer(bus, 0) as server, AsyncExitStack() as stack:
        port = int(server.address.rpartition(":")[2])
        for _ in range(MAX_CONNECTIONS):
            await stack.enter_async_context(await anyio.connect_tcp("127.0.0.1", port))
        last = await stack.enter_async_context(await anyio.connect_tcp("127.0.0.1", port))
        with pytest.raises(anyio.EndOfStream):
            await last.receive()
        assert server.refused == 1


async def test_no_message_of_a_stranger_ends_the_server(bus: Bus) -> None:
    bus.publish(static("base", "lidar", 2.0, stamp=START))
    draw = random.Random(34)
    words = ["op", "subscribe", "subscriptions", "id", "channelId", "unsubscribe", "\ud7ff", "getParameters", ""]

    def value(depth: int) -> Any:
        kind = draw.randrange(6 if depth else 4)
        if kind < 4:
            return [draw.choice(words), draw.randrange(-(2**70), 2**70), draw.choice([None, True, 1e308]), -1][kind]
        if kind == 4:
            return [value(depth - 1) for _ in range(draw.randrange(4))]
        return {draw.choice(words): value(depth - 1) for _ in range(draw.randrange(4))}

    def send_all(address: str) -> None:
        for _ in range(20):
            # It reads nothing, and the server answers each message that is none.
            with (
                connect(address, subprotocols=[Subprotocol("foxglove.sdk.v1")], proxy=None, max_queue=None) as client,
                suppress(ConnectionClosed),
            ):
                for _ in range(20):
                    client.send(json.dumps({"op": draw.choice(words), draw.choice(words): value(3)}))
                    client.send(json.dumps(value(3)))
                    client.send(draw.randbytes(draw.randrange(40)))

    async with FoxgloveServer(bus, 0) as server:
        await anyio.to_thread.run_sync(send_all, server.address)
        async with application(server) as app:
            app.subscribe()
            assert [each[2] for each in await anyio.to_thread.run_sync(app.transforms)] == ["lidar"]
