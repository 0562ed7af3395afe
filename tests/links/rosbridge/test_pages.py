"""Web pages at a `RosbridgeServer`: a websocket says what roslib says.

Tests of periods run in simulated time, in which they cost nothing and are exact.
"""

import json
import math
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from typing import Any

import pytest

pytest.importorskip("wsproto", reason='pip install "tfbus[rosbridge]"')
pytest.importorskip("trio")

import anyio
import cbor2
from support.processes import until
from support.samples import moving, static
from trio.testing import MockClock

from tfbus import SECOND, Buffer, Bus, SimulatedClock, Transform, TransformStamped
from tfbus._aio.websocket import WebSocket
from tfbus.links.ros.messages import as_mapping, decode_mapping
from tfbus.links.rosbridge import RosbridgeLink, RosbridgeServer
from tfbus.tf_message import decode

pytestmark = pytest.mark.anyio

START = 1_000 * SECOND
QUARTER = Transform.from_axis_angle((0.0, 0.0, 1.0), math.pi / 2, (1.0, 0.0, 0.0))
FEEDBACK = "/tf2_web_republisher/feedback"


def in_simulated_time(test: Any) -> Any:
    """Run a test in a time that goes on when nobody has anything to do."""
    backend = ("trio", {"clock": MockClock(autojump_threshold=0.005)})
    return pytest.mark.every_loop(pytest.mark.parametrize("anyio_backend", [backend], ids=["simulated"])(test))


@pytest.fixture
def bus() -> Bus:
    return Bus(SimulatedClock(START))


class Page:
    """The websocket of a page."""

    def __init__(self, socket: WebSocket) -> None:
        self._socket = socket

    async def ask(self, op: str, **fields: Any) -> None:
        await self._socket.send(json.dumps({"op": op, **fields}))

    async def send(self, message: str | bytes) -> None:
        await self._socket.send(message)

    async def hear(self) -> dict[str, Any]:
        """The next message."""
        with anyio.fail_after(30.0):
            message = await self._socket.receive()
        heard: dict[str, Any] = json.loads(message) if isinstance(message, str) else cbor2.loads(message)
        return heard

    async def hear_all(self) -> list[dict[str, Any]]:
        """The messages until the answer to a request that is refused."""
        await self.ask("nonsense", id="end")
        heard = []
        while (message := await self.hear()).get("id") != "end":
            heard.append(message)
        return heard


@asynccontextmanager
async def page_of(server: RosbridgeServer) -> AsyncIterator[Page]:
    socket = await WebSocket.connect(server.address, 2**22, 5.0)
    try:
        yield Page(socket)
    finally:
        await socket.close()


def samples_of(message: Any) -> list[tuple[str, str, int, Transform]]:
    """Parent, child, stamp and value of each transform of a message, and that both ROSes can read the stamps."""
    for row in message["transforms"]:
        stamp = row["header"]["stamp"]
        assert (stamp["sec"], stamp["nanosec"]) == (stamp["secs"], stamp["nsecs"])
    return [(each.parent, each.child, each.stamp, each.transform) for each in decode_mapping(message).samples if each]


def summary(*samples: TransformStamped) -> list[tuple[str, str, int, Transform]]:
    return [(each.parent, each.child, each.stamp, each.transform) for each in samples]


# Topics


@pytest.mark.every_loop
async def test_a_page_hears_the_latched_frames_and_then_what_moves(bus: Bus) -> None:
    turned = TransformStamped("map", "base", START + 7, QUARTER)
    bus.publish(static("base", "lidar", 2.0, START))
    async with RosbridgeServer(bus, 0) as server, page_of(server) as page:
        await page.ask("subscribe", topic="/tf_static", id="s", type="tf2_msgs/TFMessage")
        assert samples_of((await page.hear())["msg"]) == summary(static("base", "lidar", 2.0, START))
        await page.ask("subscribe", topic="tf", id="m", type="tf2_msgs/msg/TFMessage")
        assert await page.hear_all() == []
        bus.publish([turned, static("base", "camera", 3.0, START)])
        heard = {message["topic"]: samples_of(message["msg"]) for message in (await page.hear(), await page.hear())}
        # The name of a topic is the one that the page has used.
        assert heard == {"tf": summary(turned), "/tf_static": summary(static("base", "camera", 3.0, START))}
        await page.ask("unsubscribe", topic="tf", id="other")
        await page.ask("unsubscribe", topic="/tf_static")
        assert await page.hear_all() == []
        bus.publish([static("base", "third", 3.0, START), moving("map", "base", START + 8)])
        assert [message["topic"] for message in await page.hear_all() or [await page.hear()]] == ["tf"]
        assert (server.sent, server.dropped, server.requests_refused) == (4, 0, 3)


