import json
import math
from types import SimpleNamespace
from typing import Any

import anyio
import anyio.lowlevel
import pytest

pytest.importorskip("cbor2", reason='pip install "tfbus[rosbridge]"')

from support.processes import until
from support.rosbridge import rosbridge_server
from support.samples import moving, static

from tfbus import SimulatedClock
from tfbus.links._carrier import Carrier, SendReport
from tfbus.links._entries import OutgoingBatch
from tfbus.links._outbox import Turn
from tfbus.links._receive_queue import Presence, Received
from tfbus.links.ros.messages import as_mapping
from tfbus.links.ros.ros_link import RosMessage
from tfbus.links.ros.settings import settings_of
from tfbus.links.rosbridge import rosbridge_link
from tfbus.links.rosbridge.protocol import Incoming
from tfbus.links.rosbridge.rosbridge_link import Encoding, RosbridgeCarrier
from tfbus.tf_message import MalformedMessageError

AS_A_CARRIER: type[Carrier] = RosbridgeCarrier
"""That it fits the protocol, mypy says."""

pytestmark = pytest.mark.anyio


async def test_a_server_that_falls_silent_is_left_and_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rosbridge_link, "SILENCE", 0.2)
    monkeypatch.setattr(rosbridge_link, "FIRST_PAUSE", 0.01)
    items: list[Received] = []
    errors: list[Exception] = []
    async with rosbridge_server() as server:
        carrier = RosbridgeCarrier(server.url, settings_of({}))
        await carrier.open(items.append, SendReport(errors.append))
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(carrier.run)
            await until(lambda: len(server.operations("subscribe")) == 2)
            server.silent = True
            await until(lambda: len(items) == 2)
            server.silent = False
            await until(lambda: len(items) == 3)
            tasks.cancel_scope.cancel()
        await carrier.close()
    assert [item.content for item in items] == [Presence.JOINED, Presence.LEFT, Presence.JOINED]
    assert "nothing has come for 0.2 s" in str(errors[0])


async def test_a_carrier_that_never_opened_closes() -> None:
    await RosbridgeCarrier("ws://127.0.0.1:1", settings_of({})).close()


async def test_attempts_to_come_back_are_ever_further_apart_up_to_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []

    class Refused(RosbridgeCarrier):
        async def _connect(self) -> None:
            if len(pauses) < 8:
                raise OSError("refused")
            self._socket = found

    async def sleep(seconds: float) -> None:
        pauses.append(seconds)

    found: Any = object()
    carrier = Refused("ws://127.0.0.1:1", settings_of({}))
    told: list[str] = []
    carrier._report = SendReport(lambda error: told.append(str(error)))
    monkeypatch.setattr(anyio, "sleep", sleep)
    await carrier._come_back()
    assert told == ["ws://127.0.0.1:1: refused"] * 7
    # Each is between a half of it and the whole, so that not all clients of a server come in one instant.
    for pause, longest in zip(pauses, [0.25, 0.5, 1.0, 2.0, 4.0, 5.0, 5.0, 5.0], strict=True):
        assert longest / 2 <= pause <= longest
    assert len(set(pauses[5:])) == 3


