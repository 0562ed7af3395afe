import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from support.joint_messages import joint_state, odometry
from support.processes import until
from support.ros import ListCarrier, RosEnd, named
from support.samples import moving, static
from support.worlds import random_covariance

from tfbus import (
    Bus,
    Covariance,
    PeerRejected,
    SimulatedClock,
    Transform,
    TransformStamped,
    UncertainSample,
    from_seconds,
)
from tfbus.geometry.covariance import inverse_jacobian
from tfbus.links.ros import RosLink, RosOptions
from tfbus.links.ros.ros_link import MOST_TRANSFORMS, RosMessage
from tfbus.links.ros.settings import Other, as_topics
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
                carrier.hear(RosMessage(encode([moving("map", name, 9)]), static=False, authority="/n"))
            await until(lambda: link.statistics().received_messages == 3)
        assert link.statistics().queue.capacity == 7
    assert carrier.said == [(False, [("map", "base", 1)]), (True, [("map", "lidar", 0)])]
    assert heard[1:] == [(moving("map", "base", 9, authority="/n"),)]
    assert link.statistics().rejected == {"too many frames": 1}
    assert carrier.closed


async def test_an_offset_moves_stamps_on_their_way_in_and_back_on_their_way_out() -> None:
    states: list[object] = []
    options: RosOptions = {"offset": 2.0, "joint_states": lambda *state: states.append(state[1])}
    carrier = ListCarrier(options)
    heard: list[object] = []
    with Bus(max_ahead=None) as bus:
        async with RosLink(bus, "ros", carrier, **options) as link:
            bus.publish([moving("map", "base", from_seconds(5.0)), moving("map", "early", from_seconds(-(2.0**31)))])
            bus.subscribe(heard.append)
            carrier.hear(RosMessage(encode([moving("map", "arm", from_seconds(9.0))]), static=False, authority="/n"))
            carrier.hear(RosMessage(joint_state(from_seconds(3.0), {"hip": 0.5}), False, "/n", "joints"))
            await until(lambda: link.statistics().received_messages == 2)
            assert link.statistics().not_sent == {"stamp": 1}
    assert carrier.said == [(False, [("map", "base", from_seconds(3.0))])]
    assert heard == [(moving("map", "arm", from_seconds(11.0), authority="/n"),)]
    assert states == [from_seconds(5.0)]


@pytest.mark.parametrize(("options", "frames"), [({}, 1), ({"drop_lost": False}, 1), ({"drop_lost": True}, 0)])
async def test_the_frames_of_a_lost_peer_stay_or_are_dropped_and_come_back_as_they_were(
    options: RosOptions, frames: int
) -> None:
    carrier, payload = ListCarrier(options), encode([static("map", "lidar", 2.0)])
    with Bus() as bus:
        async with RosLink(bus, "ros", carrier, **options) as link:
            for _ in range(2):
                carrier.meet(True)
                carrier.hear(RosMessage(payload, static=True, authority="/n"))
                await until(lambda: bus.statistics().frames == 1)
                carrier.meet(False)
                await until(lambda: link.peers == ())
                assert bus.statistics().frames == frames


async def test_a_large_message_is_published_in_parts_up_to_its_first_fault() -> None:
    carrier, heard = ListCarrier(), list[tuple[object, ...]]()
    payload = encode([moving("map", f"frame{number}", 9) for number in range(200)])
    with Bus() as bus:
        bus.subscribe(heard.append)
        async with RosLink(bus, "ros", carrier) as link:
            for sent, static_topic in ((payload, False), (payload[:-1], True)):
                carrier.hear(RosMessage(sent, static_topic, authority="/n"))
            await until(lambda: link.statistics().rejected == {"truncated": 1})
            assert link.statistics().received_messages == 2
    assert [len(batch) for batch in heard] == [40] * 9
    assert [getattr(batch[0], "static", None) for batch in heard] == [False] * 5 + [True] * 4


@pytest.mark.parametrize("other", ["joints", "clock", "odometry"])
async def test_a_huge_message_beside_transforms_is_refused(other: Other) -> None:
    taken: list[object] = []
    carrier = ListCarrier({"joint_states": lambda *state: taken.append(state)})
    content = RosMessage(b"\0\1\0\0" + bytes(2**15), static=False, authority="", other=other)
    with Bus() as bus:
        async with RosLink(bus, "ros", carrier) as link:
            carrier.hear(content)
            await until(lambda: link.statistics().rejected == {"oversized": 1})
    assert taken == []