@pytest.mark.parametrize("compression", ["cbor", "cbor-raw"])
async def test_a_page_may_have_messages_in_cbor_or_as_bytes_of_ros(bus: Bus, compression: str) -> None:
    async with RosbridgeServer(bus, 0) as server, page_of(server) as page:
        await page.ask("subscribe", topic="/tf", compression=compression)
        assert await page.hear_all() == []
        bus.publish(TransformStamped("map", "base", START + 7, QUARTER))
        message = (await page.hear())["msg"]
        if compression == "cbor-raw":
            assert (message["secs"], message["nsecs"]) == divmod(START, SECOND)
            (held,) = decode(message["bytes"]).samples
            assert held == TransformStamped("map", "base", START + 7, QUARTER)
        else:
            assert samples_of(message) == [("map", "base", START + 7, QUARTER)]


@pytest.mark.parametrize("compression", ["cbor", "cbor-raw"])
async def test_a_name_that_has_no_utf_8_comes_in_json_or_is_left_out_and_ends_nothing(
    bus: Bus, compression: str
) -> None:
    async with RosbridgeServer(bus, 0) as server, page_of(server) as page:
        await page.ask("subscribe", topic="/tf", compression=compression)
        assert await page.hear_all() == []
        bus.publish([moving("map", "\ud800", START), moving("map", "base", START)])
        message = (await page.hear())["msg"]
        if compression == "cbor-raw":
            assert [sample.child for sample in decode(message["bytes"]).samples if sample] == ["base"]
        else:
            assert [row["child_frame_id"] for row in message["transforms"]] == ["\ud800", "base"]
        bus.publish(moving("map", "base", START + 1))
        await page.hear()


@in_simulated_time
@pytest.mark.parametrize(("length", "kept"), [(0, [9]), (3, [7, 8, 9])])
async def test_a_throttled_page_gets_the_newest_of_each_frame_or_as_many_as_it_has_room_for(
    bus: Bus, length: int, kept: list[int]
) -> None:
    async with RosbridgeServer(bus, 0) as server, page_of(server) as page:
        await page.ask("subscribe", topic="/tf", id="slow", throttle_rate=2_000, queue_length=length)
        assert await page.hear_all() == []
        begin = anyio.current_time()
        for number in range(10):
            bus.publish(moving("map", "base", START + number))
        heard = [await page.hear() for _ in kept]
        assert [stamp - START for message in heard for _, _, stamp, _ in samples_of(message["msg"])] == kept
        bus.publish([moving("map", "base", START + 20), moving("map", "arm", START + 20)])
        assert len((await page.hear())["msg"]["transforms"]) == 2
        assert anyio.current_time() - begin == pytest.approx(2.0 * len(kept), abs=0.2)
        assert server.dropped == (10 - len(kept) if length else 0)
        # Of two subscriptions to one topic, the faster one counts, and each message comes once.
        await page.ask("subscribe", topic="/tf", id="fast")
        assert await page.hear_all() == []
        for number in (30, 31):
            bus.publish(moving("map", "base", START + number))
        assert [(await page.hear())["msg"]["transforms"][0]["header"]["stamp"]["nsecs"] for _ in "ab"] == [30, 31]


@pytest.mark.thorough
async def test_a_page_that_reads_nothing_loses_the_oldest_and_delays_nobody(bus: Bus) -> None:
    async with RosbridgeServer(bus, 0) as server, page_of(server) as slow, page_of(server) as other:
        await slow.ask("subscribe", topic="/tf")
        await other.ask("subscribe", topic="/tf", throttle_rate=1)
        assert await slow.hear_all() == await other.hear_all() == []
        published = 0
        while server.dropped < 100:
            assert published < 1_000_000
            bus.publish([moving("map", f"frame {k}", START + published) for k in range(500)])
            published += 500
            # Five messages of a hundred each.
            heard = [samples_of((await other.hear())["msg"]) for _ in range(5)]
            assert {stamp for samples in heard for _, _, stamp, _ in samples} == {START + published - 500}
        await slow.ask("unsubscribe", topic="/tf")
        heard = [samples_of(message["msg"]) for message in await slow.hear_all()]
        # It had the oldest already, and reads nothing twice.
        assert len({(child, stamp) for samples in heard for _, child, stamp, _ in samples}) == sum(map(len, heard))
        assert 0 < sum(map(len, heard)) <= published - server.dropped


