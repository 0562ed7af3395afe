import math
import os
import re
import struct
import sys
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from threading import Event
from threading import enumerate as enumerate_threads
from typing import Any, NamedTuple, Unpack
from xml.etree import ElementTree as ET

import anyio
import anyio.to_thread
import pytest
from support.joint_messages import odometry
from support.processes import until
from support.ros import named
from support.samples import latched, moving, static

pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant
from cyclonedds.core import DDSException
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from support.dds import DdsNode

from tfbus import Bus, PeerJoined, PeerLost, PeerRejected, SimulatedClock, TransformStamped, UncertainSample
from tfbus.links.dds import DdsLink, readers
from tfbus.links.dds.dds_link import Discovery, configuration
from tfbus.links.dds.types import (
    Header,
    ParticipantEntitiesInfo,
    RawClock,
    RawEntitiesInfo,
    RawJointState,
    RawOdometry,
    RawString,
    RawTFMessage,
    Time,
)
from tfbus.links.ros import RosOptions
from tfbus.links.ros.ros_link import MAX_SIZE
from tfbus.tf_message import encode

pytestmark = pytest.mark.anyio


class Joined(NamedTuple):
    """A link in a domain, and what its bus has heard."""

    bus: Bus
    link: DdsLink
    heard: list[TransformStamped]

    async def until_heard(self, *children: str) -> None:
        await until(lambda: [sample.child for sample in self.heard] == list(children))


@asynccontextmanager
async def joined(number: int, **options: Unpack[RosOptions]) -> AsyncIterator[Joined]:
    heard: list[TransformStamped] = []
    with Bus() as bus:
        bus.subscribe(heard.extend)
        async with DdsLink(bus, number, **options) as link:
            yield Joined(bus, link, heard)


# Messages that come in


async def test_messages_come_with_the_name_of_their_node(domain_number: int) -> None:
    async with joined(domain_number) as end:
        with DdsNode(domain_number) as node:
            node.say(static("map", "lidar"), topic="rt/tf_static")
            node.writer("rt/tf")
            await until(lambda: len(end.link.peers) == 1)
            node.tell_name("/robot1", "driver")
            await end.until_heard("lidar")
            node.say(moving("map", "base", 5))
            await end.until_heard("lidar", "base")
        # Another one, which the library may know by the same number.
        with DdsNode(domain_number) as node:
            node.say(static("map", "camera"), topic="rt/tf_static")
            node.tell_name("/", "camera")
            await end.until_heard("lidar", "base", "camera")
        assert end.heard == [
            static("map", "lidar", authority="/robot1/driver"),
            moving("map", "base", 5, authority="/robot1/driver"),
            static("map", "camera", authority="/camera"),
        ]


@pytest.mark.thorough
async def test_a_message_waits_for_the_name_of_its_node_only_a_while_and_longer_for_a_program_of_ros(
    domain_number: int,
) -> None:
    async with joined(domain_number) as end:
        with DdsNode(domain_number, b"enclave=/robot;\0") as node, DdsNode(domain_number) as other:
            node.say(static("map", "lidar"), topic="rt/tf_static")
            await until(lambda: end.link.peers == (node.id,))
            other.say(static("map", "camera"), topic="rt/tf_static")
            await end.until_heard("camera")
            node.tell_name("/", "late")
            await end.until_heard("camera", "lidar")
    assert [sample.authority for sample in end.heard] == [other.id, "/late"]


async def test_a_program_that_is_no_node_is_the_authority_by_the_name_of_its_participant(domain_number: int) -> None:
    async with joined(domain_number) as end:
        with DdsNode(domain_number, name="planner") as node, DdsNode(domain_number, name="x" * 1_000) as long:
            node.say(static("map", "lidar"), topic="rt/tf_static")
            await end.until_heard("lidar")
            long.say(static("map", "camera"), topic="rt/tf_static")
            await end.until_heard("lidar", "camera")
    assert [sample.authority for sample in end.heard] == ["planner", "x" * 256]


