import asyncio
import importlib.util
import json
import math
import struct
import sys
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import AbstractContextManager, AsyncExitStack, asynccontextmanager, contextmanager
from functools import partial
from itertools import count
from pathlib import Path
from random import Random
from typing import Any, NamedTuple, Unpack

import anyio
import anyio.lowlevel
import anyio.to_thread
import pytest
import zenoh
import zenoh.ext
from rosbags.typesys import Stores, get_typestore
from support.both_sides import SECONDS, Node, check_killed_node, check_link_that_came_back, meet, node
from support.damage import damaged
from support.joint_messages import joint_state, odometry
from support.processes import free_ports, on_one_loop, until
from support.samples import latched, moving, static

from tfbus import Bus, PeerRejected, SimulatedClock, TransformStamped, UncertainSample
from tfbus.links.rmw_zenoh import RmwZenohLink, rmw_zenoh_link
from tfbus.links.rmw_zenoh.rmw_zenoh_link import (
    CLOCK_HASH,
    CLOCK_TYPE,
    HASH,
    JOINT_HASH,
    JOINT_TYPE,
    ODOMETRY_HASH,
    ODOMETRY_TYPE,
    TEXT_HASH,
    TEXT_TYPE,
    TYPE,
    Attachment,
    configuration,
    pack,
    publisher_of,
)
from tfbus.links.ros import RosOptions
from tfbus.links.ros.ros_link import MAX_SIZE
from tfbus.links.zenoh import ZenohRouter, sessions
from tfbus.tf_message import encode

pytestmark = pytest.mark.anyio

PEER = Path(__file__).parents[2] / "support" / "rmw_zenoh_peer.py"
DOMAIN = 7
BLOCK = zenoh.CongestionControl.BLOCK
PIECES = [struct.pack("<I", number) for number in (0, 1, 2, 2**16, 2**31, 2**32 - 1)] + [bytes(1_000)]
TF_KEY = f"{DOMAIN}/tf/tf2_msgs::msg::dds_::TFMessage_/{HASH}"
TF_STATIC_KEY = f"{DOMAIN}/tf_static/tf2_msgs::msg::dds_::TFMessage_/{HASH}"
TEXT = b"\0\1\0\0" + struct.pack("<I", 9) + b"<robot/>\0"


@asynccontextmanager
async def router() -> AsyncIterator[str]:
    """The address of a router, as rmw_zenohd is one."""
    (port,) = free_ports(1)
    async with ZenohRouter(f"tcp/127.0.0.1:{port}"):
        yield f"tcp/127.0.0.1:{port}"


def sdk_peer(address: str, seconds: float = SECONDS, x: float = 0.5) -> AbstractContextManager[Node]:
    """A node of another program; skips the test without it."""
    if importlib.util.find_spec("zenoh_ros2_sdk") is None:
        pytest.skip('no peer: pip install "tfbus[thorough]"')
    variables = {"ROUTER_PORT": address.rpartition(":")[2], "ROS_DOMAIN_ID": f"{DOMAIN}"}
    return node([sys.executable, str(PEER)], variables, seconds, x)


class Joined(NamedTuple):
    """A link to a router, what its bus has heard, and a session of zenoh that may say anything."""

    bus: Bus
    link: RmwZenohLink
    heard: list[TransformStamped]
    session: zenoh.Session

    async def publisher(self, key: str) -> Any:
        """A publisher that the link hears: the router knows of a subscription some time after the link is joined."""
        publisher = self.session.declare_publisher(f"{DOMAIN}/{key}", congestion_control=BLOCK)
        await until(lambda: bool(publisher.matching_status.matching))  # type: ignore[attr-defined]
        return publisher

    async def until_heard(self, *children: str) -> None:
        await until(lambda: [sample.child for sample in self.heard] == list(children))


@contextmanager
def stranger(address: str) -> Iterator[zenoh.Session]:
    with zenoh.open(configuration(address, {})) as session:
        yield session


