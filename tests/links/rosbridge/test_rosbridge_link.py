import json
from contextlib import AsyncExitStack
from random import Random
from typing import Any, Literal

import pytest

pytest.importorskip("cbor2", reason='pip install "tfbus[rosbridge]"')

import anyio.lowlevel
import cbor2
from support.processes import until
from support.rosbridge import rosbridge_server
from support.samples import moving, static
from support.wires import latched

from tfbus import Buffer, Bus, PeerJoined, PeerLost, SimulatedClock
from tfbus.links.ros.messages import as_mapping
from tfbus.links.rosbridge import RosbridgeLink, rosbridge_link
from tfbus.links.rosbridge.websocket import WebSocket
from tfbus.tf_message import encode

pytestmark = pytest.mark.anyio


@pytest.mark.parametrize(
    ("wanted", "known", "asked"),
    [
        ("cbor", ("cbor-raw", "cbor"), "cbor"),
        ("cbor", (), "cbor"),
        ("cbor-raw", ("cbor-raw", "cbor"), "cbor-raw"),
        ("cbor-raw", ("cbor",), "cbor"),
    ],
)
async def test_transforms_pass_both_ways_in_an_encoding_that_the_server_has(
    wanted: Literal["cbor", "cbor-raw"], known: tuple[str, ...], asked: str
) -> None:
    async with rosbridge_server(known) as server:
        server.latched["/tf_static"] = (static("map", "lidar", 2.0, 3),)
        heard: list[Any] = []
        with Bus() as bus:
            bus.publish(static("map", "camera", 1.0, 4))
            bus.subscribe(lambda batch: heard.extend(batch))
            async with RosbridgeLink(bus, server.url, encoding=wanted) as link:
                await until(lambda: link.statistics().received_samples == 1)
                assert link.peers == (server.url,)
                await until(lambda: len(server.operations("publish")) == 1)
                await server.say(moving("map", "base", 5))
                await until(lambda: link.statistics().received_samples == 2)
                bus.publish([moving("base", "arm", 6, 2.5), static("base", "imu", 3.0, 7)])
                await until(lambda: len(server.operations("publish")) == 3)
                assert server.operations("subscribe")[:2] == ["/tf_static", "/tf"]
                await until(lambda: set(server.clients[0].subscriptions.values()) == {asked})
                # The server has given back all three messages.
                await until(lambda: link.statistics().duplicates >= 4)
                assert link.statistics().rejected == {}
        assert heard[1:3] == [
            static("map", "lidar", 2.0, 3, "rosbridge"),
            moving("map", "base", 5, authority="rosbridge"),
        ]
        assert len(heard) == 5, "what the server gives back is no news"
        said = [request["msg"]["transforms"] for request in server.requests if request["op"] == "publish"]
        # Static frames go before moving ones, as they are fewer and latched.
        assert [[row["child_frame_id"] for row in rows] for rows in said] == [["camera"], ["camera", "imu"], ["arm"]]
        advertised = [request for request in server.requests if request["op"] == "advertise"]
        assert {request["topic"]: request["latch"] for request in advertised} == {"/tf": False, "/tf_static": True}
        assert len(advertised) == 2


@pytest.mark.parametrize("first", [True, False])
async def test_a_client_that_wants_json_hears_the_same_topics_as_a_link(first: bool) -> None:
    async with rosbridge_server() as server, AsyncExitStack() as stack:
        bus = stack.enter_context(Bus())
        if first:
            link = await stack.enter_async_context(RosbridgeLink(bus, server.url))
            await until(lambda: len(server.operations("subscribe")) == 2)
        page = await WebSocket.connect(server.url, 10_000, 5.0)
        stack.push_async_callback(page.close)
        await page.send(json.dumps({"op": "subscribe", "topic": "/tf", "compression": "none"}))
        await until(lambda: "none" in [request.get("compression") for request in server.requests])
        if not first:
            link = await stack.enter_async_context(RosbridgeLink(bus, server.url))
            await until(lambda: len(server.operations("subscribe")) == 3)
        await server.say(moving("map", "base", 5))
        assert json.loads(await page.receive())["msg"]["transforms"][0]["child_frame_id"] == "base"
        await until(lambda: link.statistics().received_samples == 1)