# Frames in a fixed frame


def goal(target: str = "/map", **fields: Any) -> dict[str, Any]:
    wanted = {"angular_thres": 0.1, "trans_thres": 0.01, "rate": 10.0, **fields}
    return {"source_frames": ["base", "/lidar"], "target_frame": target, **wanted}


Reader = Callable[[], Any]


async def begin(page: Page, form: str, id_: str, wanted: dict[str, Any]) -> Callable[[dict[str, Any]], Any]:
    """Ask for frames in one of the three forms; gives the transforms of a message of it."""
    if form == "action of ROS 1":
        await page.ask("advertise", topic="/tf2_web_republisher/goal")
        stamped = {"goal_id": {"stamp": {"secs": 0, "nsecs": 0}, "id": id_}, "goal": wanted}
        await page.ask("publish", topic="/tf2_web_republisher/goal", msg=stamped)
        # In this order after a connection has broken.
        await page.ask("subscribe", topic=FEEDBACK, id="f", type="tf2_web_republisher/TFSubscriptionActionFeedback")
        return lambda message: (
            (message["topic"], message["msg"]["status"]["goal_id"]["id"]) == (FEEDBACK, id_)
            and (message["msg"]["feedback"])
        )
    if form == "service":
        await page.ask("call_service", service="/republish_tfs", id=id_, args=wanted)
        answer = await page.hear()
        assert (answer["op"], answer["id"], answer["result"]) == ("service_response", id_, True)
        topic = answer["values"]["topic_name"]
        await page.ask("subscribe", topic=topic, id=f"{id_} topic")
        return lambda message: message["topic"] == topic and message["msg"]
    await page.ask(
        "send_action_goal", id=id_, action="/tf2_web_republisher", action_type="x", args=wanted, feedback=True
    )
    return lambda message: (message["op"], message["id"]) == ("action_feedback", id_) and message["values"]


async def end(page: Page, form: str, id_: str) -> list[dict[str, Any]]:
    """End it; gives the answers."""
    if form == "action of ROS 1":
        await page.ask("publish", topic="/tf2_web_republisher/cancel", msg={"id": id_})
    elif form == "service":
        await page.ask("unsubscribe", topic="/tf2_web_republisher/tf_repub_0", id=f"{id_} topic")
    else:
        await page.ask("cancel_action_goal", id=id_, action="/tf2_web_republisher")
    return await page.hear_all()


@in_simulated_time
@pytest.mark.parametrize("form", ["action of ROS 1", "service", "action of ROS 2"])
async def test_frames_are_republished_in_a_fixed_frame_until_the_page_has_enough(bus: Bus, form: str) -> None:
    async with RosbridgeServer(bus, 0) as server, page_of(server) as page:
        transforms = await begin(page, form, "g1", goal())
        # Nobody has published them yet.
        assert await page.hear_all() == []
        bus.publish([TransformStamped("map", "base", START, QUARTER), static("base", "lidar", 2.0)])
        # The laser is 2 m ahead of the base, which has turned to the left.
        lidar = QUARTER @ Transform((2.0, 0.0, 0.0))
        assert lidar.translation == pytest.approx((1.0, 2.0, 0.0))
        assert sorted(samples_of(transforms(await page.hear()))) == [
            ("map", "base", START, QUARTER),
            ("map", "lidar", START, lidar),
        ]
        begun = anyio.current_time()
        # 5 mm are below the threshold; 15 mm are not, and then the newest counts.
        for step in (5, 15, 20):
            moved = Transform((1.0 + step / 1_000, 0.0, 0.0), QUARTER.rotation)
            bus.publish(TransformStamped("map", "base", START + step, moved))
        heard = samples_of(transforms(await page.hear()))
        assert sorted(child for _, child, _, _ in heard) == ["base", "lidar"]
        assert {stamp for _, _, stamp, _ in heard} == {START + 20}
        assert anyio.current_time() - begun == pytest.approx(0.1, abs=0.05)
        answers = await end(page, form, "g1")
        assert [(each["op"], each["status"], each["result"]) for each in answers] == (
            [("action_result", 5, True)] if form == "action of ROS 2" else []
        )
        bus.publish(TransformStamped("map", "base", START + 30, Transform((9.0, 0.0, 0.0))))
        await anyio.sleep(1.0)
        assert await page.hear_all() == []


