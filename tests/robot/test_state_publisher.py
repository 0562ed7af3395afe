"""Publishing the frames of a robot by the positions of its joints, and reading these from messages."""

import logging
import math
import struct
from typing import Any

import anyio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.asking import Asked, settle
from support.joint_messages import KIND, TYPES, joint_state
from support.samples import static

from tfbus import (
    Buffer,
    Bus,
    InvalidTransformError,
    Joint,
    Mimic,
    RobotModel,
    RobotStatePublisher,
    RobotStatistics,
    SimulatedClock,
    Transform,
    TransformStamped,
    from_seconds,
)
from tfbus.robot.joint_state_message import decode_joint_state
from tfbus.tf_message import MalformedMessageError

pytestmark = pytest.mark.anyio

CRANE = RobotModel(
    "crane",
    ["base", "boom", "hook", "shadow", "lamp"],
    [
        Joint("swing", "revolute", "base", "boom", Transform((0.0, 0.0, 5.0)), (0.0, 0.0, 1.0), -1.0, 1.0),
        Joint("rope", "prismatic", "boom", "hook", Transform((2.0, 0.0, 0.0)), (0.0, 0.0, -1.0), 0.0, 4.0),
        Joint("follow", "prismatic", "boom", "shadow", mimic=Mimic("rope", 0.5)),
        Joint("screw", "fixed", "boom", "lamp", Transform((0.5, 0.0, 0.0))),
    ],
)
"""Its boom swings about z, 5 m up; its hook hangs from 2 m out."""


def batches_of(bus: Bus) -> list[tuple[TransformStamped, ...]]:
    got: list[tuple[TransformStamped, ...]] = []
    bus.subscribe(got.append)
    return got


def test_the_constructor_publishes_the_fixed_joints_once_as_statics() -> None:
    bus = Bus(SimulatedClock(start=42))
    got = batches_of(bus)
    robot = RobotStatePublisher(bus, CRANE)
    lamp = TransformStamped("boom", "lamp", 42, Transform((0.5, 0.0, 0.0)), "robot_state_publisher", static=True)
    assert got == [(lamp,)]
    robot.publish({"swing": 0.0, "rope": 1.0})
    assert [sample.child for sample in got[1]] == ["boom", "hook", "shadow"]
    assert not any(sample.static for sample in got[1])


def test_a_message_is_one_batch_with_its_own_stamp_and_by_default_with_the_clocks() -> None:
    clock = SimulatedClock(start=42)
    bus = Bus(clock)
    robot = RobotStatePublisher(bus, CRANE, authority="crane driver")
    got = batches_of(bus)
    got.clear()
    robot.publish({"swing": 0.5, "rope": 1.0}, stamp=7)
    robot.publish_state(["rope"], [2.0], stamp=0)
    clock.set(99)
    robot.publish({"rope": 3.0})
    assert [{sample.stamp for sample in batch} for batch in got] == [{7}, {0}, {99}]
    assert {sample.authority for batch in got for sample in batch} == {"crane driver"}


@pytest.mark.every_loop
async def test_a_lookup_that_waits_for_a_stamp_is_woken_by_the_message_of_that_stamp(bus: Bus, buffer: Buffer) -> None:
    robot = RobotStatePublisher(bus, CRANE)
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, lambda: buffer.lookup("base", "hook", from_seconds(2.0)))
        for second in (1.0, 2.0):
            await settle()
            assert not asked.ended
            robot.publish({"swing": 0.0, "rope": second}, from_seconds(second))
    assert asked.answer.transform.translation == (2.0, 0.0, 3.0)


def test_several_robots_share_a_bus_under_prefixes(bus: Bus, buffer: Buffer) -> None:
    for prefix, length in (("left/", 1.0), ("right/", 2.0)):
        RobotStatePublisher(bus, CRANE, prefix=prefix).publish({"swing": 0.0, "rope": length})
    for prefix, length in (("left/", 1.0), ("right/", 2.0)):
        hook = buffer.lookup_nowait(f"{prefix}base", f"{prefix}hook").transform.translation
        assert hook == (2.0, 0.0, 5.0 - length)
    assert "base" not in buffer.tree.frames()


