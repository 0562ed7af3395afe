from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.stamped_data import ANSWER, CLOUD
from support.strategies import TODAY, transforms, vectors

from tfbus import PointCloud, PointStamped, Transform, TransformStamped, do_transform
from tfbus.rows import Vector

POINTS = np.zeros((2, 3))


def test_every_point_is_transformed() -> None:
    # The numbers of tf2_sensor_msgs' test_tf2_sensor_msgs.cpp.
    moved = do_transform(PointCloud("B", 0, np.array([(1.0, 2.0, 3.0), (0.0, 0.0, 0.0)])), ANSWER)
    np.testing.assert_allclose(moved.points, [(-9.0, 18.0, 27.0), (-10.0, 20.0, 30.0)], rtol=0.0, atol=1e-13)


@given(transforms(), st.lists(vectors(), min_size=1, max_size=5))
def test_a_cloud_is_transformed_point_by_point(t: Transform, points: list[Vector]) -> None:
    sample = TransformStamped("A", "B", 0, t)
    moved = do_transform(PointCloud("B", 0, np.array(points)), sample)
    one_by_one = [do_transform(PointStamped("B", 0, point), sample).point for point in points]
    np.testing.assert_allclose(moved.points, one_by_one, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_transformed_points_keep_their_dtype(dtype: Any) -> None:
    assert do_transform(PointCloud("B", 0, np.ones((2, 3), dtype)), ANSWER).points.dtype == dtype


def test_a_missing_point_stays_missing_and_leaves_the_others() -> None:
    moved = do_transform(PointCloud("B", 0, np.array([(np.nan, np.nan, np.nan), (1.0, 2.0, 3.0)])), ANSWER)
    assert np.isnan(moved.points).tolist() == [[True] * 3, [False] * 3]


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


def test_a_cloud_is_as_long_as_its_points() -> None:
    assert len(CLOUD) == 2


def test_a_cloud_needs_neither_stamps_nor_fields() -> None:
    cloud = PointCloud("map", 0, POINTS)
    assert cloud.stamps is None
    assert cloud.fields == {}


@pytest.mark.parametrize("stamps", [[TODAY, TODAY + 1], np.array([TODAY, TODAY + 1], np.uint64)])
def test_stamps_become_int64_without_losing_a_nanosecond(stamps: Any) -> None:
    kept = PointCloud("map", 0, POINTS, stamps).stamps
    assert kept is not None
    assert kept.dtype == np.int64
    assert kept.tolist() == [TODAY, TODAY + 1]


@pytest.mark.parametrize("stamps", [[0.5, 1.5], np.array([1.0, 2.0])])
def test_stamps_in_seconds_are_refused_with_a_hint_at_from_seconds(stamps: Any) -> None:
    with pytest.raises(TypeError, match="from_seconds"):
        PointCloud("map", 0, POINTS, stamps)


@pytest.mark.parametrize(
    ("stamps", "message"),
    [
        ([1], r"stamps must have shape \(2,\), one for each point, got \(1,\)"),
        ([1, 2, 3], r"stamps must have shape \(2,\), one for each point, got \(3,\)"),
        ([[1, 2]], r"stamps must have shape \(n,\), got \(1, 2\)"),
        (np.array([1, 2**63], np.uint64), "does not fit 64-bit"),
    ],
)
def test_there_is_one_stamp_for_each_point(stamps: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
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
