import gc
import math
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from itertools import pairwise, permutations, product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.asking import threads_that
from support.samples import any_samples, moving, over, static, tree_of, x_of
from support.strategies import TODAY

from tfbus import (
    LATEST,
    SECOND,
    DisconnectedError,
    Edge,
    ExtrapolationError,
    FutureExtrapolationError,
    GapError,
    Hold,
    InvalidTransformError,
    Latest,
    Outcome,
    PastExtrapolationError,
    Transform,
    TransformLookupError,
    TransformStamped,
    TransformTree,
    UnknownFrameError,
)
from tfbus.tree.tree import forest_of


def commit_batch(tree: TransformTree, batch: tuple[TransformStamped, ...]) -> None:
    """Insert a batch that was judged before, as a bus does."""
    forest_of(tree).commit(batch)


# Insertion and the window


def test_a_sample_as_old_as_the_window_answers_and_one_nanosecond_before_is_past() -> None:
    for keep in (1, 10, 99):
        tree = TransformTree(float(keep))
        for second in range(101):
            tree.insert(moving("a", "b", second * SECOND, float(second)))
        oldest = (100 - keep) * SECOND
        assert x_of(tree, "a", "b", oldest) == 100.0 - keep
        with pytest.raises(PastExtrapolationError) as caught:
            tree.lookup("a", "b", oldest - 1)
        assert caught.value.oldest == oldest


def test_each_edge_has_its_own_window() -> None:
    tree = tree_of(*over("a", "b", [0, 5]), *over("b", "c", [0, 1_000]), keep=10e-9)
    assert tree.lookup("a", "b", 0).stamp == 0
    assert not tree.can_transform("b", "c", 0)


def test_outcomes_are_returned_and_counted() -> None:
    tree = TransformTree(keep=10e-9)
    batch = [moving("a", "b", stamp) for stamp in (100, 90, 89, 90, 101, 90)]
    expected = [
        Outcome.INSERTED,
        Outcome.INSERTED,
        Outcome.EXPIRED,
        Outcome.REPLACED,
        Outcome.INSERTED,
        Outcome.EXPIRED,
    ]
    assert tree.insert_many(batch) == expected
    assert (tree.inserted, tree.replaced, tree.expired) == (3, 1, 2)
    assert tree.insert(static("a", "c")) is Outcome.INSERTED
    assert tree.insert(static("a", "c")) is Outcome.REPLACED


def test_an_expired_sample_adds_no_frame() -> None:
    tree = tree_of(moving("a", "b", 100), keep=10e-9)
    assert tree.insert(moving("ghost", "b", 50)) is Outcome.EXPIRED
    assert tree.frames() == ["a", "b"]


def test_a_parent_is_forgotten_with_the_last_sample_that_names_it() -> None:
    tree = tree_of(moving("old", "b", 0), moving("new", "b", 10), keep=10e-9)
    assert tree.frames() == ["b", "new", "old"]
    tree.insert(moving("new", "b", 11))
    assert tree.frames() == ["b", "new"]
    with pytest.raises(UnknownFrameError):
        tree.lookup("old", "b", 11)


def test_a_parent_that_only_a_late_sample_names_is_forgotten_when_that_expires() -> None:
    tree = tree_of(moving("new", "b", 100), moving("old", "b", 90), keep=10e-9)
    assert "old" in tree
    tree.insert(moving("new", "b", 101))
    assert "old" not in tree


def test_a_late_sample_extends_the_past_of_a_cached_path() -> None:
    tree = tree_of(*over("a", "b", [50, 60]))
    with pytest.raises(PastExtrapolationError):
        tree.lookup("a", "b", 45)
    tree.insert(moving("a", "b", 40, 40.0))
    assert x_of(tree, "a", "b", 45) == 45.0