@in_simulated_time
async def test_all_frames_of_a_goal_go_into_one_message_a_period_and_are_as_new_as_it(bus: Bus) -> None:
    names = [f"frame {number}" for number in range(50)]
    async with RosbridgeServer(bus, 0) as server, page_of(server) as page:
        await begin(page, "action of ROS 2", "g", goal(source_frames=[*names, "static"], trans_thres=0.0))
        assert await page.hear_all() == []
        bus.publish([*(moving("map", name, START) for name in names), static("map", "static")])
        assert len((await page.hear())["values"]["transforms"]) == 51
        # When all are at rest, the first that moves is sent at once. The others move at other times of the period that
        # begins then, and all of them right before its end.
        await anyio.sleep(1.0)
        for number, name in enumerate(names):
            bus.publish(moving("map", name, START + 1 + number))
            await anyio.sleep(0.001)
        bus.publish([moving("map", name, START + 1_000) for name in names])
        assert samples_of((await page.hear())["values"])[0][1:3] == (names[0], START + 1)
        heard = samples_of((await page.hear())["values"])
        assert {(child, stamp) for _, child, stamp, _ in heard} == {(name, START + 1_000) for name in names}


@in_simulated_time
async def test_feedback_waits_for_its_subscription_after_a_connection_has_broken(bus: Bus) -> None:
    bus.publish(static("map", "base"))
    async with RosbridgeServer(bus, 0) as server, page_of(server) as page:
        stamped = {"goal_id": {"id": "g"}, "goal": goal(source_frames=["base"])}
        await page.ask("publish", topic="/tf2_web_republisher/goal", msg=stamped)
        await anyio.sleep(1.0)
        await page.ask("subscribe", topic=FEEDBACK)
        assert samples_of((await page.hear())["msg"]["feedback"]) == summary(static("map", "base"))


async def test_a_jump_back_of_the_clock_begins_anew(bus: Bus) -> None:
    clock = bus.clock
    assert isinstance(clock, SimulatedClock)
    async with RosbridgeServer(bus, 0) as server, page_of(server) as page:
        await begin(page, "action of ROS 2", "g", goal(source_frames=["base"]))
        bus.publish(moving("map", "base", START, 1.0))
        assert samples_of((await page.hear())["values"])[0][2] == START
        clock.set(0)
        bus.publish(moving("map", "base", 5, 1.0))
        assert samples_of((await page.hear())["values"])[0][2] == 5


# Requests that are refused

REFUSED: dict[str, tuple[str | bytes | dict[str, Any], str]] = {
    "no JSON": ("{", "no JSON"),
    "deep": ("[" * 200_000, "no JSON"),
    "bytes": (b"\x81", "in bytes"),
    "a list": ("[1]", "must be an object, not list"),
    "no operation": ("{}", "op must be a text, not None"),
    "another operation": ({"op": "advertise_service"}, "no operation 'advertise_service'"),
    "no topic": ({"op": "subscribe"}, "topic must be a text"),
    "another topic": ({"op": "subscribe", "topic": "/odom"}, "no topic '/odom'; there are /tf, /tf_static"),
    "a rate": ({"op": "subscribe", "topic": "/tf", "throttle_rate": -1}, "throttle_rate must be a number from 0"),
    "an infinite rate": ('{"op": "subscribe", "topic": "/tf", "throttle_rate": Infinity}', "must be a number"),
    "a huge number": ({"op": "subscribe", "topic": "/tf", "queue_length": 10**400}, "must be a number"),
    "publishing": ({"op": "publish", "topic": "/tf", "msg": {"transforms": []}}, "without publish=True"),
    "advertising": ({"op": "advertise", "topic": "tf_static"}, "without publish=True"),
    "publishing elsewhere": (
        {"op": "publish", "topic": "/odom", "msg": {}},
        "nobody hears the topic '/odom'; there are",
    ),
    "a level": ({"op": "set_level", "level": "loud"}, "not 'loud'"),
    "a goal": ({"op": "publish", "topic": "/tf2_web_republisher/goal", "msg": {"goal_id": {"id": "g"}}}, "goal must"),
    "frames": (
        {"op": "publish", "topic": "/tf2_web_republisher/goal", "msg": {"goal_id": {"id": "g"}, "goal": goal("")}},
        "not empty",
    ),
    "a canceled goal": ({"op": "cancel_action_goal", "action": "a", "id": "g"}, "no goal 'g'"),
}