@asynccontextmanager
async def joined(address: str, **options: Unpack[RosOptions]) -> AsyncIterator[Joined]:
    heard: list[TransformStamped] = []
    with Bus() as bus, stranger(address) as session:
        bus.subscribe(heard.extend)
        async with RmwZenohLink(bus, address, DOMAIN, **options) as link:
            yield Joined(bus, link, heard, session)


# The keys, tokens and attachments of rmw_zenoh


def test_the_hash_is_that_of_the_type() -> None:
    hash_of = get_typestore(Stores.ROS2_JAZZY).hash_rihs01
    assert hash_of("tf2_msgs/msg/TFMessage") == HASH
    assert hash_of("sensor_msgs/msg/JointState") == JOINT_HASH
    assert hash_of("rosgraph_msgs/msg/Clock") == CLOCK_HASH
    assert hash_of("std_msgs/msg/String") == TEXT_HASH
    assert hash_of("nav_msgs/msg/Odometry") == ODOMETRY_HASH


def test_an_attachment_tells_the_publisher() -> None:
    data = pack(Attachment(5, 7, bytes(range(16))))
    assert data == b"\x05" + bytes(7) + b"\x07" + bytes(7) + b"\x10" + bytes(range(16))
    assert publisher_of(data) == bytes(range(16))
    for other in (b"", b"sequence_number", bytes(33), data + b"\0"):
        assert publisher_of(other) is None


async def test_a_node_announces_its_topics_and_speaks_to_the_first_of_several() -> None:
    options: RosOptions = {"joint_states": print, "joint_topic": "/a/j", "clock": SimulatedClock()}
    options |= {"tf": ["/tf", "/r/tf"], "robot_description": print}
    async with router() as address, joined(address, **options) as end:
        tokens: set[str] = set()
        # The router may be told of them after the link has joined.
        with anyio.fail_after(20):
            while len(tokens) < 9:
                replies = await anyio.to_thread.run_sync(end.session.liveliness().get, "@ros2_lv/**")
                tokens = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
                await anyio.sleep(0.01)
    transforms, latched = f"tf2_msgs::msg::dds_::TFMessage_/{HASH}", "/:1:,1:,:,:,,"
    moving = "/::,100:,:,:,,"
    (zid,) = {token.split("/")[2] for token in tokens}
    assert {token.removeprefix(f"@ros2_lv/7/{zid}/0/") for token in tokens} == {
        "0/NN/%/%/tfbus",
        f"1/MS/%/%/tfbus/%tf_static/{transforms}{latched}",
        f"2/MP/%/%/tfbus/%tf_static/{transforms}{latched}",
        f"3/MS/%/%/tfbus/%tf/{transforms}{moving}",
        f"4/MP/%/%/tfbus/%tf/{transforms}{moving}",
        f"5/MS/%/%/tfbus/%r%tf/{transforms}{moving}",
        f"7/MS/%/%/tfbus/%a%j/sensor_msgs::msg::dds_::JointState_/{JOINT_HASH}{moving}",
        f"8/MS/%/%/tfbus/%clock/rosgraph_msgs::msg::dds_::Clock_/{CLOCK_HASH}{moving}",
        f"9/MS/%/%/tfbus/%robot_description/std_msgs::msg::dds_::String_/{TEXT_HASH}{latched}",
    }


async def test_messages_go_out_with_their_number_and_the_id_of_their_publisher() -> None:
    async with router() as address, joined(address) as end:
        said: list[zenoh.Sample] = []
        end.session.declare_subscriber("**", said.append)
        stamps = count(1)
        with anyio.fail_after(20):
            while not said:
                # Until the router knows of the subscription; from then on nothing is lost.
                end.bus.publish(moving("map", "base", next(stamps)))
                await anyio.sleep(0.01)
        last = next(stamps)
        end.bus.publish(moving("map", "base", last))
        end.bus.publish(static("map", "lidar"))
        # It goes behind the moving one.
        await until(lambda: str(said[-1].key_expr) == TF_STATIC_KEY)
        assert bytes(said[-1].payload) == encode([static("map", "lidar")])
        told = [sample for sample in said if str(sample.key_expr) == TF_KEY]
        assert bytes(told[-1].payload) == encode([moving("map", "base", last)])
        attachments = [bytes(sample.attachment or b"") for sample in told]
        numbers = [int.from_bytes(attachment[:8], "little") for attachment in attachments]
        assert numbers == list(range(last - len(told) + 1, last + 1))
        assert len({attachment[-16:] for attachment in attachments}) == 1
        statistics = end.link.statistics()
        assert (statistics.received_messages, statistics.duplicates) == (0, 0), "it does not hear itself"