class Alone:
    """A carrier that was not opened, what it could not send, and what it asks its server for."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, waits: list[bool] | None = None, encoding: Encoding = "cbor"
    ) -> None:
        self.errors: list[Exception] = []
        self.pauses: list[float] = []
        self.items: list[Received] = []
        self._waits = iter([] if waits is None else waits)
        settings = settings_of({"joint_states": print, "clock": SimulatedClock(), "robot_description": print})
        self.carrier = RosbridgeCarrier("ws://127.0.0.1:1", settings, encoding, lambda: next(self._waits))
        self.carrier._report = self.report = SendReport(self.errors.append)
        self.carrier._receive = self.items.append
        self._left = None if waits is None else len(waits)
        monkeypatch.setattr(anyio, "sleep", self._sleep)

    async def _sleep(self, seconds: float) -> None:
        if len(self.pauses) == self._left:
            raise EOFError
        self.pauses.append(seconds)

    async def connect(self, monkeypatch: pytest.MonkeyPatch, now: float) -> None:
        """Find a server at a time."""

        async def found(*_: object) -> object:
            return object()

        monkeypatch.setattr(rosbridge_link, "monotonic", lambda: now)
        monkeypatch.setattr(rosbridge_link, "WebSocket", SimpleNamespace(connect=found))
        await self.carrier._connect()

    def encodings(self) -> dict[str, str]:
        """The encoding that is asked for of each topic."""
        taken = [json.loads(text) for text in self.carrier._requests]
        return {request["topic"]: request["compression"] for request in taken if request["op"] == "subscribe"}

    def requests(self) -> list[tuple[str, str]]:
        """Operation and topic of each request since the last call."""
        taken = [json.loads(text) for text in self.carrier._requests]
        self.carrier._requests.clear()
        return [(request["op"], request["topic"]) for request in taken]


MOVING, STATIC = (Incoming(topic, {"transforms": []}, "cbor") for topic in ("/tf", "/tf_static"))
_ROW = as_mapping(static("map", "lidar"))
_ROW["header"]["stamp"] = {"sec": 5, "nanosec": 0}
OF_ROS_2 = Incoming("/tf_static", {"transforms": [_ROW]}, "cbor")


async def test_each_topic_has_its_kind_and_only_what_comes_again_may_be_dropped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    alone = Alone(monkeypatch)
    for topic in ("/tf", "/tf_static", "/joint_states", "/clock", "/robot_description"):
        alone.carrier._take(Incoming(topic, "content", "cbor"), 7)
    with pytest.raises(MalformedMessageError, match="'/other', which nobody asked for"):
        alone.carrier._take(Incoming("/other", "content", "cbor"), 7)
    url = "ws://127.0.0.1:1"
    assert alone.items == [
        Received(url, RosMessage("content", static=False, authority="rosbridge"), 7, moving=True),
        Received(url, RosMessage("content", static=True, authority="rosbridge"), 7),
        Received(url, RosMessage("content", static=False, authority="", joints=True), 7, moving=True),
        Received(url, RosMessage("content", static=False, authority="", clock=True), 7, moving=True),
        Received(url, RosMessage("content", static=False, authority="", description=True), 7),
    ]
    assert alone.carrier._heard_moving
    alone.carrier._take(Incoming("", "status: no such type", "none"), 7)
    assert [str(error) for error in alone.errors] == [f"{url} says: status: no such type"]
    assert len(alone.items) == 5


@pytest.mark.parametrize(("encoding", "joints"), [("cbor", "none"), ("cbor-raw", "cbor-raw")])
async def test_what_is_latched_is_asked_for_first_and_joints_never_in_decoded_cbor(
    encoding: Encoding, joints: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = Alone(monkeypatch, encoding=encoding)
    await alone.connect(monkeypatch, 100.0)
    others = {"/tf": encoding, "/clock": encoding, "/robot_description": encoding}
    assert alone.encodings() == {"/tf_static": encoding, "/joint_states": joints, **others}
    requests = alone.requests()
    assert requests[:2] == [("subscribe", "/tf_static"), ("subscribe", "/tf")]
    assert requests[5:] == [("advertise", "/tf_static")]
    assert [item.content for item in alone.items] == [Presence.JOINED]
    # In JSON, from a server that has not the bytes.
    alone.carrier._take(MOVING._replace(encoding="none"), 7)
    assert alone.requests() == (again("/tf_static") + again("/tf")) * (encoding == "cbor-raw")


async def test_what_waited_for_a_server_that_has_gone_is_not_sent_to_the_next_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    alone = Alone(monkeypatch)
    await alone.connect(monkeypatch, 100.0)
    first = list(alone.carrier._requests)
    assert alone.carrier._publish([moving("map", "a", 1)], static=False)
    await alone.connect(monkeypatch, 200.0)
    assert list(alone.carrier._requests) == first
    assert not alone.carrier._moving


async def test_static_frames_are_sent_again_to_a_server_that_is_back(monkeypatch: pytest.MonkeyPatch) -> None:
    alone = Alone(monkeypatch)
    await alone.connect(monkeypatch, 100.0)
    kept = OutgoingBatch(bytes(16), 1, [static("map", "lidar")])
    alone.carrier.send(Turn([], {"lidar": kept}))
    # Sent, and then the server goes.
    text, alone.carrier._changed_statics = alone.carrier._changed_statics, None
    await alone.connect(monkeypatch, 200.0)
    assert alone.carrier._changed_statics == text
    assert "lidar" in str(text)


@pytest.mark.parametrize(
    ("of_ros2", "published", "held"), [(True, True, True), (False, True, False), (True, False, False)]
)
async def test_after_a_break_moving_frames_are_held_back_while_ros_2_has_the_former_publisher(
    of_ros2: bool, published: bool, held: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = Alone(monkeypatch)
    await alone.connect(monkeypatch, 100.0)
    if of_ros2:
        alone.carrier._take(OF_ROS_2, 7)
    # That the server is of ROS 2 is not forgotten.
    alone.carrier._take(STATIC, 7)
    sample = [moving("map", "a", 1)]
    if published:
        assert alone.carrier._publish(sample, static=False)
    alone.carrier._broken_at = 150.0
    await alone.connect(monkeypatch, 155.0)
    assert alone.carrier._publish(sample, static=False) is not held
    # What a server of ROS 2 gives at first may be of this link itself.
    for later, still in ((rosbridge_link.ECHO_TIME, held), (rosbridge_link.ECHO_TIME + 0.1, False)):
        monkeypatch.setattr(rosbridge_link, "monotonic", lambda now=155.0 + later: now)
        alone.carrier._take(STATIC, 7)
        alone.carrier._take(MOVING, 7)
        assert alone.carrier._publish(sample, static=False) is not still


@pytest.mark.parametrize("waits", [rosbridge_link.LINGER_TIME - 0.1, rosbridge_link.LINGER_TIME])
async def test_moving_frames_are_held_back_for_so_long_after_the_break(
    waits: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = Alone(monkeypatch)
    await alone.connect(monkeypatch, 100.0)
    alone.carrier._take(OF_ROS_2, 7)
    assert alone.carrier._publish([moving("map", "a", 1)], static=False)
    alone.carrier._broken_at = 150.0
    await alone.connect(monkeypatch, 150.0 + waits)
    taken = alone.carrier._publish([moving("map", "a", 1)], static=False)
    assert taken is (waits >= rosbridge_link.LINGER_TIME)


async def test_a_server_is_pinged_until_it_has_been_silent_for_too_long(monkeypatch: pytest.MonkeyPatch) -> None:
    alone, pings, now = Alone(monkeypatch, []), list[float](), 1_000.0
    alone._left = None

    async def ping() -> None:
        pings.append(now)

    def pass_time() -> float:
        nonlocal now
        now += rosbridge_link.SILENCE / 4
        return now

    monkeypatch.setattr(rosbridge_link, "monotonic", pass_time)
    socket: Any = SimpleNamespace(heard=1_000.0, ping=ping)
    with pytest.raises(ConnectionResetError, match="nothing has come for 10 s"):
        await alone.carrier._keep_alive(socket)
    assert alone.pauses == [rosbridge_link.SILENCE / 4] * 5
    assert len(pings) == 4


class Socket:
    """An open connection to a server that says nothing."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, str]] = []
        self.closed = False
        self.heard = math.inf

    async def ping(self) -> None:
        """It is heard for ever."""

    async def send(self, text: str) -> None:
        await anyio.lowlevel.checkpoint()
        request = json.loads(text)
        self.sent.append((request["op"], request["topic"]))

    async def receive(self) -> str:
        await anyio.sleep_forever()
        raise AssertionError

    async def close(self) -> None:
        await anyio.lowlevel.checkpoint()
        self.closed = True