@pytest.mark.parametrize("name", REFUSED)
async def test_a_request_that_cannot_be_carried_out_is_told_counted_and_disturbs_nothing(bus: Bus, name: str) -> None:
    request, why = REFUSED[name]
    async with RosbridgeServer(bus, 0) as server, page_of(server) as page:
        id_ = None
        if isinstance(request, dict):
            id_ = request.setdefault("id", 7)
            await page.ask(**request)
        else:
            await page.send(request)
        answer = await page.hear()
        assert (answer["op"], answer["level"]) == ("status", "error")
        assert why in answer["msg"]
        assert len(answer["msg"]) <= 1_000
        assert answer.get("id") == id_
        assert server.requests_refused == 1
        await page.ask("set_level", level="none")
        await page.send("nonsense")
        await page.ask("subscribe", topic="/tf_static")
        bus.publish(static("base", "lidar"))
        assert (await page.hear())["op"] == "publish"


@pytest.mark.parametrize("op", ["call_service", "send_action_goal"])
@pytest.mark.parametrize("name", [False, True])
async def test_a_service_or_an_action_that_is_refused_fails(bus: Bus, op: str, name: bool) -> None:
    of_service = op == "call_service"
    called = ("republish_tfs" if of_service else "tf2_web_republisher") if name else "/rosapi/topics"
    async with RosbridgeServer(bus, 0) as server, page_of(server) as page:
        await page.ask(op, id="x", feedback=True, args={}, **{"service" if of_service else "action": called})
        answer = await page.hear()
        kind = "service_response" if of_service else "action_result"
        assert (answer["op"], answer["id"], answer["result"]) == (kind, "x", False)
        assert ("source_frames must be a list" if name else "'/rosapi/topics'") in answer["values"]


async def test_what_is_not_offered_is_told_and_the_messages_come_in_json(bus: Bus) -> None:
    bus.publish(static("base", "lidar"))
    async with RosbridgeServer(bus, 0) as server, page_of(server) as page:
        await page.ask("subscribe", topic="/tf_static", id="a", compression="png", fragment_size=100)
        heard = [await page.hear() for _ in range(3)]
        assert [(each["op"], each.get("level"), each.get("id")) for each in heard] == [
            ("status", "warning", "a"),
            ("status", "warning", "a"),
            ("publish", None, None),
        ]
        assert "'png'" in heard[0]["msg"]
        assert "fragments" in heard[1]["msg"]


# Bounds


async def test_what_a_page_asks_for_has_bounds(bus: Bus) -> None:
    async with RosbridgeServer(bus, 0) as server, page_of(server) as page:
        for number in range(101):
            await page.ask("subscribe", topic="/tf", id=f"s{number}")
        many = [f"frame {number}" for number in range(600)]
        await begin(page, "action of ROS 2", "g1", goal(source_frames=many))
        await begin(page, "action of ROS 2", "g2", goal(source_frames=many))
        # The goal of the same name replaces the first, so there is room.
        await begin(page, "action of ROS 2", "g1", goal(source_frames=many))
        first, second = await page.hear_all()
        assert (first["id"], first["msg"]) == ("s100", "'/tf' has 100 subscriptions already")
        assert (second["id"], second["values"]) == ("g2", "a page has at most 1000 frames republished")
        assert server.requests_refused == 3


async def test_republications_of_no_frame_have_a_bound_too(bus: Bus) -> None:
    async with RosbridgeServer(bus, 0) as server, page_of(server) as page:
        for number in range(1_001):
            await begin(page, "action of ROS 2", f"g{number}", goal(source_frames=[]))
        (refused,) = await page.hear_all()
        assert (refused["id"], refused["values"]) == ("g1000", "a page has at most 1000 frames republished")