def test_unknown_joints_are_counted_and_logged_once_each(caplog: pytest.LogCaptureFixture) -> None:
    robot = RobotStatePublisher(Bus(SimulatedClock()), CRANE)
    with caplog.at_level(logging.WARNING, "tfbus"):
        for _ in range(3):
            robot.publish({"swing": 0.0, "elbow": 0.0, "wrist": math.nan})
    assert robot.statistics() == RobotStatistics(messages=3, unknown_joints=6, violations={})
    assert caplog.messages == ["robot 'crane' has no joint 'elbow'", "robot 'crane' has no joint 'wrist'"]


def test_violations_are_counted_and_logged_once_a_joint_and_nothing_is_clamped(
    bus: Bus, buffer: Buffer, caplog: pytest.LogCaptureFixture
) -> None:
    robot = RobotStatePublisher(bus, CRANE)
    with caplog.at_level(logging.WARNING, "tfbus"):
        for rope in (4.0, 5.0, 6.0):
            robot.publish({"swing": 0.5, "rope": rope})
    assert robot.statistics() == RobotStatistics(messages=3, unknown_joints=0, violations={"rope": 2})
    assert caplog.messages == ["robot 'crane', joint 'rope': position 5 is outside its limits, from 0 to 4"]
    assert buffer.lookup_nowait("boom", "hook").transform.translation == (2.0, 0.0, -6.0)


@pytest.mark.parametrize(
    "positions",
    [[0.5, 1.5], (0.5, 1.5), np.array([0.5, 1.5]), np.array([0.5, 1.5], np.float32), [np.float64(0.5), 1.5]],
)
def test_names_and_positions_may_be_parallel_sequences_as_in_ros(bus: Bus, positions: Any) -> None:
    robot = RobotStatePublisher(bus, CRANE)
    got = batches_of(bus)
    robot.publish_state(["swing", "rope"], positions, 7)
    robot.publish({"swing": 0.5, "rope": 1.5}, 7)
    assert got[-2] == got[-1]
    assert {type(part) for sample in got[-2] for part in sample.transform.rotation} == {float}


@pytest.mark.parametrize(
    ("names", "positions", "message"),
    [
        (["swing", "rope"], [0.5], "there are 2 names of joints, but 1 positions"),
        (["swing"], [], "there are 1 names of joints, but 0 positions"),
        ([], [0.5], "there are 0 names of joints, but 1 positions"),
        (["rope", "swing", "rope"], [1.0, 2.0, 3.0], "a joint has one position, but there are several of 'rope'"),
    ],
)
def test_inconsistent_names_and_positions_are_refused(bus: Bus, names: Any, positions: Any, message: str) -> None:
    robot = RobotStatePublisher(bus, CRANE)
    got = batches_of(bus)
    got.clear()
    with pytest.raises(ValueError, match=f"^{message}$"):
        robot.publish_state(names, positions)
    assert got == []


def test_nothing_is_published_or_counted_if_one_position_is_bad(bus: Bus) -> None:
    robot = RobotStatePublisher(bus, CRANE)
    got = batches_of(bus)
    got.clear()
    with pytest.raises(InvalidTransformError, match="joint 'rope': position nan is not finite"):
        robot.publish({"swing": 9.0, "rope": math.nan, "elbow": 0.0})
    assert got == []
    assert robot.statistics() == RobotStatistics(messages=0, unknown_joints=0, violations={})


def test_a_refusal_of_the_bus_is_raised() -> None:
    bus = Bus(SimulatedClock())
    bus.publish(static("lamp", "boom"))
    with pytest.raises(InvalidTransformError) as caught:
        RobotStatePublisher(bus, CRANE)
    assert caught.value.reason == "cycle"
    bus = Bus(SimulatedClock())
    robot = RobotStatePublisher(bus, CRANE)
    with bus.reserve("hook", "somebody else"), pytest.raises(InvalidTransformError, match="reserved"):
        robot.publish({"rope": 1.0})
    assert robot.statistics().messages == 0