async def test_messages_come_from_each_topic_with_any_attachment_or_none() -> None:
    clock = SimulatedClock()
    taken: list[Any] = []
    options: RosOptions = {"joint_states": lambda *state: taken.append(state), "robot_description": taken.append}
    options |= {"clock": clock, "odometry": "/odom"}
    async with router() as address:
        with stranger(address) as session:
            description = zenoh.ext.declare_advanced_publisher(
                session,
                f"{DOMAIN}/robot_description/{TEXT_TYPE}/{TEXT_HASH}",
                cache=zenoh.ext.CacheConfig(max_samples=1),
                publisher_detection=True,
            )
            # Long before the link.
            description.put(TEXT)
            async with joined(address, **options) as end:
                await until(lambda: taken == ["<robot/>"])
                # ROS 2 Humble has no hash.
                joints = await end.publisher(f"joint_states/{JOINT_TYPE}/any")
                joints.put(joint_state(5, {"a": 0.5}))
                await until(lambda: taken[1:] == [({"a": 0.5}, 5)])
                (await end.publisher(f"clock/{CLOCK_TYPE}/{CLOCK_HASH}")).put(b"\0\1\0\0" + struct.pack("<iI", 100, 5))
                await until(lambda: clock.now() == 100_000_000_005)
                odom = await end.publisher(f"odom/{ODOMETRY_TYPE}/{ODOMETRY_HASH}")
                odom.put(odometry(moving("odom", "cart", 7, 1.5)))
                await end.until_heard("cart")
                pose = end.heard.pop()
                assert pose == moving("odom", "cart", 7, 1.5, "/odom")
                assert isinstance(pose, UncertainSample)
                statics = await end.publisher(f"tf_static/{TYPE}/{HASH}")
                statics.put(encode([moving("map", "lidar", 0)]))
                await end.until_heard("lidar")
                publisher = await end.publisher(f"tf/{TYPE}/{HASH}")
                for stamp, attachment in enumerate((b"", b"x", bytes(33), pack(Attachment(1, 2, bytes(16))))):
                    publisher.put(encode([moving("map", "base", stamp)]), attachment=attachment)
                await end.until_heard("lidar", *["base"] * 4)
                assert end.heard[0] == static("map", "lidar", authority="rmw_zenoh")
                assert end.link.statistics().rejected == {}


@pytest.mark.thorough
async def test_garbage_is_counted_by_reason_and_ends_nothing() -> None:
    async with router() as address, joined(address) as end:
        with end.bus.events() as events:
            publisher = await end.publisher(f"tf/{TYPE}/{HASH}")
            for payload in (b"", b"garbage", b"\0\1\0\0\xff\xff\xff\xff", bytes(MAX_SIZE + 1)) * 2:
                publisher.put(payload)
            # This one may be that large, but holds no message.
            publisher.put(b"\0\1\0\0" + b"\xff" * (MAX_SIZE - 4))
            publisher.put(encode([moving("map", "base", 1)]))
            await end.until_heard("base")
            rejected = end.link.statistics().rejected
            assert rejected == {"oversized": 2, "truncated": 7}
            told = [event.reason for event in iter(events.queue.get, None) if isinstance(event, PeerRejected)]
            assert told == ["truncated", "oversized"]


