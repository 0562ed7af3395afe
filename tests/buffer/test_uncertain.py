"""Samples with covariances on a bus, and lookups of buffers that ask for them."""

import anyio
import numpy as np
import pytest
from support.worlds import sigma_of, unsure

from tfbus import (
    Buffer,
    Bus,
    Covariance,
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
    UncertainSample,
)
from tfbus.data import to_message

pytestmark = pytest.mark.anyio

ERROR = Covariance.of(xyz=0.1, rpy=0.01)


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


def test_messages_with_a_covariance_are_sent_with_it_and_unknown_ones_without() -> None:
    bus = Bus(SimulatedClock())
    sender, pose, still = TransformBroadcaster(bus), Transform((2.0, 0.0, 0.0)), (0.0, 0.0, 0.0)
    with Buffer(bus) as buffer:
        odometry = Odometry("odom", 5, "base", pose, still, still, pose_covariance=ERROR.matrix)
        sender.send_message(to_message(odometry))
        sender.send_message(PoseWithCovarianceStamped("camera", 5, pose, ERROR.matrix), "tag", invert=True)
        sender.send_message(PoseWithCovarianceStamped("world", 5, pose, -np.eye(6)), "map")
        assert buffer.lookup_nowait("odom", "base", covariance=True).covariance == ERROR
        found = buffer.lookup_nowait("camera", "tag", covariance=True)
        assert found.covariance.matrix == pytest.approx(ERROR.matrix)
        assert found.exact == ()
        assert buffer.lookup_nowait("world", "map", covariance=True).exact == (("world", "map"),)
        # Out again, in the order of ROS.
        message = to_message(found.as_pose())
        assert message["pose"]["covariance"].tolist() == found.covariance.matrix.ravel().tolist()
        sender.send_message({**message, "header": {"frame_id": "x", "stamp": {"sec": 0, "nanosec": 5}}}, "y")
        assert buffer.lookup_nowait("x", "y", covariance=True).covariance.matrix == pytest.approx(ERROR.matrix)
