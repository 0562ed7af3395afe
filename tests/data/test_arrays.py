""""""

import copy
import json
import math
import pickle
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import pytest
from support.samples import moving, tree_of
from support.stamped_data import ANSWER, HOLDERS, ONE_OF_EACH, VALUES, arrays_of, contents, name_of

from tfbus import (
    InvalidTransformError,
    LaserScan,
    PointCloud,
    PointStamped,
    Polygon,
    PoseWithCovarianceStamped,
    Transform,
    TransformArray,
    TwistStamped,
    Vector3Stamped,
    WrenchStamped,
    do_transform,
)

TRIPLES = [
    pytest.param(lambda value: PointStamped("map", 0, value).point, id="point"),
    pytest.param(lambda value: Vector3Stamped("map", 0, value).vector, id="vector"),
    pytest.param(lambda value: TwistStamped("map", 0, value, (0.0, 0.0, 0.0)).linear, id="linear"),
    pytest.param(lambda value: TwistStamped("map", 0, (0.0, 0.0, 0.0), value).angular, id="angular"),
    pytest.param(lambda value: WrenchStamped("map", 0, value, (0.0, 0.0, 0.0)).force, id="force"),
    pytest.param(lambda value: WrenchStamped("map", 0, (0.0, 0.0, 0.0), value).torque, id="torque"),
]


@dataclass(init=False, frozen=True)
class Landmark(PointStamped):
    name: str = "lamp"


def test_a_subclass_may_have_a_further_field() -> None:
    lamp = Landmark("map", 5, (1, 2, 3))
    assert (lamp.frame, lamp.stamp, lamp.point, lamp.name) == ("map", 5, (1.0, 2.0, 3.0), "lamp")


@pytest.mark.parametrize("data", ONE_OF_EACH, ids=name_of)
def test_a_frame_is_a_name_and_a_stamp_an_int_or_latest(data: Any) -> None:
    for frame in ("", "/map"):
        with pytest.raises(InvalidTransformError, match="frame name"):
            replace(data, frame=frame)
    for stamp in (1.5, None, True, "LATEST"):
        with pytest.raises(TypeError, match="int of nanoseconds"):
            replace(data, stamp=stamp)
    assert type(replace(data, stamp=np.int64(3)).stamp) is int


@pytest.mark.parametrize("build", TRIPLES)
def test_three_numbers_of_any_kind_become_a_tuple_of_floats_also_if_they_are_not_finite(build: Any) -> None:
    for numbers in ([1, 2, 3], np.array([1, 2, 3]), np.array([1, 2, 3], np.float32)):
        assert repr(build(numbers)) == "(1.0, 2.0, 3.0)"
    assert repr(build((math.nan, -math.inf, -0.0))) == "(nan, -inf, -0.0)"


@pytest.mark.parametrize("build", TRIPLES)
def test_another_number_of_numbers_is_refused_with_the_shape(build: Any) -> None:
    for numbers, shape in (
        ((), r"\(0,\)"),
        ((1.0, 2.0), r"\(2,\)"),
        ((1.0, 2.0, 3.0, 1.0), r"\(4,\)"),
        (np.zeros((4, 3)), r"\(4, 3\)"),
        (np.zeros((3, 1)), r"\(3, 1\)"),
    ):
        with pytest.raises(ValueError, match=rf"must be three numbers, got shape {shape}"):
            build(numbers)


@pytest.mark.parametrize("build", TRIPLES)
def test_values_that_are_not_numbers_are_refused_and_shown(build: Any) -> None:
    for wrong in (
        "123",
        b"123",
        5,
        None,
        ["1", "2", "3"],
        (math.nan, "1", "2"),
        [1.0, math.nan, None],
        [None, 1.0, 2.0],
        [[1.0], [2.0], [3.0]],
        {1.0, 2.0, 3.0},
        {1.0: 0, 2.0: 0, 3.0: 0},
        np.array(["nan", "1", "2"]),
    ):
        with pytest.raises(TypeError, match="must be three numbers, not") as caught:
            build(wrong)
        assert repr(wrong) in str(caught.value)


