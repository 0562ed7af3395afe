"""Covariances beside the history: kept and dropped with their samples, by a tree, a bus and a buffer."""

import anyio
import numpy as np
import pytest
from support.samples import moving, static
from support.worlds import random_covariance, random_transform

from tfbus import (
    SECOND,
    Buffer,
    Bus,
    Covariance,
    FutureExtrapolationError,
    Hold,
    Odometry,
    PointStamped,
    PointWithCovarianceStamped,
    PoseStamped,
    PoseWithCovarianceStamped,
    QuaternionStamped,
    SimulatedClock,
    Transform,
    TransformBroadcaster,
    TransformStamped,
    TransformTree,
    UncertainSample,
)

ERROR = Covariance.of(xyz=0.1, rpy=0.01)


def unsure(
    parent: str, child: str, stamp: int, sigma: float = 0.1, x: float = 0.0, static: bool = False
) -> UncertainSample:
    error = Covariance.of(xyz=sigma)
    return UncertainSample(parent, child, stamp, Transform((x, 0.0, 0.0)), static=static, covariance=error)


def sigma_of(tree: TransformTree | Buffer, target: str, source: str, at: int) -> float | None:
    """The standard deviation of x; None if the only edge counts as exact."""
    ask = tree.lookup_nowait if isinstance(tree, Buffer) else tree.lookup
    found = ask(target, source, at, covariance=True)
    return None if found.exact else float(found.covariance.sigmas[0])


def test_an_edge_without_a_covariance_is_told_and_not_taken_for_zero_in_silence() -> None:
    tree = TransformTree()
    tree.insert_many([unsure("a", "b", 0), static("b", "c"), moving("c", "d", 0)])
    found = tree.lookup("a", "d", 0, covariance=True)
    assert found.exact == (("b", "c"), ("c", "d"))
    assert found.transform == tree.lookup("a", "d", 0).transform
    # Between two samples, both must be known; at a sample, that one.
    tree.insert(moving("a", "b", 10))
    assert [sigma_of(tree, "a", "b", at) for at in (0, 5, 10)] == [pytest.approx(0.1), None, None]
    assert tree.lookup("d", "d", covariance=True).covariance.matrix.any().item() is False


def test_the_covariance_goes_with_its_sample() -> None:
    tree = TransformTree(keep=1e-7)
    for stamp in range(0, 1000, 10):
        tree.insert(unsure("a", "b", stamp, stamp))
    assert sigma_of(tree, "a", "b", 990) == pytest.approx(990.0)
    tree.insert(unsure("a", "b", 990, 3.0))
    assert sigma_of(tree, "a", "b", 990) == pytest.approx(3.0)
    tree.insert(moving("a", "b", 990))
    assert sigma_of(tree, "a", "b", 990) is None
    tree.insert(unsure("a", "b", 955, 7.0))
    assert sigma_of(tree, "a", "b", 955) == pytest.approx(7.0)
    for copied in (tree.copy(), TransformTree(keep=1e-7)):
        copied.insert(unsure("a", "b", 991, 4.0))
        assert sigma_of(copied, "a", "b", 991) == pytest.approx(4.0)
    assert sigma_of(tree.copy(), "a", "b", 955) == pytest.approx(7.0)
    tree.clear()
    for stamp in (955, 980):
        tree.insert(moving("a", "b", stamp))
    assert sigma_of(tree, "a", "b", 955) is None, "a sample after a reset has no covariance of one before"


def test_a_static_covariance_is_replaced_with_its_sample_and_changes_of_the_kind_forget_it() -> None:
    tree = TransformTree()
    tree.insert(unsure("a", "b", 5, static=True))
    assert sigma_of(tree, "a", "b", 100) == pytest.approx(0.1)
    tree.insert(unsure("a", "b", 5, 0.2, static=True))
    assert sigma_of(tree, "a", "b", 100) == pytest.approx(0.2)
    tree.insert(static("a", "b", stamp=5))
    assert sigma_of(tree, "a", "b", 100) is None
    tree.insert(unsure("a", "b", 5, static=True))
    for stamp in (0, 5, 10):
        tree.insert(moving("a", "b", stamp))
    assert sigma_of(tree, "a", "b", 5) is None
    tree.insert(unsure("a", "b", 7))
    tree.insert(static("a", "b", stamp=7))
    assert sigma_of(tree, "a", "b", 7) is None


