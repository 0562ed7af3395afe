"""Twists of motions that the interpolation follows exactly, such as lines and steady turns, and against differences."""

import math
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.samples import moving, static
from support.strategies import TODAY, stamps, transforms

from tfbus import (
    LATEST,
    SECOND,
    DisconnectedError,
    FutureExtrapolationError,
    Latest,
    PastExtrapolationError,
    Transform,
    TransformLookupError,
    TransformStamped,
    TransformTree,
    TwistStamped,
    UnknownFrameError,
    do_transform,
)
from tfbus.rows import Quaternion, Vector, rotate

STILL = (0.0, 0.0, 0.0)
Z = (0.0, 0.0, 1.0)
QUARTER = SECOND // 4


def tree_of(*samples: TransformStamped) -> TransformTree:
    tree = TransformTree(keep=None)
    tree.insert_many(samples)
    return tree


def trajectory(
    parent: str, child: str, pose: Callable[[float], Transform], last: float = 4.0
) -> list[TransformStamped]:
    """Samples every quarter of a second, from 0 s to the last."""
    times = range(0, int(last * SECOND) + 1, QUARTER)
    return [TransformStamped(parent, child, stamp, pose(stamp / SECOND)) for stamp in times]


def placed(
    parent: str, child: str, translation: Vector, rotation: Quaternion = (0.0, 0.0, 0.0, 1.0)
) -> TransformStamped:
    return TransformStamped(parent, child, 0, Transform(translation, rotation), static=True)


def turning(rate: float, axis: Vector = Z) -> Callable[[float], Transform]:
    """A steady turn, in rad/s: slerp between its samples is exact."""
    return lambda time: Transform.from_axis_angle(axis, rate * time)


def near(vector: Vector, tolerance: float = 1e-9) -> object:
    return pytest.approx(vector, rel=0, abs=tolerance)


def plus(*vectors: Vector) -> Vector:
    x, y, z = (math.fsum(parts) for parts in zip(*vectors, strict=True))
    return x, y, z


def times(factor: float, vector: Vector) -> Vector:
    return factor * vector[0], factor * vector[1], factor * vector[2]


def check_twist(twist: TwistStamped, linear: Vector, angular: Vector, tolerance: float = 1e-9) -> None:
    assert twist.linear == near(linear, tolerance)
    assert twist.angular == near(angular, tolerance)


# Closed forms

INSTANTS = [0.0, 0.1, 0.25, 1.0, 1.625, 3.999, 4.0]


