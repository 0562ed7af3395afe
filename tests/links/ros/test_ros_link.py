import struct

import pytest
from support.processes import until
from support.ros import ListCarrier
from support.samples import moving, static

from tfbus import Bus, SimulatedClock, from_seconds
from tfbus.links._receive_queue import Presence, Received
from tfbus.links.ros import RosLink, RosOptions
from tfbus.links.ros.ros_link import RosMessage
from tfbus.tf_message import encode

pytestmark = pytest.mark.anyio


async def test_a_link_to_ros_passes_on_both_ways_what_its_options_let_through() -> None:
    options: RosOptions = {"frames": ["base", "lidar"], "capacity": 7, "max_frames": 1, "drop_lost": True}
    carrier = ListCarrier(options)
    heard: list[object] = []
    with Bus() as bus:
        async with RosLink(bus, "ros", carrier, **options) as link:
            bus.publish([moving("map", "base", 1), moving("map", "other", 1), static("map", "lidar")])
            bus.subscribe(heard.append)
            for name in ("base", "lidar", "other"):
                payload = encode([moving("map", name, 9)])
                carrier._receive(Received("peer", RosMessage(payload, static=False, authority="/n"), len(payload)))
            await until(lambda: link.statistics().received_messages == 3)
        assert link.statistics().queue.capacity == 7
    assert carrier.said == [(False, [("map", "base", 1)]), (True, [("map", "lidar", 0)])]
    assert heard[1:] == [(moving("map", "base", 9, authority="/n"),)]
    assert link.statistics().rejected == {"too many frames": 1}
    assert carrier.closed


@pytest.mark.parametrize(("options", "frames"), [({}, 1), ({"drop_lost": False}, 1), ({"drop_lost": True}, 0)])
async def test_the_frames_of_a_lost_peer_stay_unless_they_are_to_be_dropped(options: RosOptions, frames: int) -> None:
    carrier, payload = ListCarrier(options), encode([moving("map", "base", 9)])
    with Bus() as bus:
        async with RosLink(bus, "ros", carrier, **options) as link:
            for content in (Presence.JOINED, RosMessage(payload, static=False, authority="/n")):
                carrier._receive(Received("peer", content))
            await until(lambda: bus.statistics().frames == 1)
            carrier._receive(Received("peer", Presence.LEFT))
            await until(lambda: link.peers == ())
            assert bus.statistics().frames == frames


async def test_a_large_message_is_published_in_parts_up_to_its_first_fault() -> None:
    carrier, heard = ListCarrier(), list[tuple[object, ...]]()
    payload = encode([moving("map", f"frame{number}", 9) for number in range(200)])
    with Bus() as bus:
        bus.subscribe(heard.append)
        async with RosLink(bus, "ros", carrier) as link:
            for sent, static_topic in ((payload, False), (payload[:-1], True)):
                carrier._receive(Received("peer", RosMessage(sent, static_topic, authority="/n"), len(sent)))
            await until(lambda: link.statistics().rejected == {"truncated": 1})
            assert link.statistics().received_messages == 2
    assert [len(batch) for batch in heard] == [40] * 9
    assert [getattr(batch[0], "static", None) for batch in heard] == [False] * 5 + [True] * 4


@pytest.mark.parametrize("kind", ["joints", "clock"])
async def test_a_huge_message_of_joints_or_of_the_time_is_refused(kind: str) -> None:
    taken: list[object] = []
    carrier = ListCarrier({"joint_states": lambda *state: taken.append(state)})
    content = RosMessage(b"\0\1\0\0" + bytes(2**15), static=False, authority="", **{kind: True})
    with Bus() as bus:
        async with RosLink(bus, "ros", carrier) as link:
            carrier._receive(Received("peer", content, 2**15))
            await until(lambda: link.statistics().rejected == {"oversized": 1})
    assert taken == []


async def test_a_simulated_clock_follows_the_time_of_ros_and_one_jump_back_is_one_reset() -> None:
    clock = SimulatedClock()
    options: RosOptions = {"clock": clock}
    carrier = ListCarrier(options)

    def tell(second: int) -> None:
        payload = b"\0\1\0\0" + struct.pack("<iI", second, 5)
        carrier._receive(
            Received("clock", RosMessage(payload, static=False, authority="", clock=True), 12, moving=True)
        )

    with Bus(clock) as bus:
        async with RosLink(bus, "ros", carrier, **options) as link:
            for second in (100, 101, 50, 51):
                tell(second)
                await until(lambda second=second: clock.now() == from_seconds(second) + 5)  # type: ignore[misc]
            assert bus.statistics().clock_resets == 1
            assert link.statistics().rejected == {}


def test_numbers_of_a_link_to_ros_are_checked() -> None:
    for options in (RosOptions(capacity=0), RosOptions(max_frames=0)):
        with pytest.raises(ValueError):
            RosLink(Bus(), "ros", ListCarrier(), **options)
