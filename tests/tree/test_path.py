import math
from collections.abc import Iterable
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.strategies import TODAY, angles, transforms, unit_vectors

from tfbus import (
    LATEST,
    DisconnectedError,
    ExtrapolationError,
    FutureExtrapolationError,
    PastExtrapolationError,
    Transform,
)
from tfbus.geometry.rows import IDENTITY, Row, Vector
from tfbus.geometry.transform import from_row
from tfbus.tree._python_kernel import Step, climb
from tfbus.tree.history import FrameHistory
from tfbus.tree.path import Path, find_path

Forest = dict[str, FrameHistory]


def moving(parent: str, child: str, samples: Iterable[tuple[int, Transform]] = ()) -> FrameHistory:
    edge = FrameHistory(child, parent, static=False, keep=None)
    for stamp, transform in samples:
        edge.insert(parent, stamp, row_of(transform), "")
    return edge


def static(parent: str, child: str, transform: Transform, stamp: int = 0) -> FrameHistory:
    edge = FrameHistory(child, parent, static=True, keep=None)
    edge.insert_static(parent, stamp, row_of(transform), "")
    return edge


def row_of(transform: Transform) -> Row:
    return *transform.translation, *transform.rotation


def forest(*edges: FrameHistory) -> Forest:
    return {edge.child: edge for edge in edges}


def hanging(parents: dict[str, str]) -> Forest:
    """Static edges from each key to its value."""
    return forest(*(static(parent, child, Transform()) for child, parent in parents.items()))


def at_x(x: float) -> Transform:
    return Transform((x, 0.0, 0.0))


# The kernel


def test_a_climb_of_no_steps_is_the_identity() -> None:
    assert climb((), 5) == IDENTITY


@st.composite
def steps(draw: st.DrawFn, at: int) -> tuple[Step, Transform]:
    """A step of a path, and what it is at a stamp by the readable arithmetic of `Transform`."""
    first, second = draw(transforms(10.0)), draw(transforms(10.0))
    if draw(st.booleans()):
        return row_of(first), first
    before, after = draw(st.integers(0, 100)), draw(st.integers(1, 100))
    edge = moving("parent", "child", [(at - before, first), (at + after, second)])
    if draw(st.booleans()):
        edge.insert("parent", at - before - 7, row_of(second), "")
        edge.insert("parent", at + after + 7, row_of(first), "")
    return edge, first.interpolate(second, before / (before + after))


@settings(deadline=None)
@given(st.sampled_from([0, TODAY]).flatmap(lambda at: st.tuples(st.just(at), st.lists(steps(at), max_size=6))))
def test_the_kernel_equals_composition_and_interpolation(drawn: tuple[int, list[tuple[Step, Transform]]]) -> None:
    at, path = drawn
    expected = Transform.identity()
    for _, transform in path:
        expected = transform @ expected
    row = climb(tuple(step for step, _ in path), at)
    assert row == pytest.approx(row_of(expected), rel=0, abs=1e-12)


@settings(deadline=None)
@given(unit_vectors(), angles(), st.integers(0, 1_000), st.sampled_from([1.0, -1.0]), st.sampled_from([1.0, -1.0]))
def test_a_turn_about_a_fixed_axis_is_steady_whatever_its_size_and_the_signs_of_its_quaternions(
    axis: Vector, angle: float, thousandths: int, first_sign: float, second_sign: float
) -> None:
    turned = Transform.from_axis_angle(axis, angle)
    first = Transform(rotation=(0.0, 0.0, 0.0, first_sign))
    second = Transform(rotation=[second_sign * part for part in turned.rotation])
    edge = moving("parent", "child", [(0, first), (1_000, second)])
    expected = Transform.from_axis_angle(axis, angle * thousandths / 1_000)
    assert from_row(climb((edge,), thousandths)).is_close(expected, rotation_tolerance=1e-9)


