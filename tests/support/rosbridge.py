"""A server that speaks as much of the rosbridge protocol as links do, and does what a test tells it."""

import json
import shutil
import subprocess
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple, Unpack

import anyio
import anyio.abc
import anyio.to_thread
import cbor2
import pytest
from support.processes import until
from wsproto import ConnectionType, WSConnection
from wsproto.events import (
    AcceptConnection,
    BytesMessage,
    CloseConnection,
    Event,
    Ping,
    Pong,
    RejectConnection,
    Request,
    TextMessage,
)
from wsproto.utilities import LocalProtocolError

from tfbus import Bus, TransformStamped
from tfbus.links.ros import RosOptions
from tfbus.links.ros.messages import as_mapping, decode_mapping
from tfbus.links.rosbridge import RosbridgeLink
from tfbus.links.rosbridge.rosbridge_link import Encoding
from tfbus.tf_message import encode

_GONE = (anyio.EndOfStream, anyio.BrokenResourceError, anyio.ClosedResourceError, LocalProtocolError)


class Client:
    """One connection of the server."""

    def __init__(self, stream: anyio.abc.SocketStream) -> None:
        self.stream = stream
        self.connection = WSConnection(ConnectionType.SERVER)
        self.subscriptions: dict[str, str] = {}
        self.sending = anyio.Lock()

    async def send(self, event: Event) -> None:
        data = self.connection.send(event)
        async with self.sending:
            await self.stream.send(data)


class RosbridgeServer:
    """Serves one topic tree: what a client publishes goes to all that have subscribed, itself included.

    As the real one, it has each topic decoded or as bytes, as its first client wants it, and nothing for the others.

    Parameters
    ----------
    encodings : collection of str
        The server knows these, and answers in JSON to others.

    Attributes
    ----------
    requests : list of dict
        All that clients have asked for, each with the time of the loop as ``"at"``.
    attempts : list of tuple
        The path of each attempt to connect, and the time of the loop.
    pongs : list of bytes
        The answers to its pings.
    absent, silent, only_sends : bool
        Whether it refuses to talk, answers nothing, or sends without reading.
    refuses : set of str
        Topics that it lets nobody advertise or publish to, without a word.
    """

    def __init__(self, encodings: tuple[str, ...] = ("cbor-raw", "cbor")) -> None:
        self.encodings = encodings
        self.clients: list[Client] = []
        self.requests: list[dict[str, Any]] = []
        self.attempts: list[tuple[str, float]] = []
        self.pongs: list[bytes] = []
        self.latched: dict[str, tuple[TransformStamped, ...]] = {}
        self.port = 0
        self.absent = False
        self.silent = False
        self.only_sends = False
        self.refuses: set[str] = set()

    @property
    def url(self) -> str:
        return f"ws://127.0.0.1:{self.port}"

    def operations(self, name: str) -> list[str]:
        """The topics of all requests of a kind."""
        return [request["topic"] for request in self.requests if request["op"] == name]

    async def say(self, *samples: TransformStamped, topic: str = "/tf") -> None:
        """Publish as a node of ROS 2 does."""
        for client in list(self.clients):
            if topic in client.subscriptions and self.passes(topic, client.subscriptions[topic]):
                await client.send(self.encoded(topic, samples, client.subscriptions[topic]))

    def passes(self, topic: str, encoding: str) -> bool:
        """Whether a topic is decoded if an encoding needs that, and not if that wants the bytes."""
        first = next(each.subscriptions[topic] for each in self.clients if topic in each.subscriptions)
        return "cbor-raw" not in self.encodings or (first == "cbor-raw") == (encoding == "cbor-raw")

    def encoded(self, topic: str, samples: tuple[TransformStamped, ...], encoding: str) -> Event:
        envelope: dict[str, Any] = {"op": "publish", "topic": topic}
        fields = {"transforms": list(map(as_mapping, samples))}
        if encoding == "cbor-raw" and encoding in self.encodings:
            return BytesMessage(cbor2.dumps({**envelope, "msg": {"secs": 1, "nsecs": 2, "bytes": encode(samples)}}))
        if encoding == "cbor" and encoding in self.encodings:
            return BytesMessage(cbor2.dumps({**envelope, "msg": fields}))
        return TextMessage(json.dumps({**envelope, "msg": fields}))

    async def say_anything(self, *contents: str | bytes) -> None:
        for client in list(self.clients):
            for content in contents:
                # A client may leave because of it.
                with suppress(*_GONE):
                    await client.send(TextMessage(content) if isinstance(content, str) else BytesMessage(content))

    async def cut(self) -> None:
        """Break all connections."""
        for client in list(self.clients):
            await anyio.aclose_forcefully(client.stream)

    async def handle(self, stream: anyio.abc.SocketStream) -> None:
        client = Client(stream)
        self.clients.append(client)
        try:
            async with stream:
                text = ""
                while True:
                    while self.only_sends:
                        await client.send(TextMessage("{}"))
                        await anyio.sleep(0.5)
                    client.connection.receive_data(await stream.receive())
                    for event in client.connection.events():
                        if self.silent:
                            continue
                        if isinstance(event, Request):
                            self.attempts.append((event.target, anyio.current_time()))
                            await client.send(RejectConnection(status_code=404) if self.absent else AcceptConnection())
                        elif isinstance(event, Pong):
                            self.pongs.append(bytes(event.payload))
                        elif isinstance(event, Ping | CloseConnection):
                            await client.send(event.response())
                        elif isinstance(event, TextMessage):
                            text += event.data
                            if event.message_finished:
                                await self.answer(client, json.loads(text))
                                text = ""
        except _GONE:
            pass
        finally:
            self.clients.remove(client)

    async def answer(self, client: Client, request: dict[str, Any]) -> None:
        self.requests.append({**request, "at": anyio.current_time()})
        topic = request["topic"]
        if request["op"] == "subscribe":
            client.subscriptions[topic] = request["compression"]
            if topic in self.latched:
                await client.send(self.encoded(topic, self.latched[topic], request["compression"]))
        elif request["op"] == "unsubscribe":
            del client.subscriptions[topic]
        elif request["op"] == "publish" and topic not in self.refuses:
            samples = [sample for sample in decode_mapping(request["msg"]).samples if sample is not None]
            await self.say(*samples, topic=topic)