@pytest.mark.parametrize("keep", [None, math.inf])
def test_without_a_window_nothing_expires(keep: float | None) -> None:
    tree = tree_of(moving("a", "b", 10**18), keep=keep)
    assert tree.insert(moving("a", "b", 0)) is Outcome.INSERTED
    assert tree.lookup("a", "b", 0).stamp == 0


@pytest.mark.parametrize(("keep", "error"), [(-1.0, ValueError), (math.nan, ValueError), ("10", TypeError)])
def test_a_window_that_is_no_duration_is_an_error(keep: Any, error: type[Exception]) -> None:
    with pytest.raises(error, match="keep"):
        TransformTree(keep)


@pytest.mark.parametrize("sample", [None, "a", {"parent": "a"}, Transform()])
def test_inserting_anything_but_samples_is_a_type_error_and_stores_nothing(sample: Any) -> None:
    tree = TransformTree()
    with pytest.raises(TypeError, match="TransformStamped"):
        tree.insert(sample)
    with pytest.raises(TypeError, match="TransformStamped"):
        tree.insert_many([moving("a", "b", 0), sample])
    assert tree.frames() == []


# Loops


def test_a_batch_that_closes_a_loop_is_refused_and_nothing_is_stored() -> None:
    tree = tree_of(moving("a", "b", 0), moving("b", "c", 0))
    edges, frames = tree.edges(), tree.frames()
    with pytest.raises(InvalidTransformError) as caught:
        tree.insert_many([moving("x", "y", 1), moving("c", "a", 1, authority="culprit"), moving("a", "b", 1)])
    error = caught.value
    assert (error.reason, error.parent, error.child, error.authority) == ("cycle", "c", "a", "culprit")
    assert error.loop == ("a", "c", "b", "a")
    assert (tree.edges(), tree.frames(), tree.inserted) == (edges, frames, 2)


def test_one_batch_may_reverse_an_edge() -> None:
    tree = tree_of(moving("map", "base", 0, 5.0))
    tree.insert_many([moving("base", "map", 10, -7.0), moving("world", "base", 10, 100.0)])
    assert tree.chain("world", "map") == ["world", "base", "map"]
    assert x_of(tree, "world", "map", 10) == 93.0
    assert x_of(tree, "base", "map", 10) == -7.0
    assert x_of(tree, "map", "base", 0) == 5.0, "the past is unchanged"


def test_a_loop_that_late_samples_form_in_the_past_is_an_error_only_at_its_stamps() -> None:
    tree = tree_of(*over("map", "a", [10, 20]), *over("a", "b", [10, 20]))
    tree.insert(moving("b", "a", 5))
    tree.insert(moving("a", "b", 5))
    with pytest.raises(DisconnectedError) as caught:
        tree.lookup("map", "b", 5)
    assert sorted(set(caught.value.loop)) == ["a", "b"]
    assert caught.value.loop[0] == caught.value.loop[-1]
    assert caught.value.stamp == 5
    assert x_of(tree, "map", "b", 15) == 30.0
    assert x_of(tree, "map", "b") == 40.0


@settings(deadline=None)
@given(st.lists(st.tuples(st.sampled_from("bcd"), st.sampled_from("abcd"), st.integers(0, 9)), max_size=30))
def test_a_lookup_ends_for_any_history_of_parents(history: list[tuple[str, str, int]]) -> None:
    tree = tree_of(moving("a", "b", 10), moving("b", "c", 10), moving("c", "d", 10))
    for child, parent, stamp in history:
        if child != parent:
            tree.insert(moving(parent, child, stamp))
    for target, source, at in product("abcd", "abcd", range(11)):
        try:
            found = tree.lookup(target, source, at)
        except (DisconnectedError, ExtrapolationError):
            continue
        assert found.stamp == at
    assert tree.chain("a", "d") == ["a", "b", "c", "d"]


# Static