async def test_a_simulated_clock_follows_the_time_of_ros_and_one_jump_back_is_one_reset() -> None:
    clock = SimulatedClock()
    options: RosOptions = {"clock": clock}
    carrier = ListCarrier(options)

    def tell(second: int) -> None:
        payload = b"\0\1\0\0" + struct.pack("<iI", second, 5)
        carrier.hear(RosMessage(payload, static=False, authority="", other="clock"), moving=True)

    with Bus(clock) as bus:
        async with RosLink(bus, "ros", carrier, **options) as link:
            for second in (100, 101, 50, 51):
                tell(second)
                await until(lambda second=second: clock.now() == from_seconds(second) + 5)  # type: ignore[misc]
            assert bus.statistics().clock_resets == 1
            assert link.statistics().rejected == {}


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"authority": 5}, TypeError),
        ({"joint_states": "/joint_states"}, TypeError),
        ({"robot_description": "/robot_description"}, TypeError),
        ({"tf": ""}, ValueError),
        ({"tf_static": []}, ValueError),
        ({"tf": [5]}, TypeError),
        ({"joint_states": print, "joint_topic": "a b"}, ValueError),
        ({"odometry": "/camera/pose=camera"}, ValueError),
        ({"odometry": []}, ValueError),
        ({"prefix": "/r"}, ValueError),
        ({"shared": ["map"]}, TypeError),
        ({"capacity": 0}, ValueError),
        ({"max_frames": 0}, ValueError),
    ],
)
def test_options_that_are_not_valid_are_refused(options: Any, error: type[Exception]) -> None:
    with pytest.raises(error):
        RosLink(Bus(), "ros", ListCarrier(options), **options)


@pytest.mark.parametrize(
    ("topics", "found"),
    [("/tf", ("/tf",)), ("robot1/tf", ("/robot1/tf",)), (["/tf", "tf", "/b_2/tf"], ("/tf", "/b_2/tf"))],
)
def test_topics_are_one_or_several_each_once_with_a_slash_in_front(topics: Any, found: tuple[str, ...]) -> None:
    assert as_topics(topics, "tf") == found


@pytest.mark.parametrize("topic", ["", "/", "/tf/", "a//b", "/1tf", "/t f", "/tf\n", ["/tf", "a-b"], []])
def test_what_cannot_be_a_topic_is_refused(topic: Any) -> None:
    with pytest.raises(ValueError, match="topic"):
        as_topics(topic, "tf")


@pytest.fixture
def end() -> RosEnd:
    return RosEnd()


def test_what_comes_from_ros_has_the_node_as_its_authority_and_the_kind_of_its_topic() -> None:
    end = RosEnd()
    end.hear(moving("map", "base", 5, 1.0), moving("base", "arm", 6, 2.0))
    end.hear(static("map", "lidar", 3.0, stamp=7), static=True, authority="/calibration")
    # Names of ROS 1 may have leading slashes.
    end.hear_bytes(named(named(encode([moving("-map", "--tip", 5)]), "-map", "/map"), "--tip", "//tip"))
    assert end.heard == [
        (moving("map", "base", 5, 1.0, "/node"), moving("base", "arm", 6, 2.0, "/node")),
        (static("map", "lidar", 3.0, 7, "/calibration"),),
        (moving("map", "tip", 5, authority="/node"),),
    ]
    end.endpoint.send()
    assert end.carrier.said == [], "nothing goes back"
    # Nor is an empty message anything.
    end.hear()
    assert (len(end.heard), end.endpoint.messages) == (3, 4)
    # An authority may be given.
    end = RosEnd(authority="robot")
    end.hear(moving("map", "base", 5))
    assert end.heard == [(moving("map", "base", 5, authority="robot"),)]