async def test_what_waits_is_sent_at_the_end_of_a_cancelled_link_too() -> None:
    carrier, socket = RosbridgeCarrier("ws://127.0.0.1:1", settings_of({})), Socket()
    carrier._socket = socket  # type: ignore[assignment]
    assert carrier._publish([moving("map", "a", 1)], static=False)
    with anyio.CancelScope() as scope:
        scope.cancel()
        await carrier.close()
    assert socket.sent == [("advertise", "/tf"), ("publish", "/tf")]
    assert socket.closed


async def test_a_carrier_talks_until_its_link_ends_and_then_ends_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rosbridge_link, "_CLOSING_TIME", 1_000.0)
    monkeypatch.setattr(rosbridge_link, "_MISS_PERIODS", (0.0, 1_000.0))
    carrier, socket = RosbridgeCarrier("ws://127.0.0.1:1", settings_of({}), lookup_waits=lambda: True), Socket()
    opened: Any = socket
    carrier._socket = opened
    # A time of holding back that is over.
    carrier._held_until = 0.0
    with anyio.fail_after(20):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(carrier.run)
            # For the lookup that waits, and because of that time.
            asked = again("/tf_static") + 2 * again("/tf")
            await until(lambda: sorted(socket.sent) == sorted(asked))
            for _ in range(2):
                socket.sent.clear()
                assert carrier._publish([moving("map", "a", 1)], static=False)
                await until(lambda: socket.sent[-1:] == [("publish", "/tf")])
            tasks.cancel_scope.cancel()
    assert carrier._socket is opened, "what is left is sent when it closes"
    assert not socket.closed


