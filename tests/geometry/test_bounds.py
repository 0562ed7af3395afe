import math
from typing import Any

import pytest
from support.samples import moving

from tfbus import InvalidTransformError, Transform, TransformStamped
from tfbus.geometry.stamped import GREATEST_BOUND, as_max_translation, check_translations, is_within, not_physical

FAR = Transform((1e308, 0.0, 0.0))


def test_a_translation_of_just_the_bound_is_within_and_a_longer_one_is_not() -> None:
    sample = TransformStamped("a", "b", 0, Transform((3.0, -4.0, 12.0)))
    assert is_within(sample, 13.0)
    assert is_within(sample, 14.0)
    assert not is_within(sample, math.nextafter(13.0, 0.0))


def test_a_rotation_makes_no_translation_longer() -> None:
    sample = TransformStamped("a", "b", 0, Transform((3.0, -4.0, 12.0), (1.0, 0.0, 0.0, 0.0)))
    assert is_within(sample, 13.0)
    assert str(not_physical(sample, 5.0)) == (
        "the translation of 'b' in 'a' is 13 m long, which is not physical (at most 5 m)"
    )


def test_the_error_says_how_long_it_is_where_it_is_and_what_is_allowed() -> None:
    near, far = moving("a", "b", 0, 1e12), moving("b", "c", 0, 2e12, "peer")
    with pytest.raises(InvalidTransformError) as caught:
        check_translations((near, far), 1e12)
    error = caught.value
    assert (error.reason, error.parent, error.child, error.authority) == ("not physical", "b", "c", "peer")
    assert str(error) == (
        "the translation of 'c' in 'b' is 2e+12 m long, which is not physical (at most 1e+12 m), from 'peer'"
    )


@pytest.mark.parametrize("transform", [FAR @ FAR, FAR.inverse() @ FAR.inverse() @ FAR @ FAR])
def test_a_product_that_has_overflowed_is_not_finite(transform: Transform) -> None:
    sample = TransformStamped("a", "b", 0, transform)
    assert not is_within(sample, GREATEST_BOUND)
    assert not_physical(sample, GREATEST_BOUND).reason == "not finite"


def test_finite_numbers_whose_length_overflows_are_not_physical() -> None:
    sample = TransformStamped("a", "b", 0, Transform((1.7e308, 1.7e308, 0.0)))
    assert not_physical(sample, GREATEST_BOUND).reason == "not physical"


@pytest.mark.parametrize("bound", [1e-3, 1, 1e12, GREATEST_BOUND])
def test_a_bound_is_a_float(bound: float) -> None:
    assert as_max_translation(bound) == bound


@pytest.mark.parametrize("bound", [0.0, -1.0, 1.1e100, math.inf, math.nan])
def test_a_bound_is_greater_than_zero_and_at_most_1e100(bound: float) -> None:
    with pytest.raises(ValueError, match="max_translation must be greater than 0 and at most 1e\\+100 m"):
        as_max_translation(bound)


@pytest.mark.parametrize("bound", [None, "far", True])
def test_a_bound_is_a_number(bound: Any) -> None:
    with pytest.raises(TypeError, match="max_translation must be a number in m"):
        as_max_translation(bound)