@pytest.mark.thorough
async def test_after_a_break_the_link_is_back_with_its_static_frames_and_hears_those_of_ros() -> None:
    async with rosbridge_server() as server:
        server.latched["/tf_static"] = (static("map", "lidar", 2.0, 3),)
        with Bus() as bus, bus.events() as events:
            bus.publish(static("map", "camera"))
            async with RosbridgeLink(bus, server.url, drop_lost=True) as link:
                await until(lambda: len(latched(bus)) == 2)
                await until(lambda: server.operations("publish") == ["/tf_static"])
                await server.cut()
                await until(lambda: link.peers == ())
                assert set(latched(bus)) == {"camera"}
                bus.publish(moving("map", "base", 5))
                await until(lambda: link.peers != ())
                await until(lambda: len(latched(bus)) == 2)
                await until(lambda: server.operations("publish") == ["/tf_static"] * 2)
                assert link.statistics().not_sent == {"not connected": 1}
                bus.publish(moving("map", "base", 6))
                await until(lambda: server.operations("publish")[-1] == "/tf")
            told = [type(event) for event in iter(events.queue.get, None) if isinstance(event, PeerJoined | PeerLost)]
        assert told == [PeerJoined, PeerLost, PeerJoined]


async def test_garbage_is_counted_by_reason_and_ends_nothing() -> None:
    async with rosbridge_server() as server:
        with Bus() as bus:
            async with RosbridgeLink(bus, server.url) as link:
                await until(lambda: len(server.operations("subscribe")) == 2)
                other = {"op": "publish", "topic": "/other", "msg": {}}
                bad = {"op": "publish", "topic": "/tf", "msg": {"transforms": [{}]}}
                raw = {"op": "publish", "topic": "/tf", "msg": {"bytes": b"\x05\0\0\0"}}
                await server.say_anything("nonsense", b"\xff", "[" * 10_000, json.dumps(other), json.dumps(bad))
                await server.say_anything(cbor2.dumps(raw), json.dumps({"op": "status", "msg": "hm"}))
                await server.say(moving("map", "base", 5))
                await until(lambda: link.statistics().received_samples == 1)
                assert link.statistics().rejected == {"encoding": 4, "topic": 1, "truncated": 1}