async def test_two_buses_hear_each_other_and_a_late_one_the_last_static_frames_and_no_moving_ones() -> None:
    async with router() as address, joined(address) as near:
        near.bus.publish([moving("map", "base", 0), static("map", "lidar", 1.0, 3), static("map", "gone", 2.0)])
        await until(lambda: near.link.statistics().sent_messages == 2)
        near.bus.remove_frame("gone")
        await until(lambda: near.link.statistics().sent_messages == 3)
        async with joined(address) as far:
            await far.until_heard("lidar")
            far.bus.publish([moving("base", "arm", 6, 2.0), static("arm", "tool", 3.0, 7)])
            await until(lambda: near.link.statistics().received_samples == 2)
            for stamp in range(100):
                near.bus.publish(moving("map", "base", stamp, 1.0))
                await anyio.lowlevel.checkpoint()
            await until(lambda: far.link.statistics().received_samples == 101)
            assert latched(near.bus) == {
                "lidar": static("map", "lidar", 1.0, 3),
                "tool": static("arm", "tool", 3.0, 7, "rmw_zenoh"),
            }
            assert (near.link.statistics().duplicates, far.link.statistics().duplicates) == (0, 0)
        assert far.heard[0] == static("map", "lidar", 1.0, 3, "rmw_zenoh")
        assert [sample for sample in far.heard if sample.child == "base"] == [
            moving("map", "base", stamp, 1.0, "rmw_zenoh") for stamp in range(100)
        ]


@pytest.mark.thorough
async def test_several_topics_are_heard_and_one_that_only_listens_says_nothing() -> None:
    async with (
        router() as address,
        joined(address, tf="/robot1/tf", tf_static="/robot1/tf_static") as near,
        joined(address, send=False, tf=["/tf", "/robot1/tf"], tf_static=["/s", "/robot1/tf_static"]) as far,
    ):
        near.bus.publish(static("map", "lidar"))
        await far.until_heard("lidar")
        far.bus.publish([static("map", "far"), moving("map", "arm", 1)])
        near.bus.publish(moving("map", "near", 1))
        await until(lambda: far.link.statistics().received_samples == 2)
        assert near.link.statistics().received_samples == 0
        assert far.link.statistics().sent_messages == 0


@pytest.mark.thorough
async def test_links_hear_each_other_again_when_their_router_is_back() -> None:
    (port,) = free_ports(1)
    address = f"tcp/127.0.0.1:{port}"
    with Bus() as near, Bus() as far, Bus() as late:
        async with AsyncExitStack() as first:
            await first.enter_async_context(ZenohRouter(address))
            async with RmwZenohLink(near, address, DOMAIN), RmwZenohLink(far, address, DOMAIN):
                near.publish(static("map", "lidar", 1.0))
                await until(lambda: "lidar" in latched(far))
                await first.aclose()
                near.publish([static("map", "camera", 2.0)])
                async with ZenohRouter(address):
                    await until(lambda: "camera" in latched(far))
                    async with RmwZenohLink(late, address, DOMAIN):
                        await until(lambda: latched(late).keys() == {"lidar", "camera"})


@pytest.mark.thorough
async def test_a_node_of_another_program_both_ways_with_every_answer_right() -> None:
    with Bus() as bus:
        async with router() as address:
            assert await meet(RmwZenohLink(bus, address, DOMAIN), bus, sdk_peer(address)) == {"rmw_zenoh"}


@pytest.mark.thorough
@on_one_loop
async def test_a_node_of_another_program_is_heard_again_when_it_is_back_and_a_link_too() -> None:
    async with router() as address:
        with Bus() as bus:
            await check_killed_node(RmwZenohLink(bus, address, DOMAIN), bus, partial(sdk_peer, address))
        await check_link_that_came_back(lambda bus: RmwZenohLink(bus, address, DOMAIN), sdk_peer(address, 3.0))


@pytest.mark.thorough
async def test_links_begin_and_end_again_and_again() -> None:
    async with router() as address:
        for _ in range(10):
            with Bus() as bus, anyio.fail_after(10):
                async with RmwZenohLink(bus, address, DOMAIN), RmwZenohLink(bus, address, DOMAIN):
                    bus.publish([moving("map", "base", 1), static("map", "lidar")])