async def test_others_see_the_name_of_the_program_of_a_link_and_its_process(domain_number: int) -> None:
    with DdsNode(domain_number) as node:
        reader = BuiltinDataReader(node.participant, BuiltinTopicDcpsParticipant)
        async with joined(domain_number):
            await until(lambda: any(readers.name_of(each).startswith("tfbus ") for each in readers.read(reader)))
            names = {readers.name_of(each) for each in readers.read(reader)}
        readers.delete(reader)
    assert names == {"", f"tfbus {Path(sys.argv[0]).name} [{os.getpid()}]"}


async def test_a_program_whose_file_has_no_utf_8_for_its_name_can_join(
    domain_number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["/opt/r\udcff.py"])
    async with joined(domain_number) as end:
        assert end.link.peers == ()


async def test_a_link_is_a_node_with_its_publishers_until_it_ends(domain_number: int) -> None:
    told: list[Any] = []
    with DdsNode(domain_number) as node:
        reader = node.reader("ros_discovery_info", RawEntitiesInfo)

        def has_told(count: int) -> bool:
            told.extend(each.read() for each in reader.take(N=10) if isinstance(each, RawEntitiesInfo))
            return len(told) >= count

        async with joined(domain_number) as hearing:
            await until(lambda: has_told(1))
            async with joined(domain_number) as sending:
                await until(lambda: has_told(2))
                sending.bus.publish(static("map", "lidar"))
                await hearing.until_heard("lidar")
            await until(lambda: has_told(3))
        await until(lambda: has_told(4))
    (first, [(name, _)]), (second, [(_, publishers)]), *gone = told
    assert gone == [(second, []), (first, [])]
    assert name == f"/{re.sub(r'[^a-z0-9]+', '_', f'tfbus {Path(sys.argv[0]).name}')}_{os.getpid()}"
    assert [sample.authority for sample in hearing.heard] == [name]
    assert len(set(publishers)) == 2


async def test_a_participant_is_a_peer_while_it_publishes_on_any_topic(domain_number: int) -> None:
    async with joined(domain_number, authority="ros") as end:
        with end.bus.events() as events:
            with DdsNode(domain_number) as node:
                node.say(static("map", "lidar"), topic="rt/tf_static")
                await end.until_heard("lidar")
                node.writer("rt/tf")
                await until(lambda: bool(node.writer("rt/tf").get_matched_subscriptions()))
                node.say(moving("map", "base", 1))
                await end.until_heard("lidar", "base")
                node.silence("rt/tf_static")
                node.say(moving("map", "base", 2))
                await end.until_heard("lidar", "base", "base")
                assert end.link.peers == (node.id,)
            await until(lambda: not end.link.peers)
            told = [type(event) for event in iter(events.queue.get, None) if isinstance(event, PeerJoined | PeerLost)]
        assert told == [PeerJoined, PeerLost]


async def test_what_waits_for_the_name_of_its_node_comes_before_the_end_of_its_participant(domain_number: int) -> None:
    async with joined(domain_number, drop_lost=True) as end:
        # Dropped with the peer, and back with the next one.
        for _ in range(2):
            with DdsNode(domain_number) as node:
                node.say(static("map", "lidar"), topic="rt/tf_static")
                await until(lambda: end.link.peers == (node.id,))
            await until(lambda: not end.link.peers)
            assert end.heard == [static("map", "lidar", authority=node.id)]
            assert end.bus.statistics().frames == 0
            end.heard.clear()


def call_after_the_writers(method: str, topic: str, monkeypatch: pytest.MonkeyPatch) -> Event:
    """While the event is set, have readers of a topic call a method of theirs only when their writers have gone."""
    called, waits = getattr(DataReader, method), Event()

    def call_late(reader: Any, *arguments: Any, **options: Any) -> Any:
        while waits.is_set() and reader.topic.name == topic and reader.get_matched_publications():
            time.sleep(0.01)
        return called(reader, *arguments, **options)

    monkeypatch.setattr(DataReader, method, call_late)
    return waits