COPIES = [
    pytest.param(copy.copy, id="copy"),
    pytest.param(copy.deepcopy, id="deepcopy"),
    pytest.param(lambda data: pickle.loads(pickle.dumps(data)), id="pickle"),
    pytest.param(lambda data: replace(data, stamp=data.stamp), id="replace"),
    pytest.param(lambda data: type(data).from_dict(json.loads(json.dumps(data.to_dict(), allow_nan=False))), id="JSON"),
]

OWNERS = [data for data in HOLDERS if isinstance(data, (Polygon, PoseWithCovarianceStamped))]
"""Data that copy the array that they are given."""

POINTS_OF = [
    pytest.param(lambda values: Polygon("map", 0, values).points, id="polygon"),
    pytest.param(lambda values: PointCloud("map", 0, values).points, id="cloud"),
]


@pytest.mark.parametrize("data", HOLDERS, ids=name_of)
def test_held_arrays_are_read_only(data: Any) -> None:
    assert arrays_of(data)
    for array in arrays_of(data):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


@pytest.mark.parametrize("twin_of", COPIES)
@pytest.mark.parametrize("data", ONE_OF_EACH, ids=name_of)
def test_copies_have_the_same_contents_and_are_read_only_too(data: Any, twin_of: Callable[[Any], Any]) -> None:
    twin = twin_of(data)
    assert type(twin) is type(data)
    assert contents(twin) == contents(data)
    assert not any(array.flags.writeable for array in arrays_of(twin))


@pytest.mark.parametrize("made", [*COPIES, pytest.param(lambda data: do_transform(data, ANSWER), id="moved")])
@pytest.mark.parametrize("data", OWNERS, ids=name_of)
def test_a_copied_array_cannot_be_made_writable_again(data: Any, made: Callable[[Any], Any]) -> None:
    for array in arrays_of(data) + arrays_of(made(data)):
        with pytest.raises(ValueError, match="WRITEABLE"):
            array.flags.writeable = True


@pytest.mark.parametrize("data", HOLDERS, ids=name_of)
def test_a_deep_copy_shares_no_array(data: Any) -> None:
    for mine, other in zip(arrays_of(data), arrays_of(copy.deepcopy(data)), strict=True):
        assert not np.shares_memory(mine, other)


@pytest.mark.parametrize("data", HOLDERS, ids=name_of)
def test_data_with_arrays_are_equal_only_to_themselves(data: Any) -> None:
    assert data == data
    assert data != copy.copy(data)
    assert len({data, copy.copy(data)}) == 2


@pytest.mark.parametrize("data", VALUES, ids=name_of)
def test_data_without_arrays_compare_by_value(data: Any) -> None:
    twin = copy.deepcopy(data)
    assert twin == data
    assert hash(twin) == hash(data)
    assert replace(data, stamp=8) != data


def test_clouds_and_scans_view_the_given_arrays_which_stay_writable() -> None:
    points, stamps, column = np.zeros((2, 3), np.float32), np.array([1, 2]), np.array([5.0, 6.0])
    cloud = PointCloud("map", 0, points, stamps, {"ring": column})
    scan = LaserScan("map", 0, column, angle_min=0.0, angle_increment=1.0, intensities=stamps)
    for owned, held in [
        (points, cloud.points),
        (stamps, cloud.stamps),
        (column, cloud.fields["ring"]),
        (column, scan.ranges),
        (stamps, scan.intensities),
    ]:
        assert held is not None
        assert np.shares_memory(owned, held)
        assert owned.flags.writeable


def test_small_arrays_are_copied() -> None:
    points, covariance = np.zeros((3, 3)), np.eye(6)
    polygon = Polygon("map", 0, points)
    pose = PoseWithCovarianceStamped("map", 0, Transform(), covariance)
    points[...] = 9.0
    covariance[...] = 9.0
    assert (polygon.points == 0.0).all()
    assert (pose.covariance == np.eye(6)).all()


