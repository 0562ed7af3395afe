import logging
import math
from collections import Counter
from typing import Any

import anyio
import numpy as np
import numpy.typing as npt
import pytest
from support import pr2
from support.asking import Asked, settle
from support.samples import static

from tfbus import (
    Buffer,
    Bus,
    BusClosedError,
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


def test_a_buffer_that_joins_later_gets_the_fixed_joints_too() -> None:
    bus = Bus(SimulatedClock())
    RobotStatePublisher(bus, CRANE)
    assert Buffer(bus).lookup_nowait("boom", "lamp").transform.translation == (0.5, 0.0, 0.0)


def test_a_robot_without_fixed_joints_publishes_nothing_at_first() -> None:
    bus = Bus(SimulatedClock())
    got = batches_of(bus)
    RobotStatePublisher(bus, RobotModel("r", ["a", "b"], [Joint("j", "continuous", "a", "b")])).publish({"j": 1.0})
    assert [[sample.child for sample in batch] for batch in got] == [["b"]]


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


def test_the_pose_of_the_hook_has_the_closed_form() -> None:
    with Bus(SimulatedClock()) as bus, Buffer(bus) as buffer:
        RobotStatePublisher(bus, CRANE).publish({"swing": 0.5, "rope": 1.5})
        hook = buffer.lookup_nowait("base", "hook").transform.translation
        assert hook == pytest.approx((2.0 * math.cos(0.5), 2.0 * math.sin(0.5), 5.0 - 1.5))
        assert buffer.lookup_nowait("boom", "shadow").transform.translation == (0.75, 0.0, 0.0)


@pytest.mark.every_loop
async def test_a_lookup_that_waits_for_a_stamp_is_woken_by_the_message_of_that_stamp() -> None:
    with Bus(SimulatedClock()) as bus, Buffer(bus) as buffer:
        robot = RobotStatePublisher(bus, CRANE)
        async with anyio.create_task_group() as tasks:
            asked = Asked(tasks, lambda: buffer.lookup("base", "hook", from_seconds(2.0)))
            for second in (1.0, 2.0):
                await settle()
                assert not asked.ended
                robot.publish({"swing": 0.0, "rope": second}, from_seconds(second))
        assert asked.answer.transform.translation == (2.0, 0.0, 3.0)


def test_several_robots_share_a_bus_under_prefixes() -> None:
    with Bus(SimulatedClock()) as bus, Buffer(bus) as buffer:
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
    caplog: pytest.LogCaptureFixture,
) -> None:
    with Bus(SimulatedClock()) as bus, Buffer(bus) as buffer:
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
def test_names_and_positions_may_be_parallel_sequences_as_in_ros(positions: Any) -> None:
    bus = Bus(SimulatedClock())
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
def test_inconsistent_names_and_positions_are_refused(names: Any, positions: Any, message: str) -> None:
    bus = Bus(SimulatedClock())
    robot = RobotStatePublisher(bus, CRANE)
    got = batches_of(bus)
    got.clear()
    with pytest.raises(ValueError, match=f"^{message}$"):
        robot.publish_state(names, positions)
    assert got == []


def test_nothing_is_published_or_counted_if_one_position_is_bad() -> None:
    bus = Bus(SimulatedClock())
    robot = RobotStatePublisher(bus, CRANE)
    got = batches_of(bus)
    got.clear()
    with pytest.raises(InvalidTransformError, match="joint 'rope': position nan is not finite"):
        robot.publish({"swing": 9.0, "rope": math.nan, "elbow": 0.0})
    assert got == []
    assert robot.statistics() == RobotStatistics(messages=0, unknown_joints=0, violations={})


def test_an_empty_message_moves_nothing() -> None:
    bus = Bus(SimulatedClock())
    robot = RobotStatePublisher(bus, CRANE)
    robot.publish_state([], [])
    assert robot.statistics().messages == 1


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
def test_a_prefix_with_a_leading_slash_is_refused_before_anything_is_sent(prefix: str) -> None:
    bus = Bus(SimulatedClock())
    with pytest.raises(ValueError, match="must not be empty or start with '/'"):
        RobotStatePublisher(bus, CRANE, prefix)
    assert bus.statistics().samples == 0


def test_a_closed_bus_refuses_the_robot_and_its_messages() -> None:
    bus = Bus(SimulatedClock())
    robot = RobotStatePublisher(bus, CRANE)
    bus.close()
    with pytest.raises(BusClosedError):
        robot.publish({"rope": 1.0})
    with pytest.raises(BusClosedError):
        RobotStatePublisher(bus, CRANE)


@pr2.needed
@pytest.mark.thorough
def test_the_grippers_of_a_pr2_are_where_the_recorded_transforms_of_the_real_robot_put_them() -> None:
    model = RobotModel.from_urdf(pr2.URDF)
    recorded = pr2.recorded()
    with Bus(SimulatedClock()) as bus, Buffer(bus, keep=None) as buffer:
        robot = RobotStatePublisher(bus, model)
        for state in recorded.states:
            robot.publish_state(state.names, state.positions, state.stamp)
        for stamp, moving in recorded.moving.items():
            edges = {child: (parent, t) for (parent, child), t in {**recorded.static, **moving}.items()}
            for tip in ("r_gripper_tool_frame", "l_gripper_l_finger_tip_link", "wide_stereo_optical_frame"):
                expected: npt.NDArray[np.float64] = np.eye(4)
                frame = tip
                while frame in edges:
                    frame, parent_from_frame = edges[frame]
                    expected = parent_from_frame.matrix() @ expected
                found = buffer.lookup_nowait("base_footprint", tip, stamp).transform.matrix()
                np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)
        counted = robot.statistics()
    assert (counted.messages, counted.unknown_joints) == (598, 2 * 598)
    limits = {joint.name: (joint.lower, joint.upper) for joint in model.joints if joint.lower is not None}
    beyond = [
        name
        for state in recorded.states
        for name, position in zip(state.names, state.positions, strict=True)
        if name in limits and np.clip(position, *limits[name]) != position
    ]
    assert counted.violations == Counter(beyond) != {}


def test_a_publisher_that_drops_goes_on_whatever_edges_others_publish() -> None:
    bus = Bus(SimulatedClock())
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