@pytest.mark.parametrize("late", ["take", "take_status"])
async def test_a_message_that_is_read_after_the_end_of_its_writer_is_still_of_its_node(
    late: str, domain_number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits = call_after_the_writers(late, "rt/tf_static", monkeypatch)
    async with joined(domain_number, drop_lost=True) as end:
        with DdsNode(domain_number) as node:
            node.writer("rt/tf_static")
            await until(lambda: end.link.peers == (node.id,))
            waits.set()
            node.say(static("map", "lidar"), topic="rt/tf_static")
        await until(lambda: not end.link.peers)
        assert end.heard == [static("map", "lidar", authority=node.id)]
        assert end.bus.statistics().frames == 0


async def test_all_messages_that_wait_at_the_end_of_their_writer_are_of_its_node(
    domain_number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = [f"frame{number}" for number in range(400)]
    waits = call_after_the_writers("take_status", "rt/tf", monkeypatch)
    async with joined(domain_number) as end:
        with DdsNode(domain_number) as node:
            node.writer("rt/tf")
            await until(lambda: end.link.peers == (node.id,))
            waits.set()
            for number, frame in enumerate(frames, 1):
                node.say(moving("map", frame, number))
        await until(lambda: not end.link.peers)
        assert end.heard == [moving("map", frame, number, authority=node.id) for number, frame in enumerate(frames, 1)]


async def test_joints_the_time_and_a_description_come_from_topics_of_their_own(domain_number: int) -> None:
    states: list[Any] = []
    descriptions: list[str] = []
    clock = SimulatedClock()
    options: RosOptions = {
        "joint_states": lambda *state: states.append(state),
        "robot_description": descriptions.append,
        "clock": clock,
        "odometry": "/odom",
    }
    joints: Any = RawJointState
    time: Any = Time(100, 5)
    pose = RawOdometry.__idl__.deserialize(odometry(moving("odom", "base", 7, 1.5)))
    with DdsNode(domain_number) as node:
        # Latched, so it may come long before the link.
        node.writer("rt/robot_description", RawString).write(RawString("<robot/>"))
        async with joined(domain_number, **options) as end:
            await until(lambda: descriptions == ["<robot/>"])
            with anyio.fail_after(20):
                while not states or not clock.now() or not end.heard:
                    # Messages that are not latched may be lost while the two meet.
                    state = joints(Header(time, ""), ["a"], [0.5], [], [])
                    node.writer("rt/joint_states", RawJointState).write(state)
                    node.writer("rt/clock", RawClock).write(RawClock(time))
                    node.writer("rt/odom", RawOdometry).write(pose)
                    await anyio.sleep(0.01)
            assert end.link.statistics().rejected == {}
    assert end.heard[0] == moving("odom", "base", 7, 1.5, "/odom")
    assert isinstance(end.heard[0], UncertainSample)
    assert states[0] == ({"a": 0.5}, 100_000_000_005)
    assert clock.now() == 100_000_000_005


@contextmanager
def other_threads_waiting() -> Iterator[None]:
    """Keep the interpreter lock, so the thread of the readers takes nothing meanwhile."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(100.0)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)


async def test_a_burst_loses_no_message_up_to_the_depth_of_dds_and_beyond_it_that_is_told(
    domain_number: int, caplog: pytest.LogCaptureFixture
) -> None:
    async with joined(domain_number, authority="ros") as end:
        with DdsNode(domain_number) as node:
            node.writer("rt/tf")
            await until(lambda: len(end.link.peers) == 1)
            with other_threads_waiting():
                for stamp in range(2_000):
                    node.say(moving("map", "base", stamp))
            await until(lambda: len(end.heard) == 2_000)
            assert [sample.stamp for sample in end.heard] == list(range(2_000))
            assert end.link.statistics().rejected == {}
            with other_threads_waiting():
                for stamp in range(2_000, 8_000):
                    node.say(moving("map", "base", stamp))
            await until(lambda: end.link.statistics().rejected == {"overrun": 1})
            await until(lambda: end.heard[-1].stamp == 7_999)
    assert "messages of /tf come faster than they are taken, some may be lost" in caplog.text


@pytest.mark.thorough
async def test_garbage_is_counted_by_reason_and_ends_nothing(domain_number: int) -> None:
    async with joined(domain_number) as end:
        with end.bus.events() as events, DdsNode(domain_number) as node:
            writer = node.writer("rt/tf")
            await until(lambda: end.link.peers != ())
            # Cyclone DDS itself drops what has not the layout of the type.
            bad = encode([moving("map", "base", 1, 1.5)])
            own_parent = named(encode([moving("self", "also", 1)]), "also", "self")
            not_finite = bad.replace(struct.pack("<d", 1.5), struct.pack("<d", math.nan))
            large = encode([moving("map", f"{number:0100d}", 1) for number in range(25_000)])
            assert len(large) > MAX_SIZE
            for payload in (own_parent, not_finite, large) * 2:
                await anyio.to_thread.run_sync(writer.write, RawTFMessage.of(payload))
            node.say(moving("map", "base", 5))
            await end.until_heard("base")
            assert end.link.statistics().rejected == {"self transform": 2, "not finite": 2, "oversized": 2}
            told = [event.reason for event in iter(events.queue.get, None) if isinstance(event, PeerRejected)]
        assert told == ["self transform", "not finite", "oversized"]


@pytest.mark.parametrize(
    ("nodes", "reason"),
    [
        (struct.pack("<II2s2xI2s2xII", 1, 2, b"/\0", 2, b"\xff\0", 0, 0), "encoding"),
        (struct.pack("<II2s2xI2s2xII", 1, 2, b"/\0", 2, b"a\0", 0, 300_000) + bytes(16 * 300_000), "oversized"),
    ],
    ids=["encoding", "oversized"],
)
async def test_names_of_nodes_that_cannot_be_read_are_malformed_and_spoil_no_others(
    domain_number: int, nodes: bytes, reason: str
) -> None:
    async with joined(domain_number) as end:
        with DdsNode(domain_number) as node:
            node.say(static("map", "lidar"), topic="rt/tf_static")
            bad: Any = node.names("/", "bad")
            bad.serialize = lambda **_: b"\0\1\0\0" + node.participant.guid.bytes + nodes
            await anyio.to_thread.run_sync(node.writer("ros_discovery_info", ParticipantEntitiesInfo).write, bad)
            await until(lambda: end.link.statistics().rejected == {reason: 1})
            node.tell_name("/", "good")
            await end.until_heard("lidar")
            assert end.heard[0].authority == "/good"


@pytest.mark.parametrize(
    ("method", "error", "counted"),
    [
        # Another writer has come between the two calls that the library makes for this.
        ("get_matched_publications", IndexError("invalid index"), set()),
        ("get_matched_publications", RuntimeError("once"), {"not read"}),
        # A stranger has given its writer such a name.
        ("get_matched_publication_data", UnicodeDecodeError("utf-8", b"\xff", 0, 1, "x" * 1_000), {"not read"}),
        ("take", ValueError("once"), {"not read"}),
    ],
)
async def test_an_error_of_the_library_keeps_no_message_of_others_from_coming(
    domain_number: int, method: str, error: Exception, counted: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    sound, failed = getattr(DataReader, method), list[object]()

    def fail(reader: DataReader[Any], *arguments: Any, **options: Any) -> Any:
        if reader.topic.name == "rt/tf_static" and (not failed or (arguments and failed[0] == arguments[0])):
            failed.extend([*arguments, None])
            raise error
        return sound(reader, *arguments, **options)

    async with joined(domain_number, authority="ros") as end:
        with end.bus.events() as events, DdsNode(domain_number) as stranger, DdsNode(domain_number) as node:
            monkeypatch.setattr(DataReader, method, fail)
            stranger.say(static("map", "lidar"), topic="rt/tf_static")
            await until(lambda: failed != [])
            node.say(static("map", "camera"), topic="rt/tf_static")
            await until(lambda: "camera" in latched(end.bus))
            await until(lambda: node.id in end.link.peers)
            assert end.link.statistics().rejected.keys() == counted
            told = [str(event.error) for event in iter(events.queue.get, None) if isinstance(event, PeerRejected)]
        assert bool(told) is bool(counted)
        assert all("DDS cannot be read" in text and len(text) < 300 for text in told)


# Messages that go out


async def test_two_buses_in_one_domain_hear_each_other_and_a_late_one_the_last_static_frames(
    domain_number: int,
) -> None:
    async with joined(domain_number, authority="ros") as near:
        near.bus.publish([static("map", "lidar", 1.0, stamp=3), static("map", "gone", 2.0)])
        near.bus.remove_frame("gone")
        async with joined(domain_number, authority="ros") as far:
            await until(lambda: len(near.link.peers) == len(far.link.peers) == 1)
            near.bus.publish(moving("map", "base", 5, 1.0))
            await far.until_heard("lidar", "base")
            far.bus.publish([moving("base", "arm", 6, 2.0)])
            await until(lambda: near.link.statistics().received_samples == 1)
            near.bus.publish([static("map", "lidar", 2.0, stamp=4)])
            async with joined(domain_number, send=False, authority="ros") as late:
                await late.until_heard("lidar")
                assert late.heard == [static("map", "lidar", 2.0, 4, "ros")]
            assert far.heard[:2] == [static("map", "lidar", 1.0, 3, "ros"), moving("map", "base", 5, 1.0, "ros")]
            assert (near.link.statistics().duplicates, far.link.statistics().duplicates) == (0, 0)
            assert near.link.statistics().sent_messages == 3 + (near.heard == [])


@pytest.mark.thorough
async def test_several_topics_are_heard_and_the_first_is_spoken_to(domain_number: int) -> None:
    async with (
        joined(domain_number, tf="/robot1/tf", tf_static="/robot1/tf_static") as near,
        joined(domain_number, tf=["/tf", "/robot1/tf"], tf_static=["/s", "/robot1/tf_static"]) as far,
    ):
        await until(lambda: far.link.peers != ())
        far.bus.publish(moving("map", "far", 1))
        near.bus.publish([moving("map", "near", 1), static("map", "lidar")])
        await until(lambda: far.link.statistics().received_samples == 2)
        assert near.link.statistics().received_samples == 0


@pytest.mark.thorough
async def test_links_of_one_bus_to_one_domain_send_nothing_round(domain_number: int) -> None:
    with Bus() as bus, Bus() as far:

        def counted() -> int:
            return bus.statistics().samples + far.statistics().samples

        async with (
            DdsLink(bus, domain_number) as one,
            DdsLink(bus, domain_number) as other,
            DdsLink(far, domain_number) as third,
        ):
            await until(lambda: len(one.peers) == len(other.peers) == len(third.peers) == 2)
            for stamp in range(100):
                bus.publish(moving("map", "base", stamp))
                far.publish(moving("map", "arm", stamp))
                await anyio.sleep(0.001)
            far.publish(static("map", "lidar"))
            await until(lambda: counted() >= 402)
            # A message that goes round comes before these have gone round.
            for stamp in range(5):
                far.publish(moving("map", "last", stamp))
                await until(lambda stamp=stamp: counted() >= 404 + 2 * stamp)  # type: ignore[misc]
            assert (bus.statistics().samples, far.statistics().samples) == (206, 206)


async def test_what_dds_does_not_take_is_told_and_not_counted_as_sent(
    domain_number: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def write(*_: object) -> None:
        raise DDSException(-1)

    async with joined(domain_number) as end:
        monkeypatch.setattr(DataWriter, "write", write)
        end.bus.publish([moving("map", "base", 1), static("map", "lidar")])
        await until(lambda: "not sent over the link" in caplog.text)
        assert end.link.statistics().sent_messages == 0


# Joining and leaving


async def test_links_share_a_domain_until_the_last_of_them_ends_with_one_configuration(domain_number: int) -> None:
    with Bus() as bus:
        for further in ("127.0.0.2", "127.0.0.3"):
            async with DdsLink(bus, domain_number, peers=[further]):
                async with DdsLink(bus, domain_number, peers=[further]):
                    pass
                with pytest.raises(OSError, match="is open in this process with another configuration"):
                    await DdsLink(bus, domain_number).__aenter__()
                assert sum(thread.name == "tfbus dds" for thread in enumerate_threads()) == 1


async def test_a_configuration_that_cannot_be_read_is_an_os_error(domain_number: int, tmp_path: Path) -> None:
    broken = tmp_path / "broken.xml"
    broken.write_text("<CycloneDDS><Domain><Nonsense/></Domain></CycloneDDS>")
    with Bus() as bus:
        with pytest.raises(OSError, match=f"cannot open the DDS domain {domain_number}"):
            await DdsLink(bus, domain_number, config=f"file://{broken}").__aenter__()
        # It is not taken for open.
        async with DdsLink(bus, domain_number):
            pass


@pytest.mark.thorough
async def test_a_domain_that_cannot_be_left_is_not_waited_for(
    domain_number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    going_on, stop = Event(), readers.ReaderThread.stop

    def wait(thread: readers.ReaderThread) -> None:
        going_on.wait(20.0)
        stop(thread)

    monkeypatch.setattr(readers.ReaderThread, "stop", wait)
    with anyio.fail_after(10):
        async with joined(domain_number):
            pass
    (closing,) = [thread for thread in enumerate_threads() if thread.name == "tfbus dds close"]
    going_on.set()
    assert closing.daemon, "nor at the end of the program"
    await anyio.to_thread.run_sync(closing.join)


@pytest.mark.parametrize(
    ("discovery", "peers", "variable", "interfaces", "addresses"),
    [
        ("localhost", (), "SUBNET", ["lo"], ["127.0.0.1"]),
        ("localhost", ("10.0.0.5",), "", ["lo"], ["127.0.0.1", "10.0.0.5"]),
        ("subnet", (), "", [], []),
        ("subnet", ('a"<b',), "", [], ['a"<b']),
        (None, (), "", ["lo"], ["127.0.0.1"]),
        (None, (), "LOCALHOST", ["lo"], ["127.0.0.1"]),
        (None, (), "subnet", [], []),
    ],
)
def test_others_are_looked_for_where_discovery_peers_and_the_variable_of_ros_say(
    discovery: Discovery | None,
    peers: tuple[str, ...],
    variable: str,
    interfaces: list[str],
    addresses: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", variable)
    root = ET.fromstring(configuration(discovery, peers))
    assert [each.get("name") for each in root.iter("NetworkInterface")] == interfaces
    assert [each.get("address") for each in root.iter("Peer")] == addresses
    assert [each.text for each in root.iter("AllowMulticast")] == ["false"] * len(interfaces)
    assert [each.text for each in root.iter("IgnoreTypeInformation")] == ["1.15"]


@pytest.mark.parametrize("given", [True, False])
def test_a_configuration_of_ones_own_is_in_place_of_that_but_for_fast_dds(
    given: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", "file:///b.xml" if given else "file:///a.xml")
    own, _, rest = configuration(None, ("1.2.3.4",), "file:///a.xml" if given else None).partition(",")
    assert own == "file:///a.xml"
    assert [each.tag for each in ET.fromstring(rest).iter()][2:] == ["Compatibility", "IgnoreTypeInformation"]


@pytest.mark.parametrize(
    ("arguments", "error", "said"),
    [
        ({"domain": -1}, ValueError, "from 0 to 232"),
        ({"domain": 233}, ValueError, "from 0 to 232"),
        ({"domain": True}, TypeError, "int"),
        ({"domain": "0"}, TypeError, "int"),
        ({}, ValueError, r"ROS_DOMAIN_ID.*'home'"),
        ({"discovery": "far"}, ValueError, "'localhost' or 'subnet'"),
        ({"peers": "10.0.0.1"}, TypeError, "several"),
        ({"tf": "a b"}, ValueError, "topic"),
    ],
)
def test_arguments_and_variables_that_are_not_valid_are_refused(
    arguments: Any, error: type[Exception], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "0" if arguments else "home")
    with pytest.raises(error, match=said):
        DdsLink(Bus(), **arguments)


@pytest.mark.parametrize(("variable", "domain"), [("", 0), ("42", 42)])
def test_the_domain_is_that_of_the_variable_unless_it_is_given(
    monkeypatch: pytest.MonkeyPatch, variable: str, domain: int
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", variable)
    assert [DdsLink(Bus()).id, DdsLink(Bus(), 232).id] == [f"dds:{domain}", "dds:232"]