def again(topic: str) -> list[tuple[str, str]]:
    return [("unsubscribe", topic), ("subscribe", topic)]


async def test_moving_frames_are_refused_while_the_server_is_away_or_hides_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    alone = Alone(monkeypatch)
    samples = [moving("map", "a", 1), moving("map", "b", 1)]
    assert alone.carrier._publish(samples, static=False) is False
    alone.carrier._socket = socket = object()  # type: ignore[assignment]
    alone.carrier._held_until = math.inf
    assert alone.carrier._publish(samples, static=False) is False
    assert alone.report.not_sent == {"not connected": 2, "rejoining": 2}
    assert ["is not connected" in str(alone.errors[0]), "which hides others" in str(alone.errors[1])] == [True, True]
    alone.carrier._held_until = -math.inf
    # The topic is advertised with the first ones; the oldest give way.
    for _ in range(rosbridge_link.MOST_QUEUED):
        assert alone.carrier._publish(samples, static=False) is True
    assert (alone.requests(), len(alone.errors)) == ([("advertise", "/tf")], 2)
    assert alone.carrier._publish(samples[:1], static=False) is True
    assert alone.report.not_sent["congested"] == 2
    assert [count for _, count in alone.carrier._moving] == [2] * (rosbridge_link.MOST_QUEUED - 1) + [1]
    assert alone.carrier._socket is socket


async def test_static_frames_are_asked_for_ever_more_seldom_while_a_lookup_waits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    alone = Alone(monkeypatch, [True] * 6 + [False, True])
    alone.carrier._heard_moving = True
    with pytest.raises(EOFError):
        await alone.carrier._ask_again()
    assert alone.pauses == [1.0, 2.0, 4.0, 8.0, 16.0, 16.0, 16.0, 1.0]
    assert alone.requests() == again("/tf_static") * 7


@pytest.mark.parametrize(
    ("heard", "advertised", "asks"), [(False, False, True), (True, False, False), (False, True, False)]
)
async def test_moving_frames_are_asked_for_again_if_none_has_come_and_none_is_sent(
    monkeypatch: pytest.MonkeyPatch, heard: bool, advertised: bool, asks: bool
) -> None:
    alone = Alone(monkeypatch, [True])
    alone.carrier._heard_moving, alone.carrier._advertised = heard, advertised
    with pytest.raises(EOFError):
        await alone.carrier._ask_again()
    assert alone.requests() == again("/tf_static") + again("/tf") * asks


async def test_the_time_of_holding_back_ends_with_a_new_subscription(monkeypatch: pytest.MonkeyPatch) -> None:
    alone = Alone(monkeypatch)
    await alone.carrier._end_holding()
    assert (alone.pauses, alone.requests()) == ([0.0], [])
    monkeypatch.setattr(rosbridge_link, "monotonic", lambda: 100.0)
    alone.carrier._held_until = 107.5
    await alone.carrier._end_holding()
    assert (alone.pauses[1:], alone.requests()) == ([7.5], again("/tf"))
    assert alone.carrier._held_until == -math.inf
