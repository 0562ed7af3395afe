import math
import struct
from typing import Any

import anyio
import anyio.to_thread
import pytest
from support.processes import until
from support.ros import named
from support.samples import moving, static
from support.wires import latched

pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')

from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from tfbus import Bus, PeerJoined, PeerLost, PeerRejected, SimulatedClock
from tfbus.links.dds import DdsLink
from tfbus.links.dds.types import Header, RawClock, RawJointState, RawString, RawTFMessage, Time
from tfbus.links.ros.ros_link import MAX_SIZE
from tfbus.tf_message import encode

pytestmark = pytest.mark.anyio


@pytest.mark.thorough
async def test_two_buses_in_one_domain_hear_each_other_and_a_late_one_the_static_frames(domain_number: int) -> None:
    heard: list[Any] = []
    with Bus() as near, Bus() as far, Bus() as late:
        far.subscribe(lambda batch: heard.extend(batch))
        async with DdsLink(near, domain_number) as here:
            near.publish([static("map", "lidar", 1.0, stamp=3), static("map", "gone", 2.0)])
            near.remove_frame("gone")
            async with DdsLink(far, domain_number, authority="ros") as there:
                await until(lambda: len(here.peers) == len(there.peers) == 1)
                near.publish(moving("map", "base", 5, 1.0))
                await until(lambda: len(heard) == 2)
                far.publish([moving("base", "arm", 6, 2.0)])
                await until(lambda: here.statistics().received_samples == 1)
                assert heard[:2] == [
                    static("map", "lidar", 1.0, 3, "ros"),
                    moving("map", "base", 5, 1.0, "ros"),
                ]
                async with DdsLink(late, domain_number, send=False, authority="ros") as last:
                    await until(lambda: last.statistics().received_samples == 1)
                    assert latched(late) == {"lidar": static("map", "lidar", 1.0, 3, "ros")}
                assert (here.statistics().duplicates, there.statistics().duplicates) == (0, 0)


@pytest.mark.thorough
async def test_a_peer_that_goes_is_lost_with_its_frames_if_asked_and_comes_back_with_them(domain_number: int) -> None:
    with Bus() as near, Bus() as far:
        with near.events() as events:
            async with DdsLink(near, domain_number, drop_lost=True) as here:
                far.publish(static("map", "lidar", 1.0, stamp=3))
                for _ in range(2):
                    async with DdsLink(far, domain_number):
                        await until(lambda: near.statistics().frames == 1)
                        (peer,) = here.peers
                    await until(lambda: not here.peers)
                    assert near.statistics().frames == 0
        told = [type(event) for event in iter(events.queue.get, None) if isinstance(event, PeerJoined | PeerLost)]
        assert told == [PeerJoined, PeerLost] * 2
        assert len(peer) == 32


@pytest.mark.thorough
async def test_several_topics_are_heard_and_the_first_is_spoken_to(domain_number: int) -> None:
    with Bus() as near, Bus() as far:
        async with (
            DdsLink(near, domain_number, tf="/robot1/tf", tf_static="/robot1/tf_static") as here,
            DdsLink(far, domain_number, tf=["/tf", "/robot1/tf"], tf_static=["/s", "/robot1/tf_static"]) as there,
        ):
            await until(lambda: there.peers != ())
            far.publish(moving("map", "far", 1))
            near.publish([moving("map", "near", 1), static("map", "lidar")])
            await until(lambda: there.statistics().received_samples == 2)
            assert here.statistics().received_samples == 0


@pytest.mark.thorough
async def test_positions_of_joints_go_to_who_takes_them(domain_number: int) -> None:
    make: Any = RawJointState
    stamp: Any = Time(0, 5)
    state = make(Header(stamp, ""), ["a", "b"], [0.5, 1.5], [], [])
    taken: list[Any] = []
    with Bus() as bus:
        async with DdsLink(bus, domain_number, joint_states=lambda *state: taken.append(state)):
            participant = DomainParticipant(domain_number)
            writer = DataWriter(participant, Topic(participant, "rt/joint_states", RawJointState))
            with anyio.fail_after(20):
                while not taken:
                    writer.write(state)
                    await anyio.sleep(0.05)
            writer.__del__()
            participant.__del__()
    assert taken[0] == ({"a": 0.5, "b": 1.5}, 5)


