import importlib.util
import json
import math
import struct
import sys
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import AbstractContextManager, AsyncExitStack, asynccontextmanager, contextmanager
from itertools import count
from pathlib import Path
from random import Random
from typing import Any

import anyio
import anyio.to_thread
import pytest
import zenoh
import zenoh.ext
from support.both_sides import SECONDS, Node, Program, meet, node
from support.joint_messages import joint_state
from support.processes import free_ports, until
from support.samples import moving, static
from support.wires import latched

from tfbus import SECOND, Buffer, Bus, PeerRejected, SimulatedClock
from tfbus.links.rmw_zenoh import RmwZenohLink
from tfbus.links.rmw_zenoh.rmw_zenoh_link import (
    CLOCK_HASH,
    CLOCK_TYPE,
    HASH,
    JOINT_HASH,
    JOINT_TYPE,
    TEXT_HASH,
    TEXT_TYPE,
    TYPE,
    Attachment,
    _config,
    pack,
)
from tfbus.links.zenoh import ZenohRouter
from tfbus.tf_message import encode

pytestmark = pytest.mark.anyio

PEER = Path(__file__).parents[2] / "support" / "rmw_zenoh_peer.py"
DOMAIN = 7


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


@pytest.mark.thorough
async def test_two_buses_hear_each_other_and_a_late_one_the_static_frames() -> None:
    with Bus() as near, Bus() as far:
        heard: list[Any] = []
        far.subscribe(lambda batch: heard.extend(batch))
        async with router() as address, RmwZenohLink(near, address, DOMAIN) as here:
            near.publish([static("map", "lidar", 1.0, 3), static("map", "gone", 2.0)])
            near.remove_frame("gone")
            await until(lambda: here.statistics().sent_messages == 1)
            async with RmwZenohLink(far, address, DOMAIN) as there:
                await until(lambda: there.statistics().received_samples == 1)
                for stamp in range(100):
                    near.publish(moving("map", "base", stamp, 1.0))
                    await anyio.sleep(0.001)
                far.publish([moving("base", "arm", 6, 2.0), static("arm", "tool", 3.0, 7)])
                await until(lambda: len(heard) == 103)
                await until(lambda: here.statistics().received_samples == 2)
                assert latched(near) == {
                    "lidar": static("map", "lidar", 1.0, 3),
                    "tool": static("arm", "tool", 3.0, 7, "rmw_zenoh"),
                }
                # Neither hears itself.
                assert (here.statistics().duplicates, there.statistics().duplicates) == (0, 0)
        assert heard[0] == static("map", "lidar", 1.0, 3, "rmw_zenoh")
        # What this bus publishes itself may come before the last of them.
        assert [sample for sample in heard if sample.child == "base"] == [
            moving("map", "base", stamp, 1.0, "rmw_zenoh") for stamp in range(100)
        ]


