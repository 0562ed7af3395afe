from collections.abc import Sequence

import numpy as np
import pytest
from support.samples import moving, over, static, tree_of

import tfbus
from tfbus import TransformStamped, TransformTree, UnknownFrameError
from tfbus.rows import Row
from tfbus.tree.history import Runs, Samples
from tfbus.tree.lookup_many import CopiedPath, PathsOverTime, Query, copy_paths
from tfbus.tree.tree import forest_of


def copies(tree: TransformTree, target: str, source: str, stamps: Sequence[int]) -> PathsOverTime:
    forest = forest_of(tree)
    query = Query(target, source, np.array(stamps, np.int64))
    with forest.lock:
        return copy_paths(forest, query, query.span())


def xs(samples: Samples) -> list[tuple[int, float]]:
    """The stamp and x of each copied sample."""
    return list(zip(samples.stamps.tolist(), samples.rows[:, 0].tolist(), strict=True))


@pytest.mark.parametrize("span", [(), (0, 5)])
@pytest.mark.parametrize(("target", "source"), [("nobody", "b"), ("b", "nobody")])
def test_an_unknown_frame_is_an_error_even_without_stamps(target: str, source: str, span: tuple[int, ...]) -> None:
    with pytest.raises(UnknownFrameError) as caught:
        copies(tree_of(moving("a", "b", 0)), target, source, span)
    assert caught.value.frame == "nobody"


def test_without_stamps_there_is_no_path() -> None:
    assert copies(tree_of(moving("a", "b", 0)), "a", "b", ()) == PathsOverTime([], [None])


@pytest.mark.parametrize(
    ("low", "high", "copied"),
    [
        (20, 30, [20, 30]),
        (21, 29, [20, 30]),
        (20, 20, [20]),
        (25, 41, [20, 30, 40, 50]),
        (-5, 5, [0, 10]),
        (45, 99, [40, 50]),
    ],
)
def test_the_samples_around_the_span_are_copied_in_stamp_order(low: int, high: int, copied: list[int]) -> None:
    tree = tree_of(*over("a", "b", [30, 0, 50, 10, 40, 20]))
    (path,) = copies(tree, "a", "b", (low, high)).paths
    assert path is not None
    (samples,) = path.moving
    assert list(samples.stamps) == copied
    assert xs(samples) == [(stamp, float(stamp)) for stamp in copied]
    assert samples.parents is None


