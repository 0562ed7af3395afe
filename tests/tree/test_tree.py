""""""

import copy
import gc
import math
import multiprocessing
import pickle
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
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
    Buffer,
    Bus,
    Edge,
    FutureExtrapolationError,
    Hold,
    InvalidTransformError,
    Latest,
    Outcome,
    PastExtrapolationError,
    Transform,
    TransformArray,
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


# Frames and edges


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


def answers(tree: TransformTree, *stamps: int | Latest) -> list[object]:
    """The frames, the edges and the answers of a tree to every question at some stamps."""
    asked = product(tree.frames(), tree.frames(), (LATEST, *stamps))
    return [tree.frames(), tree.edges(), *(outcome(partial(tree.lookup, *question)) for question in asked)]


def outcome(question: Callable[[], TransformStamped]) -> object:
    try:
        return question()
    except TransformLookupError as error:
        return type(error), str(error)


@settings(deadline=None)
@given(
    st.lists(st.lists(any_samples("abcd", last=20), min_size=1, max_size=3), max_size=8),
    st.sampled_from([None, 0.0, 8e-9]),
)
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
        assert answers(committed, 3, 10, 17) == answers(judged, 3, 10, 17)
    for counter in ("inserted", "replaced", "expired"):
        assert getattr(committed, counter) == getattr(judged, counter)


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
            answer = outcome(lambda: tree.lookup(target, source, at, **policy))  # noqa: B023
            assert answer == outcome(lambda: tree.copy().lookup(target, source, at, **policy))  # noqa: B023
            back = outcome(lambda: tree.lookup(source, target, at, **policy))  # noqa: B023
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


def test_the_repr_is_one_line_with_frames_samples_and_span() -> None:
    assert repr(TransformTree()) == "<TransformTree of 0 frames, 0 samples>"
    tree = tree_of(*over("map", "base", [SECOND, 2 * SECOND]), static("base", "lidar"))
    assert repr(tree) == "<TransformTree of 3 frames, 3 samples, 1.000 s to 2.000 s>"


COPIES: list[Callable[[TransformTree], TransformTree]] = [
    lambda tree: pickle.loads(pickle.dumps(tree)),
    copy.deepcopy,
    copy.copy,
]


@given(
    st.lists(
        st.builds(
            lambda sample, authority: sample.replace(authority=authority),
            any_samples("abc", 4),
            st.sampled_from(["", "slam", "odometry"]),
        ),
        max_size=12,
    ),
    st.sampled_from([None, 2e-9]),
    st.booleans(),
    st.sampled_from(COPIES),
)
def test_a_copied_tree_answers_all_questions_as_the_one_that_it_was(
    samples: list[TransformStamped],
    keep: float | None,
    cleared: bool,
    copied: Callable[[TransformTree], TransformTree],
) -> None:
    tree = TransformTree(keep)
    for sample in samples:
        with suppress(InvalidTransformError):
            tree.insert(sample)
    if cleared:
        tree.clear()
    twin = copied(tree)
    assert (twin.keep, twin.max_translation) == (tree.keep, tree.max_translation)
    assert answers(twin, *range(5)) == answers(tree, *range(5))
    for late in (moving("a", "d", 0), moving("d", "e", 9)):
        assert twin.insert(late) == tree.insert(late)
    assert answers(twin, *range(5)) == answers(tree, *range(5))


@pytest.mark.parametrize("copied", COPIES)
def test_samples_of_several_senders_and_parents_are_copied_one_by_one(
    copied: Callable[[TransformTree], TransformTree],
) -> None:
    tree = tree_of(
        *(moving("map", "a", stamp, 1.0 * stamp, "slam") for stamp in range(3)),
        *(moving("map", "a", stamp, 2.0 * stamp, "odometry") for stamp in range(3, 6)),
        *(moving("odom", "a", stamp, 3.0 * stamp, "odometry") for stamp in range(6, 9)),
        *(moving("map", "odom", stamp, 1.0 * stamp) for stamp in range(9)),
    )
    assert answers(copied(tree), *range(10)) == answers(tree, *range(10))


def test_a_copy_is_independent_and_keeps_the_windows_and_the_senders() -> None:
    tree = tree_of(*over("map", "base", range(0, 20 * SECOND, SECOND)), static("base", "lidar", authority="urdf"))
    twin = pickle.loads(pickle.dumps(tree))
    assert [edge.authority for edge in twin.edges()] == ["", "urdf"]
    twin.insert(moving("map", "base", 30 * SECOND, authority="odometry"))
    edges = {edge.child: edge for edge in twin.edges()}
    assert (edges["base"].oldest, edges["base"].authority) == (30 * SECOND, "odometry")
    assert {edge.child: edge.samples for edge in tree.edges()} == {"base": 11, "lidar": 1}


def test_the_tree_of_a_buffer_is_pickled_as_one_that_can_be_changed_and_a_buffer_says_so() -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        bus.publish([moving("map", "base", 1), static("base", "lidar")])
        twin = pickle.loads(pickle.dumps(buffer.tree))
        twin.insert(moving("map", "base", 2))
        assert [edge.samples for edge in twin.edges()] == [2, 1]
        for refused in (pickle.dumps, copy.copy, copy.deepcopy):
            with pytest.raises(TypeError, match=r"cannot be copied or pickled: use buffer\.tree\.copy\(\)"):
                refused(buffer)