@pytest.mark.parametrize("prefix", ["/", "/robot1/"])
def test_a_prefix_with_a_leading_slash_is_refused_before_anything_is_sent(bus: Bus, prefix: str) -> None:
    with pytest.raises(ValueError, match="must not be empty or start with '/'"):
        RobotStatePublisher(bus, CRANE, prefix)
    assert bus.statistics().samples == 0


def test_a_publisher_that_drops_goes_on_whatever_edges_others_publish(bus: Bus) -> None:
    model = RobotModel(
        "r", ("base", "a", "b"), (Joint("fix", "fixed", "base", "a"), Joint("turn", "revolute", "a", "b"))
    )
    bus.publish(static("a", "base", authority="stranger"))
    with pytest.raises(InvalidTransformError):
        RobotStatePublisher(bus, model)
    robot = RobotStatePublisher(bus, model, invalid="drop")
    bus.publish(static("b", "a", authority="stranger"))
    robot.publish({"turn": 0.5})
    assert bus.statistics().rejected == {"cycle": 3}


@pytest.mark.parametrize("names", [[], ["a"], ["a", "bcd", "efghijk"]])
def test_all_encodings_are_those_of_rosbags(names: list[str]) -> None:
    positions = {name: float(at) + 0.5 for at, name in enumerate(names)}
    cdr = joint_state(1_500_000_001, positions)
    assert decode_joint_state(cdr, ros1=False) == (1_500_000_001, positions)
    big_endian = joint_state(1_500_000_001, positions, little_endian=False)
    assert decode_joint_state(big_endian, ros1=False) == (1_500_000_001, positions)
    assert decode_joint_state(bytes(TYPES.cdr_to_ros1(cdr, KIND)), ros1=True) == (1_500_000_001, positions)


@pytest.mark.parametrize("ros1", [True, False])
@given(data=st.data())
def test_any_bytes_are_positions_or_malformed(ros1: bool, data: st.DataObject) -> None:
    payload = bytearray(joint_state(1, {"shoulder": 0.5, "elbow": 1.0}))
    for place in data.draw(st.lists(st.integers(0, len(payload) - 1), max_size=3)):
        payload[place] = data.draw(st.integers(0, 255))
    try:
        decode_joint_state(bytes(payload[: data.draw(st.integers(0, len(payload)))]), ros1)
    except MalformedMessageError as error:
        assert error.reason


@pytest.mark.parametrize("positions", [{}, {"a": 0.5}])
def test_names_without_positions_are_refused(positions: dict[str, float]) -> None:
    cdr = joint_state(1, positions, more_names=["b", "c"])
    for payload, ros1 in ((cdr, False), (bytes(TYPES.cdr_to_ros1(cdr, KIND)), True)):
        with pytest.raises(MalformedMessageError) as caught:
            decode_joint_state(payload, ros1)
        names = len(positions) + 2
        assert caught.value.reason == "positions"
        assert caught.value.detail == f"there are {names} names, and {len(positions)} positions"


@pytest.mark.parametrize("ros1", [True, False])
def test_a_message_that_ends_before_its_last_position_is_truncated(ros1: bool) -> None:
    payload = joint_state(1, {"shoulder": 0.5, "elbow": 1.0})
    if ros1:
        payload = bytes(TYPES.cdr_to_ros1(payload, KIND))
    end = payload.index(struct.pack("<d", 1.0)) + 8
    assert decode_joint_state(payload[:end], ros1) == (1, {"shoulder": 0.5, "elbow": 1.0})
    for length in range(4 if ros1 else 8, end):
        with pytest.raises(MalformedMessageError) as caught:
            decode_joint_state(payload[:length], ros1)
        assert caught.value.reason == "truncated"


@pytest.mark.parametrize("count", [6, 2**31])
def test_a_count_that_no_message_can_hold_is_refused_at_once(count: int) -> None:
    # The header is followed by 20 bytes, and each name has at least 4 for its length.
    payload = b"\0\1\0\0" + struct.pack("<iII", 1, 2, 1) + b"\0" * 4 + struct.pack("<I", count)
    with pytest.raises(MalformedMessageError, match=f"cannot hold {count} names"):
        decode_joint_state(payload, ros1=False)
    with pytest.raises(MalformedMessageError, match="are too few"):
        decode_joint_state(payload[:-4] + struct.pack("<I", 5), ros1=False)
