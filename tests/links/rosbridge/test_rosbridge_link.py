import json
from contextlib import AsyncExitStack
from pathlib import Path
from random import Random
from typing import Any, Literal

import pytest

pytest.importorskip("cbor2", reason='pip install "tfbus[rosbridge]"')

import anyio
import anyio.lowlevel
import cbor2
from support.damage import damaged
from support.joint_messages import ODOMETRY, TYPES, odometry
from support.processes import until
from support.rosbridge import install_roslib, joined, rosbridge_server, roslib_client
from support.samples import moving, static
from wsproto.events import TextMessage

from tfbus import Bus, Covariance, PeerLost, PeerRejected, SimulatedClock
from tfbus._aio.websocket import WebSocket
from tfbus.links.ros import RosOptions
from tfbus.links.ros.messages import as_mapping
from tfbus.links.rosbridge import RosbridgeLink
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


async def test_garbage_is_counted_by_reason_and_ends_nothing() -> None:
    async with joined() as (server, _, link):
        other = {"op": "publish", "topic": "/other", "msg": {}}
        bad = {"op": "publish", "topic": "/tf", "msg": {"transforms": [{}]}}
        raw = {"op": "publish", "topic": "/tf", "msg": {"bytes": b"\x05\0\0\0"}}
        no_messages = ("", "[1]", "nonsense", "5", b"\xff", b"\x05", "[" * 100_000, b"\x81" * 100_000)
        await server.say_anything(*no_messages, json.dumps(other), json.dumps(bad), cbor2.dumps(raw))
        await server.say_anything(json.dumps({"op": "status", "msg": "hm"}))
        await server.say(moving("map", "base", 5))
        await until(lambda: link.statistics().received_samples == 1)
        assert link.statistics().rejected == {"encoding": 9, "topic": 1, "truncated": 1}


TINY = {
    "empty": b"\x81\0",
    "one byte": b"\x81\1x",
    "no operation": b"\x81\2{}",
    "fragments": b"\x01\0" + b"\0\0" * 6_000,
}


@pytest.mark.parametrize("frames", TINY)
async def test_thousands_of_tiny_frames_share_the_event_loop_with_others(frames: str) -> None:
    async with joined() as (server, _, link):
        count = 1 if frames == "fragments" else 6_000
        await server.clients[0].stream.send(TINY[frames] * count + b"\x80\1x" * (frames == "fragments"))
        turns, most, before = 0, 0, 0
        while before < count:
            await anyio.lowlevel.checkpoint()
            statistics = link.statistics()
            seen = statistics.rejected.get("encoding", 0) + statistics.queue.pending
            turns, most, before = turns + 1, max(most, seen - before), seen
        # In one turn, it would be all of a read.
        assert most < 3_000
        assert turns > 5
        await server.say(moving("map", "base", 5))
        await until(lambda: link.statistics().received_samples == 1)


PIECES = [b"\xff", b"\x9b", b"\xbb", b"\xdb", b"\xc2", b"\x5f", b"\xfb\x7f\xf0"]
PIECES += [b"[", b"{", b'"', b"1" * 5_000, b"NaN", b"1e999"]