@pytest.mark.thorough
def test_a_tree_goes_to_a_pool_of_new_processes() -> None:
    stamps = range(0, 1_000 * SECOND, SECOND // 100)
    tree = tree_of(*over("map", "base", stamps, 1e-9), static("base", "lidar", 2.0), keep=None)
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        futures = [pool.submit(tree.lookup_many, "map", "lidar", np.array([n * SECOND + 7])) for n in range(8)]
        found = [future.result(60).translations[0, 0] for future in futures]
    assert found == [pytest.approx(n + 7e-9 + 2.0, abs=1e-12) for n in range(8)]


def test_the_samples_on_either_side_of_a_stamp_are_those_that_were_sent() -> None:
    first, second = moving("map", "base", 10, 1.0, "a"), moving("odom", "base", 20, 2.0, "b")
    mount = static("base", "lidar", 3.0, 0, "urdf")
    tree = tree_of(first, second, mount)
    assert tree.samples_around("base", 15) == (first, second)
    assert tree.samples_around("base", 10) == (first, first)
    assert tree.samples_around("base", np.datetime64(20, "ns")) == (second, second)
    assert tree.samples_around("base", 9) == (None, first)
    assert tree.samples_around("base", 21) == (second, None)
    assert tree.samples_around("lidar", 99) == (mount, mount)
    assert tree.samples_around("map", 15) == (None, None)
    with pytest.raises(UnknownFrameError):
        tree.samples_around("bsae", 15)
    with pytest.raises(TypeError, match="from_seconds"):
        tree.samples_around("base", 1.5)  # type: ignore[arg-type]


def test_the_samples_of_a_frame_are_given_at_their_own_stamps() -> None:
    sent = [
        TransformStamped("map", "base", k * 10, Transform((float(k), 0.0, 0.0), (0.6, 0.0, 0.0, 0.8))) for k in range(5)
    ]
    tree = tree_of(*sent[::-1], static("base", "lidar", 3.0, 7), keep=None)
    found = tree.samples("base")
    assert list(found) == [sample.transform for sample in sent]
    assert found.stamps is not None
    assert found.stamps.tolist() == [0, 10, 20, 30, 40]
    for start, stop, kept in ((10, 30, [10, 20, 30]), (11, 29, [20]), (41, None, []), (None, 0, [0])):
        for part in (tree.samples("base", start, stop), found.between(start, stop)):
            assert part.stamps is not None
            assert part.stamps.tolist() == kept
            assert [pose.translation[0] * 10 for pose in part] == kept
    mount = tree.samples("lidar", 100, 200)
    assert (mount[0].translation, str(mount.stamps)) == ((3.0, 0.0, 0.0), "[7]")
    assert len(tree.samples("map")) == 0
    with pytest.raises(UnknownFrameError):
        tree.samples("bsae")
    with pytest.raises(ValueError, match="no stamps"):
        TransformArray(found.translations, found.rotations).between(1)


def test_the_samples_of_several_parents_are_not_mixed() -> None:
    tree = tree_of(*over("map", "base", (10, 20)), *over("odom", "base", (30, 40)), keep=None)
    with pytest.raises(ValueError, match=r"'map' first, 'odom' from 0\.00000003 s"):
        tree.samples("base")
    assert [len(tree.samples("base", *bounds)) for bounds in ((None, 29), (30, None))] == [2, 2]


def test_the_stamps_between_two_frames_are_those_that_all_moving_edges_cover() -> None:
    tree = tree_of(
        *over("map", "odom", range(30, 70, 10)),
        *over("odom", "base", range(25, 75)),
        static("base", "lidar"),
        keep=None,
    )
    assert tree.stamps("lidar", "map").tolist() == list(range(30, 61))
    assert tree.stamps("map", "lidar", 20, 32).tolist() == [30, 31, 32]
    assert tree.stamps("map", "odom").tolist() == [30, 40, 50, 60]
    assert tree.stamps("base", "lidar").tolist() == []
    assert tree.lookup_many("map", "lidar", tree.stamps("map", "lidar")).valid.all()


@pytest.mark.parametrize("stamps", [list(range(5)), [4, 2, 2, 0, 9]])
def test_columns_of_a_new_frame_are_stored_as_their_objects_would_be(stamps: list[int]) -> None:
    moves, turns = [[float(k), 0.0, 0.0] for k in range(5)], [[0.0, 0.0, 0.0, 1.0]] * 5
    by_columns, by_objects = tree_of(moving("map", "odom", 0)), tree_of(moving("map", "odom", 0))
    objects = [moving("odom", "base", stamp, float(k)) for k, stamp in enumerate(stamps)]
    assert by_columns.insert_columns("odom", "base", stamps, moves, turns) == by_objects.insert_many(objects)
    assert by_columns.edges() == by_objects.edges()
    assert list(by_columns.samples("base")) == list(by_objects.samples("base"))
    with pytest.raises(InvalidTransformError, match="loop of parents"):
        by_columns.insert_columns("base", "map", stamps, moves, turns)
    assert by_columns.frames() == ["base", "map", "odom"]
    assert by_columns.parent("map") is None


def test_what_is_older_than_a_stamp_can_be_deleted() -> None:
    tree = tree_of(*over("map", "base", range(10)), moving("base", "arm", 3), static("base", "lidar"), keep=None)
    tree.lookup("map", "lidar", 2)
    tree.forget_before(4)
    edges = {edge.child: (edge.samples, edge.oldest) for edge in tree.edges()}
    assert edges == {"base": (6, 4), "arm": (0, None), "lidar": (1, None)}
    assert not tree.can_transform("map", "lidar", 2)
    assert tree.lookup("map", "lidar", 4).transform.translation[0] == 4.0
    assert tree.frames() == ["arm", "base", "lidar", "map"]
    tree.insert(moving("map", "base", 2))
    assert tree.can_transform("map", "lidar", 2)


def test_a_parent_that_only_deleted_samples_name_is_forgotten() -> None:
    tree = tree_of(moving("map", "base", 1), moving("odom", "base", 5), keep=None)
    tree.forget_before(5)
    assert tree.frames() == ["base", "odom"]