@pytest.mark.thorough
async def test_several_topics_are_heard_and_the_first_is_spoken_to() -> None:
    with Bus() as near, Bus() as far:
        async with (
            router() as address,
            RmwZenohLink(near, address, DOMAIN, tf="/robot1/tf", tf_static="/robot1/tf_static") as here,
            RmwZenohLink(
                far, address, DOMAIN, tf=["/tf", "/robot1/tf"], tf_static=["/s", "/robot1/tf_static"]
            ) as there,
        ):
            heard: list[str] = []
            far.subscribe(lambda batch: heard.extend(sample.child for sample in batch))
            near.publish(static("map", "lidar"))
            await until(lambda: heard == ["lidar"])
            far.publish(moving("map", "far", 1))
            near.publish(moving("map", "near", 1))
            await until(lambda: heard == ["lidar", "far", "near"])
            assert (here.statistics().received_samples, there.statistics().received_samples) == (0, 2)


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
async def test_a_node_of_another_program_is_heard_again_when_it_is_back_and_a_link_too() -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        async with router() as address:
            async with RmwZenohLink(bus, address, DOMAIN):
                with sdk_peer(address, 60.0):
                    await buffer.lookup("base", "laser", timeout=20.0)
                # Killed without a word: a new one says something else.
                with sdk_peer(address, 60.0, x=0.75):
                    await until(lambda: latched(bus)["laser"].transform.translation[0] == 0.75)
            with sdk_peer(address, 3.0) as ros:
                assert (await ros.next_line())["event"] == "up"
                program = Program(bus, buffer)
                for _ in range(2):
                    async with RmwZenohLink(bus, address, DOMAIN), anyio.create_task_group() as tasks:
                        tasks.start_soon(program.send)
                        # What has not been sent yet.
                        await buffer.lookup("odom", "tool", time.time_ns() + SECOND // 10, timeout=20.0)
                        await anyio.sleep(1.0)
                        tasks.cancel_scope.cancel()
                facts = await ros.next_line()
    assert facts["answered"] > 50
    assert facts["wrong"] == 0


@pytest.mark.thorough
async def test_positions_of_joints_go_to_who_takes_them() -> None:
    taken: list[Any] = []
    async with router() as address:
        with Bus() as bus:
            async with RmwZenohLink(bus, address, DOMAIN, joint_states=lambda *state: taken.append(state)):
                with stranger(address) as session:
                    key = f"{DOMAIN}/joint_states/{JOINT_TYPE}/{JOINT_HASH}"
                    (await heard_publisher(session, key)).put(joint_state(5, {"a": 0.5}))
                    await until(lambda: taken == [({"a": 0.5}, 5)])


@pytest.mark.thorough
async def test_the_description_of_a_robot_is_latched() -> None:
    taken: list[str] = []
    async with router() as address:
        with Bus() as bus, stranger(address) as session:
            latched = zenoh.ext.declare_advanced_publisher(
                session,
                f"{DOMAIN}/robot_description/{TEXT_TYPE}/{TEXT_HASH}",
                cache=zenoh.ext.CacheConfig(max_samples=1),
                publisher_detection=True,
            )
            # Long before the link.
            latched.put(b"\0\1\0\0" + struct.pack("<I", 9) + b"<robot/>\0")
            async with RmwZenohLink(bus, address, DOMAIN, robot_description=taken.append):
                await until(lambda: taken == ["<robot/>"])


@pytest.mark.thorough
async def test_garbage_is_counted_by_reason_and_ends_nothing() -> None:
    async with router() as address:
        with Bus() as bus, bus.events() as events, stranger(address) as session:
            async with RmwZenohLink(bus, address, DOMAIN) as link:
                publisher = await heard_publisher(session, f"{DOMAIN}/tf/{TYPE}/{HASH}")
                for payload in (b"", b"garbage", b"\0\1\0\0\xff\xff\xff\xff", bytes(5_000_000)) * 2:
                    publisher.put(payload)
                for attachment in (b"", b"x", bytes(33)):
                    publisher.put(encode([moving("map", f"f{len(attachment)}", 1)]), attachment=attachment)
                await until(lambda: link.statistics().received_samples == 3)
                assert link.statistics().rejected == {"truncated": 6, "oversized": 2}
            told = [event.reason for event in iter(events.queue.get, None) if isinstance(event, PeerRejected)]
            assert told == ["truncated", "oversized"]


async def heard_publisher(session: zenoh.Session, key: str) -> zenoh.Publisher:
    """A publisher that the link hears: the router knows of a subscription some time after the link is joined."""
    publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
    await until(lambda: bool(publisher.matching_status.matching))  # type: ignore[attr-defined]
    return publisher


@contextmanager
def stranger(address: str) -> Iterator[zenoh.Session]:
    """A session of zenoh that may say anything."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("timestamping/enabled", "true")
    config.insert_json5("connect/endpoints", json.dumps([address]))
    with zenoh.open(config) as session:
        yield session


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
    config = _config("tcp/robot:7447", {"scouting/multicast/enabled": True, "connect/timeout_ms": 500})
    read = {
        path: json.loads(config.get_json(path))
        for path in ("mode", "connect/endpoints", "timestamping/enabled", "scouting/multicast/enabled")
    }
    # Without time stamps nothing is kept for late joiners.
    assert list(read.values()) == ["client", ["tcp/robot:7447"], True, True]
    assert json.loads(_config("tcp/robot:7447", {}).get_json("scouting/multicast/enabled")) is False


def test_the_domain_is_that_of_the_variable_unless_it_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    assert [RmwZenohLink(Bus()).domain, RmwZenohLink(Bus(), domain=3).domain] == [42, 3]


@pytest.mark.thorough
async def test_a_router_that_is_not_there_is_an_os_error() -> None:
    (port,) = free_ports(1)
    # Without the place in zenoh's own source.
    with Bus() as bus, pytest.raises(OSError, match=rf"no router of rmw_zenoh: [^/]*tcp/127.0.0.1:{port}[^/]*$"):
        async with RmwZenohLink(bus, f"tcp/127.0.0.1:{port}", config={"connect/timeout_ms": 500}):
            raise AssertionError


BLOCK = zenoh.CongestionControl.BLOCK
NAMES = [b"\xff\xfe", b"a\0b", b"\n\x1b[2J", b"///"]
NUMBERS = [math.nan, math.inf, -1e308, 1e13]


def mutated(random: Random, message: bytes) -> bytes:
    """A message with some of its bytes changed, cut, or put in."""
    data = bytearray(message)
    for _ in range(random.randint(1, 3)):
        at = random.randrange(len(data) + 1)
        match random.randrange(6):
            case 0:
                data[at : at + 1] = random.randbytes(1)
            case 1:
                data[at - at % 4 : at - at % 4 + 4] = struct.pack("<I", random.choice([0, 1, 2**16, 2**31, 2**32 - 1]))
            case 2:
                del data[at:]
            case 3:
                data[at:at] = random.randbytes(random.choice([1, 8, 1_000]))
            case 4 if (place := data.find(struct.pack("<d", 1.5))) >= 0:
                data[place : place + 8] = struct.pack("<d", random.choice(NUMBERS))
            case _ if (place := data.find(b"frame")) >= 0:
                name = random.choice(NAMES)
                data[place : place + len(name)] = name
    return bytes(data)


@pytest.mark.parametrize("cases", [300, pytest.param(10_000, marks=pytest.mark.thorough)])
async def test_no_damaged_message_attachment_or_key_ends_a_link_and_each_is_counted_or_heard(
    cases: int, caplog: pytest.LogCaptureFixture
) -> None:
    random = Random(cases)
    clock = SimulatedClock()
    heard: set[str] = set()
    taken: list[Any] = []
    text = b"\0\1\0\0" + struct.pack("<I", 9) + b"<robot/>\0"
    transforms = [encode([moving("map", f"frame{number}", 5, 1.5) for number in range(size)]) for size in (1, 3, 400)]
    good = {
        f"tf/{TYPE}/{HASH}": transforms,
        f"tf_static/{TYPE}/{HASH}": transforms[:2],
        f"joint_states/{JOINT_TYPE}/{JOINT_HASH}": [joint_state(5, {"frame": 1.5})],
        f"clock/{CLOCK_TYPE}/{CLOCK_HASH}": [b"\0\1\0\0" + struct.pack("<iI", 5, 6)],
        f"robot_description/{TEXT_TYPE}/{TEXT_HASH}": [text],
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
            ) as link,
        ):
            session = await anyio.to_thread.run_sync(zenoh.open, _config(address, {}))
            attachment = pack(Attachment(1, 2, b"a publisher of 16"[:16]))

            def storm() -> None:
                for _ in range(cases):
                    key, payloads = random.choice(list(good.items()))
                    key = random.choice([key, key, key, key.rpartition("/")[0] + "/x", key + "/x", "tf/x/y"])
                    with_it = random.choice([attachment, None, mutated(random, attachment), b"", bytes(100_000)])
                    payload = mutated(random, random.choice(payloads))
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
