""""""

import math
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.stamped_data import ANSWER, CLOUD, SCAN
from support.strategies import TODAY, transforms, vectors

from tfbus import (
    LATEST,
    SECOND,
    LaserScan,
    PointCloud,
    PointStamped,
    Transform,
    TransformStamped,
    do_transform,
    from_seconds,
)
from tfbus.rows import Vector
from tfbus.stamps import STAMP_MAX

POINTS = np.zeros((2, 3))


@given(transforms(), st.lists(vectors(), min_size=1, max_size=5))
def test_a_cloud_is_transformed_point_by_point(t: Transform, points: list[Vector]) -> None:
    sample = TransformStamped("A", "B", 0, t)
    moved = do_transform(PointCloud("B", 0, np.array(points)), sample)
    one_by_one = [do_transform(PointStamped("B", 0, point), sample).point for point in points]
    np.testing.assert_allclose(moved.points, one_by_one, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_an_infinite_point_stays_not_finite_without_a_warning(dtype: Any) -> None:
    points = np.array([(np.inf, 0, 0), (0, -np.inf, 0), (np.inf, -np.inf, np.nan), (1, 2, 3)], dtype)
    for rotation in ((0.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0), (0.1, -0.7, 0.1, -0.7)):
        answer = TransformStamped("A", "B", 0, Transform((1.0, 2.0, 3.0), rotation))
        moved = do_transform(PointCloud("B", 0, points), answer)
        assert np.isfinite(moved.points).all(axis=1).tolist() == [False, False, False, True]


def test_stamps_and_fields_are_passed_on_without_a_copy() -> None:
    moved = do_transform(CLOUD, ANSWER)
    assert moved.stamps is CLOUD.stamps
    assert moved.fields["intensity"] is CLOUD.fields["intensity"]


def test_a_cloud_may_be_empty() -> None:
    cloud = PointCloud("B", 0, np.empty((0, 3)), [], {"ring": np.empty(0)})  # type: ignore[arg-type]
    moved = do_transform(cloud, ANSWER)
    assert len(moved) == 0
    assert moved.stamps is not None
    assert moved.stamps.dtype == np.int64


@pytest.mark.parametrize("stamps", [[TODAY, TODAY + 1], np.array([TODAY, TODAY + 1], np.uint64)])
def test_stamps_become_int64_without_losing_a_nanosecond(stamps: Any) -> None:
    kept = PointCloud("map", 0, POINTS, stamps).stamps
    assert kept is not None
    assert kept.dtype == np.int64
    assert kept.tolist() == [TODAY, TODAY + 1]


@pytest.mark.parametrize(
    ("stamps", "error", "message"),
    [
        ([1], ValueError, r"stamps must have shape \(2,\), one for each point, got \(1,\)"),
        ([1, 2, 3], ValueError, r"stamps must have shape \(2,\), one for each point, got \(3,\)"),
        ([[1, 2]], ValueError, r"stamps must have shape \(n,\), got \(1, 2\)"),
        (np.array([1, 2**63], np.uint64), ValueError, "does not fit 64-bit"),
        ([0.5, 1.5], TypeError, "from_seconds"),
        (np.array([1.0, 2.0]), TypeError, "from_seconds"),
    ],
)
def test_there_is_one_stamp_for_each_point_in_nanoseconds(stamps: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        PointCloud("map", 0, POINTS, stamps)


@pytest.mark.parametrize(
    "values",
    [
        [3, 4],
        np.array(["road", "kerb"]),
        np.zeros((2, 4, 4), np.uint8),
        np.array([(1, 0.5), (2, 0.25)], [("ring", "u1"), ("intensity", "f4")]),
    ],
    ids=["numbers", "words", "patches", "records"],
)
def test_a_field_is_any_array_with_one_row_for_each_point(values: Any) -> None:
    kept = do_transform(PointCloud("B", 0, POINTS, fields={"extra": values}), ANSWER).fields["extra"]
    assert kept.dtype == np.asarray(values).dtype
    np.testing.assert_array_equal(kept, values)


@pytest.mark.parametrize("values", [[1], [1, 2, 3], np.zeros((3, 2)), 5.0], ids=["one", "three", "transposed", "none"])
def test_a_field_of_another_length_is_refused_by_its_name(values: Any) -> None:
    with pytest.raises(ValueError, match=r"field 'ring' must have shape \(2, \.\.\.\), one for each point, got"):
        PointCloud("map", 0, POINTS, fields={"ring": values})


def test_the_name_of_a_field_is_a_str() -> None:
    with pytest.raises(TypeError, match="name of a field must be a str, not 5"):
        PointCloud("map", 0, POINTS, fields={5: np.zeros(2)})  # type: ignore[dict-item]


def test_fields_can_neither_be_changed_by_the_caller_nor_through_the_cloud() -> None:
    mine = {"ring": np.array([1, 2])}
    cloud = PointCloud("map", 0, POINTS, fields=mine)
    mine["late"] = np.array([3, 4])
    assert list(cloud.fields) == ["ring"]
    assert isinstance(cloud.fields, MappingProxyType)
    with pytest.raises(TypeError):
        cloud.fields["ring"] = np.array([5, 6])  # type: ignore[index]


def scan_of(ranges: Any, **changes: Any) -> LaserScan:
    """Rays from -45 degrees to the left, 45 degrees apart."""
    return LaserScan("laser", 0, ranges, **{"angle_min": -math.pi / 4, "angle_increment": math.pi / 4, **changes})


def test_a_point_is_at_the_angle_and_the_range_of_its_ray() -> None:
    cloud = scan_of([math.sqrt(2.0), 3.0, math.sqrt(2.0), 2.0]).to_points()
    expected = [(1.0, -1.0, 0.0), (3.0, 0.0, 0.0), (1.0, 1.0, 0.0), (0.0, 2.0, 0.0)]
    np.testing.assert_allclose(cloud.points, expected, atol=1e-15)
    assert (cloud.frame, cloud.stamp) == ("laser", 0)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_points_have_the_dtype_of_the_ranges_and_are_exact_to_its_last_digits(dtype: Any) -> None:
    scan = LaserScan("laser", 0, np.full(1000, 10.0, dtype), angle_min=-3.0, angle_increment=0.006)
    points = scan.to_points().points
    assert points.dtype == dtype
    # The angles are float64 whatever the ranges are.
    expected = 10.0 * np.cos(-3.0 + 0.006 * np.arange(1000))
    np.testing.assert_allclose(points[:, 0], expected, rtol=0.0, atol=10.0 * np.finfo(dtype).eps)


# Which rays count


def test_ranges_that_are_not_finite_or_outside_the_limits_give_no_points() -> None:
    ranges = [math.nan, math.inf, -math.inf, 0.05, 0.1, 5.0, 30.0, 30.5, 0.0, -1.0]
    cloud = scan_of(ranges, range_min=0.1, range_max=30.0).to_points()
    assert cloud.fields["index"].tolist() == [4, 5, 6]
    np.testing.assert_allclose(np.linalg.norm(cloud.points, axis=1), [0.1, 5.0, 30.0])


def test_a_range_at_a_limit_rounded_to_float32_is_valid() -> None:
    ranges = np.array([0.1, 30.1], np.float32)
    assert len(scan_of(ranges, range_min=0.1, range_max=30.1).to_points()) == 2


@pytest.mark.parametrize(("dtype", "beyond"), [(np.float32, 1e300), (np.float16, 1e5), (np.float16, 1e300)])
def test_a_limit_beyond_the_dtype_of_the_ranges_is_infinite(dtype: Any, beyond: float) -> None:
    ranges = np.array([1.0, math.inf, np.finfo(dtype).max, math.nan, -1.0], dtype)
    index = scan_of(ranges, range_max=beyond).to_points().fields["index"]
    assert index.tolist() == [0, 2]
    assert scan_of(ranges, range_min=-beyond).to_points().fields["index"].tolist() == [0, 2, 4]
    assert len(scan_of(ranges, range_min=beyond).to_points()) == 0


@pytest.mark.parametrize("ranges", [[], [math.nan, math.inf]])
def test_a_scan_without_valid_ranges_is_an_empty_cloud(ranges: list[float]) -> None:
    cloud = scan_of(ranges, intensities=np.zeros(len(ranges))).to_points()
    assert cloud.points.shape == (0, 3)
    assert cloud.stamps is not None
    assert len(cloud.stamps) == 0


def test_intensities_stay_with_their_rays() -> None:
    cloud = scan_of([1.0, math.nan, 3.0], intensities=np.array([10, 20, 30], np.uint16)).to_points()
    assert cloud.fields["intensities"].tolist() == [10, 30]
    assert cloud.fields["intensities"].dtype == np.uint16


@pytest.mark.parametrize("none", [None, [], np.array([], np.float32)])
def test_an_empty_array_of_intensities_becomes_none(none: Any) -> None:
    scan = scan_of([1.0, 2.0], intensities=none)
    assert scan.intensities is None
    assert list(scan.to_points().fields) == ["index"]


# Stamps


@given(st.integers(1, 1000), st.sampled_from([1e-9, 2.7e-5, -2.7e-5, 0.00016416666039731354, 0.3]))
def test_each_point_has_the_stamp_of_its_ray_to_the_nanosecond(rays: int, time_increment: float) -> None:
    ranges = np.ones(rays)
    ranges[::3] = math.nan
    cloud = LaserScan(
        "laser", TODAY, ranges, angle_min=0.0, angle_increment=0.1, time_increment=time_increment
    ).to_points()
    assert cloud.stamps is not None
    expected = [TODAY + from_seconds(i * time_increment) for i in range(rays) if i % 3]
    assert cloud.stamps.tolist() == expected


def test_a_scan_stamped_latest_gives_no_stamps() -> None:
    cloud = replace(scan_of([1.0, 1.0], time_increment=0.5), stamp=LATEST).to_points()
    assert cloud.stamp is LATEST
    assert cloud.stamps is None


def test_a_scan_whose_last_ray_is_beyond_64_bits_is_refused() -> None:
    assert replace(scan_of([1.0, 1.0], time_increment=1.0), stamp=STAMP_MAX - SECOND).stamp == STAMP_MAX - SECOND
    with pytest.raises(ValueError, match="64-bit"):
        replace(scan_of([1.0, 1.0], time_increment=1.0), stamp=STAMP_MAX - SECOND + 1)
    with pytest.raises(ValueError, match="64-bit"):
        scan_of([1.0, 1.0], time_increment=1e300)


# The values of a scan


def test_only_frame_stamp_ranges_and_angles_are_needed_and_the_rest_is_computed() -> None:
    scan = LaserScan(frame="laser", stamp=0, angle_min=-1.0, angle_increment=0.5, ranges=np.array([1, 2, 3]))
    assert scan.angle_max == 0.0
    assert scan.ranges.dtype == np.float64
    assert (scan.time_increment, scan.scan_time, scan.range_min, scan.range_max) == (0.0, 0.0, 0.0, math.inf)


def test_numbers_of_numpy_become_plain_floats() -> None:
    scan = scan_of([1.0], angle_min=np.float32(0.1), angle_max=np.float32(0.2), range_max=np.int32(7))
    assert [type(value) for value in (scan.angle_min, scan.angle_max, scan.range_max)] == [float, float, float]
    assert scan.angle_min == np.float32(0.1)


def test_the_rounding_of_drivers_is_no_error() -> None:
    # A YDLIDAR X4, https://github.com/SteveMacenski/slam_toolbox/issues/63: both ends of the circle, one ray less.
    ends = {"angle_min": -3.14159274101, "angle_max": 3.14159274101, "angle_increment": 0.00872664619237}
    scan = scan_of(np.ones(720, np.float32), **ends, time_increment=0.000164166660397, scan_time=0.11819999665)
    assert scan.angle_max == 3.14159274101
    assert len(scan.to_points()) == 720


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ranges": [[1.0, 2.0]]}, r"ranges must have shape \(n,\), got \(1, 2\)"),
        ({"intensities": [1, 2]}, r"intensities must have shape \(3,\), as the ranges, got \(2,\)"),
        ({"intensities": [[1, 2, 3]]}, r"intensities must have shape \(3,\), as the ranges, got \(1, 3\)"),
        ({"angle_min": math.nan}, "angle_min must be finite, got nan"),
        ({"angle_increment": math.inf}, "angle_increment must be finite, got inf"),
        ({"time_increment": math.nan}, "time_increment must be finite, got nan"),
        ({"angle_increment": 0.0}, "angle_increment must not be 0 for a scan of 3 rays"),
        ({"range_min": 2.0, "range_max": 1.0}, r"range_min must not be above range_max, got 2\.0 and 1\.0"),
        ({"range_max": math.nan}, "range_min must not be above range_max"),
    ],
)
def test_an_inconsistent_scan_is_refused_with_the_value(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(SCAN, **changes)


@pytest.mark.parametrize(
    "name", ["angle_min", "angle_max", "angle_increment", "time_increment", "scan_time", "range_min", "range_max"]
)
@pytest.mark.parametrize("wrong", ["1", True, (1.0,)])
def test_a_value_that_is_not_a_number_is_refused_with_the_name_of_the_field(name: str, wrong: Any) -> None:
    with pytest.raises(TypeError, match=f"{name} must be a number, not"):
        replace(SCAN, **{name: wrong})


def test_ranges_that_are_no_numbers_are_refused() -> None:
    with pytest.raises(TypeError, match="ranges must be numbers, not of dtype"):
        replace(SCAN, ranges=np.array(["far", "near", "far"]))


def test_one_ray_needs_no_increment() -> None:
    scan = LaserScan("sonar", 0, np.array([2.0]), angle_min=math.pi / 2, angle_increment=0.0)
    np.testing.assert_allclose(scan.to_points().points, [(0.0, 2.0, 0.0)], atol=1e-15)