def test_a_new_static_parent_moves_a_frame_with_its_descendants() -> None:
    tree = tree_of(static("a", "b", 1.0), static("b", "c", 2.0), static("a", "d", 10.0))
    assert x_of(tree, "a", "c") == 3.0
    tree.insert(static("d", "b", 5.0))
    assert x_of(tree, "a", "c", 0) == 17.0
    assert tree.chain("a", "c") == ["a", "d", "b", "c"]
    tree.insert(static("elsewhere", "b"))
    with pytest.raises(DisconnectedError):
        tree.lookup("a", "c")


# Frames and edges


def test_an_empty_tree_knows_nothing() -> None:
    tree = TransformTree()
    assert (tree.frames(), tree.edges()) == ([], [])
    with pytest.raises(UnknownFrameError):
        tree.lookup("a", "a")


def test_parent_gives_the_parent_at_a_stamp() -> None:
    tree = tree_of(*over("a", "b", [10, 20]), static("b", "c"), moving("b", "d", 5))
    assert [tree.parent(frame) for frame in "abcd"] == [None, "a", "b", "b"]
    assert tree.parent("a", 12_345) is None
    assert tree.parent("c", 12_345) == "b"
    with pytest.raises(PastExtrapolationError):
        tree.parent("b", 9)
    with pytest.raises(FutureExtrapolationError):
        tree.parent("d", 6)
    with pytest.raises(UnknownFrameError):
        tree.parent("nobody")


def test_frames_are_sorted_and_include_the_roots() -> None:
    tree = tree_of(moving("world", "base", 0), static("base", "camera"))
    assert tree.frames() == ["base", "camera", "world"]
    assert "world" in tree
    assert "moon" not in tree