@pytest.mark.parametrize("build", POINTS_OF)
def test_points_keep_a_dtype_of_floats_and_other_numbers_become_float64(build: Any) -> None:
    for dtype, kept in (("f2", "f2"), ("f4", "f4"), ("f8", "f8"), ("i8", "f8"), ("u1", "f8")):
        points = build(np.array([(1, 2, 3)], dtype))
        assert (points.dtype, points.tolist()) == (np.dtype(kept), [[1.0, 2.0, 3.0]])
    assert np.isnan(build([(1.0, 2.0, 3.0), (np.nan,) * 3])).tolist() == [[False] * 3, [True] * 3]


@pytest.mark.parametrize("build", POINTS_OF)
def test_points_of_another_shape_or_dtype_are_refused_with_it(build: Any) -> None:
    for shape in ((0,), (3,), (2, 2), (2, 4), (3, 3, 3), ()):
        with pytest.raises(ValueError, match=r"points must have shape \(n, 3\), got") as caught:
            build(np.zeros(shape))
        assert str(caught.value).endswith(f"got {shape}")
    for wrong in ([("1", "2", "3")], [(True, False, True)], [(1j, 0, 0)], [(None, None, None)]):
        with pytest.raises(TypeError, match="points must be numbers, not of dtype"):
            build(wrong)


MASKED: Any = np.ma.array(np.ones((2, 3)), mask=[[False, True, False], [False] * 3])
DOORS: dict[str, Callable[[Any], object]] = {
    "points of a cloud": lambda masked: PointCloud("lidar", 5, masked),
    "rows of points": lambda masked: PointCloud("lidar", 5, cast(Any, [masked[0], masked[1]])),
    "a field": lambda masked: PointCloud("lidar", 5, np.ones((2, 3)), fields={"rgb": masked}),
    "stamps of points": lambda masked: PointCloud("lidar", 5, np.ones((3, 3)), masked[0].astype(np.int64)),
    "corners": lambda masked: Polygon("lidar", 5, masked),
    "ranges": lambda masked: LaserScan("lidar", 5, masked[0], angle_min=0.0, angle_increment=0.1),
    "intensities": lambda masked: LaserScan(
        "lidar", 5, np.ones(3), angle_min=0.0, angle_increment=0.1, intensities=masked[0]
    ),
    "points that are moved": lambda masked: Transform().apply(masked),
    "points that are moved one by one": lambda masked: TransformArray(np.zeros((2, 3)), [[0, 0, 0, 1]] * 2).apply(
        masked
    ),
    "translations": lambda masked: TransformArray(masked, [[0, 0, 0, 1]] * 2),
    "a translation": lambda masked: Transform(masked[0]),
    "a matrix": lambda masked: Transform.from_matrix(np.ma.vstack((masked, masked))),
    "stamps": lambda masked: tree_of(moving("a", "b", 1)).lookup_many("a", "b", masked[0].astype(np.int64)),
    "stamps of the source": lambda masked: tree_of(moving("a", "b", 1)).lookup_many(
        "a", "b", [1] * 3, source_at=masked[0].astype(np.int64), fixed="a"
    ),
}


@pytest.mark.parametrize("door", DOORS)
def test_a_masked_value_is_refused_wherever_arrays_come_in(door: str) -> None:
    with pytest.raises(ValueError, match=r"must have no masked values, got [12]: leave these out, or use .filled"):
        DOORS[door](MASKED)


def test_an_array_with_a_mask_and_no_masked_value_is_like_any_other() -> None:
    whole: Any = np.ma.array(np.ones((2, 3)), mask=False)
    assert type(PointCloud("lidar", 5, whole).points) is np.ndarray
    assert Transform((1.0, 0.0, 0.0)).apply(whole).tolist() == [[2.0, 1.0, 1.0]] * 2
    stamps = whole[0].astype(np.int64)
    assert tree_of(moving("a", "b", 1, 7.0)).lookup_many("a", "b", stamps).translations[:, 0].tolist() == [7.0] * 3