@pytest.mark.parametrize("angle", [1e-7, 1e-4, 0.01, 0.02, 0.05, 0.1, 3.1, math.pi - 1e-7])
def test_a_turn_is_as_steady_where_others_switch_to_a_straight_line(angle: float) -> None:
    edge = moving("parent", "child", [(0, Transform()), (100, Transform.from_axis_angle((1.0, 2.0, 3.0), angle))])
    for percent in range(101):
        expected = Transform.from_axis_angle((1.0, 2.0, 3.0), angle * percent / 100)
        assert from_row(climb((edge,), percent)).is_close(expected, rotation_tolerance=1e-9)


def test_a_turn_too_small_for_its_cosine_is_still_halved() -> None:
    edge = moving("parent", "child", [(0, Transform()), (2, Transform.from_axis_angle((0.0, 0.0, 1.0), 2e-8))])
    assert climb((edge,), 1)[5] == pytest.approx(5e-9, rel=1e-9)


@settings(deadline=None)
@given(st.lists(transforms(), min_size=1, max_size=6))
def test_a_sample_is_read_back_bit_for_bit_at_its_stamp(poses: list[Transform]) -> None:
    edge = moving("parent", "child", enumerate(poses))
    for stamp, pose in enumerate(poses):
        assert climb((edge,), stamp) == row_of(pose)


def test_neighbouring_nanoseconds_of_today_are_told_apart() -> None:
    edge = moving("parent", "child", [(TODAY, at_x(0.0)), (TODAY + 3, at_x(3.0)), (TODAY + 4, at_x(10.0))])
    assert [climb((edge,), TODAY + late)[0] for late in range(5)] == [0.0, 1.0, 2.0, 3.0, 10.0]


def test_a_gap_of_any_length_is_interpolated() -> None:
    edge = moving("parent", "child", [(0, at_x(0.0)), (2**62, at_x(4.0))])
    assert climb((edge,), 2**61)[0] == 2.0


def test_the_older_value_is_held_until_the_new_parent_begins() -> None:
    edge = moving("old", "child", [(0, at_x(0.0)), (10, at_x(10.0))])
    edge.insert("new", 20, row_of(at_x(100.0)), "")
    edge.insert("new", 30, row_of(at_x(110.0)), "")
    assert [climb((edge,), at)[0] for at in (5, 10, 11, 19, 20, 25)] == [5.0, 10.0, 10.0, 10.0, 100.0, 105.0]


@pytest.mark.parametrize(
    ("at", "kind"), [(9, PastExtrapolationError), (21, FutureExtrapolationError), (2**70, FutureExtrapolationError)]
)
def test_nothing_is_extrapolated_by_a_single_nanosecond(at: int, kind: type[ExtrapolationError]) -> None:
    edge = moving("parent", "child", [(10, at_x(1.0)), (20, at_x(2.0))])
    with pytest.raises(kind) as caught:
        climb((edge,), at)
    assert (caught.value.child, caught.value.stamp) == ("child", at)
    assert (caught.value.oldest, caught.value.newest) == (10, 20)


def test_what_has_left_the_window_is_not_used_to_interpolate() -> None:
    edge = FrameHistory("child", "parent", static=False, keep=160)
    for stamp in range(166):
        edge.insert("parent", stamp, row_of(at_x(stamp)), "")
    assert climb((edge,), 5)[0] == 5.0
    with pytest.raises(PastExtrapolationError, match="oldest sample"):
        climb((edge,), 4)


# Paths between frames

TREE = {"b": "a", "c": "b", "d": "c", "e": "b", "f": "e", "g": "a"}


@pytest.mark.parametrize(
    ("target", "source", "frames"),
    [
        ("a", "a", "a"),
        ("a", "d", "abcd"),
        ("d", "a", "dcba"),
        ("b", "c", "bc"),
        ("d", "f", "dcbef"),
        ("f", "d", "febcd"),
        ("g", "d", "gabcd"),
        ("c", "e", "cbe"),
    ],
)
def test_a_path_goes_over_the_lowest_common_ancestor(target: str, source: str, frames: str) -> None:
    assert "".join(find_path(hanging(TREE), target, source, None).frames) == frames


