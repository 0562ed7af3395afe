import copy
from dataclasses import dataclass, replace
from typing import Any, assert_type

import numpy as np
import pytest
from hypothesis import given
from support.stamped_data import (
    ANSWER,
    MOVABLE,
    POINTS,
    SCAN,
    Header,
    Point,
    PointMessage,
    Time,
    arrays_of,
    contents,
    name_of,
    numbers,
)
from support.strategies import transforms

from tfbus import LATEST, Latest, PointCloud, PointStamped, Transform, TransformStamped, do_transform
from tfbus.rows import Vector


@pytest.mark.parametrize("data", MOVABLE, ids=name_of)
def test_transformed_data_have_the_frame_and_the_stamp_of_the_transform(data: Any) -> None:
    moved = do_transform(data, ANSWER)
    assert type(moved) is type(data)
    assert (moved.frame, moved.stamp) == ("A", 2_000_000_000)


@pytest.mark.parametrize("data", MOVABLE, ids=name_of)
def test_data_stamped_latest_get_the_stamp_of_the_transform(data: Any) -> None:
    assert do_transform(replace(data, stamp=LATEST), ANSWER).stamp == 2_000_000_000


@pytest.mark.parametrize("data", MOVABLE, ids=name_of)
def test_the_original_data_are_not_changed(data: Any) -> None:
    before = copy.deepcopy(data)
    moved = do_transform(data, ANSWER)
    assert contents(data) == contents(before)
    assert not any(array.flags.writeable for array in arrays_of(moved))


def test_the_array_of_the_original_points_stays_writable() -> None:
    points = POINTS.copy()
    moved = do_transform(PointCloud("B", 0, points), ANSWER)
    assert points.flags.writeable
    assert (points == POINTS).all()
    assert not np.shares_memory(points, moved.points)


@pytest.mark.parametrize("data", MOVABLE, ids=name_of)
def test_data_in_another_frame_than_the_source_are_refused(data: Any) -> None:
    with pytest.raises(ValueError, match=r"the data are in frame 'B', but the transform is from 'laser'"):
        do_transform(data, TransformStamped("base", "laser", 0, Transform()))


@given(transforms(10.0), transforms(10.0))
def test_two_transforms_in_turn_equal_their_product(c_from_a: Transform, a_from_b: Transform) -> None:
    first, second = TransformStamped("A", "B", 0, a_from_b), TransformStamped("C", "A", 0, c_from_a)
    both = TransformStamped("C", "B", 0, c_from_a @ a_from_b)
    for data in MOVABLE:
        exact = replace(data, points=data.points.astype(np.float64)) if hasattr(data, "points") else data
        steps, leap = do_transform(do_transform(exact, first), second), do_transform(exact, both)
        assert steps.frame == leap.frame == "C"
        np.testing.assert_allclose(numbers(steps), numbers(leap), rtol=0.0, atol=1e-10)


@given(transforms(10.0))
def test_the_inverse_restores_the_data(a_from_b: Transform) -> None:
    there, back = TransformStamped("A", "B", 0, a_from_b), TransformStamped("B", "A", 0, a_from_b.inverse())
    for data in MOVABLE:
        exact = replace(data, points=data.points.astype(np.float64)) if hasattr(data, "points") else data
        returned = do_transform(do_transform(exact, there), back)
        assert returned.frame == "B"
        np.testing.assert_allclose(numbers(returned), numbers(exact), rtol=0.0, atol=1e-10)


@pytest.mark.parametrize(("data", "kind"), [((1.0, 2.0, 3.0), "tuple"), (None, "NoneType"), (Transform(), "Transform")])
def test_an_unregistered_type_is_a_type_error_that_says_how_to_register_it(data: Any, kind: str) -> None:
    with pytest.raises(TypeError, match=rf"@do_transform\.register\({kind}\)") as caught:
        do_transform(data, ANSWER)
    assert "to_points" not in str(caught.value)


def test_a_scan_is_refused_with_a_hint_at_to_points() -> None:
    with pytest.raises(TypeError, match=r"cannot transform a LaserScan: transform its to_points\(\) instead"):
        do_transform(SCAN, ANSWER)
    assert do_transform(SCAN.to_points(), ANSWER).frame == "A"


@dataclass(frozen=True)
class Sphere:
    frame: str
    stamp: int | Latest
    centre: Vector
    radius: float


@do_transform.register
def _(data: Sphere, transform: TransformStamped) -> Sphere:
    return Sphere(transform.parent, transform.stamp, transform.transform.apply(data.centre), data.radius)


def test_a_program_can_register_its_own_type() -> None:
    moved = do_transform(Sphere("B", 7, (1.0, 2.0, 3.0), 0.5), ANSWER)
    assert (moved.frame, moved.stamp, moved.radius) == ("A", 2_000_000_000, 0.5)
    assert moved.centre == pytest.approx((-9.0, 18.0, 27.0), abs=1e-13)


@do_transform.register
def _(data: PointMessage, transform: TransformStamped) -> PointMessage:
    p = data.point
    header = Header(Time(*divmod(transform.stamp, 1_000_000_000)), transform.parent)
    return PointMessage(header, Point(*transform.transform.apply((p.x, p.y, p.z))))


def test_a_message_of_ros_can_be_registered_although_its_frame_is_in_a_header() -> None:
    message = PointMessage(Header(Time(2, 0), "B"), Point(1.0, 2.0, 3.0))
    moved = do_transform(message, ANSWER)
    assert moved.header == Header(Time(2, 0), "A")
    assert (moved.point.x, moved.point.y, moved.point.z) == pytest.approx((-9.0, 18.0, 27.0), abs=1e-13)


class Landmark(PointStamped):
    """A subclass that nobody registered."""


def test_a_subclass_is_transformed_as_its_base_class() -> None:
    moved = do_transform(Landmark("B", 0, (1.0, 2.0, 3.0)), ANSWER)
    assert moved.point == pytest.approx((-9.0, 18.0, 27.0), abs=1e-13)


def test_type_checkers_see_the_type_that_was_given() -> None:
    assert_type(do_transform(PointStamped("B", 0, (1.0, 2.0, 3.0)), ANSWER), PointStamped)
    assert_type(do_transform(PointCloud("B", 0, np.zeros((1, 3))), ANSWER), PointCloud)