def test_what_the_bus_refuses_is_counted_by_reason_and_announced_once_and_the_rest_is_published(end: RosEnd) -> None:
    with end.bus.events() as events:
        for stamp in (1, 2):
            own_parent = named(encode([moving("self", "also", stamp)]), "also", "self")
            end.hear_bytes(own_parent)
            end.hear_bytes(named(encode([moving("-", "a", stamp), moving("map", "b", stamp)]), "-", "/"))
            end.hear_bytes(b"garbage")
    rejected = [event for event in iter(events.queue.get, None) if isinstance(event, PeerRejected)]
    assert end.endpoint.rejected == {"self transform": 2, "frame name": 2, "truncated": 2}
    assert [event.reason for event in rejected] == ["self transform", "frame name", "truncated"]
    assert [event.peer for event in rejected] == ["peer"] * 3
    assert getattr(rejected[0].error, "authority", "") == "/node"
    assert [[sample.child for sample in batch] for batch in end.heard] == [["b"], ["b"]]


def test_moving_frames_of_a_turn_go_out_together_and_static_ones_with_all_others_that_this_link_sends() -> None:
    end = RosEnd()
    end.bus.publish([moving("map", "base", 1), static("base", "lidar", stamp=2)])
    end.say(moving("map", "base", 3))
    end.say(static("base", "camera", stamp=4))
    end.hear(static("base", "imu", stamp=5), static=True)
    end.endpoint.send()
    end.say(static("base", "lidar", stamp=6))
    lidar, camera = ("base", "lidar", 2), ("base", "camera", 4)
    assert end.carrier.said == [
        (False, [("map", "base", 1), ("map", "base", 3)]),
        (True, [lidar]),
        (True, [lidar, camera]),
        (True, [("base", "lidar", 6), camera]),
    ]
    assert (end.report.messages, end.report.samples) == (4, 7)


def test_a_removed_static_frame_is_missing_in_the_next_message_and_a_moving_one_is_counted(end: RosEnd) -> None:
    end.say(static("map", "lidar"), static("map", "camera"), moving("map", "base", 1))
    end.bus.remove_frame("lidar")
    end.bus.remove_frame("base")
    end.endpoint.send()
    assert end.carrier.said[2:] == [(True, [("map", "camera", 0)])]
    end.bus.remove_frame("camera")
    end.endpoint.send()
    assert end.carrier.said[3:] == [(True, [])]
    assert end.report.not_sent == {"removal": 1}
    assert ["'base'" in str(error) for error in end.errors] == [True]


def test_a_static_frame_that_begins_to_move_leaves_the_latched_message(end: RosEnd) -> None:
    end.say(static("map", "lidar"), static("map", "camera"))
    end.say(moving("map", "lidar", 5))
    assert end.carrier.said[1:] == [(False, [("map", "lidar", 5)]), (True, [("map", "camera", 0)])]


def test_what_a_message_cannot_hold_is_counted_and_the_rest_goes_out(end: RosEnd) -> None:
    end.say(moving("map", "late", 2**62), moving("map", "base", 1), static("map", "x" * 2_000), static("map", "b"))
    assert end.carrier.said == [(False, [("map", "base", 1)]), (True, [("map", "b", 0)])]
    assert end.report.not_sent == {"stamp": 1, "frame name": 1}
    end.say(static("map", "c"))
    assert end.report.not_sent == {"stamp": 1, "frame name": 1}, "once for each sample"


def test_many_moving_frames_go_out_in_several_messages(end: RosEnd) -> None:
    end.say(*(moving("map", f"f{number}", 1) for number in range(2 * MOST_TRANSFORMS + 1)))
    assert [len(rows) for _, rows in end.carrier.said] == [MOST_TRANSFORMS, MOST_TRANSFORMS, 1]
    assert [row[1] for _, rows in end.carrier.said for row in rows] == [f"f{n}" for n in range(2 * MOST_TRANSFORMS + 1)]


def test_with_a_prefix_only_the_frames_of_that_robot_go_out_by_their_names_there() -> None:
    end = RosEnd(prefix="r1/", shared={"map"})
    end.hear(moving("odom", "base", 1), moving("map", "odom", 1))
    named_here = moving("r1/odom", "r1/base", 1, authority="/node"), moving("map", "r1/odom", 1, authority="/node")
    assert end.heard == [named_here]
    end.say(moving("map", "r1/odom", 2), moving("map", "r2/odom", 2), static("r1/base", "r1/lidar"))
    end.bus.remove_frame("r2/odom")
    end.endpoint.send()
    assert end.carrier.said == [(False, [("map", "odom", 2)]), (True, [("base", "lidar", 0)])]
    end.bus.remove_frame("r1/lidar")
    end.endpoint.send()
    assert end.carrier.said[-1] == (True, [])


