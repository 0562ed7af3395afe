"""A broadcaster's samples, its mistakes and the frames that it owns."""

import math
from collections.abc import Callable

import anyio
import numpy as np
import pytest
from support.samples import moving

from tfbus import (
    Buffer,
    Bus,
    Covariance,
    InvalidTransformError,
    LookupTimeoutError,
    SimulatedClock,
    Transform,
    TransformBroadcaster,
    TransformStamped,
    UncertainSample,
)
from tfbus.data import Odometry, PointStamped, PoseStamped, PoseWithCovarianceStamped, to_message
from tfbus.stamps import STAMP_MAX, STAMP_MIN

pytestmark = pytest.mark.anyio

HERE = Transform((1.0, 2.0, 3.0))


def test_a_sample_has_the_stamp_of_the_clock_and_the_authority() -> None:
    clock = SimulatedClock(start=42)
    bus = Bus(clock)
    got: list[TransformStamped] = []
    bus.subscribe(got.extend)
    broadcaster = TransformBroadcaster(bus, "odometry")
    broadcaster.send("odom", "base", HERE)
    clock.set(99)
    broadcaster.send("odom", "base", HERE)
    broadcaster.send("odom", "base", HERE, at=50)
    assert [sample.stamp for sample in got] == [42, 99, 50]
    assert {(sample.parent, sample.child, sample.transform, sample.authority) for sample in got} == {
        ("odom", "base", HERE, "odometry")
    }


async def test_an_offset_moves_each_stamp_of_a_moving_sample() -> None:
    bus = Bus(SimulatedClock(start=42))
    got: list[TransformStamped] = []
    bus.subscribe(got.extend)
    broadcaster = TransformBroadcaster(bus, offset=-1e-8)
    broadcaster.send("map", "odom", HERE)
    broadcaster.send("map", "odom", HERE, at=50)
    broadcaster.send_all([("map", "odom", HERE), moving("map", "other", 70)], at=60)
    for stamps in (80, [81, 91]):
        broadcaster.send_columns("map", "odom", [(0.0, 0.0, 0.0)] * 2, [(0.0, 0.0, 0.0, 1.0)] * 2, stamps)
    broadcaster.send_static("map", "lamp", HERE)
    with Buffer(bus) as buffer:
        broadcaster.send_all([UncertainSample("map", "dock", 80, HERE, covariance=Covariance.of(xyz=0.5))])
        assert buffer.lookup_nowait("map", "dock", covariance=True).covariance.matrix[0, 0] == 0.25
        TransformBroadcaster(bus).send("odom", "base", HERE, at=90)
        estimate = {"base": "base", "pose": HERE, "at": 100, "buffer": buffer}
        await broadcaster.correct("map", "odom", **estimate, timeout=1.0)  # type: ignore[arg-type]
    assert [sample.stamp for sample in got if sample.child != "base"] == [32, 40, 50, 60, 70, 70, 71, 81, 42, 70, 90]


@pytest.mark.parametrize(("offset", "error"), [("1", TypeError), (math.nan, ValueError), (1e10, ValueError)])
def test_an_offset_is_a_number_of_seconds(offset: object, error: type[Exception]) -> None:
    with pytest.raises(error, match="offset must be"):
        TransformBroadcaster(Bus(), offset=offset)  # type: ignore[arg-type]


def test_a_stamp_beyond_all_stamps_because_of_the_offset_is_refused() -> None:
    broadcaster = TransformBroadcaster(Bus(), offset=1.0)
    with pytest.raises(InvalidTransformError, match="fit 64"):
        broadcaster.send("map", "odom", HERE, at=STAMP_MAX)
    with pytest.raises(InvalidTransformError, match="fit 64"):
        broadcaster.send_all([moving("map", "odom", STAMP_MAX)])
    with pytest.raises(ValueError, match="fit 64"):
        broadcaster.send_columns("map", "odom", [(0.0, 0.0, 0.0)], [(0.0, 0.0, 0.0, 1.0)], [STAMP_MAX])


SECOND_ODOMETRY = Odometry("t265", 7, "base", HERE, (0.5, 0.0, 0.0), (0.0, 0.0, 0.1))