@asynccontextmanager
async def rosbridge_server(encodings: tuple[str, ...] = ("cbor-raw", "cbor")) -> AsyncIterator[RosbridgeServer]:
    """Such a server, listening at the loopback."""
    server = RosbridgeServer(encodings)
    async with await anyio.create_tcp_listener(local_host="127.0.0.1") as listener, anyio.create_task_group() as tasks:
        server.port = listener.extra(anyio.abc.SocketAttribute.local_port)
        tasks.start_soon(listener.serve, server.handle)
        yield server
        tasks.cancel_scope.cancel()


class Joined(NamedTuple):
    """A link that has joined a server."""

    server: RosbridgeServer
    bus: Bus
    link: RosbridgeLink

    def not_sent(self) -> dict[str, int]:
        return dict(self.link.statistics().not_sent)

    def published(self, topic: str) -> list[dict[str, Any]]:
        """The transforms that the server has got on a topic."""
        said = [each for each in self.server.requests if each["op"] == "publish" and each["topic"] == topic]
        return [row for each in said for row in each["msg"]["transforms"]]

    def times(self, operation: str, topic: str) -> list[float]:
        """The times at which the server got some requests."""
        return [each["at"] for each in self.server.requests if (each["op"], each["topic"]) == (operation, topic)]


@asynccontextmanager
async def joined(
    encodings: tuple[str, ...] = ("cbor-raw", "cbor"), encoding: Encoding = "cbor", **options: Unpack[RosOptions]
) -> AsyncIterator[Joined]:
    """A link of a bus of its own that sends, when the server has got its requests."""
    async with rosbridge_server(encodings) as server:
        with Bus() as bus:
            async with RosbridgeLink(bus, server.url, encoding=encoding, **options) as link:
                await until(lambda: len(server.operations("advertise")) == 1)
                yield Joined(server, bus, link)


# A client of rosbridge that is not ours: npm's roslib, in a process of its own

_PROGRAM = """
import * as roslib from "roslib";
const { Ros, Topic, TFClient, ROS2TFClient } = roslib.default ?? roslib;
const say = (fact) => console.log(JSON.stringify(fact));
const [url, client] = process.argv.slice(2);
const ros = new Ros({ url, groovyCompatibility: client !== "service" });
ros.on("error", (error) => { say({ error: String(error) }); process.exit(1); });
ros.on("connection", () => {
  for (const name of ["/tf_static", "/tf"]) {
    const topic = new Topic({ ros, name, messageType: "tf2_msgs/TFMessage" });
    topic.subscribe((message) => say({ topic: name, transforms: message.transforms }));
  }
  if (client !== "") {
    const tf = new (client === "ROS2TFClient" ? ROS2TFClient : TFClient)({ ros, fixedFrame: "map" });
    for (const frame of ["base", "/laser"]) {
      tf.subscribe(frame, (transform) => say({ frame: frame.replace("/", ""), transform }));
    }
  }
  say({ connected: true });
});
"""


def install_roslib(folder: Path, *packages: str) -> None:
    """Install roslib, or these packages of npm, into a folder; skips the test if they cannot be had."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        pytest.skip("roslib needs node and npm")
    (folder / "package.json").write_text('{"private": true, "type": "module"}')
    command = [npm, "install", *(packages or ("roslib",)), "--no-audit", "--no-fund"]
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
    except subprocess.TimeoutExpired:
        pytest.skip("npm does not answer")
    if done.returncode:
        pytest.skip(f"npm cannot install roslib: {done.stderr[-200:]}")
    (folder / "listen.js").write_text(_PROGRAM)


@asynccontextmanager
async def roslib_client(folder: Path, url: str, client: str = "") -> AsyncIterator[list[dict[str, Any]]]:
    """The transforms that roslib, subscribed to ``/tf`` and ``/tf_static``, has heard, and those of a client of tf."""
    heard: list[dict[str, Any]] = []
    async with (
        await anyio.open_process(["node", "listen.js", url, client], cwd=folder, stderr=None) as process,
        anyio.create_task_group() as tasks,
    ):
        connected = anyio.Event()

        async def read() -> None:
            rest = b""
            assert process.stdout is not None
            async for piece in process.stdout:
                *lines, rest = (rest + piece).split(b"\n")
                for line in filter(lambda line: line.startswith(b"{"), lines):
                    fact = json.loads(line)
                    assert "error" not in fact, fact
                    if "connected" in fact:
                        connected.set()
                    else:
                        heard.append(fact)

        tasks.start_soon(read)
        try:
            with anyio.fail_after(30):
                await connected.wait()
            yield heard
        finally:
            process.kill()
            tasks.cancel_scope.cancel()
