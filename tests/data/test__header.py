import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from support.stamped_data import ONE_OF_EACH, name_of
from support.strategies import data_stamps, frame_names

from tfbus import InvalidTransformError, Latest, PointStamped, TwistStamped, Vector3Stamped, WrenchStamped

TRIPLES = [
    pytest.param(lambda value: PointStamped("map", 0, value).point, id="point"),
    pytest.param(lambda value: Vector3Stamped("map", 0, value).vector, id="vector"),
    pytest.param(lambda value: TwistStamped("map", 0, value, (0.0, 0.0, 0.0)).linear, id="linear"),
    pytest.param(lambda value: TwistStamped("map", 0, (0.0, 0.0, 0.0), value).angular, id="angular"),
    pytest.param(lambda value: WrenchStamped("map", 0, value, (0.0, 0.0, 0.0)).force, id="force"),
    pytest.param(lambda value: WrenchStamped("map", 0, (0.0, 0.0, 0.0), value).torque, id="torque"),
]


@given(frame_names(), data_stamps())
def test_any_frame_and_stamp_are_kept(frame: str, stamp: int | Latest) -> None:
    for data in ONE_OF_EACH:
        kept = replace(data, frame=frame, stamp=stamp)
        assert kept.frame == frame
        assert kept.stamp == stamp


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
@pytest.mark.parametrize("numbers", [[1, 2, 3], np.array([1, 2, 3]), np.array([1, 2, 3], np.float32)])
def test_three_numbers_of_any_kind_become_a_tuple_of_floats(build: Any, numbers: Any) -> None:
    triple = build(numbers)
    assert triple == (1.0, 2.0, 3.0)
    assert [type(part) for part in triple] == [float, float, float]


@pytest.mark.parametrize("build", TRIPLES)
def test_three_numbers_may_be_nan_or_infinite(build: Any) -> None:
    missing, beyond, there = build((math.nan, -math.inf, -0.0))
    assert math.isnan(missing)
    assert beyond == -math.inf
    assert math.copysign(1.0, there) == -1.0


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


def test_the_error_names_the_field() -> None:
    with pytest.raises(TypeError, match=r"^angular must be"):
        TwistStamped("map", 0, (0.0, 0.0, 0.0), "123")  # type: ignore[arg-type]