@pytest.mark.parametrize("as_ros", [False, True])
@pytest.mark.parametrize(
    ("data", "child", "invert", "edges"),
    [
        (SECOND_ODOMETRY, None, False, [("t265", "r/base", (1.0, 2.0, 3.0))]),
        (SECOND_ODOMETRY, None, True, [("r/base", "t265", (-1.0, -2.0, -3.0))]),
        (PoseStamped("map", 7, HERE), "camera", False, [("map", "r/camera", (1.0, 2.0, 3.0))]),
        (PoseStamped("map", 7, HERE), "camera", True, [("r/camera", "map", (-1.0, -2.0, -3.0))]),
        (
            PoseWithCovarianceStamped("map", 7, HERE, np.eye(6)),
            "base",
            False,
            [("map", "r/base", (1.0, 2.0, 3.0))],
        ),
        (TransformStamped("map", "base", 7, HERE), None, True, [("r/base", "map", (-1.0, -2.0, -3.0))]),
    ],
)
def test_a_message_is_sent_at_its_own_stamp_with_the_prefix_and_the_authority(
    data: Odometry | PoseStamped | PoseWithCovarianceStamped | TransformStamped,
    child: str | None,
    invert: bool,
    edges: list[tuple[str, str, tuple[float, ...]]],
    as_ros: bool,
) -> None:
    bus = Bus(SimulatedClock(start=99))
    got: list[TransformStamped] = []
    bus.subscribe(got.extend)
    broadcaster = TransformBroadcaster(bus, "slam", prefix="r/", shared={"map", "t265"})
    broadcaster.send_message(to_message(data) if as_ros else data, child, invert=invert)
    assert [(sample.parent, sample.child, sample.transform.translation) for sample in got] == edges
    assert {(sample.stamp, sample.authority) for sample in got} == {(7, "slam")}


def test_the_transforms_of_a_message_are_one_batch() -> None:
    bus = Bus(SimulatedClock(start=0))
    batches: list[tuple[TransformStamped, ...]] = []
    bus.subscribe(batches.append)
    samples = [TransformStamped("map", "odom", 1, HERE), TransformStamped("odom", "base", 2, HERE)]
    TransformBroadcaster(bus).send_message(to_message(samples))
    assert [[(each.child, each.stamp) for each in batch] for batch in batches] == [[("odom", 1), ("base", 2)]]


@pytest.mark.parametrize(
    ("message", "child", "words"),
    [
        (PoseStamped("map", 7, HERE), None, "give child="),
        (SECOND_ODOMETRY, "camera", "child='camera' was given, but the message names its own: 'base'"),
        (to_message(PointStamped("map", 7, (1.0, 2.0, 3.0))), None, "PointStamped does not say where a frame is"),
        ({"number": 5}, None, "its fields are number"),
    ],
)
def test_a_message_that_does_not_say_where_a_frame_is_is_refused(
    message: object, child: str | None, words: str
) -> None:
    bus = Bus(SimulatedClock(start=0))
    got: list[TransformStamped] = []
    bus.subscribe(got.extend)
    with pytest.raises(TypeError, match=words):
        TransformBroadcaster(bus).send_message(message, child)
    assert got == []


@pytest.mark.parametrize("prefix", [None, "robot1/"])
async def test_a_correction_waits_for_the_odometry_of_its_instant_and_puts_the_base_where_it_was_estimated(
    prefix: str | None,
) -> None:
    clock = SimulatedClock(start=0)
    with Bus(clock) as bus, Buffer(bus, prefix=prefix) as buffer:
        odometry, localisation = (TransformBroadcaster(bus, name, prefix=prefix) for name in ("odometry", "amcl"))
        odometry.send("odom", "base", Transform.from_xyz_rpy((1.0, 2.0, 0.0), (0.0, 0.0, 0.3)), at=100)
        estimate = Transform.from_xyz_rpy((5.5, 4.0, 0.0), (0.0, 0.0, 1.0))
        sent: list[TransformStamped] = []

        async def correct() -> None:
            correction = localisation.correct(
                "map", "odom", base="base", pose=estimate, at=200, buffer=buffer, timeout=1.0, post_date=1e-7
            )
            sent.append(await correction)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(correct)
            await anyio.wait_all_tasks_blocked()
            assert sent == []
            odometry.send("odom", "base", Transform.from_xyz_rpy((1.5, 2.25, 0.0), (0.0, 0.0, 0.5)), at=300)
        assert (sent[0].stamp, sent[0].authority) == (300, "amcl")
        localisation.send("map", "odom", sent[0].transform, at=200)
        assert buffer.lookup_nowait("map", "base", 200).transform.is_close(estimate)
        # Half way, the odometry is at (1.25, 2.125) with a heading of 0.4. Turned by 0.6, it ends at the estimate.
        x = 5.5 - (1.25 * math.cos(0.6) - 2.125 * math.sin(0.6))
        y = 4.0 - (1.25 * math.sin(0.6) + 2.125 * math.cos(0.6))
        assert sent[0].transform.translation == pytest.approx((x, y, 0.0))
        # The difference of the positions is elsewhere.
        assert math.dist(sent[0].transform.translation[:2], (5.5 - 1.25, 4.0 - 2.125)) > 1.0