def test_static_edges_are_one_row_and_both_sides_of_a_path_are_copied() -> None:
    tree = tree_of(
        static("root", "mast", 1.0),
        static("mast", "head", 2.0),
        *over("head", "eye", [0, 10]),
        *over("root", "arm", [0, 10], speed=2.0),
    )
    (path,) = copies(tree, "arm", "eye", (0, 10)).paths
    assert path is not None
    eye, mast = path.up
    assert isinstance(eye, Samples)
    assert xs(eye) == [(0, 0.0), (10, 10.0)]
    assert mast == (3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    (arm,) = path.down
    assert isinstance(arm, Samples)
    assert xs(arm) == [(0, 0.0), (10, 20.0)]
    assert path.moving == [eye, arm]


def test_copies_do_not_change_with_the_tree() -> None:
    tree = tree_of(*over("a", "b", [0, 10, 20]))
    (path,) = copies(tree, "a", "b", (0, 20)).paths
    assert path is not None
    tree.insert_many([moving("a", "b", 10, -50.0), moving("z", "b", 20, -50.0)])
    tree.clear()
    assert xs(path.moving[0]) == [(0, 0.0), (10, 10.0), (20, 20.0)]
    assert path.moving[0].parents is None


def reparented() -> tuple[TransformStamped, ...]:
    """Frame b under 'left' to 9, under 'right' from 10, under 'left' again from 20; 'right' is another tree."""
    return (
        static("root", "left"),
        static("moon", "right"),
        *(moving("left" if stamp < 10 or stamp >= 20 else "right", "b", stamp) for stamp in range(0, 30, 5)),
    )


@pytest.mark.parametrize(
    ("span", "changes", "connected"),
    [
        ((0, 9), [], [True]),
        ((0, 10), [10], [True, False]),
        ((10, 19), [], [False]),
        ((9, 20), [10, 20], [True, False, True]),
        ((20, 25), [], [True]),
    ],
)
def test_a_path_is_copied_for_each_time_between_two_changes_of_parents(
    span: tuple[int, int], changes: list[int], connected: list[bool]
) -> None:
    found = copies(tree_of(*reparented()), "root", "b", span)
    assert found.changes == changes
    assert [path is not None for path in found.paths] == connected


def test_the_same_path_is_copied_once() -> None:
    first, _, last = copies(tree_of(*reparented()), "root", "b", (0, 25)).paths
    assert first is last
    assert first is not None
    assert first.moving[0].parents == ["left", "left", "right", "right", "left", "left"]


def test_only_the_neighbours_are_copied_where_samples_outnumber_stamps() -> None:
    tree = tree_of(*over("a", "b", range(0, 5_000, 10)))
    (path,) = copies(tree, "a", "b", (4_001, 15, 30, 4_005)).paths
    assert path is not None
    (samples,) = path.moving
    neighbours = [10, 20, 30, 40, 4_000, 4_010]
    # The compiled kernel gives them all, as views.
    assert list(samples.stamps) == (neighbours if tfbus.kernel == "python" else list(range(10, 4_020, 10)))
    assert xs(samples) == [(stamp, float(stamp)) for stamp in samples.stamps]


def test_a_loop_in_the_past_splits_the_path_where_the_samples_of_a_way_begin_and_end() -> None:
    # a was on b until 10, and from 20 on b is on a.
    tree = tree_of(moving("b", "a", 0), moving("b", "a", 9), moving("c", "a", 10), moving("c", "a", 30))
    tree.insert_many(over("a", "b", [20, 30]))
    found = copies(tree, "a", "b", (0, 30))
    assert found.changes == [10, 20]
    assert [path is not None and len(path.up) for path in found.paths] == [0, 1, 1]


def test_changes_of_parents_elsewhere_split_no_permanent_path() -> None:
    tree = tree_of(*reparented(), *over("a", "c", [0, 30]))
    assert copies(tree, "a", "c", (0, 30)).changes == []


def samples(*stamps: int) -> Samples:
    return Samples((np.array(stamps, np.int64), 0, np.zeros((len(stamps), 7)), 0, 7, len(stamps)), Runs(), Runs())


STAMPS = np.array([15, 4, 10, 9, 20])
ROW = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def test_stamps_are_split_by_the_path_that_answers_them() -> None:
    path = CopiedPath((ROW,), ())
    other = CopiedPath((), (ROW,))
    ((places, only),) = PathsOverTime([], [path]).split(STAMPS)
    assert (np.arange(5)[places].tolist(), only) == ([0, 1, 2, 3, 4], path)
    split = PathsOverTime([10, 15, 20], [path, None, other, path]).split(STAMPS)
    assert [(np.arange(5)[places].tolist(), found) for places, found in split] == [
        ([1, 3, 4], path),
        ([2], None),
        ([0], other),
    ]


@pytest.mark.parametrize(
    ("up", "down", "covered"),
    [
        ((), (), [True] * 5),
        ((ROW, samples(4, 20)), (), [True] * 5),
        ((samples(4, 20),), (samples(5, 20), ROW), [True, False, True, True, True]),
        ((samples(0, 19), samples(9, 30)), (), [True, False, True, True, False]),
        ((samples(4, 20),), (samples(),), [False] * 5),
    ],
)
def test_a_path_covers_the_stamps_that_all_its_moving_edges_cover(
    up: tuple[Samples | Row, ...], down: tuple[Samples | Row, ...], covered: list[bool]
) -> None:
    path = CopiedPath(up, down)
    assert path.covered(STAMPS).tolist() == covered
    assert path.covers_all(STAMPS) == all(covered)