def test_a_change_of_the_parent_is_held_with_the_error_of_the_older_edge() -> None:
    tree = TransformTree()
    tree.insert_many([static("root", "a"), static("root", "b"), unsure("a", "c", 0, 0.1), unsure("b", "c", 10, 0.3)])
    found = tree.lookup("root", "c", 5, covariance=True)
    assert found.covariance.sigmas[0] == pytest.approx(0.1)
    assert found.exact == (("root", "a"),)
    assert tree.lookup("root", "c", 10, covariance=True).covariance.sigmas[0] == pytest.approx(0.3)


def test_a_policy_reads_the_error_of_the_sample_that_stands_in() -> None:
    tree = TransformTree()
    tree.insert_many([unsure("a", "b", 0, 0.1), unsure("a", "b", SECOND, 0.2)])
    found = tree.lookup("a", "b", 2 * SECOND, extrapolate=Hold(1.0), covariance=True)
    assert found.covariance.sigmas[0] == pytest.approx(0.2)
    assert found.extrapolated_by == SECOND
    with pytest.raises(FutureExtrapolationError):
        tree.lookup("a", "b", 2 * SECOND, covariance=True)


def test_many_answers_have_the_covariances_of_single_ones() -> None:
    rng = np.random.default_rng(1)
    tree = TransformTree(keep=None)
    for parent, child, every in (("map", "odom", 50), ("odom", "base", 10), ("map", "other", 30)):
        for stamp in range(0, 301, every):
            error = Covariance(random_covariance(rng, 0.1, 0.1))
            tree.insert(UncertainSample(parent, child, stamp, random_transform(rng), covariance=error))
    tree.insert(UncertainSample("base", "camera", 0, random_transform(rng), static=True, covariance=ERROR))
    tree.insert(static("other", "laser"))
    stamps = [*range(0, 301, 7), 300, 0]
    found = tree.lookup_many("laser", "camera", stamps, covariance=True)
    assert found.exact == (("other", "laser"),)
    assert found.stamps is not None
    assert found.stamps.tolist() == stamps
    for i, stamp in enumerate(stamps):
        one = tree.lookup("laser", "camera", stamp, covariance=True)
        assert found.covariances[i] == pytest.approx(one.covariance.matrix, rel=1e-9, abs=1e-15)
    # One by one: time travel, and a frame that changes its parent.
    travel = tree.lookup_many("camera", "camera", [300, 200], source_at=100, fixed="map", covariance=True)
    one = tree.lookup("camera", "camera", 200, source_at=100, fixed="map", covariance=True)
    assert travel.covariances[1] == pytest.approx(one.covariance.matrix)
    tree.insert(unsure("other", "base", 310))
    held = tree.lookup_many("laser", "camera", [305, 400], out_of_range="nan", covariance=True)
    assert held.covariances[0] == pytest.approx(tree.lookup("laser", "camera", 305, covariance=True).covariance.matrix)
    assert np.isnan(held.covariances[1]).all()


@pytest.mark.parametrize("count", [0, 3])
def test_many_answers_without_errors_say_so(count: int) -> None:
    tree = TransformTree()
    tree.insert_many([moving("a", "b", stamp) for stamp in (0, 10)])
    found = tree.lookup_many("a", "b", range(count), covariance=True)
    assert found.covariances.shape == (count, 6, 6)
    assert not found.covariances.any()
    assert found.exact == ((("a", "b"),) if count else ())


# A bus and its buffers


def test_a_buffer_that_joins_late_has_the_errors_of_static_samples_and_a_prefix_keeps_them() -> None:
    bus = Bus(SimulatedClock())
    robot = TransformBroadcaster(bus, "robot", prefix="r1/", shared={"map"})
    robot.send_static("base", "laser", Transform(), covariance=ERROR)
    with Buffer(bus) as late, Buffer(bus, prefix="r1/", shared={"map"}) as local:
        assert sigma_of(late, "r1/base", "r1/laser", 0) == pytest.approx(0.1)
        robot.send("map", "base", Transform(), at=5, covariance=ERROR, kind="drift")
        found = local.lookup_nowait("map", "laser", covariance=True)
        assert (found.parent, found.child, found.exact) == ("map", "laser", ())
        assert found.covariance.sigmas[0] == pytest.approx(0.1 * np.sqrt(2.0))
        assert sigma_of(Buffer(bus, prefill=late), "map", "r1/base", 5) == pytest.approx(0.1)
        # A plain sample in the same batch, and in the same history.
        robot.send_all([TransformStamped("map", "base", 6, Transform()), unsure("map", "mast", 6, 0.5)])
        assert [sigma_of(local, "map", name, 6) for name in ("base", "mast")] == [None, pytest.approx(0.5)]