@pytest.mark.parametrize(
    ("arguments", "error", "said"),
    [
        ({"router": "localhost:7447"}, ValueError, "setting"),
        ({"router": 7447}, TypeError, "router"),
        ({"domain": 300}, ValueError, "0 to 232"),
        ({"node": "a b"}, ValueError, "name of a node"),
        ({"config": {"no/such": 1}}, ValueError, "setting"),
        ({"tf": "a b"}, ValueError, "topic"),
    ],
)
def test_arguments_that_are_not_valid_are_refused(arguments: Any, error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        RmwZenohLink(Bus(), **arguments)


def test_settings_of_zenoh_are_laid_over_those_of_a_client_of_the_router() -> None:
    config = configuration("tcp/robot:7447", {"scouting/multicast/enabled": True, "connect/timeout_ms": 500})
    read = {
        path: json.loads(config.get_json(path))
        for path in ("mode", "connect/endpoints", "timestamping/enabled", "scouting/multicast/enabled")
    }
    # Without time stamps nothing is kept for late joiners.
    assert list(read.values()) == ["client", ["tcp/robot:7447"], True, True]
    assert json.loads(configuration("tcp/robot:7447", {}).get_json("scouting/multicast/enabled")) is False


def test_the_domain_is_that_of_the_variable_unless_it_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    assert [RmwZenohLink(Bus()).domain, RmwZenohLink(Bus(), domain=3).domain] == [42, 3]


async def test_a_router_that_is_not_there_is_an_os_error() -> None:
    (port,) = free_ports(1)
    # Without the place in zenoh's own source.
    with Bus() as bus, pytest.raises(OSError, match=rf"no router of rmw_zenoh: [^/]*tcp/127.0.0.1:{port}[^/]*$"):
        await RmwZenohLink(bus, f"tcp/127.0.0.1:{port}", config={"connect/timeout_ms": 50}).__aenter__()


def test_a_link_that_asyncio_cancels_while_it_connects_is_no_node_later(monkeypatch: pytest.MonkeyPatch) -> None:
    connecting, cancelled, sessions_opened = threading.Event(), threading.Event(), list[zenoh.Session]()
    connect = zenoh.open

    def connect_late(config: zenoh.Config) -> zenoh.Session:
        connecting.set()
        cancelled.wait(SECONDS)
        sessions_opened.append(connect(config))
        return sessions_opened[0]

    async def cancel() -> None:
        async with router() as address:
            with Bus() as bus, monkeypatch.context() as patch:
                patch.setattr(zenoh, "open", connect_late)
                task = asyncio.create_task(RmwZenohLink(bus, address, DOMAIN).__aenter__())
                await until(connecting.is_set)
                task.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await task
            cancelled.set()
            await until(lambda: bool(sessions_opened))
            await until(sessions_opened[0].is_closed)

    asyncio.run(cancel())


async def test_what_zenoh_does_not_take_is_told_and_not_counted_as_sent(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(_: object) -> bytes:
        raise zenoh.ZError("the session is closed")

    async with router() as address, joined(address) as end:
        monkeypatch.setattr(rmw_zenoh_link, "encode", fail)
        end.bus.publish([moving("map", "base", 1), static("map", "lidar")])
        await until(lambda: "the session is closed" in caplog.text)
        assert end.link.statistics().sent_messages == 0


async def test_a_session_that_does_not_close_in_time_is_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async with router() as address:
        async with joined(address):
            pass
        assert caplog.records == [], "an end in time is no failure"
        told, begin = threading.Event(), sessions.begin_to_close
        monkeypatch.setattr(
            rmw_zenoh_link, "begin_to_close", lambda close: begin(lambda: told.wait(SECONDS) and close())
        )
        monkeypatch.setattr(sessions, "CLOSING_TIME", 0.0)
        async with joined(address):
            pass
        assert "zenoh has not closed its session" in caplog.text
        told.set()


@pytest.mark.parametrize("cases", [300, pytest.param(3_000, marks=pytest.mark.thorough)])
async def test_no_damaged_message_attachment_or_key_ends_a_link_and_each_is_counted_or_heard(
    cases: int, caplog: pytest.LogCaptureFixture
) -> None:
    random = Random(cases)
    clock = SimulatedClock()
    heard: set[str] = set()
    taken: list[Any] = []
    transforms = [encode([moving("map", f"frame{number}", 5, 1.5) for number in range(size)]) for size in (1, 3, 400)]
    for name in (b"\xff\xfe", b"a\0b", b"\n\x1b[2J", b"///"):
        transforms.append(transforms[1].replace(b"frame0", name.ljust(6, b"/")))
    for number in (math.nan, math.inf, -1e308, 1e13):
        transforms.append(transforms[1].replace(struct.pack("<d", 1.5), struct.pack("<d", number)))
    good = {
        f"tf/{TYPE}/{HASH}": transforms,
        f"tf_static/{TYPE}/{HASH}": transforms[:2],
        f"joint_states/{JOINT_TYPE}/{JOINT_HASH}": [joint_state(5, {"frame": 1.5})],
        f"clock/{CLOCK_TYPE}/{CLOCK_HASH}": [b"\0\1\0\0" + struct.pack("<iI", 5, 6)],
        f"robot_description/{TEXT_TYPE}/{TEXT_HASH}": [TEXT],
        f"odom/{ODOMETRY_TYPE}/{ODOMETRY_HASH}": [odometry(moving("odom", "frame", 5, 1.5))],
    }
    with Bus(SimulatedClock(), max_ahead=None) as bus:
        bus.subscribe(lambda batch: heard.update(sample.child for sample in batch))
        async with (
            router() as address,
            RmwZenohLink(
                bus,
                address,
                DOMAIN,
                clock=clock,
                max_frames=10**6,
                joint_states=lambda *joints: taken.append(joints),
                robot_description=taken.append,
                odometry="/odom",
            ) as link,
        ):
            session = await anyio.to_thread.run_sync(zenoh.open, configuration(address, {}))
            attachment = pack(Attachment(1, 2, b"a publisher of 16"[:16]))

            def hurt(message: bytes) -> bytes:
                return damaged(random, message, PIECES)

            def storm() -> None:
                for _ in range(cases):
                    key, payloads = random.choice(list(good.items()))
                    key = random.choice([key, key, key, key.rpartition("/")[0] + "/x", key + "/x", "tf/x/y"])
                    with_it = random.choice([attachment, None, hurt(attachment), b"", bytes(100_000)])
                    payload = random.choice(payloads)
                    payload = random.choice([payload, hurt(payload), hurt(payload)])
                    session.put(f"{DOMAIN}/{key}", payload, attachment=with_it, congestion_control=BLOCK)
                    session.delete(f"{DOMAIN}/{key}")
                session.put(f"{DOMAIN}/tf/{TYPE}/{HASH}", bytes(5_000_000))

            try:
                await anyio.to_thread.run_sync(storm)
                for stamp in count(1):
                    session.put(f"{DOMAIN}/tf/{TYPE}/{HASH}", encode([moving("map", "last", stamp)]))
                    await anyio.sleep(0.01)
                    if "last" in heard and link.statistics().queue.pending == 0:
                        break
            finally:
                await anyio.to_thread.run_sync(session.close)
            counts = link.statistics()
            # Two in three have a key that the link takes, and the queue drops none.
            assert counts.received_messages + sum(counts.rejected.values()) > cases / 2
            assert counts.queue.dropped == 0
            for reason in ("truncated", "oversized", "not finite", "frame name"):
                assert counts.rejected[reason], (reason, counts.rejected)
            assert "not published" not in counts.rejected
    assert [record for record in caplog.records if record.levelname in ("ERROR", "CRITICAL")] == []