def test_a_name_without_the_prefix_on_the_bus_or_with_it_in_ros_is_refused_and_told() -> None:
    end = RosEnd(prefix="r1/")
    end.say(moving("world", "r1/x", 3))
    assert end.report.not_sent == {"prefix": 1}
    assert "shared={'world'} lets it pass" in str(end.errors[0])
    with end.bus.events() as events:
        end.hear(moving("base", "r1/b", 1))
        end.hear(moving("r1/base", "tool", 1))
    assert end.endpoint.rejected == {"prefix": 2}
    (told,) = (event for event in iter(events.queue.get, None) if isinstance(event, PeerRejected))
    assert told.reason == "prefix"
    assert [getattr(told.error, name) for name in ("parent", "child", "authority")] == ["base", "r1/b", "/node"]


def test_a_link_that_only_listens_sends_nothing() -> None:
    end = RosEnd(send=False)
    end.say(moving("map", "base", 1), static("map", "lidar"))
    end.bus.remove_frame("base")
    end.endpoint.send()
    assert end.carrier.said == []
    assert (end.report.messages, end.report.not_sent) == (0, {})


def test_what_ros_gives_back_is_no_news(end: RosEnd) -> None:
    end.say(moving("map", "base", 1, 5.0), static("map", "lidar", 2.0))
    end.hear(moving("map", "base", 1, 5.0))
    end.hear(static("map", "lidar", 2.0), static=True)
    assert (len(end.heard), end.endpoint.duplicates) == (1, 2)
    end.hear(static("map", "lidar", 3.0), static=True)
    assert end.heard[1:] == [(static("map", "lidar", 3.0, authority="/node"),)]


def test_after_a_jump_back_of_the_clock_the_stamps_of_before_are_news(end: RosEnd) -> None:
    for jumps in range(2):
        end.hear(moving("map", "base", 1, 5.0))
        end.hear(static("map", "lidar", 2.0), static=True)
        assert len(end.heard) == 2 + jumps
        end.endpoint.relay.clock_jumped_back()


def test_positions_of_joints_are_handed_on_and_what_comes_of_that_is_counted() -> None:
    taken: list[tuple[Mapping[str, float], int]] = []

    def take(positions: Mapping[str, float], stamp: int) -> None:
        taken.append((positions, stamp))
        if "broken" in positions:
            raise ValueError(positions)

    end = RosEnd(joint_states=take)
    for payload in (joint_state(5, {"a": 0.5, "b": 1.5}), b"garbage", joint_state(6, {"broken": 1.0})):
        end.carrier.hear(RosMessage(payload, static=False, authority="", other="joints"))
    assert taken == [({"a": 0.5, "b": 1.5}, 5), ({"broken": 1.0}, 6)]
    assert end.endpoint.rejected == {"truncated": 1, "not published": 1}
    assert end.heard == []


@pytest.mark.parametrize("invert", [False, True])
def test_odometry_is_a_transform_of_its_topic_and_may_be_inverted(invert: bool) -> None:
    pose = Transform.from_xyz_rpy((1.0, -2.0, 0.5), (0.1, 0.2, 0.3))
    end = RosEnd(odometry="/odom", invert=invert, prefix="r/")
    error = Covariance(random_covariance(np.random.default_rng(1), 0.1, 0.05))
    of_pose = odometry(TransformStamped("odom", "base", 5, pose), covariance=error.matrix.ravel())
    for payload in (of_pose, b"garbage"):
        end.carrier.hear(RosMessage(payload, static=False, authority="/odom", other="odometry"))
    expected = TransformStamped("r/odom", "r/base", 5, pose, "/odom")
    if invert:
        expected = TransformStamped("r/base", "r/odom", 5, pose.inverse(), "/odom")
    assert end.heard == [(expected,)]
    (sample,) = end.heard[0]
    assert isinstance(sample, UncertainSample)
    jacobian = inverse_jacobian(pose) if invert else np.eye(6)
    assert sample.covariance.matrix == pytest.approx(jacobian @ error.matrix @ jacobian.T)
    assert sample.kind == ("independent" if invert else "drift")
    assert end.endpoint.rejected == {"truncated": 1}