def test_streams_subscribers_and_threads_get_samples_with_their_errors() -> None:
    bus, got = Bus(SimulatedClock()), list[TransformStamped]()
    with bus.subscribe(got.extend):
        bus.publish([unsure("a", "b", 0), unsure("a", "c", 0, static=True)])
    assert [sample.covariance.sigmas[0] for sample in got if isinstance(sample, UncertainSample)] == [0.1, 0.1]
    with Buffer(bus) as late:
        assert sigma_of(late, "a", "c", 0) == pytest.approx(0.1)


async def test_a_lookup_that_waits_is_answered_with_its_error() -> None:
    bus = Bus(SimulatedClock())
    with Buffer(bus) as buffer:
        bus.publish(unsure("a", "b", 0))
        found = []

        async def wait() -> None:
            found.append(await buffer.lookup("a", "b", 5, covariance=True))

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(wait)
            await anyio.wait_all_tasks_blocked()
            bus.publish(unsure("a", "b", 10, 0.3))
        assert found[0].covariance.sigmas[0] ** 2 == pytest.approx(0.5 * (0.01 + 0.09))


async def test_data_move_with_their_own_error_and_that_of_the_transform() -> None:
    bus = Bus(SimulatedClock())
    with Buffer(bus) as buffer:
        quarter = Transform.from_axis_angle((0.0, 0.0, 1.0), np.pi / 2)
        error = Covariance.of(xyz=(0.1, 0.2, 0.3), rpy=(0.0, 0.0, 0.01))
        TransformBroadcaster(bus).send_static("map", "base", quarter, covariance=error)
        own = np.diag([1.0, 4.0, 9.0, 0.1, 0.2, 0.3])
        # A yaw of 0.01 rad shifts a point at (10, 0, 0), which is at (0, 10, 0) in the map, by 0.1 m along x.
        both = np.diag([0.01 + 0.01, 0.04, 0.09])
        point = await buffer.transform(PointStamped("base", 0, (10.0, 0.0, 0.0)), "map", covariance=True)
        assert isinstance(point, PointWithCovarianceStamped)
        assert point.point == pytest.approx((0.0, 10.0, 0.0))
        assert point.covariance == pytest.approx(both, abs=1e-12)
        detected = PointWithCovarianceStamped("base", 0, (10.0, 0.0, 0.0), own[:3, :3])
        point = await buffer.transform(detected, "map", covariance=True)
        assert point.covariance == pytest.approx(both + np.diag([4.0, 1.0, 9.0]), abs=1e-12)
        place = Transform((10.0, 0.0, 0.0))
        pose = await buffer.transform(PoseStamped("base", 0, place), "map", covariance=True)
        assert pose.covariance[:3, :3] == pytest.approx(both, abs=1e-12)
        assert pose.covariance[5].tolist() == pytest.approx([-1e-3, 0.0, 0.0, 0.0, 0.0, 1e-4])
        pose = await buffer.transform(PoseWithCovarianceStamped("base", 0, place, own), "map", covariance=True)
        assert pose.covariance.diagonal() == pytest.approx([4.02, 1.04, 9.09, 0.2, 0.1, 0.3001])
        unknown = PoseWithCovarianceStamped("base", 0, place, -np.eye(6))
        pose = await buffer.transform(unknown, "map", covariance=True)
        assert (pose.covariance == -np.eye(6)).all()
        odometry = Odometry("base", 0, "wheel", place, (0.0,) * 3, (0.0,) * 3, pose_covariance=own)
        moved = await buffer.transform(odometry, "map", covariance=True)
        assert moved.pose_covariance.diagonal() == pytest.approx([4.02, 1.04, 9.09, 0.2, 0.1, 0.3001])
        with pytest.raises(TypeError, match="no place for a covariance"):
            await buffer.transform(QuaternionStamped("base", 0, (0.0, 0.0, 0.0, 1.0)), "map", covariance=True)


@pytest.mark.parametrize(
    ("covariance", "kind", "error"),
    [(np.eye(6), "drift", TypeError), (ERROR, "drifting", ValueError), ([0.1] * 6, "drift", TypeError)],
)
def test_a_wrong_covariance_is_refused_at_the_sender(covariance: object, kind: object, error: type[Exception]) -> None:
    bus = Bus(SimulatedClock())
    with Buffer(bus) as buffer, pytest.raises(error, match="must be"):
        TransformBroadcaster(bus).send("a", "b", Transform(), covariance=covariance, kind=kind)  # type: ignore[arg-type]
    assert not buffer.tree.frames()
