from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.histories import at_x, moving_edge, static_edge
from support.strategies import transforms

from tfbus import (
    LATEST,
    DisconnectedError,
    ExtrapolationError,
    FutureExtrapolationError,
    PastExtrapolationError,
    Transform,
)
from tfbus.geometry.transform import from_row
from tfbus.rows import IDENTITY
from tfbus.stamps import STAMP_MAX, STAMP_MIN
from tfbus.tree.forest import Path, find_path, path_at
from tfbus.tree.history import FrameHistory

Frames = dict[str, FrameHistory]


def frames_of(*edges: FrameHistory) -> Frames:
    return {edge.child: edge for edge in edges}


def static_frames(parents: dict[str, str]) -> Frames:
    """Static edges from each key to its value."""
    return frames_of(*(static_edge(parent, child, Transform()) for child, parent in parents.items()))


# Search

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
def test_a_path_goes_through_the_lowest_common_ancestor(target: str, source: str, frames: str) -> None:
    assert "".join(find_path(static_frames(TREE), target, source, None).frames) == frames


def test_a_path_has_the_children_of_its_edges_and_the_newest_stamp_of_its_static_samples() -> None:
    stamps = {"b": ("a", 9), "c": ("b", 3), "d": ("c", 5), "e": ("b", 4)}
    frames = frames_of(*(static_edge(parent, child, Transform(), at) for child, (parent, at) in stamps.items()))
    path = find_path(frames, "d", "e", None)
    assert (path.root, path.children, path.static_stamp) == ("b", ["c", "d", "e"], 5)
    frames["e"] = moving_edge("b", "e", [(7, Transform())])
    assert find_path(frames, "c", "e", None).static_stamp == 3
    assert find_path(frames, "b", "e", None).static_stamp == 0, "nothing is static"
    zero = frames_of(static_edge("a", "b", Transform(), 0), static_edge("b", "c", Transform(), -5))
    assert [find_path(zero, "a", source, None).static_stamp for source in "bc"] == [0, 0]
    assert find_path(zero, "b", "c", None).static_stamp == -5


def test_the_search_climbs_above_the_common_ancestor_no_further_than_the_shorter_side() -> None:
    asked: list[str] = []

    class CountedFrames(dict[str, FrameHistory]):
        def get(self, key: str, default: FrameHistory | None = None) -> FrameHistory | None:  # type: ignore[override]
            asked.append(key)
            return super().get(key, default)

    trunk = {f"trunk {depth + 1}": f"trunk {depth}" for depth in range(5_000)}
    frames = CountedFrames(static_frames({**trunk, "left": "trunk 5000", "right": "trunk 5000", "tip": "right"}))
    assert find_path(frames, "left", "tip", None).frames == ("left", "trunk 5000", "right", "tip")
    assert len(asked) <= 6


def test_a_disconnected_error_names_the_roots_of_both_trees() -> None:
    frames = static_frames({"b": "a", "y": "x", "z": "y"})
    with pytest.raises(DisconnectedError) as caught:
        find_path(frames, "b", "z", 7)
    error = caught.value
    assert (error.target, error.source, error.roots, error.stamp, error.loop) == ("b", "z", ("a", "x"), 7, ())


NAMES = "abcdef"
ANY_PARENTS = st.tuples(*(st.sampled_from((NAMES + "g").replace(name, "")) for name in NAMES))


@given(ANY_PARENTS, st.sampled_from(NAMES), st.sampled_from(NAMES))
def test_the_search_ends_for_any_parents_and_finds_a_path_or_names_a_loop(
    parents: tuple[str, ...], target: str, source: str
) -> None:
    parent_of = dict(zip(NAMES, parents, strict=True))
    try:
        found = find_path(static_frames(parent_of), target, source, None).frames
    except DisconnectedError as error:
        assert not ancestors(parent_of, target) & ancestors(parent_of, source)
        assert all(parent_of[frame] == parent for frame, parent in pairwise(error.loop))
        # There is only one root, 'g', so two walks that never meet end in a loop.
        assert len(error.loop) > 2
        assert error.loop[0] == error.loop[-1]
    else:
        assert (found[0], found[-1]) == (target, source)
        assert len(set(found)) == len(found)
        assert all(parent_of.get(a) == b or parent_of.get(b) == a for a, b in pairwise(found))


def ancestors(parent_of: dict[str, str], frame: str) -> set[str]:
    """A frame and all its ancestors."""
    seen = {frame}
    while (frame := parent_of.get(frame, frame)) not in seen:
        seen.add(frame)
    return seen


def test_a_path_follows_the_parents_that_hold_at_the_stamp() -> None:
    edge = moving_edge("left", "child", [(0, Transform())])
    edge.insert("right", 10, IDENTITY, "")
    frames = {**static_frames({"left": "root", "right": "root"}), "child": edge}
    assert find_path(frames, "root", "child", 9).frames == ("root", "left", "child")
    assert find_path(frames, "root", "child", 10).frames == ("root", "right", "child")
    assert find_path(frames, "root", "child", None).frames == ("root", "right", "child")