def test_the_search_goes_no_further_above_the_common_ancestor_than_the_path_is_long() -> None:
    asked: list[str] = []

    class WatchState(dict[str, FrameHistory]):
        def get(self, key: str, default: FrameHistory | None = None) -> FrameHistory | None:  # type: ignore[override]
            asked.append(key)
            return super().get(key, default)

    trunk = {f"trunk {depth + 1}": f"trunk {depth}" for depth in range(5_000)}
    frames = WatchState(hanging({**trunk, "left": "trunk 5000", "right": "trunk 5000", "tip": "right"}))
    assert find_path(frames, "left", "tip", None).frames == ("left", "trunk 5000", "right", "tip")
    assert len(asked) <= 6


def test_two_trees_are_disconnected_and_the_error_names_both_roots() -> None:
    frames = hanging({"b": "a", "y": "x", "z": "y"})
    with pytest.raises(DisconnectedError) as caught:
        find_path(frames, "b", "z", 7)
    error = caught.value
    assert (error.target, error.source, error.roots, error.stamp, error.loop) == ("b", "z", ("a", "x"), 7, ())


NAMES = "abcdef"
ANY_PARENTS = st.tuples(*(st.sampled_from((NAMES + "g").replace(name, "")) for name in NAMES))


@settings(deadline=None)
@given(ANY_PARENTS, st.sampled_from(NAMES), st.sampled_from(NAMES))
def test_a_search_ends_even_where_frames_hang_on_each_other_in_a_circle(
    parents: tuple[str, ...], target: str, source: str
) -> None:
    above = dict(zip(NAMES, parents, strict=True))
    try:
        found = find_path(hanging(above), target, source, None).frames
    except DisconnectedError as error:
        assert not ancestors(above, target) & ancestors(above, source)
        assert all(above[frame] == parent for frame, parent in pairwise(error.loop))
        # There is one root, 'g', so whoever does not meet is in a circle.
        assert len(error.loop) > 2
        assert error.loop[0] == error.loop[-1]
    else:
        assert (found[0], found[-1]) == (target, source)
        assert len(set(found)) == len(found)
        assert all(above.get(a) == b or above.get(b) == a for a, b in pairwise(found))


def ancestors(above: dict[str, str], frame: str) -> set[str]:
    """A frame and all above it."""
    seen = {frame}
    while (frame := above.get(frame, frame)) not in seen:
        seen.add(frame)
    return seen


def test_each_instant_has_the_path_of_its_own_parents() -> None:
    edge = moving("left", "child", [(0, Transform())])
    edge.insert("right", 10, IDENTITY, "")
    frames = {**hanging({"left": "root", "right": "root"}), "child": edge}
    assert find_path(frames, "root", "child", 9).frames == ("root", "left", "child")
    assert find_path(frames, "root", "child", 10).frames == ("root", "right", "child")
    assert find_path(frames, "root", "child", None).frames == ("root", "right", "child")


def test_a_path_is_lasting_unless_a_frame_on_it_changes_its_parent() -> None:
    changing = moving("left", "child", [(0, Transform())])
    changing.insert("right", 10, IDENTITY, "")
    frames = {**hanging({"left": "root", "right": "root", "below": "child"}), "child": changing}
    assert not find_path(frames, "root", "below", None).permanent
    assert find_path(frames, "child", "below", None).permanent
    assert find_path(frames, "left", "right", None).permanent


def test_static_edges_have_no_say_in_what_is_moving() -> None:
    frames = forest(
        static("a", "b", at_x(1.0), stamp=4),
        moving("b", "c", [(0, at_x(2.0)), (10, at_x(4.0))]),
        static("c", "d", at_x(8.0), stamp=6),
        static("d", "e", at_x(16.0), stamp=5),
    )
    path = find_path(frames, "a", "e", None)
    assert [edge.child for edge in path.moving] == ["c"]
    assert path.row(5)[0] == 28.0
    assert find_path(frames, "e", "a", None).row(5)[0] == -28.0
    assert find_path(frames, "c", "e", None).static_stamp == 6