@pytest.mark.parametrize("cases", [150, pytest.param(1_000, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("size", [1, 100])
async def test_no_damaged_message_ends_a_link_and_each_is_counted_or_heard(cases: int, size: int) -> None:
    random = Random(cases)
    samples = [moving("map", f"frame{number}", number) for number in range(size)]
    text = json.dumps({"op": "publish", "topic": "/tf", "msg": {"transforms": list(map(as_mapping, samples))}})
    raw = {"op": "publish", "topic": "/tf", "msg": {"secs": 1, "nsecs": 2, "bytes": encode(samples)}}
    good = [text.encode(), cbor2.dumps(json.loads(text)), cbor2.dumps(raw)]
    heard: set[str] = set()
    async with joined(max_frames=10**6) as (server, bus, link):
        bus.subscribe(lambda batch: heard.update(sample.child for sample in batch))
        for number in range(cases):
            content = damaged(random, good[number % 3], PIECES)
            await server.say_anything(content.decode(errors="replace") if number % 3 == 0 else content)
        await server.say(moving("map", "last", 5))
        await until(lambda: "last" in heard)
        assert len(server.operations("subscribe")) == 2, "it is the first connection"
        counted = link.statistics()
        assert sum(counted.rejected.values()) > 0
        assert counted.received_messages > 0


async def test_one_message_of_thousands_of_transforms_is_published_in_parts_in_its_order() -> None:
    samples = [moving("map", f"frame{number}", 5) for number in range(2_000)]
    for known in ((), ("cbor",), ("cbor", "cbor-raw")):
        heard: list[Any] = []
        async with joined(known, "cbor-raw") as (server, bus, link):
            bus.subscribe(heard.append)
            await server.say(*samples)
            await until(lambda: link.statistics().received_samples == 2_000)
            assert link.statistics().received_messages == 1
            assert [sample.child for batch in heard for sample in batch] == [sample.child for sample in samples]
            assert max(map(len, heard)) <= 40


async def test_a_link_that_only_listens_announces_nothing() -> None:
    async with rosbridge_server() as server:
        with Bus() as bus:
            bus.publish(static("map", "camera"))
            async with RosbridgeLink(bus, server.url, send=False, tf="/r/tf", tf_static="/r/tf_static"):
                await until(lambda: len(server.requests) == 2)
        assert server.operations("subscribe") == ["/r/tf_static", "/r/tf"]
        assert len(server.requests) == 2


JOINTS = {"header": {"stamp": {"sec": 0, "nanosec": 5}}, "name": ["a"], "position": [0.5]}


@pytest.mark.parametrize(
    ("topic", "option", "message", "taken"),
    [
        ("/joint_states", "joint_states", JOINTS, [({"a": 0.5}, 5)]),
        ("/robot_description", "robot_description", {"data": "<robot/>"}, [("<robot/>",)]),
    ],
)
async def test_joints_and_the_description_of_a_robot_go_to_who_takes_them(
    topic: str, option: str, message: dict[str, Any], taken: list[Any]
) -> None:
    heard: list[Any] = []
    options: Any = {option: lambda *content: heard.append(content)}
    async with joined(**options) as (server, _, link):
        for content in ({"data": 5}, message):
            await server.say_anything(json.dumps({"op": "publish", "topic": topic, "msg": content}))
        await until(lambda: heard == taken)
        assert link.statistics().rejected == {"encoding": 1}


async def test_odometry_comes_as_fields_and_as_bytes_of_either_ros() -> None:
    moved = [moving("odom", "base", stamp, 1.5, "/odom") for stamp in range(3)]
    row = as_mapping(moved[0])
    pose = {"position": row["transform"]["translation"], "orientation": row["transform"]["rotation"]}
    of_ros2 = [odometry(sample) for sample in moved[1:]]
    numbers = cbor2.CBORTag(86, Covariance.of(xyz=0.1).matrix.tobytes())
    contents = [{**row, "pose": {"pose": pose, "covariance": numbers}}, {"bytes": of_ros2[0]}]
    contents.append({"bytes": bytes(TYPES.cdr_to_ros1(of_ros2[1], ODOMETRY))})
    heard: list[Any] = []
    async with joined(odometry="/odom") as (server, bus, link):
        bus.subscribe(heard.extend)
        await until(lambda: "/odom" in server.operations("subscribe"))
        for content in contents:
            await server.say_anything(cbor2.dumps({"op": "publish", "topic": "/odom", "msg": content}))
        await until(lambda: heard == moved)
        assert link.statistics().rejected == {}
    assert heard[0].covariance == Covariance.of(xyz=0.1)
    assert all((sample.covariance.matrix == 7.0).all() for sample in heard[1:])


@pytest.mark.parametrize(("encoding", "joints"), [("cbor", "none"), ("cbor-raw", "cbor-raw")])
async def test_what_is_latched_is_asked_for_first_and_joints_never_in_decoded_cbor_and_a_clock_follows_ros(
    encoding: Literal["cbor", "cbor-raw"], joints: str
) -> None:
    clock = SimulatedClock()
    options: RosOptions = {"joint_states": print, "robot_description": print, "clock": clock}
    async with rosbridge_server() as server:
        with Bus(clock) as bus:
            async with RosbridgeLink(bus, server.url, encoding=encoding, **options):
                message = {"op": "publish", "topic": "/clock", "msg": {"clock": {"secs": 100, "nsecs": 5}}}
                await until(lambda: len(server.requests) == 6)
                await server.say_anything(json.dumps(message))
                await until(lambda: clock.now() == 100_000_000_005)
        # A server of ROS 1 fails at the names of joints in CBOR.
        others = {"/clock": encoding, "/robot_description": encoding, "/joint_states": joints}
        asked = {each["topic"]: each["compression"] for each in server.requests if each["op"] == "subscribe"}
        assert asked == {"/tf": encoding, "/tf_static": encoding, **others}
        topics = [(each["op"], each["topic"]) for each in server.requests]
        assert topics[:2] == [("subscribe", "/tf_static"), ("subscribe", "/tf")]
        assert topics[5] == ("advertise", "/tf_static")


async def test_beyond_its_capacity_a_link_drops_what_comes_again_and_nothing_that_is_latched() -> None:
    taken: list[str] = []
    async with joined(capacity=3, robot_description=taken.append) as (server, bus, link):
        (client,) = server.clients
        described = {"op": "publish", "topic": "/robot_description", "msg": {"data": "<robot/>"}}
        news = [server.encoded("/tf", (moving("map", "base", stamp),), "none") for stamp in range(50)]
        kept = [
            TextMessage(json.dumps(described)),
            server.encoded("/tf_static", (static("map", "lidar"),), "none"),
        ]
        messages = [*news[:25], *kept, *news[25:]]
        # All in one read.
        await client.stream.send(b"".join(map(client.connection.send, messages)))
        await until(lambda: link.statistics().queue.dropped > 0)
        await until(lambda: bus.statistics().frames == 2)
        assert taken == ["<robot/>"]


@pytest.mark.parametrize("when", ["at once", "settled", "cancelled"])
async def test_what_was_published_before_the_end_still_goes_out(when: str) -> None:
    async with rosbridge_server() as server:
        with Bus() as bus, anyio.CancelScope() as scope:
            async with RosbridgeLink(bus, server.url):
                # At the end, the link has not begun to write yet, or waits for something to write.
                await until(lambda: when == "at once" or len(server.requests) == 3)
                bus.publish([moving("map", "base", 5), static("map", "camera")])
                if when == "cancelled":
                    scope.cancel()
        await until(lambda: sorted(server.operations("publish")) == ["/tf", "/tf_static"])
        await until(lambda: server.clients == [])


async def test_two_links_of_a_bus_pass_on_and_tell_of_a_refused_sample_and_a_lost_peer_once() -> None:
    async with rosbridge_server() as one, rosbridge_server() as two:
        with Bus() as bus, bus.events() as events:
            async with RosbridgeLink(bus, one.url) as first, RosbridgeLink(bus, two.url) as second:
                await until(lambda: len(one.operations("advertise")) == len(two.operations("advertise")) == 1)
                await one.say(moving("map", "base", 5))
                await until(lambda: "/tf" in two.operations("publish"))
                row = {**as_mapping(moving("map", "base", 6)), "child_frame_id": "map"}
                message = json.dumps({"op": "publish", "topic": "/tf", "msg": {"transforms": [row]}})
                await two.say_anything(message, message)
                await until(lambda: second.statistics().rejected == {"self transform": 2})
                await two.cut()
                await until(lambda: second.peers == ())
                assert first.peers == (one.url,)
                assert first.statistics().rejected == {}
        told = [
            (type(event), event.peer)
            for event in iter(events.queue.get, None)
            if isinstance(event, PeerRejected | PeerLost)
        ]
        assert told[:2] == [(PeerRejected, two.url), (PeerLost, two.url)]
        assert "/tf" not in one.operations("publish"), "nothing goes back"


NO_URLS = ["", "localhost:9090", "http://a", "ws://", "ws://a:0", "ws://a:70000", "ws://:9090"]


@pytest.mark.parametrize(
    ("url", "options", "said"),
    [
        *((url, {}, "no URL of a websocket") for url in NO_URLS),
        (9090, {}, "a URL must be a str, not 9090"),
        ("ws://a:9090", {"tf": ""}, "topic"),
        ("ws://a", {"encoding": "json"}, "'cbor' or 'cbor-raw', not 'json'"),
    ],
)
def test_arguments_that_are_not_valid_are_refused(url: Any, options: Any, said: str) -> None:
    with pytest.raises(ValueError if isinstance(url, str) else TypeError, match=said):
        RosbridgeLink(Bus(), url, **options)


@pytest.mark.thorough
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_roslib_hears_what_a_link_publishes(tmp_path: Path) -> None:
    install_roslib(tmp_path)
    samples = {"/tf": moving("map", "base", 1_000_000_005, 1.5), "/tf_static": static("base", "lidar", 2.0)}
    async with rosbridge_server() as server, roslib_client(tmp_path, server.url) as heard:
        await until(lambda: sorted(server.operations("subscribe")) == ["/tf", "/tf_static"])
        with Bus() as bus:
            async with RosbridgeLink(bus, server.url):
                bus.publish(samples.values())
                await until(lambda: len(heard) == 2)
    said = {fact["topic"]: fact["transforms"] for fact in heard}
    assert said == {topic: [as_mapping(sample)] for topic, sample in samples.items()}