def test_a_path_is_permanent_unless_a_frame_on_it_changes_its_parent() -> None:
    changing = moving_edge("left", "child", [(0, Transform())])
    changing.insert("right", 10, IDENTITY, "")
    frames = {**static_frames({"left": "root", "right": "root", "below": "child"}), "child": changing}
    assert not find_path(frames, "root", "below", None).permanent
    assert find_path(frames, "child", "below", None).permanent
    assert find_path(frames, "left", "right", None).permanent


def test_static_edges_are_folded_and_only_moving_edges_are_listed_as_moving() -> None:
    frames = frames_of(
        static_edge("a", "b", at_x(1.0), stamp=4),
        moving_edge("b", "c", [(0, at_x(2.0)), (10, at_x(4.0))]),
        static_edge("c", "d", at_x(8.0), stamp=6),
        static_edge("d", "e", at_x(16.0), stamp=5),
    )
    path = find_path(frames, "a", "e", None)
    assert [edge.child for edge in path.moving] == ["c"]
    assert path.row_at(5)[0] == 28.0
    assert find_path(frames, "e", "a", None).row_at(5)[0] == -28.0
    assert find_path(frames, "c", "e", None).static_stamp == 6


@given(st.lists(st.tuples(transforms(10.0), st.booleans()), min_size=1, max_size=6), st.integers(0, 6), st.data())
def test_the_row_of_a_path_is_the_product_of_its_edges(
    edges: list[tuple[Transform, bool]], split: int, data: st.DataObject
) -> None:
    frames: Frames = {}
    expected = {"root": Transform.identity()}
    for number, (pose, is_static) in enumerate(edges):
        parent = data.draw(st.sampled_from(sorted(expected)))
        child = f"frame {number}"
        frames[child] = static_edge(parent, child, pose) if is_static else moving_edge(parent, child, [(split, pose)])
        expected[child] = expected[parent] @ pose
    target, source = data.draw(st.tuples(st.sampled_from(sorted(expected)), st.sampled_from(sorted(expected))))
    found = from_row(find_path(frames, target, source, split).row_at(split))
    # The product goes through the root, the path only to the common ancestor.
    assert found.is_close(
        expected[target].inverse() @ expected[source], translation_tolerance=1e-11, rotation_tolerance=1e-11
    )


# The edge that decides


def path_over(*windows: tuple[int, int] | None) -> Path:
    """A path up over one moving edge for each window, the lowest first; None is an edge without samples."""
    frames: Frames = {}
    for level, window in enumerate(windows):
        samples = [] if window is None else [(window[0], Transform()), (window[1], Transform())]
        frames[str(level)] = moving_edge(str(level + 1), str(level), samples)
    return find_path(frames, str(len(windows)), "0", None)


def test_the_newest_common_stamp_is_the_newest_stamp_of_the_lagging_edge() -> None:
    common, lagging = path_over((0, 30), (5, 20), (0, 25)).newest_common()
    assert (common, lagging.child) == (20, "1")


def test_an_edge_without_samples_has_no_newest_common_stamp() -> None:
    with pytest.raises(FutureExtrapolationError) as caught:
        path_over((0, 30), None).newest_common()
    assert (caught.value.child, caught.value.stamp, caught.value.newest) == ("1", LATEST, None)


def test_a_past_extrapolation_decides_before_future_ones() -> None:
    error = path_over((0, 10), (20, 30), None).deciding_error(15)
    assert type(error) is PastExtrapolationError
    assert (error.child, error.stamp, error.oldest) == ("1", 15, 20)


def test_of_several_future_extrapolations_that_of_the_most_lagging_edge_decides() -> None:
    error = path_over((0, 12), (0, 10), (0, 20)).deciding_error(15)
    assert type(error) is FutureExtrapolationError
    assert (error.child, error.newest) == ("1", 10)
    assert path_over((0, 12), None, (0, 10)).deciding_error(15).child == "1"
    # A stamp that some edges have reached is the oldest that the others lack.
    last = STAMP_MAX
    assert path_over((0, last), (0, last - 1)).deciding_error(last).child == "1"
    assert path_over((0, last - 1), (0, last)).deciding_error(last).child == "0"
    # Of two that lag as far, the first one.
    assert path_over((0, 20), (0, 10), (0, 10)).deciding_error(15).child == "1"
    assert path_over((0, 20), None, (STAMP_MIN, STAMP_MIN)).deciding_error(15).child == "1"


@given(
    st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)).map(sorted), min_size=1, max_size=5), st.integers(-1, 10)
)
def test_a_path_has_a_row_exactly_at_the_stamps_that_every_moving_edge_covers(
    windows: list[list[int]], at: int
) -> None:
    path = path_over(*((low, high) for low, high in windows))
    covered = all(low <= at <= high for low, high in windows)
    if covered:
        assert path.row_at(at) == IDENTITY
    else:
        with pytest.raises(ExtrapolationError):
            path.row_at(at)
        assert isinstance(path.deciding_error(at), PastExtrapolationError) == any(at < low for low, _ in windows)


# The path that counts at a stamp