async def test_the_service_names_a_hundred_topics_and_forgets_the_oldest(bus: Bus) -> None:
    bus.publish(static("map", "base"))
    async with RosbridgeServer(bus, 0) as server, page_of(server) as page:
        topics = []
        for _ in range(101):
            await page.ask("call_service", service="/republish_tfs", args=goal(source_frames=["base"]))
            topics.append((await page.hear())["values"]["topic_name"])
        assert len(set(topics)) == 101
        await page.ask("subscribe", topic=topics[0])
        assert (await page.hear())["op"] == "status"
        await page.ask("subscribe", topic=topics[1])
        assert (await page.hear())["topic"] == topics[1]


async def test_a_request_that_is_too_long_ends_its_connection_and_no_other(bus: Bus) -> None:
    async with RosbridgeServer(bus, 0) as server, page_of(server) as other:
        async with page_of(server) as page:
            await page.send("x" * 2**19)
            with pytest.raises(OSError, match=r"closed|gone"):
                await page.hear()
        await other.ask("subscribe", topic="/tf_static")
        bus.publish(static("base", "lidar"))
        assert (await other.hear())["op"] == "publish"


# Pages that publish


async def test_a_page_publishes_if_it_may_and_hears_what_it_has_published(bus: Bus) -> None:
    heard: list[TransformStamped] = []
    bus.subscribe(heard.extend)
    good, bad = as_mapping(moving("map", "base", START, 1.0)), as_mapping(moving("map", "arm", START))
    bad["transform"]["rotation"]["w"] = 5.0
    async with RosbridgeServer(bus, 0, publish=True) as server, page_of(server) as page:
        for topic in ("/tf", "/tf_static"):
            await page.ask("subscribe", topic=topic)
            await page.ask("advertise", topic=topic, type="tf2_msgs/TFMessage")
        await page.ask("publish", topic="/tf", msg={"transforms": [good, bad]}, id="p")
        (refused, said) = sorted(
            [await page.hear(), await page.hear()], key=lambda message: message["op"], reverse=True
        )
        assert (refused["op"], refused["id"]) == ("status", "p")
        assert refused["msg"].startswith("1 of 2 transforms are refused; the first: ")
        assert samples_of(said["msg"]) == [("map", "base", START, Transform((1.0, 0.0, 0.0)))]
        laser = as_mapping(static("base", "lidar", 2.0)) | {"child_frame_id": "/lidar"}
        for _ in range(2):
            # The second is nothing new for the bus; two buses that are linked twice would pass it on for ever.
            await page.ask("publish", topic="/tf_static", msg={"transforms": [laser]})
            assert samples_of((await page.hear())["msg"]) == summary(static("base", "lidar", 2.0))
    assert heard == [moving("map", "base", START, 1.0, "rosbridge"), static("base", "lidar", 2.0, 0, "rosbridge")]


async def test_a_page_publishes_no_more_than_a_thousand_frames(bus: Bus) -> None:
    rows = [as_mapping(moving("map", f"frame {number}", START)) for number in range(1_001)]
    async with RosbridgeServer(bus, 0, publish=True) as server, page_of(server) as page:
        await page.ask("publish", topic="/tf", msg={"transforms": rows[:500]})
        await page.ask("publish", topic="/tf", msg={"transforms": rows[500:]})
        assert "1 of 501 transforms are refused" in (await page.hear())["msg"]
    assert bus.statistics().frames == 1_000


@in_simulated_time
async def test_two_buses_that_are_linked_twice_pass_each_sample_on_once(bus: Bus) -> None:
    with Bus() as other:
        counts = {"here": 0, "there": 0}
        async with (
            RosbridgeServer(bus, 0, publish=True) as one,
            RosbridgeServer(other, 0, publish=True) as two,
            RosbridgeLink(other, one.address) as there,
            RosbridgeLink(bus, two.address) as here,
        ):
            bus.subscribe(lambda batch: counts.update(here=counts["here"] + len(batch)))
            other.subscribe(lambda batch: counts.update(there=counts["there"] + len(batch)))
            bus.publish([moving("map", "base", START, 1.0), static("base", "lidar", 2.0)])
            other.publish(static("base", "camera", 3.0))
            await until(lambda: counts == {"here": 3, "there": 3})
            # Static frames that do not come back would be said again and again.
            await anyio.sleep(10.0)
            assert counts == {"here": 3, "there": 3}
            assert [link.statistics().not_sent for link in (here, there)] == [{}, {}]