@pytest.mark.parametrize("time", INSTANTS)
def test_a_body_on_the_unit_circle_has_the_textbook_velocity(time: float) -> None:
    tree = tree_of(*trajectory("map", "arm", turning(1.0)), placed("arm", "body", (1.0, 0.0, 0.0)))
    twist = tree.twist("body", "map", round(time * SECOND))
    check_twist(twist, (-math.sin(time), math.cos(time), 0.0), Z)
    assert (twist.frame, twist.stamp) == ("map", round(time * SECOND))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_half_turn_whose_quaternions_are_just_a_right_angle_apart_has_the_direction_of_the_second(
    sign: float,
) -> None:
    half_turn = Transform(rotation=(0.0, 0.0, sign, 0.0))
    tree = tree_of(moving("map", "body", 0), TransformStamped("map", "body", SECOND, half_turn))
    check_twist(tree.twist("body", "map", SECOND // 2), STILL, (0.0, 0.0, sign * math.pi))


# Against differences


def difference(tree: TransformTree, frame: str, reference: str, at: int, step: int = 2_000) -> tuple[Vector, Vector]:
    """The linear and angular velocity by central differences of the lookup, along the reference's axes."""
    after = tree.lookup(reference, frame, at + step).transform
    before = tree.lookup(reference, frame, at - step).transform
    rate = SECOND / (2 * step)
    axis, angle = (after @ before.inverse()).as_axis_angle()
    return times(rate, plus(after.translation, times(-1.0, before.translation))), times(rate * angle, axis)


@st.composite
def trees(draw: st.DrawFn) -> tuple[TransformTree, int, list[str]]:
    """Two legs of up to three edges below one root, an instant away from all samples, and the frames.

    Samples are at least 1 s apart, and at most 2 m from their parent: over 2 us the third derivative counts for less
    than 1e-7.
    """
    at = draw(st.sampled_from([0, TODAY]))
    tree = TransformTree(keep=None)
    frames = ["root"]
    for leg, least in (("a", 1), ("b", 0)):
        parent = "root"
        for n in range(draw(st.integers(least, 3))):
            child = f"{leg}{n}"
            if draw(st.booleans()):
                tree.insert(TransformStamped(parent, child, 0, draw(transforms(2.0)), static=True))
            else:
                share = draw(st.integers(1, 9))
                length = draw(st.integers(1, 5)) * SECOND
                first = at - share * length // 10
                for k in range(-draw(st.integers(0, 1)), 2 + draw(st.integers(0, 1))):
                    tree.insert(TransformStamped(parent, child, first + k * length, draw(transforms(2.0))))
            frames.append(child)
            parent = child
    return tree, at, frames


@given(trees(), st.data())
def test_twist_is_the_limit_of_differences(drawn: tuple[TransformTree, int, list[str]], data: st.DataObject) -> None:
    tree, at, frames = drawn
    frame, reference, axes = (data.draw(st.sampled_from(frames)) for _ in range(3))
    linear, angular = difference(tree, frame, reference, at)
    turn = tree.lookup(axes, reference, at).transform.rotation
    twist = tree.twist(frame, reference, at, expressed_in=axes)
    check_twist(twist, rotate(turn, *linear), rotate(turn, *angular), tolerance=1e-6)
    assert (twist.frame, twist.stamp) == (axes, at)


@given(trees(), st.data())
def test_many_twists_are_those_of_each_stamp(drawn: tuple[TransformTree, int, list[str]], data: st.DataObject) -> None:
    tree, at, frames = drawn
    frame, reference, axes = (data.draw(st.sampled_from(frames)) for _ in range(3))
    # The instants of all samples, and beside them.
    own = [int(stamp) for name in frames for stamp in tree.stamps("root", name)]
    instants = [at, *own, *(stamp + 1 for stamp in own), *(stamp - 1 for stamp in own)]
    check_many(tree, frame, reference, axes, instants)


def test_a_few_twists_of_a_long_history_are_those_of_each_stamp() -> None:
    tree = tree_of(*(moving("map", "body", k * SECOND, 1e-3 * k * k) for k in range(1_000)))
    check_many(tree, "body", "map", "map", [500 * SECOND, 0, 999 * SECOND, 700 * SECOND + 1])


def check_many(tree: TransformTree, frame: str, reference: str, axes: str, instants: list[int]) -> None:
    """At each instant the twist or the NaN, and with all of them the first error, of a twist there."""
    found = tree.twist_many(frame, reference, instants, expressed_in=axes, out_of_range="nan")
    assert (found.frame, found.stamps.tolist()) == (axes, instants)
    errors = []
    for index, (stamp, linear, angular) in enumerate(zip(instants, found.linear, found.angular, strict=True)):
        try:
            one = tree.twist(frame, reference, stamp, expressed_in=axes)
        except TransformLookupError as error:
            errors.append((index, error))
            assert math.isnan(linear[0])
            assert math.isnan(angular[0])
        else:
            check_twist(one, tuple(linear.tolist()), tuple(angular.tolist()))
    if not errors:
        tree.twist_many(frame, reference, instants, expressed_in=axes)
        return
    with pytest.raises(TransformLookupError) as caught:
        tree.twist_many(frame, reference, instants, expressed_in=axes)
    first, wanted = errors[0]
    assert (type(caught.value), caught.value.index) == (type(wanted), first)
    assert str(wanted) in str(caught.value)


@given(trees(), st.data(), transforms(2.0))
def test_do_transform_of_a_body_twist_gives_the_twist_of_another_frame_of_the_body(
    drawn: tuple[TransformTree, int, list[str]], data: st.DataObject, mount: Transform
) -> None:
    tree, at, frames = drawn
    body, reference = (data.draw(st.sampled_from(frames)) for _ in range(2))
    tree.insert(TransformStamped(body, "sensor", 0, mount, static=True))
    carried = do_transform(tree.twist(body, reference, at, expressed_in=body), tree.lookup("sensor", body, at))
    own = tree.twist("sensor", reference, at, expressed_in="sensor")
    assert (carried.frame, carried.stamp) == (own.frame, own.stamp)
    check_twist(carried, own.linear, own.angular)


# At samples


def on_a_line(*points: tuple[int, float], parent: str = "map") -> list[TransformStamped]:
    """Samples of ``body`` at some seconds and x."""
    return [moving(parent, "body", seconds * SECOND, x) for seconds, x in points]


def speed(tree: TransformTree, at: int | Latest) -> float:
    """Of ``body`` on its line, seen from ``map``."""
    twist = tree.twist("body", "map", at)
    assert twist.angular == STILL
    assert twist.linear[1:] == (0.0, 0.0)
    return twist.linear[0]


def test_at_a_sample_the_velocity_is_that_of_the_segment_before() -> None:
    tree = tree_of(*on_a_line((0, 0.0), (1, 1.0), (2, 3.0), (3, 6.0)))
    assert [speed(tree, second * SECOND) for second in (1, 2, 3)] == [1.0, 2.0, 3.0]
    assert [speed(tree, second * SECOND + 1) for second in (0, 1, 2)] == [1.0, 2.0, 3.0]
    assert speed(tree, LATEST) == 3.0
    assert speed(tree, 0) == 1.0, "the first sample has only the segment after it"


@pytest.mark.parametrize("newest", [41, 42, 45])
def test_samples_outside_the_window_are_not_differentiated(newest: int) -> None:
    tree = TransformTree(keep=40.0)
    tree.insert_many(on_a_line(*((second, float(second**2)) for second in range(newest + 1))))
    oldest = newest - 40
    assert speed(tree, oldest * SECOND) == 2 * oldest + 1
    assert speed(tree, (oldest + 1) * SECOND) == 2 * oldest + 1
    with pytest.raises(PastExtrapolationError):
        tree.twist("body", "map", oldest * SECOND - 1)


@given(st.sets(stamps(), min_size=2, max_size=2))
def test_a_segment_of_any_length_has_a_velocity(ends: set[int]) -> None:
    low, high = sorted(ends)
    tree = tree_of(moving("map", "body", low, 0.0), moving("map", "body", high, (high - low) / SECOND))
    for at in (low, (low + high) // 2, high):
        assert speed(tree, at) == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize("at", [5 * SECOND, LATEST])
def test_a_single_sample_has_a_transform_but_no_velocity(at: int | Latest) -> None:
    tree = tree_of(moving("map", "body", 5 * SECOND, 1.0, authority="odometry"))
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.twist("body", "map", at)
    error = caught.value
    assert (error.child, error.stamp) == ("body", 5 * SECOND + 1)
    assert (error.oldest, error.newest) == (5 * SECOND, 5 * SECOND)
    assert error.authority == "odometry"
    tree.insert(moving("map", "body", 6 * SECOND, 3.0))
    assert speed(tree, 5 * SECOND) == speed(tree, LATEST) == 2.0


# Across a change of parent


def reparented() -> TransformTree:
    """On ``left`` until 1 s at 1 m/s, from 3 s on ``right`` at 2 m/s."""
    return tree_of(
        static("map", "left", 10.0),
        static("map", "right", 20.0),
        *on_a_line((0, 0.0), (1, 1.0), parent="left"),
        *on_a_line((3, 0.0), (4, 2.0), parent="right"),
    )


@pytest.mark.parametrize(
    ("time", "expected"),
    [(0.0, 1.0), (0.5, 1.0), (1.0, 1.0), (1.000000001, 0.0), (2.999999999, 0.0), (3.0, 2.0), (3.5, 2.0), (4.0, 2.0)],
)
def test_between_two_parents_a_frame_rests_and_the_new_parent_begins_with_the_velocity_after(
    time: float, expected: float
) -> None:
    assert speed(reparented(), round(time * SECOND)) == expected


def test_many_twists_across_changes_of_the_parent_are_those_of_each_stamp() -> None:
    instants = [round(time * SECOND) for time in (-1, 0, 0.5, 1, 2, 3, 3.5, 4, 5)]
    check_many(reparented(), "body", "map", "left", [*instants, 1, SECOND + 1, 3 * SECOND - 1])
    lone = tree_of(*on_a_line((0, 0.0), (1, 1.0)), static("map", "lift"), *on_a_line((3, 0.0), parent="lift"))
    check_many(lone, "body", "map", "map", instants)
    # Between 1 s and 3 s, the body is on an island.
    island = tree_of(*on_a_line((0, 0.0), (1, 1.0)), *on_a_line((2, 0.0), parent="island"), *on_a_line((3, 0.0)))
    check_many(island, "body", "map", "map", instants)
    with pytest.raises(DisconnectedError) as caught:
        island.twist_many("body", "map", [2 * SECOND, 5 * SECOND // 2], out_of_range="nan")
    assert caught.value.index == 0
    assert island.twist_many("body", "map", []).linear.shape == (0, 3)
    with pytest.raises(ValueError, match="out_of_range"):
        island.twist_many("body", "map", [0], out_of_range="none")  # type: ignore[arg-type]


def test_a_held_frame_moves_with_its_old_parent() -> None:
    tree = tree_of(
        *trajectory("map", "crane", turning(0.5)),
        moving("crane", "box", 0, 1.0),
        moving("crane", "box", SECOND, 2.0),
        moving("map", "box", 3 * SECOND, 0.0),
    )
    check_twist(tree.twist("box", "map", 2 * SECOND, expressed_in="crane"), (0.0, 1.0, 0.0), (0.0, 0.0, 0.5))
    check_twist(tree.twist("box", "crane", 2 * SECOND), STILL, STILL)


@pytest.mark.parametrize("at", [3 * SECOND, LATEST])
def test_a_single_newest_sample_of_a_new_parent_has_no_velocity(at: int | Latest) -> None:
    tree = tree_of(*on_a_line((0, 0.0), (1, 1.0)), static("map", "lift"), *on_a_line((3, 0.0), parent="lift"))
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.twist("body", "map", at)
    assert (caught.value.child, caught.value.newest) == ("body", 3 * SECOND)


# Stamps


@pytest.mark.parametrize("at", [-SECOND, 0, 7, TODAY])
def test_a_static_frame_is_at_rest_at_any_stamp(at: int) -> None:
    tree = tree_of(static("map", "base", 1.0, stamp=5), static("base", "lidar", 2.0, stamp=9))
    assert tree.twist("lidar", "map", at) == TwistStamped("map", at, STILL, STILL)


def slow_and_fast() -> TransformTree:
    """``fast`` is known from 0 s to 8 s, ``slow`` from 0 s to 3 s; ``post`` stands still."""
    return tree_of(
        *trajectory("map", "fast", lambda time: Transform((time, 0.0, 0.0)), last=8.0),
        *trajectory("map", "slow", turning(0.5), last=3.0),
        static("map", "post", stamp=5),
    )


@pytest.mark.parametrize(
    ("frame", "reference", "axes", "seconds"),
    [
        ("fast", "map", None, 8),
        ("fast", "map", "post", 8),
        ("fast", "map", "fast", 8),
        ("fast", "map", "slow", 3),
        ("slow", "map", "fast", 3),
        ("fast", "slow", "post", 3),
        ("post", "map", "fast", 8),
        ("post", "post", "slow", 3),
    ],
)
def test_latest_is_the_newest_common_stamp_of_frame_reference_and_axes(
    frame: str, reference: str, axes: str | None, seconds: int
) -> None:
    tree = slow_and_fast()
    twist = tree.twist(frame, reference, expressed_in=axes)
    assert twist.stamp == seconds * SECOND
    assert twist == tree.twist(frame, reference, twist.stamp, expressed_in=axes)


# Errors


def lines_of_two_trees() -> TransformTree:
    return tree_of(*on_a_line((1, 0.0), (2, 1.0)), static("map", "post"), moving("other", "elsewhere", SECOND))


@pytest.mark.parametrize(
    ("frame", "reference", "axes", "error", "text"),
    [
        ("bodi", "map", "post", UnknownFrameError, "'bodi'"),
        ("body", "mop", "post", UnknownFrameError, "'mop'"),
        ("body", "map", "pots", UnknownFrameError, "'pots'"),
        ("body", "elsewhere", "map", DisconnectedError, "different trees"),
        ("elsewhere", "map", "map", DisconnectedError, "different trees"),
        ("body", "map", "elsewhere", DisconnectedError, "different trees"),
        (1, "map", None, TypeError, "a frame name must be a str"),
        ("body", None, None, TypeError, "a frame name must be a str"),
        ("body", "map", 2, TypeError, "a frame name must be a str"),
    ],
)
@pytest.mark.parametrize("at", [SECOND, LATEST])
def test_a_wrong_frame_in_any_argument_is_an_error(
    frame: Any, reference: Any, axes: Any, error: type[Exception], text: str, at: int | Latest
) -> None:
    with pytest.raises(error, match=text):
        lines_of_two_trees().twist(frame, reference, at, expressed_in=axes)


@pytest.mark.parametrize(
    ("frame", "reference", "axes"), [("body", "map", "map"), ("map", "body", "map"), ("post", "map", "body")]
)
def test_outside_the_window_the_errors_are_those_of_lookup(frame: str, reference: str, axes: str) -> None:
    tree = lines_of_two_trees()
    for at, error in ((SECOND - 1, PastExtrapolationError), (2 * SECOND + 1, FutureExtrapolationError)):
        with pytest.raises(error) as caught:
            tree.twist(frame, reference, at, expressed_in=axes)
        assert (caught.value.child, caught.value.stamp) == ("body", at)


@pytest.mark.parametrize("at", [1.5, True, "now", None])
def test_a_stamp_is_an_integer_or_latest(at: object) -> None:
    with pytest.raises(TypeError, match="a stamp is an int of nanoseconds"):
        lines_of_two_trees().twist("body", "map", at)  # type: ignore[call-overload]


@pytest.mark.parametrize(("early", "late"), [("axes", "body"), ("body", "axes")])
def test_latest_without_a_common_stamp_waits_for_the_lagging_frame(early: str, late: str) -> None:
    tree = tree_of(*(moving("map", early if second < 2 else late, second * SECOND) for second in (0, 1, 5, 6)))
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.twist("body", "map", expressed_in="axes")
    assert (caught.value.child, caught.value.stamp) == (early, 5 * SECOND)
