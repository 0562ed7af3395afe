"""Trees that are pickled and copied, and single samples that are read back."""

import copy
import multiprocessing
import pickle
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.samples import any_samples, moving, over, static, tree_of

from tfbus import LATEST, SECOND, Buffer, Bus, InvalidTransformError, TransformError, TransformTree, UnknownFrameError

COPIES: list[Callable[[TransformTree], TransformTree]] = [
    lambda tree: pickle.loads(pickle.dumps(tree)),
    copy.deepcopy,
    copy.copy,
]


def answers(tree: TransformTree, last: int) -> list[object]:
    """The answers of a tree to every question of a small world."""
    found: list[object] = [tree.edges(), tree.frames()]
    for target in tree.frames():
        for source in tree.frames():
            for at in (*range(last + 1), LATEST):
                try:
                    found.append(tree.lookup(target, source, at))
                except TransformError as error:
                    found.append(str(error))
    return found


@given(st.lists(any_samples("abc", 4), max_size=12), st.sampled_from([None, 2e-9]), st.sampled_from(COPIES))
def test_a_pickled_tree_answers_all_questions_as_the_one_that_it_was(
    samples: list[object], keep: float | None, copied: Callable[[TransformTree], TransformTree]
) -> None:
    tree = TransformTree(keep)
    for sample in samples:
        try:
            tree.insert(sample)  # type: ignore[arg-type]
        except InvalidTransformError:
            continue
    twin = copied(tree)
    assert (twin.keep, twin.max_translation) == (tree.keep, tree.max_translation)
    assert answers(twin, 4) == answers(tree, 4)
    for late in (moving("a", "d", 0), moving("d", "e", 9)):
        assert twin.insert(late) == tree.insert(late)
    assert answers(twin, 4) == answers(tree, 4)


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
    assert answers(copied(tree), 9) == answers(tree, 9)


def test_a_copy_is_independent_and_keeps_the_windows_and_the_senders() -> None:
    tree = tree_of(*over("map", "base", range(0, 20 * SECOND, SECOND)), static("base", "lidar", authority="urdf"))
    twin = pickle.loads(pickle.dumps(tree))
    assert [edge.authority for edge in twin.edges()] == ["", "urdf"]
    twin.insert(moving("map", "base", 30 * SECOND, authority="odometry"))
    edges = {edge.child: edge for edge in twin.edges()}
    assert (edges["base"].oldest, edges["base"].authority) == (30 * SECOND, "odometry")
    assert {edge.child: edge.samples for edge in tree.edges()} == {"base": 11, "lidar": 1}


def test_a_cleared_frame_stays_known_in_a_copy() -> None:
    tree = tree_of(moving("map", "base", 1, authority="odometry"))
    tree.clear()
    twin = pickle.loads(pickle.dumps(tree))
    assert (twin.frames(), twin.edges()) == (["base", "map"], tree.edges())


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


def test_the_tree_of_a_buffer_loses_samples_by_itself_only() -> None:
    with Bus() as bus, Buffer(bus) as buffer, pytest.raises(RuntimeError, match="a bus feeds this tree"):
        buffer.tree.forget_before(1)