@pytest.mark.parametrize("encoding", ["cbor", "cbor-raw"])
async def test_a_link_of_ours_hears_a_server_of_ours(bus: Bus, encoding: Any) -> None:
    bus.publish(static("base", "lidar", 2.0))
    heard: list[TransformStamped] = []
    with Bus() as other:
        other.subscribe(heard.extend)
        async with (
            RosbridgeServer(bus, 0) as server,
            RosbridgeLink(other, server.address, encoding=encoding, send=False),
        ):
            await until(lambda: len(heard) == 1)
            bus.publish([TransformStamped("map", "base", START + stamp, QUARTER) for stamp in range(300)])
            await until(lambda: len(heard) == 301)
    assert heard[0] == static("base", "lidar", 2.0, 0, "rosbridge")
    assert heard[1:] == [TransformStamped("map", "base", START + stamp, QUARTER, "rosbridge") for stamp in range(300)]


# The server


async def test_a_buffer_of_the_user_answers_with_what_it_has(bus: Bus) -> None:
    with Buffer(bus) as buffer:
        bus.publish(moving("map", "base", START, 1.0))
        async with RosbridgeServer(bus, 0, buffer=buffer) as server, page_of(server) as page:
            await begin(page, "action of ROS 2", "g", goal(source_frames=["base"]))
            assert samples_of((await page.hear())["values"]) == summary(moving("map", "base", START, 1.0))
        # It outlives the server.
        bus.publish(moving("map", "base", START + 1, 2.0))
        assert buffer.lookup_nowait("map", "base").stamp == START + 1
        with pytest.raises(ValueError, match="another bus"):
            RosbridgeServer(Bus(), 0, buffer=buffer)


async def answer_to(server: RosbridgeServer, *lines: str) -> str:
    """The answer to a request for the page of the server."""
    place = server.address.removeprefix("ws://")
    host, port = place.split(":")
    async with await anyio.connect_tcp(host, int(port)) as stream:
        await stream.send("\r\n".join(("GET / HTTP/1.1", f"Host: {place}", *lines, "", "")).encode())
        answer = b""
        with anyio.fail_after(30.0), suppress(anyio.EndOfStream):
            while b"101" not in answer:
                answer += await stream.receive()
    return answer.decode()


UPGRADE = (
    "Upgrade: websocket",
    "Connection: Upgrade",
    "Sec-WebSocket-Version: 13",
    "Sec-WebSocket-Key: " + "A" * 22 + "==",
)


async def test_of_web_pages_only_its_own_and_those_that_are_named_may_connect(bus: Bus) -> None:
    async with RosbridgeServer(bus, 0, page="<p>é</p>", origins=["http://localhost:8000"]) as server:
        own = server.address.replace("ws:", "http:")
        page = await answer_to(server)
        assert page.endswith("\r\n\r\n<p>é</p>")
        assert "Content-Type: text/html; charset=utf-8\r\n" in page
        for origin, status in (
            (own, 101),
            ("http://localhost:8000", 101),
            ("http://localhost:8001", 403),
            ("null", 403),
        ):
            assert (await answer_to(server, *UPGRADE, f"Origin: {origin}")).startswith(f"HTTP/1.1 {status} ")
        assert server.refused == 2
    async with RosbridgeServer(bus, 0) as server:
        assert "connect with roslib" in await answer_to(server)


async def test_the_end_of_the_bus_is_told_to_who_asks_and_ends_no_connection(bus: Bus) -> None:
    async with RosbridgeServer(bus, 0, publish=True) as server, page_of(server) as page:
        await page.ask("subscribe", topic="/tf")
        await begin(page, "action of ROS 2", "g", goal())
        assert await page.hear_all() == []
        bus.close()
        await page.ask("subscribe", topic="/tf_static")
        await page.ask("publish", topic="/tf", msg={"transforms": [as_mapping(moving("map", "base", 0))]})
        assert "closed" in (await page.hear())["msg"]
    assert server.address == ""