async def test_a_correction_without_odometry_publishes_nothing() -> None:
    with Bus(SimulatedClock(start=0)) as bus, Buffer(bus) as buffer:
        broadcaster = TransformBroadcaster(bus, "amcl")
        with pytest.raises(LookupTimeoutError):
            await broadcaster.correct("map", "odom", base="base", pose=HERE, at=5, buffer=buffer, timeout=0.0)
        assert buffer.tree.frames() == []


def test_send_all_stamps_all_transforms_alike_and_keeps_the_stamps_of_samples() -> None:
    bus = Bus(SimulatedClock(start=42))
    got: list[tuple[TransformStamped, ...]] = []
    bus.subscribe(got.append)
    broadcaster = TransformBroadcaster(bus, "arm")
    broadcaster.send_all([("base", "shoulder", HERE), ("shoulder", "elbow", HERE), moving("elbow", "hand", 7)])
    (batch,) = got
    assert [(sample.child, sample.stamp, sample.authority) for sample in batch] == [
        ("shoulder", 42, "arm"),
        ("elbow", 42, "arm"),
        ("hand", 7, "arm"),
    ]
    broadcaster.send_all([("base", "shoulder", HERE)], at=50)
    assert got[1][0].stamp == 50


def test_send_static_holds_at_every_stamp_and_can_be_repeated(bus: Bus) -> None:
    broadcaster = TransformBroadcaster(bus)
    broadcaster.send_static("base", "laser", HERE)
    broadcaster.send_static("base", "laser", HERE.inverse())
    buffer = Buffer(bus)
    for at in (STAMP_MIN, 0, STAMP_MAX):
        found = buffer.lookup_nowait("base", "laser", at)
        assert (found.stamp, found.transform, found.static) == (at, HERE.inverse(), True)


BAD_CALLS: dict[str, Callable[[TransformBroadcaster], None]] = {
    "NaN": lambda tf: tf.send("map", "a", Transform((0.0, math.nan, 0.0))),
    "empty parent": lambda tf: tf.send("", "a", HERE),
    "child equal to parent": lambda tf: tf.send("a", "a", HERE),
    "cycle": lambda tf: tf.send("base", "map", HERE),
    "static cycle": lambda tf: tf.send_static("base", "map", HERE),
    "stamp beyond int64": lambda tf: tf.send("map", "a", HERE, at=STAMP_MAX + 1),
    "cycle in a batch": lambda tf: tf.send_all([("map", "a", HERE), ("base", "map", HERE)]),
    "loop in a batch": lambda tf: tf.send_all([("p", "q", HERE), ("q", "p", HERE)]),
}
MISTAKES: dict[str, Callable[[TransformBroadcaster], None]] = {
    "float stamp": lambda tf: tf.send("map", "a", HERE, at=1.5),  # type: ignore[arg-type]
    "float stamp of a batch": lambda tf: tf.send_all([("map", "a", HERE)], at=1.5),  # type: ignore[arg-type]
    "numbers for a transform": lambda tf: tf.send("map", "a", (0.0, 0.0, 0.0)),  # type: ignore[arg-type]
    "number for a name": lambda tf: tf.send("map", 7, HERE),  # type: ignore[arg-type]
    "pair in a batch": lambda tf: tf.send_all([("map", "a")]),  # type: ignore[list-item]
    "no batch": lambda tf: tf.send_all(5),  # type: ignore[arg-type]
}


@pytest.mark.parametrize(
    ("call", "error"),
    [pytest.param(call, InvalidTransformError, id=name) for name, call in BAD_CALLS.items()]
    + [pytest.param(call, TypeError, id=name) for name, call in MISTAKES.items()],
)
def test_bad_input_raises_stores_nothing_and_leaves_the_bus_usable(
    bus: Bus, buffer: Buffer, call: Callable[[TransformBroadcaster], None], error: type[Exception]
) -> None:
    got: list[tuple[TransformStamped, ...]] = []
    broadcaster = TransformBroadcaster(bus)
    broadcaster.send("map", "base", HERE)
    with bus.stream() as stream, bus.subscribe(got.append):
        with pytest.raises(error):
            call(broadcaster)
        assert got == []
        assert len(stream.queue) == 0
        assert buffer.tree.frames() == ["base", "map"]
        assert buffer.tree.inserted == 1
        broadcaster.send("map", "a", HERE)
        assert buffer.can_transform("a", "base")
        assert len(got) == 1


