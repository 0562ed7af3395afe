"""A link whose server breaks, falls silent, is too slow, refuses frames, or says things of itself.

The tests run in simulated time: it goes on when nobody has anything to do, so seconds cost nothing and are exact.
"""

import itertools
import json
import ssl
from contextlib import AbstractAsyncContextManager, suppress
from typing import Any, Unpack

import anyio
import anyio.abc
import anyio.lowlevel
import pytest

pytest.importorskip("wsproto", reason='pip install "tfbus[rosbridge]"')
pytest.importorskip("trio")

from support import rosbridge
from support.rosbridge import Joined, rosbridge_server
from support.samples import latched, moving, static
from trio.testing import MockClock
from wsproto.events import BytesMessage, CloseConnection, Ping, TextMessage
from wsproto.utilities import LocalProtocolError

from tfbus import Buffer, Bus, PeerJoined, PeerLost
from tfbus.links.ros import RosOptions
from tfbus.links.rosbridge import RosbridgeLink

pytestmark = pytest.mark.anyio

ROS_1, ROS_2 = ("cbor",), ("cbor-raw", "cbor")
"""The encodings of a server whose messages are those of ROS 1, and of one of ROS 2; the first is asked for."""


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, Any]]:
    return "trio", {"clock": MockClock(autojump_threshold=0.005)}


async def settle() -> None:
    """Let all that can be done now be done."""
    await anyio.sleep(0.02)


def joined(encodings: tuple[str, ...] = ROS_2, **options: Unpack[RosOptions]) -> AbstractAsyncContextManager[Joined]:
    return rosbridge.joined(encodings, "cbor-raw" if encodings == ROS_2 else "cbor", **options)


def gaps(times: list[float]) -> list[float]:
    return [round(later - earlier, 1) for earlier, later in itertools.pairwise(times)]


# A server that goes, falls silent, or is not one


@pytest.mark.parametrize("how", ["close", "cut", "garbage"])
async def test_the_end_of_a_connection_is_told_and_the_link_comes_back(
    how: str, caplog: pytest.LogCaptureFixture
) -> None:
    async with joined() as (server, _, link):
        (client,) = server.clients
        if how == "close":
            await client.send(CloseConnection(1001, "good night"))
        elif how == "cut":
            await server.cut()
        else:
            await client.stream.send(b"\xff" * 100)
        await anyio.sleep(1.0)
        assert link.peers == (server.url,)
        assert len(server.attempts) == 2
        said = {"close": "has closed: good night", "cut": "connection is gone", "garbage": "has closed: Invalid opcode"}
        assert said[how] in caplog.text


async def test_after_a_break_the_link_is_back_with_its_static_frames_and_hears_those_of_ros() -> None:
    async with joined(drop_lost=True) as end:
        server, bus, link = end
        with bus.events() as events:
            server.latched["/tf_static"] = (static("map", "lidar", 2.0, 3),)
            bus.publish(static("map", "camera"))
            await server.cut()
            await anyio.lowlevel.checkpoint()
            while link.peers:
                await anyio.lowlevel.checkpoint()
            bus.publish(moving("map", "base", 5))
            await anyio.sleep(1.0)
            assert latched(bus).keys() == {"camera", "lidar"}
            assert [row["child_frame_id"] for row in end.published("/tf_static")][-1] == "camera"
            assert end.not_sent() == {"not connected": 1}
            await server.cut()
            await settle()
            assert latched(bus).keys() == {"camera"}, "the frames of a lost peer are dropped"
            told = [type(event) for event in iter(events.queue.get, None) if isinstance(event, PeerJoined | PeerLost)]
        assert told == [PeerLost, PeerJoined, PeerLost]


async def test_attempts_to_come_back_are_ever_further_apart_up_to_five_seconds() -> None:
    async with joined() as (server, _, link):
        server.absent = True
        server.attempts.clear()
        broken = anyio.current_time()
        await server.cut()
        await anyio.sleep(40.0)
        assert not link.peers
        times = [broken, *(time for _, time in server.attempts)]
        pauses = [later - earlier for earlier, later in itertools.pairwise(times)][:9]
        # Each is between a half of it and the whole, so that not all clients of a server come in one instant.
        for pause, longest in zip(pauses, [0.25, 0.5, 1.0, 2.0, 4.0, 5.0, 5.0, 5.0, 5.0], strict=True):
            assert longest / 2 <= pause <= longest + 0.01
        assert len(set(pauses[5:])) == 4


