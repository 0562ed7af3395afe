import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.histories import at_x, moving_edge, row_of
from support.strategies import TODAY, angles, transforms, unit_vectors

from tfbus import ExtrapolationError, FutureExtrapolationError, PastExtrapolationError, Transform
from tfbus.geometry.rows import IDENTITY, Vector
from tfbus.geometry.transform import from_row
from tfbus.tree._python_kernel import Step, climb


def test_climbing_no_steps_gives_the_identity() -> None:
    assert climb((), 5) == IDENTITY


@st.composite
def steps(draw: st.DrawFn, at: int) -> tuple[Step, Transform]:
    """A step of a path, and what it is at a stamp by the readable arithmetic of `Transform`."""
    first, second = draw(transforms(10.0)), draw(transforms(10.0))
    if draw(st.booleans()):
        return row_of(first), first
    before, after = draw(st.integers(0, 100)), draw(st.integers(1, 100))
    edge = moving_edge("parent", "child", [(at - before, first), (at + after, second)])
    if draw(st.booleans()):
        edge.insert("parent", at - before - 7, row_of(second), "")
        edge.insert("parent", at + after + 7, row_of(first), "")
    return edge, first.interpolate(second, before / (before + after))


@given(st.sampled_from([0, TODAY]).flatmap(lambda at: st.tuples(st.just(at), st.lists(steps(at), max_size=6))))
def test_climbing_equals_the_product_of_interpolated_transforms(
    drawn: tuple[int, list[tuple[Step, Transform]]],
) -> None:
    at, path = drawn
    expected = Transform.identity()
    for _, transform in path:
        expected = transform @ expected
    row = climb(tuple(step for step, _ in path), at)
    assert row == pytest.approx(row_of(expected), rel=0, abs=1e-12)


@given(unit_vectors(), angles(), st.integers(0, 1_000), st.sampled_from([1.0, -1.0]), st.sampled_from([1.0, -1.0]))
def test_the_angle_of_an_interpolated_turn_is_linear_in_time_for_any_axis_angle_and_quaternion_signs(
    axis: Vector, angle: float, thousandths: int, first_sign: float, second_sign: float
) -> None:
    turned = Transform.from_axis_angle(axis, angle)
    first = Transform(rotation=(0.0, 0.0, 0.0, first_sign))
    second = Transform(rotation=[second_sign * part for part in turned.rotation])
    edge = moving_edge("parent", "child", [(0, first), (1_000, second)])
    expected = Transform.from_axis_angle(axis, angle * thousandths / 1_000)
    assert from_row(climb((edge,), thousandths)).is_close(expected, rotation_tolerance=1e-9)


@pytest.mark.parametrize("angle", [1e-7, 1e-4, 0.01, 0.02, 0.05, 0.1, 3.1, math.pi - 1e-7])
def test_the_angle_stays_linear_where_other_slerps_switch_to_linear_interpolation(angle: float) -> None:
    edge = moving_edge("parent", "child", [(0, Transform()), (100, Transform.from_axis_angle((1.0, 2.0, 3.0), angle))])
    for percent in range(101):
        expected = Transform.from_axis_angle((1.0, 2.0, 3.0), angle * percent / 100)
        assert from_row(climb((edge,), percent)).is_close(expected, rotation_tolerance=1e-9)


def test_half_of_a_turn_whose_cosine_rounds_to_one_is_half_the_angle() -> None:
    edge = moving_edge("parent", "child", [(0, Transform()), (2, Transform.from_axis_angle((0.0, 0.0, 1.0), 2e-8))])
    assert climb((edge,), 1)[5] == pytest.approx(5e-9, rel=1e-9)


@given(st.lists(transforms(), min_size=1, max_size=6))
def test_the_row_at_the_stamp_of_a_sample_is_the_sample_bit_for_bit(poses: list[Transform]) -> None:
    edge = moving_edge("parent", "child", enumerate(poses))
    for stamp, pose in enumerate(poses):
        assert climb((edge,), stamp) == row_of(pose)


def test_neighbouring_nanoseconds_of_today_have_different_rows() -> None:
    edge = moving_edge("parent", "child", [(TODAY, at_x(0.0)), (TODAY + 3, at_x(3.0)), (TODAY + 4, at_x(10.0))])
    assert [climb((edge,), TODAY + late)[0] for late in range(5)] == [0.0, 1.0, 2.0, 3.0, 10.0]


def test_a_gap_of_any_length_is_interpolated() -> None:
    edge = moving_edge("parent", "child", [(0, at_x(0.0)), (2**62, at_x(4.0))])
    assert climb((edge,), 2**61)[0] == 2.0


def test_the_last_value_under_the_old_parent_is_held_until_the_first_under_the_new_one() -> None:
    edge = moving_edge("old", "child", [(0, at_x(0.0)), (10, at_x(10.0))])
    edge.insert("new", 20, row_of(at_x(100.0)), "")
    edge.insert("new", 30, row_of(at_x(110.0)), "")
    assert [climb((edge,), at)[0] for at in (5, 10, 11, 19, 20, 25)] == [5.0, 10.0, 10.0, 10.0, 100.0, 105.0]


@pytest.mark.parametrize(
    ("at", "kind"), [(9, PastExtrapolationError), (21, FutureExtrapolationError), (2**70, FutureExtrapolationError)]
)
def test_one_nanosecond_outside_the_samples_is_an_error(at: int, kind: type[ExtrapolationError]) -> None:
    edge = moving_edge("parent", "child", [(10, at_x(1.0)), (20, at_x(2.0))])
    with pytest.raises(kind) as caught:
        climb((edge,), at)
    assert (caught.value.child, caught.value.stamp) == ("child", at)
    assert (caught.value.oldest, caught.value.newest) == (10, 20)


def test_a_sample_outside_the_window_is_not_used_for_interpolation() -> None:
    edge = moving_edge("parent", "child", ((stamp, at_x(stamp)) for stamp in range(166)), keep=160)
    assert climb((edge,), 5)[0] == 5.0
    with pytest.raises(PastExtrapolationError, match="oldest sample"):
        climb((edge,), 4)