# Owning


def test_an_owned_frame_is_reserved_in_the_block_and_removed_at_its_end(bus: Bus, buffer: Buffer) -> None:
    arm, other = TransformBroadcaster(bus, "arm"), TransformBroadcaster(bus, "other")
    with arm.owning("tool0", "tool1"):
        for name in ("tool0", "tool1"):
            arm.send_static("flange", name, HERE)
            with pytest.raises(InvalidTransformError, match="reserved for 'arm'") as caught:
                other.send("flange", name, HERE)
            assert (caught.value.reason, caught.value.authority, caught.value.owner) == ("reserved", "other", "arm")
        assert buffer.can_transform("tool0", "tool1")
    assert buffer.tree.frames() == []
    assert Buffer(bus).tree.frames() == []
    other.send("flange", "tool0", HERE)
    assert buffer.can_transform("flange", "tool0")


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, GeneratorExit])
def test_an_error_in_the_block_removes_the_owned_frame(bus: Bus, error: type[BaseException]) -> None:
    arm = TransformBroadcaster(bus, "arm")
    with pytest.raises(error), arm.owning("tool0"):
        arm.send_static("flange", "tool0", HERE)
        raise error
    assert bus.statistics().frames == 0
    bus.reserve("tool0", "other").close()


def test_an_owned_frame_may_be_unpublished_or_already_removed_at_the_end(bus: Bus) -> None:
    arm = TransformBroadcaster(bus, "arm")
    with arm.owning("tool0", "tool1", "tool2"):
        arm.send_static("flange", "tool1", HERE)
        arm.send_static("flange", "tool2", HERE)
        bus.remove_frame("tool1")
    assert bus.statistics().frames == 0


def test_the_bus_may_be_closed_before_the_block_of_owning_ends(bus: Bus, buffer: Buffer) -> None:
    arm = TransformBroadcaster(bus, "arm")
    with arm.owning("tool0"):
        arm.send_static("flange", "tool0", HERE)
        bus.close()
    assert buffer.can_transform("flange", "tool0"), "nothing changes any more on a closed bus"


def test_of_several_frames_all_are_reserved_or_none(bus: Bus) -> None:
    arm, other = TransformBroadcaster(bus, "arm"), TransformBroadcaster(bus, "other")
    arm.send_static("flange", "tool0", HERE)
    block = arm.owning("tool0", "tool1")
    with other.owning("tool1"), pytest.raises(InvalidTransformError, match="'tool1' is reserved for 'other'"), block:
        pytest.fail("the block began")
    assert bus.statistics().frames == 1, "what could not be owned is not removed either"
    other.send("flange", "tool0", HERE)


def test_owning_needs_a_frame() -> None:
    with pytest.raises(TypeError, match="at least one frame"), TransformBroadcaster(Bus()).owning():
        pytest.fail("the block began")


def test_a_broadcaster_that_drops_goes_on_whatever_edges_others_publish(caplog: pytest.LogCaptureFixture) -> None:
    bus = Bus(SimulatedClock())
    TransformBroadcaster(bus, "stranger").send("base", "map", Transform())
    robot = TransformBroadcaster(bus, "robot", invalid="drop")
    for _ in range(3):
        robot.send("map", "base", Transform())
        robot.send_static("map", "base", Transform())
        robot.send_all([("map", "base", Transform()), ("base", "arm", Transform())])
    assert bus.statistics().rejected == {"cycle": 9}
    assert bus.statistics().frames == 2
    assert [message for message in caplog.messages if "dropped" in message] == [
        "dropped a sample: the edge 'map' -> 'base' would close a loop of parents: base -> map -> base, "
        "with edges from 'stranger'"
    ]
    with pytest.raises(InvalidTransformError, match="frame name"):
        robot.send("/map", "base", Transform())
    with pytest.raises(ValueError, match="invalid must be 'raise' or 'drop', not 'ignore'"):
        TransformBroadcaster(bus, invalid="ignore")  # type: ignore[arg-type]


def test_an_authority_that_is_no_str_is_an_error() -> None:
    with pytest.raises(TypeError, match="authority"):
        TransformBroadcaster(Bus(SimulatedClock()), 5)  # type: ignore[arg-type]
