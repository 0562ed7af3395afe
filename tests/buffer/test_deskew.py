"""`Buffer.deskew`: clouds of a moving sensor, awaited."""

from functools import partial

import anyio
import numpy as np
import pytest
from support.asking import Asked, settle
from support.samples import moving, static

from tfbus import (
    LATEST,
    SECOND,
    Buffer,
    Bus,
    FutureExtrapolationError,
    GapError,
    LaserScan,
    Latest,
    LookupTimeoutError,
    PastExtrapolationError,
    PointCloud,
    SimulatedClock,
)
from tfbus.tree.lookup import Hold

pytestmark = [pytest.mark.anyio, pytest.mark.every_loop]


def cloud(*seconds: float, stamp: int | Latest = LATEST) -> PointCloud:
    """Points at the sensor, 1 m ahead of a cart, each seen at an instant in s."""
    stamps = np.array([round(at * SECOND) for at in seconds], np.int64)
    return PointCloud("lidar", stamp, np.zeros((len(seconds), 3)), stamps, {"ring": np.arange(len(seconds))})


def drive(bus: Bus, *seconds: float, prefix: str = "") -> None:
    """The cart goes 1 m in a second."""
    bus.publish(static(f"{prefix}cart", f"{prefix}lidar", 1.0))
    bus.publish([moving(f"{prefix}odom", f"{prefix}cart", round(at * SECOND), at) for at in seconds])


async def test_a_cloud_waits_for_the_transform_of_its_newest_point(
    clock: SimulatedClock, bus: Bus, buffer: Buffer
) -> None:
    drive(bus, 0.0, 0.5)
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, partial(buffer.deskew, cloud(0.0, 0.5, 1.0), "odom", fixed="odom", timeout=1.0))
        await settle()
        await clock.advance(0.9)
        assert not asked.ended
        drive(bus, 1.0)
    found = asked.answer
    assert (found.frame, found.stamp, found.stamps, found.fields["ring"].tolist()) == ("odom", SECOND, None, [0, 1, 2])
    assert found.points[:, 0].tolist() == [1.0, 1.5, 2.0]
    again = await buffer.deskew(cloud(0.0, 0.5, 1.0, stamp=0), "cart", fixed="odom")
    assert (again.stamp, again.points[:, 0].tolist()) == (0, [1.0, 1.5, 2.0])


async def test_one_timeout_counts_for_the_points_and_the_target_together(
    clock: SimulatedClock, bus: Bus, buffer: Buffer
) -> None:
    drive(bus, 0.0)
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, partial(buffer.deskew, cloud(0.0, 1.0), "map", fixed="odom", timeout=2.0))
        await settle()
        await clock.advance(1.5)
        drive(bus, 1.0)
        await settle()
        await clock.advance(0.4)
        assert not asked.ended
        await clock.advance(0.2)
    assert isinstance(asked.error, LookupTimeoutError)
    assert asked.error.timeout == 2.0
    assert "frame 'map' is not known" in str(asked.error)


async def test_the_policies_of_a_lookup_count_for_every_point(bus: Bus, buffer: Buffer) -> None:
    drive(bus, 0.0, 0.9)
    late = cloud(0.0, 0.9, 1.0)
    held = await buffer.deskew(late, "odom", fixed="odom", extrapolate=Hold(0.2))
    near = await buffer.deskew(late, "odom", fixed="odom", tolerance=0.1)
    assert held.points[:, 0].tolist() == near.points[:, 0].tolist() == [1.0, 1.9, 1.9]
    assert buffer.tree.deskew(late, "odom", "odom", tolerance=0.1).points.tolist() == near.points.tolist()
    with pytest.raises(LookupTimeoutError) as caught:
        await buffer.deskew(late, "odom", fixed="odom", tolerance=0.05, timeout=0.0)
    assert isinstance(caught.value.__cause__, FutureExtrapolationError)
    with pytest.raises(GapError) as gap:
        await buffer.deskew(cloud(0.0, 0.5, 0.9), "odom", fixed="odom", max_gap=0.1, timeout=0.0)
    assert gap.value.index == 1


async def test_a_point_older_than_the_window_fails_at_once_and_can_be_left_out(bus: Bus, buffer: Buffer) -> None:
    drive(bus, 1.0, 2.0)
    old = cloud(0.5, 1.5, 3.0)
    with pytest.raises(PastExtrapolationError):
        await buffer.deskew(old, "odom", fixed="odom")
    drive(bus, 3.0)
    points = buffer.tree.deskew(old, "odom", "odom", out_of_range="nan").points
    assert np.isnan(points[:, 0]).tolist() == [True, False, False]


async def test_with_a_prefix_all_names_are_local(bus: Bus) -> None:
    drive(bus, 0.0, 1.0, prefix="r1/")
    with Buffer(bus, prefix="r1/") as buffer:
        drive(bus, 0.0, 1.0, prefix="r1/")
        found = await buffer.deskew(cloud(0.0, 1.0), "cart", fixed="odom", timeout=0.0)
    assert (found.frame, found.points[:, 0].tolist()) == ("cart", [0.0, 1.0])


async def test_an_empty_cloud_needs_the_target_only_and_other_data_are_refused(bus: Bus, buffer: Buffer) -> None:
    drive(bus, 0.0, 1.0)
    assert len(await buffer.deskew(cloud(), "cart", fixed="odom", timeout=0.0)) == 0
    scan = LaserScan("lidar", 0, np.ones(3), angle_min=0.0, angle_max=1.0, angle_increment=0.5)
    with pytest.raises(TypeError, match="not a LaserScan: a scan becomes one by to_points"):
        await buffer.deskew(scan, "cart", fixed="odom")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="have no stamps"):
        await buffer.deskew(PointCloud("lidar", 0, np.zeros((1, 3))), "cart", fixed="odom")
