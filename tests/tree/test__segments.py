import math
from collections.abc import Iterable, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.strategies import TODAY, rotations, small_angles, transforms, unit_vectors

from tfbus import SECOND, Transform
from tfbus.rows import Vector
from tfbus.stamps import STAMP_MAX, STAMP_MIN
from tfbus.tree.history import FrameHistory
from tfbus.tree.lookup_many import Segments

NOT_QUITE_ONE = (-0.3982359927017631, 0.19157674456173793, -0.8783998564754538, -0.1819893876133163)
"""A rotation whose scalar product with itself rounds to less than one."""


def edge(poses: Iterable[tuple[int, Transform]], parents: Sequence[str] = ("parent",)) -> FrameHistory:
    """A moving frame; its samples name the parents in turn."""
    made = FrameHistory("child", parents[0], static=False, keep=None)
    for number, (stamp, pose) in enumerate(poses):
        made.insert(parents[number % len(parents)], stamp, (*pose.translation, *pose.rotation), "")
    return made


def curve(frame: FrameHistory, stamps: Sequence[int]) -> Segments:
    return Segments(frame.samples_between(min(stamps), max(stamps)), np.array(stamps, np.int64))


def at(frame: FrameHistory, stamps: Sequence[int]) -> list[list[float]]:
    """The row at each stamp. Asked alone and all together, because the curve is prepared otherwise."""
    alone = [np.array(curve(frame, [stamp]).at(slice(None))).T[0] for stamp in stamps]
    asked = [*stamps] * (len(frame) + 1)
    together = np.array(curve(frame, asked).at(slice(0, len(stamps)))).T
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-13)
    rows: list[list[float]] = together.tolist()
    return rows


def near(row: object, tolerance: float = 1e-12) -> object:
    return pytest.approx(row, rel=0, abs=tolerance)