async def test_a_server_that_falls_silent_is_left_after_ten_seconds_and_asked_again(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with joined() as (server, _, link):
        # It has nothing to say, but answers pings.
        await anyio.sleep(60.0)
        assert len(server.attempts) == 1
        server.silent = True
        await anyio.sleep(7.0)
        assert link.peers == (server.url,)
        await anyio.sleep(6.0)
        assert not link.peers
        await anyio.sleep(6.0)
        server.silent = False
        await anyio.sleep(12.0)
        assert link.peers == (server.url,)
    assert "nothing has come for 10 s" in caplog.text
    assert "does not answer within 5 s" in caplog.text


async def fill(end: Joined) -> int:
    """Publish until the buffers of TCP are full for a server that does not read; returns how many messages."""
    for stamp in range(50):
        end.bus.publish([moving("map", f"frame{number}", stamp) for number in range(1_000)])
        await anyio.lowlevel.checkpoint()
    await settle()
    return 50


@pytest.mark.thorough
async def test_a_server_that_sends_and_never_reads_is_left_and_what_waited_for_it_is_not_sent_to_the_next_one(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with joined(ROS_1) as end:
        end.server.only_sends = True
        await settle()
        await fill(end)
        end.bus.publish(static("map", "lidar"))
        await anyio.sleep(15.0)
        assert "it has read nothing for 10 s" in caplog.text
        end.server.only_sends = False
        await anyio.sleep(15.0)
        end.bus.publish(moving("map", "base", 77))
        await settle()
        assert [row["child_frame_id"] for row in end.published("/tf")] == ["base"]
        assert [row["child_frame_id"] for row in end.published("/tf_static")] == ["lidar"]


@pytest.mark.thorough
async def test_a_server_that_is_too_slow_costs_the_oldest_moving_samples_and_no_static_one() -> None:
    async with joined(ROS_1) as end:
        end.server.only_sends = True
        await settle()
        published = 1_000 * await fill(end) + 3_000
        for stamp in range(3_000):
            end.bus.publish(moving("map", "base", stamp))
            await anyio.lowlevel.checkpoint()
        end.bus.publish(static("map", "lidar"))
        end.server.only_sends = False
        await anyio.sleep(1.0)
        assert [row["child_frame_id"] for row in end.published("/tf_static")] == ["lidar"]
        got = end.published("/tf")
        stamps = [row["header"]["stamp"]["nsecs"] for row in got if row["child_frame_id"] == "base"]
        assert 0 < len(stamps) < 3_000
        assert stamps == list(range(3_000 - len(stamps), 3_000))
        assert end.not_sent() == {"congested": published - len(got)}


@pytest.mark.thorough
async def test_a_link_leaves_a_server_that_reads_nothing_within_seconds() -> None:
    async with joined(ROS_1) as end:
        end.server.only_sends = True
        await settle()
        await fill(end)
        left = anyio.current_time()
    assert anyio.current_time() - left < 4.0


async def test_a_message_of_more_than_4_mib_is_cut_off_before_it_has_come(caplog: pytest.LogCaptureFixture) -> None:
    async with joined() as (server, bus, link):
        (client,) = server.clients
        sent = 0
        with suppress(anyio.BrokenResourceError, anyio.ClosedResourceError, LocalProtocolError):
            while sent < 20_000_000:
                await client.send(BytesMessage(bytes(50_000), message_finished=False))
                sent += 50_000
        assert sent < 20_000_000
        assert f"a message of more than {2**22} bytes" in caplog.text
        await anyio.sleep(1.0)
        await server.say(moving("map", "base", 5))
        await settle()
        assert bus.statistics().frames == 1
        assert link.peers == (server.url,)


async def test_messages_in_fragments_come_whole_and_a_ping_among_them_is_answered() -> None:
    async with joined() as (server, bus, _):
        (client,) = server.clients
        encoded: Any = server.encoded("/tf", (moving("map", "base", 5),), "none")
        for event in (
            TextMessage(encoded.data[:40], message_finished=False),
            Ping(b"!"),
            TextMessage(encoded.data[40:]),
        ):
            await client.send(event)
        await settle()
        assert bus.statistics().frames == 1
        assert server.pongs == [b"!"]


@pytest.mark.parametrize(
    ("path", "target"), [("", "/"), ("/ros", "/ros"), ("?token=1", "/?token=1"), ("/ros?a=1&b=2", "/ros?a=1&b=2")]
)
async def test_the_path_and_the_query_of_the_url_are_asked_for(path: str, target: str) -> None:
    async with rosbridge_server() as server:
        with Bus() as bus:
            async with RosbridgeLink(bus, server.url + path):
                assert [asked for asked, _ in server.attempts] == [target]


@pytest.mark.parametrize(
    ("url", "address"),
    [
        ("ws://robot", ("robot", 9090)),
        ("wss://robot/path", ("robot", 443)),
        ("ws://user@robot:7", ("robot", 7)),
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
    with Bus() as bus, pytest.raises(ConnectionRefusedError):
        await RosbridgeLink(bus, url).__aenter__()
    assert asked == [address]


async def test_nobody_a_page_and_a_silent_program_are_os_errors() -> None:
    with Bus() as bus:
        async with rosbridge_server() as server:
            server.absent = True
            with pytest.raises(ConnectionRefusedError, match="no websocket, status 404"):
                await RosbridgeLink(bus, server.url).__aenter__()
            server.absent, server.silent = False, True
            with pytest.raises(TimeoutError, match="does not answer within 5 s"):
                await RosbridgeLink(bus, server.url).__aenter__()
        with pytest.raises(OSError):
            await RosbridgeLink(bus, server.url).__aenter__()


async def test_a_tls_server_is_spoken_to_in_tls() -> None:
    first: list[bytes] = []

    async def answer(stream: anyio.abc.SocketStream) -> None:
        async with stream:
            first.append(await stream.receive())
            await stream.send(b"no TLS here")

    async with await anyio.create_tcp_listener(local_host="127.0.0.1") as listener, anyio.create_task_group() as tasks:
        tasks.start_soon(listener.serve, answer)
        port = listener.extra(anyio.abc.SocketAttribute.local_port)
        with Bus() as bus, pytest.raises(OSError):
            await RosbridgeLink(bus, f"wss://127.0.0.1:{port}").__aenter__()
        tasks.cancel_scope.cancel()
    # A handshake record (RFC 8446, section 5.1).
    assert first[0][:2] == b"\x16\x03"


async def test_what_a_server_says_of_itself_is_logged_in_one_line_each_and_not_without_end(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with joined() as (server, _, link):
        texts = [f"full\n2026 CRITICAL \x1b[2J {number}" for number in range(25)]
        await server.say_anything(*(json.dumps({"op": "status", "msg": text}) for text in texts * 2))
        await settle()
        assert link.statistics().rejected == {"status": 10}
    said = [line for line in caplog.messages if "says: status: full" in line]
    assert len(said) == 20
    assert all(line.isprintable() for line in said)


# A server that does not take static frames


async def test_static_frames_that_a_server_refuses_without_a_word_are_told_and_sent_until_it_takes_them(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with joined() as end:
        end.server.refuses.add("/tf_static")
        end.bus.publish([static("map", "camera"), static("map", "lidar")])
        await anyio.sleep(100.0)
        assert gaps(end.times("publish", "/tf_static")) == [2.0, 4.0, 8.0, 16.0, 30.0, 30.0]
        assert len(end.times("advertise", "/tf_static")) == 7, "each time, for the first time may have been refused too"
        assert end.not_sent() == {"not confirmed": 2}
        (line,) = caplog.messages
        assert f"{end.server.url} has not given back 2 static frames, such as 'camera', within 2 s" in line
        end.server.refuses.clear()
        await anyio.sleep(30.0)
        assert caplog.messages[1:] == [f"{end.server.url} has taken all static frames now"]
        # The next change is one message again.
        before = len(end.server.requests)
        end.bus.publish(static("map", "arm"))
        await anyio.sleep(30.0)
        assert [each["op"] for each in end.server.requests[before:]] == ["publish"]
        assert end.not_sent() == {"not confirmed": 2}


@pytest.mark.parametrize(
    "other", [static("map", "lidar", 2.0, 3), static("odom", "lidar", 1.0, 3), static("map", "lidar", 1.0, 4)]
)
async def test_a_static_frame_of_somebody_else_confirms_nothing(other: Any) -> None:
    # The bus refuses it, or the link would publish it in place of its own.
    async with joined(max_frames=1) as end:
        await end.server.say(static("map", "arm"), topic="/tf_static")
        end.server.refuses.add("/tf_static")
        end.bus.publish(static("map", "lidar", 1.0, 3))
        await settle()
        await end.server.say(other, topic="/tf_static")
        await anyio.sleep(3.0)
        assert end.not_sent() == {"not confirmed": 1}


async def test_what_comes_back_is_sent_once(caplog: pytest.LogCaptureFixture) -> None:
    async with joined(prefix="r1/", tf_static="/r1/tf_static") as end:
        for x in (0.1, 0.2):
            end.bus.publish(static("r1/base", f"r1/lidar{x}", x, 7))
            # The second one comes before the first would be sent again.
            await anyio.sleep(1.5)
        await anyio.sleep(60.0)
        sent = [each for each in end.server.requests if each["op"] in ("advertise", "publish")]
        assert [each["op"] for each in sent] == ["advertise", "publish", "publish"]
        assert [each["latch"] for each in sent] == [True] * 3, "else a server of ROS 2 warns each time"
        assert end.not_sent() == {}
    assert caplog.records == []


async def test_after_a_break_what_the_former_publisher_left_at_a_server_of_ros_2_confirms_nothing() -> None:
    async with joined() as end:
        lidar = static("map", "lidar", 1.0, 3)
        end.bus.publish(lidar)
        await settle()
        end.server.latched["/tf_static"], end.server.refuses = (lidar,), {"/tf_static"}
        await end.server.cut()
        await anyio.sleep(11.0)
        assert end.not_sent() == {}
        await anyio.sleep(5.0)
        assert end.not_sent() == {"not confirmed": 1}
        end.server.refuses.clear()
        before = end.link.statistics().duplicates
        await anyio.sleep(10.0)
        assert end.link.statistics().duplicates > before


# Servers of ROS 2


@pytest.mark.parametrize(
    ("encodings", "published", "held"), [(ROS_2, True, True), (ROS_1, True, False), (ROS_2, False, False)]
)
async def test_after_a_break_ros_2_forgets_the_former_publisher_before_moving_frames_go_out_again(
    encodings: tuple[str, ...], published: bool, held: bool
) -> None:
    async with joined(encodings) as end:
        # Nothing moves yet, so the topic of moving frames is not advertised.
        assert end.server.operations("advertise") == ["/tf_static"]
        # It tells of which ROS the server is.
        await end.server.say(static("map", "lidar"), topic="/tf_static")
        if published:
            end.bus.publish(moving("map", "base", 1))
            await settle()
        await end.server.cut()
        end.server.requests.clear()
        for stamp, wait in ((2, 1.0), (3, 9.9)):
            await anyio.sleep(wait)
            end.bus.publish(moving("map", "base", stamp))
        await anyio.sleep(0.3)
        end.bus.publish(moving("map", "base", 4))
        await settle()
        stamps = [row["header"]["stamp"]["nsecs"] for row in end.published("/tf")]
        assert stamps == ([4] if held else [2, 3, 4])
        assert end.not_sent() == ({"rejoining": 2} if held else {})
        # Only then, ROS subscribes where it no longer finds that publisher.
        assert end.server.operations("unsubscribe") == (["/tf"] if held else [])
        assert end.server.operations("advertise") == ["/tf_static", "/tf"]


async def test_after_a_break_moving_frames_go_out_when_those_of_ros_2_come_in() -> None:
    async with joined() as end:
        end.bus.publish(moving("map", "base", 1))
        await settle()
        await end.server.cut()
        # During the first two seconds, a server of ROS 2 may give frames of this link itself.
        for stamp in (2, 3):
            await anyio.sleep(1.2)
            await end.server.say(moving("map", "arm", stamp))
            await settle()
            end.bus.publish(moving("map", "base", stamp))
        await settle()
        assert end.not_sent() == {"rejoining": 1}
        assert len(end.published("/tf")) == 2
        await anyio.sleep(20.0)
        assert end.server.operations("unsubscribe") == []


async def test_static_frames_are_asked_for_ever_more_seldom_while_a_lookup_waits() -> None:
    async with joined(ROS_1) as end:
        with Buffer(end.bus) as buffer:
            # The link does not ask again for moving frames when it has heard some.
            await end.server.say(moving("map", "base", 1))
            with anyio.move_on_after(50.0):
                await buffer.lookup("map", "lidar", timeout=1e6)
            times = end.times("subscribe", "/tf_static")[1:]
            assert gaps(times) == [2.0, 4.0, 8.0, 16.0, 16.0]
            assert len(end.times("subscribe", "/tf")) == 1
            await anyio.sleep(30.0)
            assert end.times("subscribe", "/tf_static")[1:] == times, "nothing waits"
            # The frame had come to the server before this link did.
            end.server.latched["/tf_static"] = (static("map", "lidar", 2.0, 3),)
            asked = anyio.current_time()
            found = await buffer.lookup("map", "lidar", timeout=100)
            assert anyio.current_time() - asked < 1.1
            assert found.transform.translation == (2.0, 0.0, 0.0)


@pytest.mark.parametrize(("sends", "asked"), [(False, ["/tf_static", "/tf"]), (True, ["/tf_static"])])
async def test_moving_frames_are_asked_for_again_if_none_has_come_and_none_is_sent(
    sends: bool, asked: list[str]
) -> None:
    async with joined(ROS_1) as end:
        with Buffer(end.bus) as buffer:
            if sends:
                # A server that does not give it back.
                end.server.clients[0].subscriptions.pop("/tf")
                end.bus.publish(moving("map", "base", 5))
            with anyio.move_on_after(1.5):
                await buffer.lookup("map", "lidar", timeout=100)
            assert end.server.operations("unsubscribe") == asked