def loop_of(*, a_on_b: tuple[int, ...], b_on_a: tuple[int, ...]) -> Frames:
    """Frames a and b, each on the other at these stamps, and by the newest stamp, 100, both on c."""
    a = moving_edge("b", "a", [(at, Transform()) for at in a_on_b])
    b = moving_edge("a", "b", [(at, Transform()) for at in b_on_a])
    a.insert("c", 100, IDENTITY, "")
    b.insert("c", 100, IDENTITY, "")
    return {"a": a, "b": b}


def at_stamp(frames: Frames, target: str, source: str, at: int) -> Path:
    return path_at(frames, target, source, at, find_path(frames, target, source, None))


def test_the_newest_path_counts_at_each_stamp_at_which_it_holds_and_has_samples() -> None:
    # Until 10, b is above c: the newest path holds then, and another way leads through it.
    top = moving_edge("b", "c", [(0, Transform()), (10, Transform())])
    top.insert("root", 20, IDENTITY, "")
    frames: Frames = {"c": top} | {
        child: moving_edge("c", child, [(0, Transform()), (30, Transform())]) for child in ("a", "b")
    }
    newest = find_path(frames, "a", "b", None)
    assert newest.permanent
    assert all(at_stamp(frames, "a", "b", at).frames == ("a", "c", "b") for at in (0, 5, 15, 30))
    early, late = at_stamp(frames, "a", "b", -1), at_stamp(frames, "a", "b", 31)
    assert early.rival is not None
    assert {early.moving, early.rival.moving} == {(frames["b"], frames["a"]), (frames["a"], frames["c"])}
    assert (late.moving, late.rival) == (newest.moving, None)


def test_both_ways_round_a_loop_have_all_their_edges() -> None:
    # Before 10, b was above c, and so the sides of the newest path met in b as well.
    top = moving_edge("b", "c", [(0, Transform()), (10, Transform())])
    top.insert("root", 20, IDENTITY, "")
    parents = {"p": "c", "a": "p", "q": "c", "s": "q", "b": "s"}
    sides = [moving_edge(parent, child, [(0, Transform()), (30, Transform())]) for child, parent in parents.items()]
    frames = frames_of(top, *sides)
    for target, source in (("a", "b"), ("b", "a")):
        path = at_stamp(frames, target, source, -1)
        assert path.rival is not None
        way, other = ["a", "p", "c", "q", "s", "b"], ["a", "p", "c", "b"]
        found = sorted(list(each.frames)[:: 1 if target == "a" else -1] for each in (path, path.rival))
        assert found == [other, way]
        assert {each.root for each in (path, path.rival)} == {"b", "c"}
        assert {edge.child for edge in path.moving} | {edge.child for edge in path.rival.moving} == set("pcaqsb")


@pytest.mark.parametrize("at", [0, 5, 10, 99])
def test_of_two_ways_round_a_loop_the_one_with_samples_counts(at: int) -> None:
    frames = loop_of(a_on_b=(0, 10), b_on_a=())
    for target, source in (("a", "b"), ("b", "a")):
        path = at_stamp(frames, target, source, at)
        assert path.frames == (target, source)
        assert [edge.child for edge in path.moving] == ["a"]


def test_two_ways_with_samples_are_no_way_unless_one_is_the_newest() -> None:
    frames = loop_of(a_on_b=(0, 10), b_on_a=(5, 20))
    assert [edge.child for edge in at_stamp(frames, "a", "b", 4).moving] == ["a"]
    for target, source in (("a", "b"), ("b", "a")):
        with pytest.raises(DisconnectedError) as caught:
            at_stamp(frames, target, source, 7)
        assert caught.value.stamp == 7
        assert caught.value.loop in (("a", "b", "a"), ("b", "a", "b"))


def test_without_samples_on_either_way_both_may_still_help() -> None:
    frames = loop_of(a_on_b=(0, 10), b_on_a=(5, 20))
    for edge in frames.values():
        edge.clear()
    frames["a"].insert("b", 10, IDENTITY, "")
    frames["b"].insert("a", 10, IDENTITY, "")
    path = path_at(frames, "a", "b", 20, None)
    back = path_at(frames, "b", "a", 20, None)
    assert path.rival is not None
    assert {path.moving, path.rival.moving} == {(frames["a"],), (frames["b"],)}
    assert back.moving == path.moving
    error = path.deciding_error(20)
    assert isinstance(error, FutureExtrapolationError)
    assert {error.child, *error.others} == {"a", "b"}
    frames["a"].insert("b", 30, IDENTITY, "")
    frames["a"].insert("b", 40, IDENTITY, "")
    early = path_at(frames, "a", "b", 5, None)
    assert isinstance(early.deciding_error(5), PastExtrapolationError)


def test_waiting_helps_if_it_helps_on_one_of_two_ways() -> None:
    frames: Frames = {"a": moving_edge("b", "a", [(30, Transform())]), "b": moving_edge("a", "b", [(10, Transform())])}
    for target, source in (("a", "b"), ("b", "a")):
        error = path_at(frames, target, source, 20, None).deciding_error(20)
        assert type(error) is FutureExtrapolationError
        assert (error.child, error.others) in (("b", ()), ("b", ("a",)))