@st.composite
def edges(draw: st.DrawFn) -> FrameHistory:
    """One to eight samples, packed or far apart anywhere in time, with one parent or with several."""
    first, step = draw(st.sampled_from([(0, 1), (0, 10), (TODAY, SECOND // 10), (STAMP_MIN, 2**61), (STAMP_MAX, -3)]))
    numbers = draw(st.lists(st.integers(0, 7), min_size=1, max_size=8, unique=True))
    poses = draw(st.lists(transforms(10.0), min_size=1, max_size=len(numbers)))
    parents = draw(st.sampled_from([("p",), ("p", "q"), ("p", "p", "q")]))
    placed = ((number, poses[place * len(poses) // len(numbers)]) for place, number in enumerate(numbers))
    return edge([(first + number * step, pose) for number, pose in placed], parents)


@given(edges(), st.data())
def test_a_curve_equals_the_history_at_every_stamp(frame: FrameHistory, data: st.DataObject) -> None:
    known = [frame.sample(i)[0] for i in range(frame.count)]
    low, high = known[0], known[-1]
    inside = st.integers(low, high) | st.sampled_from(known)
    beside = st.sampled_from(known).map(lambda stamp: min(max(stamp + 1, low), high))
    stamps = data.draw(st.lists(inside | beside, min_size=1, max_size=12))
    for stamp, row in zip(stamps, at(frame, stamps), strict=True):
        assert row == near(frame.row_at(stamp))


@given(st.lists(transforms(), min_size=1, max_size=5))
def test_the_row_at_the_stamp_of_a_sample_is_the_sample_bit_for_bit(poses: list[Transform]) -> None:
    rows = at(edge(enumerate(poses)), range(len(poses)))
    assert rows == [[*pose.translation, *pose.rotation] for pose in poses]


@given(unit_vectors(), st.floats(-3.1, 3.1) | small_angles(), st.sampled_from([1.0, -1.0]))
def test_the_angle_of_an_interpolated_turn_is_linear_in_time_for_any_angle_and_sign(
    axis: Vector, angle: float, sign: float
) -> None:
    turned = Transform.from_axis_angle(axis, angle, (8.0, 0.0, -4.0))
    last = Transform(turned.translation, [sign * part for part in turned.rotation])
    quarters = at(edge([(0, Transform()), (4, last)]), range(4))
    for quarter, row in enumerate(quarters):
        expected = Transform.from_axis_angle(axis, angle * quarter / 4, (2.0 * quarter, 0.0, -1.0 * quarter))
        assert row == near([*expected.translation, *expected.rotation], 1e-15 + 1e-9 * abs(angle))


@pytest.mark.parametrize("angle", [1e-12, 1e-9, 2e-8, 4e-8])
def test_half_of_a_turn_whose_cosine_rounds_to_one_is_half_the_angle(angle: float) -> None:
    frame = edge([(0, Transform()), (2, Transform.from_axis_angle((0.0, 0.0, 1.0), angle))])
    assert at(frame, [1])[0][5] == pytest.approx(angle / 4, rel=1e-9)


@given(rotations(), st.sampled_from([1.0, -1.0]))
def test_equal_rotations_are_not_changed_between_samples(rotation: tuple[float, ...], sign: float) -> None:
    first, last = Transform((1.0, 0.0, 0.0), rotation), Transform((3.0, 0.0, 0.0), [sign * part for part in rotation])
    assert at(edge([(0, first), (2 * SECOND, last)]), [SECOND])[0] == near([2.0, 0.0, 0.0, *first.rotation], 1e-15)


def test_half_a_turn_has_the_direction_of_the_sign_of_the_second_quaternion() -> None:
    for w in (1e-17, -1e-17):
        frame = edge([(0, Transform()), (2, Transform(rotation=(0.0, 0.0, 1.0, w)))])
        assert at(frame, [1])[0][5] == pytest.approx(math.copysign(math.sqrt(0.5), w))


@pytest.mark.parametrize("rotation", [(0.0, 0.0, 0.0, 1.0), NOT_QUITE_ONE])
def test_the_last_value_under_the_old_parent_is_held_until_the_first_under_the_new_one(
    rotation: tuple[float, ...],
) -> None:
    poses = [Transform((x, 0.0, 0.0), rotation) for x in (0.0, 10.0, 100.0, 110.0)]
    frame = edge([(stamp * SECOND, pose) for stamp, pose in enumerate(poses)], ["old", "old", "new", "new"])
    halves = at(frame, [stamp * SECOND // 2 for stamp in range(7)])
    assert [row[0] for row in halves] == [0.0, 5.0, 10.0, 10.0, 100.0, 105.0, 110.0]
    assert halves[3] == [10.0, 0.0, 0.0, *poses[1].rotation]


def test_parents_that_differ_in_the_last_character_are_different() -> None:
    frame = edge([(0, Transform()), (10, Transform((10.0, 0.0, 0.0)))], ["odom", "odom\0"])
    assert at(frame, [9])[0][0] == 0.0


def test_a_single_sample_is_the_row_at_its_stamp() -> None:
    pose = Transform((1.0, 2.0, 3.0), NOT_QUITE_ONE)
    assert at(edge([(TODAY, pose)]), [TODAY, TODAY]) == [[*pose.translation, *pose.rotation]] * 2


def test_neighbouring_nanoseconds_of_today_have_different_rows() -> None:
    places = {TODAY: 0.0, TODAY + 3: 3.0, TODAY + 4: 10.0}
    frame = edge([(stamp, Transform((x, 0.0, 0.0))) for stamp, x in places.items()])
    assert [row[0] for row in at(frame, range(TODAY, TODAY + 5))] == near([0.0, 1.0, 2.0, 3.0, 10.0])


def test_the_whole_range_of_stamps_is_one_segment() -> None:
    frame = edge([(STAMP_MIN, Transform()), (STAMP_MAX, Transform((4.0, 0.0, 0.0)))])
    rows = at(frame, [STAMP_MAX, -(2**62), 0, 2**62, STAMP_MIN])
    assert [row[0] for row in rows] == near([4.0, 1.0, 2.0, 3.0, 0.0])


@pytest.mark.parametrize("samples", [3, 300])
def test_a_slice_of_a_curve_equals_the_slice_of_its_rows(samples: int) -> None:
    frame = edge((stamp, Transform((float(stamp), 0.0, 0.0))) for stamp in range(samples))
    stamps = [number % samples for number in range(100)]
    part = curve(frame, stamps).at(slice(40, 60))
    assert part[0].tolist() == near([float(stamp) for stamp in stamps[40:60]])