@settings(deadline=None)
@given(st.lists(st.tuples(transforms(10.0), st.booleans()), min_size=1, max_size=6), st.integers(0, 6), st.data())
def test_a_path_up_and_down_is_the_product_of_its_edges(
    edges: list[tuple[Transform, bool]], split: int, data: st.DataObject
) -> None:
    frames: Forest = {}
    expected = {"root": Transform.identity()}
    for number, (pose, is_static) in enumerate(edges):
        parent = data.draw(st.sampled_from(sorted(expected)))
        child = f"frame {number}"
        frames[child] = static(parent, child, pose) if is_static else moving(parent, child, [(split, pose)])
        expected[child] = expected[parent] @ pose
    target, source = data.draw(st.tuples(st.sampled_from(sorted(expected)), st.sampled_from(sorted(expected))))
    found = from_row(find_path(frames, target, source, split).row(split))
    # Via the root, which the path avoids where it can.
    assert found.is_close(
        expected[target].inverse() @ expected[source], translation_tolerance=1e-11, rotation_tolerance=1e-11
    )


# Which edge decides


def path_over(*windows: tuple[int, int] | None) -> Path:
    """A path up over one moving edge a window, the lowest first; None is an edge without samples."""
    frames: Forest = {}
    for level, window in enumerate(windows):
        samples = [] if window is None else [(window[0], Transform()), (window[1], Transform())]
        frames[str(level)] = moving(str(level + 1), str(level), samples)
    return find_path(frames, str(len(windows)), "0", None)


def test_the_newest_common_stamp_is_that_of_the_edge_that_lags() -> None:
    common, lagging = path_over((0, 30), (5, 20), (0, 25)).newest_common()
    assert (common, lagging.child) == (20, "1")


def test_an_edge_without_samples_has_no_newest_stamp_in_common_with_others() -> None:
    with pytest.raises(FutureExtrapolationError) as caught:
        path_over((0, 30), None).newest_common()
    assert (caught.value.child, caught.value.stamp, caught.value.newest) == ("1", LATEST, None)


def test_an_edge_that_begins_too_late_decides_before_all_that_may_still_come() -> None:
    error = path_over((0, 10), (20, 30), None).deciding_error(15)
    assert type(error) is PastExtrapolationError
    assert (error.child, error.stamp, error.oldest) == ("1", 15, 20)


def test_among_edges_that_may_still_come_the_one_that_lags_most_decides() -> None:
    error = path_over((0, 12), (0, 10), (0, 20)).deciding_error(15)
    assert type(error) is FutureExtrapolationError
    assert (error.child, error.newest) == ("1", 10)
    assert path_over((0, 12), None, (0, 10)).deciding_error(15).child == "1"


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)).map(sorted), min_size=1, max_size=5), st.integers(-1, 10)
)
def test_a_path_has_an_answer_exactly_where_every_moving_edge_has_one(windows: list[list[int]], at: int) -> None:
    path = path_over(*((low, high) for low, high in windows))
    covered = all(low <= at <= high for low, high in windows)
    if covered:
        assert path.row(at) == IDENTITY
    else:
        with pytest.raises(ExtrapolationError):
            path.row(at)
        assert isinstance(path.deciding_error(at), PastExtrapolationError) == any(at < low for low, _ in windows)


@pytest.mark.parametrize(("target", "source"), ["ac", "ca", "ab", "bd", "cd", "aa"])
def test_a_row_at_each_of_some_stamps_is_the_row_at_each(target: str, source: str) -> None:
    frames = forest(
        moving("a", "b", [(0, at_x(0.0)), (10, at_x(10.0))]),
        moving("b", "c", [(0, Transform((1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))), (10, at_x(4.0))]),
        static("a", "d", at_x(8.0)),
    )
    path = find_path(frames, target, source, None)
    assert path.rows([7, 0, 10, 7]) == [path.row(at) for at in (7, 0, 10, 7)]
    assert path.rows([]) == []


def test_rows_are_given_only_where_every_edge_has_one() -> None:
    frames = forest(moving("a", "b", [(0, at_x(0.0)), (10, at_x(1.0))]))
    for target, source in ("ab", "ba"):
        path = find_path(frames, target, source, None)
        with pytest.raises(FutureExtrapolationError) as caught:
            path.rows([5, 11, -1])
        assert caught.value.stamp == 11