async def test_what_a_server_says_of_itself_is_logged_in_one_line_each_and_not_without_end(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with rosbridge_server() as server:
        with Bus() as bus:
            async with RosbridgeLink(bus, server.url) as link:
                await until(lambda: len(server.operations("subscribe")) == 2)
                texts = [f"full\n2026 CRITICAL \x1b[2J {number}" for number in range(25)]
                await server.say_anything(*(json.dumps({"op": "status", "msg": text}) for text in texts * 2))
                await until(lambda: link.statistics().rejected == {"status": 10})
    said = [line for line in caplog.messages if "says: status: full" in line]
    assert len(said) == 20
    assert all(line.isprintable() for line in said)


TINY = {
    "empty": b"\x81\0",
    "one byte": b"\x81\1x",
    "no operation": b"\x81\2{}",
    "fragments": b"\x01\0" + b"\0\0" * 20_000,
}


@pytest.mark.parametrize("frames", TINY)
async def test_tens_of_thousands_of_tiny_frames_share_the_event_loop_with_others(frames: str) -> None:
    async with rosbridge_server() as server:
        with Bus() as bus:
            async with RosbridgeLink(bus, server.url) as link:
                await until(lambda: len(server.operations("subscribe")) == 2)
                count = 1 if frames == "fragments" else 20_000
                await server.clients[0].stream.send(TINY[frames] * count + b"\x80\1x" * (frames == "fragments"))
                turns, most, before = 0, 0, 0
                while before < count:
                    await anyio.lowlevel.checkpoint()
                    statistics = link.statistics()
                    seen = statistics.rejected.get("encoding", 0) + statistics.queue.pending
                    turns, most, before = turns + 1, max(most, seen - before), seen
                # In one turn, it would be all of a read.
                assert most < 5_000
                assert turns > 5
                await server.say(moving("map", "base", 5))
                await until(lambda: link.statistics().received_samples == 1)


def mutated(random: Random, message: bytes) -> bytes:
    """A message with some bytes changed, cut, doubled, or replaced by pieces that decoders do not like."""
    nasty = (
        b"\xff",
        b"\x9b",
        b"\xbb",
        b"\xdb",
        b"\xc2",
        b"\x5f",
        b"\xfb\x7f\xf0",
        b"[",
        b"{",
        b'"',
        b"1" * 5_000,
        b"NaN",
        b"1e999",
    )
    for _ in range(random.randint(1, 4)):
        at, end = sorted(random.choices(range(len(message) + 1), k=2))
        message = random.choice(
            [
                message[:at] + random.choice(nasty) + message[at:],
                message[:at] + random.choice(nasty) * random.randint(1, 300) + message[end:],
                message[:at] + random.randbytes(random.randint(1, 8)) + message[at + 1 :],
                message[:at],
                message[:at] + message[at:end] * 2 + message[end:],
            ]
        )
    return message


@pytest.mark.parametrize("cases", [150, pytest.param(5_000, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("size", [1, 100])
async def test_no_damaged_message_ends_a_link_and_each_is_counted_or_heard(cases: int, size: int) -> None:
    random = Random(cases)
    samples = [moving("map", f"frame{number}", number) for number in range(size)]
    text = json.dumps({"op": "publish", "topic": "/tf", "msg": {"transforms": list(map(as_mapping, samples))}})
    raw = {"op": "publish", "topic": "/tf", "msg": {"secs": 1, "nsecs": 2, "bytes": encode(samples)}}
    good = [text.encode(), cbor2.dumps(json.loads(text)), cbor2.dumps(raw)]
    heard: set[str] = set()
    async with rosbridge_server() as server:
        with Bus() as bus:
            bus.subscribe(lambda batch: heard.update(sample.child for sample in batch))
            async with RosbridgeLink(bus, server.url, max_frames=10**6) as link:
                await until(lambda: len(server.operations("subscribe")) == 2)
                for number in range(cases):
                    content = mutated(random, good[number % 3])
                    as_text = number % 3 == 0
                    await server.say_anything(content.decode(errors="replace") if as_text else content)
                await server.say(moving("map", "last", 5))
                await until(lambda: "last" in heard)
                assert len(server.operations("subscribe")) == 2, "it is the first connection"
                counted = link.statistics()
                assert sum(counted.rejected.values()) > 0
                assert counted.received_messages > 0


async def test_one_message_of_thousands_of_transforms_is_published_in_parts_in_its_order() -> None:
    samples = [moving("map", f"frame{number}", 5) for number in range(2_000)]
    for known in ((), ("cbor",), ("cbor", "cbor-raw")):
        async with rosbridge_server(known) as server:
            heard: list[Any] = []
            with Bus() as bus:
                bus.subscribe(heard.append)
                async with RosbridgeLink(bus, server.url, encoding="cbor-raw") as link:
                    await until(lambda: len(server.operations("subscribe")) == 2)
                    await server.say(*samples)
                    await until(lambda: link.statistics().received_samples == 2_000)
                    assert link.statistics().received_messages == 1
            assert [sample.child for batch in heard for sample in batch] == [sample.child for sample in samples]
            assert max(map(len, heard)) <= 40


@pytest.mark.thorough
async def test_a_server_that_sends_and_never_reads_is_left_and_asked_again(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for name, value in (("FIRST_PAUSE", 0.01), ("SILENCE", 0.5)):
        monkeypatch.setattr(rosbridge_link, name, value)
    async with rosbridge_server() as server:
        with Bus() as bus:
            async with RosbridgeLink(bus, server.url) as link:
                await until(lambda: len(server.operations("advertise")) == 1)
                server.only_sends = True
                # More than the buffers of TCP hold.
                for stamp in range(60):
                    bus.publish([moving("map", f"frame{number}", stamp) for number in range(1_000)])
                    await anyio.lowlevel.checkpoint()
                await until(lambda: "has read nothing for 0.5 s" in caplog.text)
                server.only_sends = False
                await until(lambda: len(server.operations("subscribe")) == 4)
                await server.say(moving("map", "base", 5))
                await until(lambda: link.statistics().received_samples == 1)


@pytest.mark.thorough
async def test_a_server_that_sends_huge_messages_is_cut_off_and_asked_again() -> None:
    async with rosbridge_server() as server:
        with Bus() as bus:
            async with RosbridgeLink(bus, server.url) as link:
                await until(lambda: len(server.operations("subscribe")) == 2)
                await server.say_anything(bytes(100_000_000))
                await until(lambda: len(server.operations("subscribe")) == 4)
                await server.say(moving("map", "base", 5))
                await until(lambda: link.statistics().received_samples == 1)


@pytest.mark.thorough
async def test_after_a_break_ros_2_forgets_the_former_publisher_before_moving_frames_go_out_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in (("FIRST_PAUSE", 0.01), ("LINGER_TIME", 0.2), ("ECHO_TIME", 60.0)):
        monkeypatch.setattr(rosbridge_link, name, value)
    async with rosbridge_server() as server:
        with Bus() as bus:
            async with RosbridgeLink(bus, server.url, encoding="cbor-raw") as link:
                # Nothing moves yet.
                await until(lambda: server.operations("advertise") == ["/tf_static"])
                bus.publish(moving("map", "base", 1))
                # It comes back, and tells that the server is of ROS 2.
                await until(lambda: link.statistics().duplicates == 1)
                await server.cut()
                await until(lambda: link.peers == ())
                await until(lambda: link.peers != ())
                bus.publish(moving("map", "base", 2))
                await until(lambda: link.statistics().not_sent == {"rejoining": 1})
                await until(lambda: server.operations("unsubscribe") == ["/tf"])
                bus.publish(moving("map", "base", 3))
                await until(lambda: server.operations("publish").count("/tf") == 2)
        assert server.operations("advertise") == ["/tf_static", "/tf", "/tf_static", "/tf"]
        assert server.operations("subscribe") == ["/tf_static", "/tf", "/tf_static", "/tf", "/tf"]


async def test_after_a_break_moving_frames_go_out_when_those_of_ros_2_come_in(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("FIRST_PAUSE", 0.01), ("LINGER_TIME", 60.0), ("ECHO_TIME", 0.0)):
        monkeypatch.setattr(rosbridge_link, name, value)
    async with rosbridge_server() as server:
        with Bus() as bus:
            async with RosbridgeLink(bus, server.url, encoding="cbor-raw") as link:
                bus.publish(moving("map", "base", 1))
                await until(lambda: link.statistics().duplicates == 1)
                await server.cut()
                await until(lambda: len(server.operations("subscribe")) == 4)
                await server.say(moving("map", "arm", 2))
                await until(lambda: link.statistics().received_samples == 1)
                bus.publish(moving("map", "base", 3))
                await until(lambda: server.operations("publish").count("/tf") == 2)
                assert server.operations("unsubscribe") == []


@pytest.mark.thorough
@pytest.mark.parametrize(("sends", "asked"), [(False, ["/tf_static", "/tf"]), (True, ["/tf_static"])])
async def test_while_a_lookup_waits_the_static_frames_are_asked_for_again(sends: bool, asked: list[str]) -> None:
    async with rosbridge_server() as server:
        with Bus() as bus, Buffer(bus) as buffer:
            async with RosbridgeLink(bus, server.url):
                await until(lambda: len(server.operations("subscribe")) == 2)
                if sends:
                    # A server that does not give it back.
                    server.clients[0].subscriptions.pop("/tf")
                    bus.publish(moving("map", "base", 5))
                    await until(lambda: "/tf" in server.operations("publish"))
                # It had come before this link did.
                server.latched["/tf_static"] = (static("map", "lidar", 2.0, 3),)
                found = await buffer.lookup("map", "lidar", timeout=10)
        assert found.transform.translation == (2.0, 0.0, 0.0)
        assert server.operations("unsubscribe") == asked


@pytest.mark.thorough
async def test_a_server_that_takes_nothing_costs_the_oldest_moving_samples_and_no_static_one() -> None:
    async with rosbridge_server() as server:
        with Bus() as bus:
            async with RosbridgeLink(bus, server.url) as link:
                await until(lambda: len(server.operations("advertise")) == 1)
                for stamp in range(1_500):
                    bus.publish(moving("map", "base", stamp))
                    # Each in a message of its own.
                    link._endpoint.send()
                bus.publish(static("map", "lidar"))
                await until(lambda: "/tf_static" in server.operations("publish"))
                await until(lambda: server.operations("publish").count("/tf") == 1_000)
                assert link.statistics().not_sent == {"congested": 500}
                stamps = [
                    request["msg"]["transforms"][0]["header"]["stamp"]["nsecs"]
                    for request in server.requests
                    if request["op"] == "publish" and request["topic"] == "/tf"
                ]
                assert stamps == list(range(500, 1_500))


async def test_a_link_that_only_listens_announces_nothing() -> None:
    async with rosbridge_server() as server:
        with Bus() as bus:
            bus.publish(static("map", "camera"))
            async with RosbridgeLink(bus, server.url, send=False, tf="/r/tf", tf_static="/r/tf_static"):
                await until(lambda: len(server.requests) == 2)
        assert server.operations("subscribe") == ["/r/tf_static", "/r/tf"]
        assert len(server.requests) == 2


async def test_positions_of_joints_go_to_who_takes_them() -> None:
    async with rosbridge_server() as server:
        taken: list[Any] = []
        with Bus() as bus:
            async with RosbridgeLink(bus, server.url, joint_states=lambda *state: taken.append(state)):
                await until(lambda: "/joint_states" in server.operations("subscribe"))
                assert server.clients[0].subscriptions["/joint_states"] == "none", (
                    "ROS 1 has no arrays of strings in CBOR"
                )
                message = {"header": {"stamp": {"sec": 0, "nanosec": 5}}, "name": ["a"], "position": [0.5]}
                await server.say_anything(json.dumps({"op": "publish", "topic": "/joint_states", "msg": message}))
                await until(lambda: taken == [({"a": 0.5}, 5)])


async def test_the_description_of_a_robot_goes_to_who_takes_it() -> None:
    async with rosbridge_server() as server:
        taken: list[str] = []
        with Bus() as bus:
            async with RosbridgeLink(bus, server.url, robot_description=taken.append) as link:
                await until(lambda: "/robot_description" in server.operations("subscribe"))
                for data in (5, "<robot/>"):
                    message = {"op": "publish", "topic": "/robot_description", "msg": {"data": data}}
                    await server.say_anything(json.dumps(message))
                await until(lambda: taken == ["<robot/>"])
                assert link.statistics().rejected == {"encoding": 1}


async def test_a_simulated_clock_follows_the_time_of_ros() -> None:
    async with rosbridge_server() as server:
        clock = SimulatedClock()
        with Bus(clock) as bus:
            async with RosbridgeLink(bus, server.url, clock=clock):
                await until(lambda: "/clock" in server.operations("subscribe"))
                message = {"clock": {"secs": 100, "nsecs": 5}}
                await server.say_anything(json.dumps({"op": "publish", "topic": "/clock", "msg": message}))
                await until(lambda: clock.now() == 100_000_000_005)


@pytest.mark.parametrize("settled", [False, True])
async def test_what_was_published_before_the_end_still_goes_out(settled: bool) -> None:
    async with rosbridge_server() as server:
        with Bus() as bus:
            async with RosbridgeLink(bus, server.url):
                # At the end, the link has not begun to write yet, or waits for something to write.
                await until(lambda: not settled or len(server.requests) == 3)
                bus.publish([moving("map", "base", 5), static("map", "camera")])
            await until(lambda: sorted(server.operations("publish")) == ["/tf", "/tf_static"])
            await until(lambda: server.clients == [])


@pytest.mark.parametrize(
    ("url", "error"), [("localhost:9090", ValueError), (9090, TypeError), ("ws://a:9090", ValueError)]
)
def test_arguments_that_are_not_valid_are_refused(url: Any, error: type[Exception]) -> None:
    with pytest.raises(error):
        RosbridgeLink(Bus(), url, tf="")
    encoding: Any = "json"
    with pytest.raises(ValueError, match="'cbor' or 'cbor-raw', not 'json'"):
        RosbridgeLink(Bus(), "ws://a", encoding=encoding)


async def test_a_server_that_is_not_there_is_an_os_error() -> None:
    with Bus() as bus, pytest.raises(OSError):
        async with RosbridgeLink(bus, "ws://127.0.0.1:1"):
            raise AssertionError