def test_edges_describe_each_child_sorted_by_name() -> None:
    tree = tree_of(
        *over("map", "base", range(0, SECOND + 1, SECOND // 10)), static("base", "arm", authority="urdf"), keep=0.5
    )
    assert tree.edges() == [
        Edge("base", "arm", static=True, samples=1, oldest=None, newest=None, authority="urdf"),
        Edge("map", "base", static=False, samples=6, oldest=SECOND // 2, newest=SECOND, authority=""),
    ]
    assert tree.edges()[1].rate == 10.0


# Clearing, removing, copying


def test_clear_drops_moving_samples_and_keeps_static_ones_and_all_frames() -> None:
    tree = tree_of(*over("map", "base", [0, 10]), static("base", "camera", 1.0))
    tree.clear()
    assert tree.frames() == ["base", "camera", "map"]
    assert x_of(tree, "base", "camera", 5) == 1.0
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.lookup("map", "camera", 5)
    error = caught.value
    assert (error.child, error.stamp, error.oldest, error.newest) == ("base", 5, None, None)


def test_after_a_clear_an_earlier_stamp_is_inserted() -> None:
    tree = tree_of(moving("map", "base", 100 * SECOND))
    tree.clear()
    assert tree.insert(moving("map", "base", 1, 4.0)) is Outcome.INSERTED
    assert x_of(tree, "map", "base", 1) == 4.0


@pytest.mark.parametrize("commit", [False, True])
@pytest.mark.parametrize("known", [False, True])
def test_after_a_clear_an_edge_may_be_reversed(commit: bool, known: bool) -> None:
    tree = tree_of(moving("map", "base", 0, 5.0))
    if known:
        tree.insert(moving("world", "map", 0))
    tree.clear()
    turned = moving("base", "map", 1, -2.0)
    if commit:
        commit_batch(tree, (turned,))
    else:
        tree.insert(turned)
    assert x_of(tree, "base", "map") == -2.0
    assert x_of(tree, "map", "base", 1) == 2.0
    assert tree.parent("base") is None


def test_removing_a_frame_makes_it_the_root_of_its_descendants() -> None:
    tree = tree_of(static("map", "a"), *over("a", "b", [0, 10]), static("b", "c", 1.0), static("c", "d", 2.0))
    assert tree.can_transform("map", "d")
    tree.remove_frame("b")
    with pytest.raises(DisconnectedError) as caught:
        tree.lookup("map", "d")
    assert caught.value.roots == ("map", "b")
    assert x_of(tree, "b", "d", 5) == 3.0


def test_removing_a_leaf_forgets_it_and_a_parent_that_only_it_named() -> None:
    tree = tree_of(moving("a", "b", 0), moving("b", "c", 0))
    tree.remove_frame("b")
    assert tree.frames() == ["b", "c"]
    tree.remove_frame("c")
    assert tree.frames() == []
    with pytest.raises(UnknownFrameError):
        tree.remove_frame("c")


def test_removing_a_root_with_children_changes_nothing() -> None:
    tree = tree_of(moving("a", "b", 0))
    tree.remove_frame("a")
    assert tree.frames() == ["a", "b"]
    assert tree.lookup("a", "b", 0).stamp == 0


def test_a_removed_frame_may_return_under_another_parent_with_an_earlier_stamp() -> None:
    tree = tree_of(moving("a", "b", 100 * SECOND), static("b", "c", 1.0))
    tree.remove_frame("b")
    tree.insert(moving("z", "b", 1, 3.0))
    assert x_of(tree, "z", "c", 1) == 4.0


def test_a_copy_gives_the_same_answers_and_is_independent() -> None:
    tree = tree_of(*over("a", "b", [0, 10]), *over("z", "b", [20, 30]), static("b", "c", 1.0, stamp=4), keep=25e-9)
    twin = tree.copy()
    edges, frames = tree.edges(), tree.frames()
    assert (twin.keep, twin.edges(), twin.frames()) == (25e-9, edges, frames)
    assert x_of(twin, "a", "c", 10) == 11.0

    tree.insert_many([moving("a", "b", 500), static("b", "c", 9.0), moving("new", "z", 0)])
    tree.remove_frame("c")
    assert (twin.edges(), twin.frames()) == (edges, frames)
    assert x_of(twin, "z", "c", 25) == 26.0

    before = tree.edges()
    twin.clear()
    twin.insert(moving("c", "q", 5))
    assert tree.edges() == before
    assert "q" not in tree


# Depth


@pytest.fixture(scope="module")
def deep() -> TransformTree:
    """A chain of 5,000 edges, each 1 m, moving and static ones in turn."""
    tree = TransformTree()
    for depth in reversed(range(5_000)):
        make = static if depth % 2 else moving
        tree.insert(make(f"frame {depth}", f"frame {depth + 1}", stamp=7, x=1.0))
    return tree


@pytest.mark.thorough
def test_a_chain_longer_than_the_recursion_limit_is_looked_up_and_drawn(deep: TransformTree) -> None:
    assert sys.getrecursionlimit() < 5_000
    for at in (LATEST, 7):
        assert x_of(deep, "frame 0", "frame 5000", at) == 5_000.0
        assert x_of(deep, "frame 5000", "frame 0", at) == -5_000.0
    assert len(deep.chain("frame 5000", "frame 0")) == 5_001
    assert deep.describe().count("\n") == 5_000


def test_the_roots_of_disconnected_deep_trees_are_named(deep: TransformTree) -> None:
    tree = deep.copy()
    tree.insert(moving("island", "palm", 7))
    with pytest.raises(DisconnectedError) as caught:
        tree.lookup("palm", "frame 5000", 7)
    assert caught.value.roots == ("island", "frame 0")


# Caches

NAMES = "abcd"
SAMPLES = any_samples(NAMES, last=20)
KEEPS = st.sampled_from([None, 0.0, 8e-9])


def everything(tree: TransformTree) -> list[object]:
    """The answer, or the error with its facts, to every question at some stamps."""
    stamps: tuple[int | Latest, ...] = (LATEST, 3, 10, 17)
    return [outcome(partial(tree.lookup, target, source, at)) for target, source, at in product(NAMES, NAMES, stamps)]


def outcome(question: Callable[[], TransformStamped]) -> object:
    try:
        return question()
    except TransformLookupError as error:
        return type(error), str(error)


@settings(deadline=None)
@given(st.lists(SAMPLES, max_size=12), KEEPS)
def test_lookups_do_not_change_later_answers(given: list[TransformStamped], keep: float | None) -> None:
    asked = TransformTree(keep)
    accepted: list[TransformStamped] = []
    for sample in given:
        try:
            asked.insert(sample)
        except InvalidTransformError:
            continue
        accepted.append(sample)
        fresh = TransformTree(keep)
        for earlier in accepted:
            fresh.insert(earlier)
        assert everything(asked) == everything(fresh)


@settings(deadline=None)
@given(st.lists(st.lists(SAMPLES, min_size=1, max_size=3), max_size=8), KEEPS)
def test_committing_a_judged_batch_equals_inserting_it(
    batches: list[list[TransformStamped]], keep: float | None
) -> None:
    judged, committed = TransformTree(keep), TransformTree(keep)
    for batch in batches:
        try:
            judged.insert_many(batch)
        except InvalidTransformError:
            continue
        commit_batch(committed, tuple(batch))
        assert committed.edges() == judged.edges()
        assert committed.frames() == judged.frames()
        assert everything(committed) == everything(judged)
    assert (committed.inserted, committed.replaced, committed.expired) == (
        judged.inserted,
        judged.replaced,
        judged.expired,
    )


@settings(deadline=None)
@given(st.permutations(range(10)), st.lists(st.sampled_from("pq"), min_size=10, max_size=10))
def test_the_order_of_insertion_does_not_change_answers(order: list[int], parents: list[str]) -> None:
    fixed = (static("root", "p", 100.0), static("root", "q", 200.0))
    data = [moving(parents[stamp], "b", stamp, float(stamp**2)) for stamp in range(10)]
    in_order, shuffled = tree_of(*fixed, *data), tree_of(*fixed, *(data[at] for at in order))
    for at in (LATEST, *range(-1, 11)):
        for target in ("root", "p", "q"):
            ask = [partial(tree.lookup, target, "b", at) for tree in (in_order, shuffled)]
            assert outcome(ask[0]) == outcome(ask[1])


# Memory


@contextmanager
def no_growth(limit: int) -> Iterator[None]:
    """Fail if the block allocates more than `limit` bytes without freeing them."""
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        yield
        gc.collect()
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after - before < limit


@pytest.mark.parametrize("insert", [TransformTree.insert_many, commit_batch])
@pytest.mark.parametrize("order", [1, -1], ids=["in order", "backwards"])
@pytest.mark.thorough
def test_a_sample_takes_at_most_100_bytes(insert: Callable[[TransformTree, Any], object], order: int) -> None:
    edges = [(f"frame {depth}", f"frame {depth + 1}") for depth in range(5)]
    stamps = range(TODAY, TODAY + 5 * SECOND, SECOND // 100)[::order]
    tree = TransformTree(keep=None)
    with no_growth(100 * len(stamps) * len(edges)):
        for stamp in stamps:
            # A new string for each sample, as a link makes it.
            authority = bytes.decode(b"odometry")
            insert(tree, tuple(moving(parent, child, stamp, stamp / SECOND, authority) for parent, child in edges))
    assert {edge.samples for edge in tree.edges()} == {500}


@pytest.mark.thorough
def test_memory_stays_constant_while_samples_are_inserted_and_expire() -> None:
    tree = TransformTree(keep=1e-6)

    def stream(first: int, last: int) -> None:
        for stamp in range(first, last):
            commit_batch(tree, (moving("a", "b", stamp), moving("b", "c", stamp)))
            if stamp % 100 == 0:
                tree.lookup("a", "c")

    stream(0, 2_000)
    with no_growth(200_000):
        stream(2_000, 40_000)
    assert [edge.samples for edge in tree.edges()] == [1_001, 1_001]


@pytest.mark.thorough
def test_memory_stays_constant_while_frames_with_new_names_are_added_and_removed() -> None:
    tree = tree_of(static("map", "base"))

    def churn(first: int, last: int) -> None:
        for number in range(first, last):
            frame, parent = f"object {number}", f"support {number}"
            tree.insert_many([moving("base", parent, number), moving(parent, frame, number)])
            tree.lookup("map", frame)
            with pytest.raises(UnknownFrameError):
                tree.lookup("map", f"misspelt {number}")
            tree.remove_frame(frame)
            tree.remove_frame(parent)

    churn(0, 100)
    with no_growth(50_000):
        churn(100, 3_000)
    assert tree.frames() == ["base", "map"]


def test_parents_that_have_left_the_window_are_forgotten() -> None:
    tree = TransformTree(keep=100e-9)
    for number in range(500):
        tree.insert(moving(f"parent {number}", "b", number))
        assert len(tree.frames()) <= 102


# Threads


@pytest.mark.parametrize("insert", [TransformTree.insert_many, commit_batch])
def test_other_threads_see_a_whole_batch_or_nothing(insert: Callable[[TransformTree, Any], object]) -> None:
    # Only the newest samples are kept, so half a batch would be an extrapolation.
    tree = tree_of(moving("body", "left", 0), moving("body", "right", 0), keep=0.0)

    def read() -> None:
        first, second = tree.lookup("left", "right"), tree.lookup("right", "left")
        assert first.transform == second.transform == Transform.identity()
        assert first.stamp <= second.stamp

    with threads_that(read):
        for stamp in range(1, 2_000):
            insert(tree, (moving("body", "left", stamp, float(stamp)), moving("body", "right", stamp, float(stamp))))


def test_other_threads_can_read_the_whole_tree_while_frames_are_added_and_removed() -> None:
    tree = tree_of(static("map", "base"))

    def read() -> None:
        assert tree.parent("base") == "map"
        assert Edge("map", "base", True, 1, None, None, "") in tree.copy().edges()
        assert {"base", "map"} <= set(tree.frames())
        assert all("base" in picture for picture in (tree.describe(), tree.to_dot(), tree.to_yaml()))

    with threads_that(read):
        for number in range(150):
            frames = [f"frame {number} {below}" for below in range(5)]
            tree.insert_many([moving(parent, child, number) for parent, child in pairwise(["map", *frames])])
            for frame in frames:
                tree.remove_frame(frame)


# One tree, one answer


def facts(question: Callable[[], TransformStamped]) -> object:
    """An answer, or the kind and the text of its error."""
    try:
        return question()
    except TransformLookupError as error:
        return type(error), str(error)


@given(
    st.lists(st.lists(any_samples("abcde", 20), min_size=1, max_size=3), max_size=10),
    st.lists(st.tuples(st.sampled_from("abcde"), st.sampled_from("abcde"), st.none() | st.integers(0, 20)), max_size=5),
    st.sampled_from([None, 8e-9]),
    st.sampled_from([{}, {"tolerance": 2e-9}, {"max_gap": 5e-9}, {"extrapolate": Hold(3e-9)}]),
)
def test_an_answer_depends_on_the_samples_and_on_no_earlier_question(
    batches: list[list[TransformStamped]],
    earlier: list[tuple[str, str, int | None]],
    keep: float | None,
    policy: dict[str, Any],
) -> None:
    tree = TransformTree(keep)
    for batch in batches:
        with suppress(InvalidTransformError):
            tree.insert_many(batch)
        for target, source, at in earlier:
            tree.can_transform(target, source, LATEST if at is None else at)
    names = [name for name in "abcde" if name in tree]
    stamps = list(range(-1, 22)) * 2
    for target, source in permutations(names, 2):
        many = None
        with suppress(TransformLookupError):
            many = tree.copy().lookup_many(target, source, stamps, out_of_range="nan", **policy)
        for place, at in enumerate(stamps[:23]):
            answer = facts(lambda: tree.lookup(target, source, at, **policy))  # noqa: B023
            assert answer == facts(lambda: tree.copy().lookup(target, source, at, **policy))  # noqa: B023
            back = facts(lambda: tree.lookup(source, target, at, **policy))  # noqa: B023
            assert isinstance(back, TransformStamped) == isinstance(answer, TransformStamped)
            if isinstance(answer, TransformStamped):
                assert many is not None
                assert many[place].is_close(answer.transform)
            else:
                assert many is None or np.isnan(many.translations[place]).all()


def test_late_data_that_form_a_loop_give_one_answer_whatever_was_asked_before() -> None:
    # Until 20, r is on t: then r and t are each other's parents, and two ways lead from s to t.
    samples = [
        *(moving("r", child, at, x) for child, x in (("s", 14.0), ("t", 28.0)) for at in (0, 30)),
        moving("q", "r", 30),
        *(moving("t", "r", at, 77.0) for at in (0, 20)),
    ]
    asked, fresh = tree_of(*samples), tree_of(*samples)
    assert asked.lookup("t", "s").stamp == 30
    for tree in (asked, fresh):
        assert x_of(tree, "t", "s", 15) == -14.0
        assert x_of(tree, "s", "t", 15) == 14.0
        assert tree.lookup_many("t", "s", [15] * 50).translations[:, 0].tolist() == [-14.0] * 50
        assert tree.chain("t", "s", 15) == ["t", "r", "s"]
        assert tree.explain("t", "s", 15).chain == ("t", "r", "s")
    assert fresh.looped > 0


def test_a_frame_that_was_the_parent_of_its_present_parent_answers_with_both_edges() -> None:
    tree = tree_of(*over("cart", "robot", [0, 10]))
    tree.insert_many([moving("map", "robot", 20), moving("robot", "cart", 20), moving("robot", "cart", 30)])
    for _ in range(2):
        assert x_of(tree, "cart", "robot", 5) == 5.0
        assert x_of(tree, "robot", "cart", 5) == -5.0
        assert x_of(tree, "robot", "cart", 25) == 0.0
        tree.lookup("cart", "robot")
    assert tree.looped == 0


def test_the_repr_is_one_line_with_frames_samples_and_span() -> None:
    assert repr(TransformTree()) == "<TransformTree of 0 frames, 0 samples>"
    tree = tree_of(*over("map", "base", [SECOND, 2 * SECOND]), static("base", "lidar"))
    assert repr(tree) == "<TransformTree of 3 frames, 3 samples, 1.000 s to 2.000 s>"


def test_each_option_alone_is_heeded_for_many_stamps() -> None:
    # Two samples 10 s apart.
    tree = tree_of(moving("map", "base", 0), moving("map", "base", 10 * SECOND, 1.0), keep=None)

    def x(at: int, **options: Any) -> float:
        found = tree.lookup_many("map", "base", [at], **options)
        return float(found.translations[0, 0])

    assert x(5 * SECOND) == 0.5
    with pytest.raises(GapError):
        x(5 * SECOND, max_gap=1.0)
    with pytest.raises(FutureExtrapolationError):
        x(11 * SECOND)
    assert x(11 * SECOND, tolerance=2.0) == 1.0
    assert x(11 * SECOND, extrapolate=Hold(2.0)) == 1.0
    # Of the base at 5 s, seen from the map at 11 s through itself.
    assert x(11 * SECOND, fixed="map", source_at=[5 * SECOND]) == 0.5
    assert np.isnan(x(11 * SECOND, out_of_range="nan"))
    with pytest.raises(ValueError, match="out_of_range"):
        x(5 * SECOND, out_of_range="zero")