@pytest.mark.thorough
async def test_garbage_is_counted_by_reason_and_ends_nothing(domain_number: int) -> None:
    with Bus() as bus, bus.events() as events:
        async with DdsLink(bus, domain_number) as link:
            participant = DomainParticipant(domain_number)
            reliable = Qos(Policy.Reliability.Reliable(duration(seconds=10)), Policy.History.KeepAll)
            writer = DataWriter(participant, Topic(participant, "rt/tf", RawTFMessage), reliable)
            await until(lambda: link.peers != ())
            # Cyclone DDS itself drops what has not the layout of the type.
            bad = encode([moving("map", "base", 1, 1.5)])
            own_parent = named(encode([moving("self", "also", 1)]), "also", "self")
            not_finite = bad.replace(struct.pack("<d", 1.5), struct.pack("<d", math.nan))
            large = encode([moving("map", f"{number:0100d}", 1) for number in range(25_000)])
            assert len(large) > MAX_SIZE
            for payload in (own_parent, not_finite, large) * 2:
                await anyio.to_thread.run_sync(writer.write, RawTFMessage.of(payload))
            writer.write(RawTFMessage.of(encode([moving("map", "base", 5)])))
            await until(lambda: link.statistics().received_samples == 1)
            rejected = link.statistics().rejected
            writer.__del__()
            participant.__del__()
        told = [event.reason for event in iter(events.queue.get, None) if isinstance(event, PeerRejected)]
    assert rejected == {"self transform": 2, "not finite": 2, "oversized": 2}
    assert told == list(rejected)


@pytest.mark.thorough
async def test_the_description_of_a_robot_is_latched(domain_number: int) -> None:
    latched = Qos(
        Policy.Reliability.Reliable(duration(seconds=1)), Policy.Durability.TransientLocal, Policy.History.KeepLast(1)
    )
    taken: list[str] = []
    with Bus() as bus:
        async with DdsLink(bus, domain_number):
            participant = DomainParticipant(domain_number)
            topic = Topic(participant, "rt/robot_description", RawString)
            writer = DataWriter(participant, topic, latched)
            # Long before the link.
            writer.write(RawString("<robot/>"))
            async with DdsLink(bus, domain_number, robot_description=taken.append):
                await until(lambda: taken == ["<robot/>"])
            writer.__del__()
            participant.__del__()


@pytest.mark.thorough
async def test_a_simulated_clock_follows_the_time_of_ros(domain_number: int) -> None:
    make: Any = RawClock
    stamp: Any = Time(100, 5)
    clock = SimulatedClock()
    with Bus(clock) as bus:
        async with DdsLink(bus, domain_number, clock=clock):
            participant = DomainParticipant(domain_number)
            writer = DataWriter(participant, Topic(participant, "rt/clock", RawClock))
            with anyio.fail_after(20):
                while clock.now() != 100_000_000_005:
                    writer.write(make(stamp))
                    await anyio.sleep(0.05)
            writer.__del__()
            participant.__del__()


@pytest.mark.parametrize(
    ("arguments", "error", "said"),
    [
        ({"domain": -1}, ValueError, "from 0 to 232"),
        ({"domain": 233}, ValueError, "from 0 to 232"),
        ({"domain": True}, TypeError, "int"),
        ({"domain": "0"}, TypeError, "int"),
        ({"discovery": "far"}, ValueError, "'localhost' or 'subnet'"),
        ({"peers": "10.0.0.1"}, TypeError, "several"),
        ({"tf": "a b"}, ValueError, "topic"),
    ],
)
def test_arguments_that_are_not_valid_are_refused(arguments: Any, error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        DdsLink(Bus(), **arguments)


@pytest.mark.parametrize(
    ("variables", "domain", "settings"),
    [
        ({}, 0, '"lo"'),
        ({"ROS_DOMAIN_ID": "42", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}, 42, '"lo"'),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, 0, "<Discovery>"),
        ({"CYCLONEDDS_URI": "file:///mine.xml"}, 0, "file:///mine.xml,"),
    ],
)
def test_the_variables_of_ros_2_are_the_defaults(
    monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], domain: int, settings: str
) -> None:
    for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "CYCLONEDDS_URI"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    link = DdsLink(Bus())
    config: str = link._carrier._config  # type: ignore[attr-defined]
    assert (link.domain, link.id) == (domain, f"dds:{domain}")
    assert settings in config
    assert ("multicast" in config) is (settings == '"lo"')


def test_a_variable_that_is_no_number_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "home")
    with pytest.raises(ValueError, match=r"ROS_DOMAIN_ID.*'home'"):
        DdsLink(Bus())


async def test_a_domain_that_cannot_be_joined_is_an_os_error(domain_number: int) -> None:
    with Bus() as bus:
        async with DdsLink(bus, domain_number):
            with pytest.raises(OSError, match="another configuration"):
                async with DdsLink(bus, domain_number, peers=["127.0.0.2"]):
                    raise AssertionError


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
            # Whatever goes round comes before these have gone round.
            for stamp in range(5):
                far.publish(moving("map", "last", stamp))
                await until(lambda stamp=stamp: counted() >= 404 + 2 * stamp)  # type: ignore[misc]
            assert (bus.statistics().samples, far.statistics().samples) == (206, 206)
