"""Many answers at once are the same as one after the other."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import cycle, islice
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.samples import moving, over, static, tree_of
from support.strategies import TODAY, transforms

from tfbus import (
    SECOND,
    DisconnectedError,
    FutureExtrapolationError,
    PastExtrapolationError,
    Transform,
    TransformArray,
    TransformLookupError,
    TransformStamped,
    TransformTree,
)
from tfbus.stamps import STAMP_MAX, STAMP_MIN
from tfbus.tree._lookup_many import FEW

FRAMES = "rsabcdef"
ROOTS = 2
METRES = 10.0


def more(stamps: Sequence[int]) -> list[int]:
    """The stamps over and over, more than a few."""
    return list(islice(cycle(stamps), max(FEW + 1, len(stamps))))


def facts(error: TransformLookupError) -> dict[str, object]:
    """The class, the message without the index, and all else that the error says."""
    said = {name: value for name, value in vars(error).items() if name != "index" and not name.startswith("_")}
    index = "" if error.index is None else f"stamps[{error.index}]: "
    return {**said, "class": type(error), "message": str(error).removeprefix(index)}


Expected = Sequence[Transform | TransformLookupError]


def answers(tree: TransformTree, target: str, source: str, stamps: Iterable[int], **question: Any) -> Expected:
    """One scalar lookup after the other; `source_at` has a stamp for each."""
    found: list[Transform | TransformLookupError] = []
    for number, at in enumerate(stamps):
        its_own = {name: value[number] if name == "source_at" else value for name, value in question.items()}
        try:
            found.append(tree.lookup(target, source, at, **its_own).transform)
        except TransformLookupError as error:
            found.append(error)
    return found


def is_severed(expected: Expected) -> bool:
    return all(isinstance(one, DisconnectedError) for one in expected)


def assert_same(found: TransformArray, expected: Expected) -> None:
    """NaN where an error is expected, and else the same to 1e-12 of the size of the numbers."""
    assert found.valid.tolist() == [isinstance(one, Transform) for one in expected]
    assert np.isnan(found.translations).all(axis=1).tolist() == (~found.valid).tolist()
    assert np.isnan(found.rotations).all(axis=1).tolist() == (~found.valid).tolist()
    rows = [(*one.translation, *one.rotation) for one in expected if isinstance(one, Transform)]
    columns = np.hstack((found.translations, found.rotations))[found.valid]
    np.testing.assert_allclose(columns, np.reshape(rows, (-1, 7)), rtol=0, atol=1e-12 * METRES)


def compare(lookup_many: Callable[..., TransformArray], expected: Expected, severed: bool) -> None:
    """The answers, or the first error, as expected; and so the answers with NaN, unless there is no path at all."""
    errors = [(index, one) for index, one in enumerate(expected) if isinstance(one, TransformLookupError)]
    if errors:
        with pytest.raises(TransformLookupError) as caught:
            lookup_many()
        assert (caught.value.index, facts(caught.value)) == (errors[0][0], facts(errors[0][1]))
    else:
        assert_same(lookup_many(), expected)
    if severed:
        with pytest.raises(DisconnectedError) as caught:
            lookup_many(out_of_range="nan")
        assert caught.value.index == 0
    else:
        assert_same(lookup_many(out_of_range="nan"), expected)


# Any tree


@st.composite
def scenes(draw: st.DrawFn) -> tuple[TransformTree, st.SearchStrategy[int]]:
    """A tree under one root or two, with the stamps that are worth asking.

    A frame is static, or moves on one parent, or on several in turn, with its samples in any order. All its parents
    come before it in the alphabet of `FRAMES`, so that nothing is refused.
    """
    first, step = draw(
        st.sampled_from([(0, 1), (-20, 10), (TODAY, SECOND // 10), (STAMP_MIN, 2**59), (STAMP_MAX, -(2**58) + 1)])
    )
    roots = draw(st.integers(1, ROOTS))
    tree = TransformTree(draw(st.sampled_from([None, None, abs(step) * 6e-9])))
    pose = transforms(METRES / len(FRAMES))
    for number in range(ROOTS, ROOTS + draw(st.integers(1, len(FRAMES) - ROOTS))):
        child, above = FRAMES[number], st.sampled_from(FRAMES[:roots] + FRAMES[ROOTS:number])
        parents = draw(st.lists(above, min_size=1, max_size=draw(st.sampled_from([1, 1, 1, 2]))))
        if draw(st.integers(0, 3)) == 0:
            tree.insert(TransformStamped(parents[0], child, 0, draw(pose), static=True))
            continue
        begin, end = draw(st.sampled_from([(0, 10), (0, 10), (0, 0), (2, 10), (0, 8)]))
        ticks = draw(st.lists(st.integers(begin, end), min_size=1, max_size=8, unique=True))
        for tick in {begin: None, end: None, **dict.fromkeys(ticks)}:
            parent = parents[tick * len(parents) // 11]
            tree.insert(TransformStamped(parent, child, first + step * tick, draw(pose)))
    ends = [stamp for edge in tree.edges() for stamp in (edge.oldest, edge.newest) if stamp is not None]
    near = sorted(ends) or [first]
    low, high = max(near[0] - 1, STAMP_MIN), min(near[-1] + 1, STAMP_MAX)
    worth = st.sampled_from(near) | st.integers(0, 10).map(lambda tick: first + step * tick)
    beside = st.tuples(worth, st.sampled_from([-1, 1])).map(lambda pair: min(max(sum(pair), STAMP_MIN), STAMP_MAX))
    return tree, st.integers(low, high) | worth | beside


@settings(max_examples=200)
@given(scenes(), st.data())
def test_many_lookups_are_the_same_as_one_after_the_other(
    scene: tuple[TransformTree, st.SearchStrategy[int]], data: st.DataObject
) -> None:
    tree, worth = scene
    stamps = data.draw(st.lists(worth, min_size=1, max_size=12))
    names = st.sampled_from(tree.frames())
    for ends in data.draw(st.lists(st.tuples(names, names), min_size=1, max_size=3)):
        for asked in (stamps, more(stamps)):
            expected = answers(tree, *ends, asked)
            compare(partial(tree.lookup_many, *ends, asked), expected, is_severed(expected))


@settings(max_examples=150)
@given(scenes(), st.data())
def test_many_lookups_over_a_fixed_frame_are_the_same_as_one_after_the_other(
    scene: tuple[TransformTree, st.SearchStrategy[int]], data: st.DataObject
) -> None:
    tree, worth = scene
    names = st.sampled_from(tree.frames())
    target, source, fixed = data.draw(st.tuples(names, names, names))
    pairs = data.draw(st.lists(st.tuples(worth, worth), min_size=1, max_size=12))
    stamps, then = (list(one) for one in zip(*pairs, strict=True))
    for asked, source_at in ((stamps, then), (more(stamps), more(then))):
        travel: dict[str, Any] = {"source_at": source_at, "fixed": fixed}
        legs = answers(tree, target, fixed, asked), answers(tree, fixed, source, source_at)
        expected = answers(tree, target, source, asked, **travel)
        compare(partial(tree.lookup_many, target, source, asked, **travel), expected, any(map(is_severed, legs)))


@pytest.mark.parametrize("asked", [FEW, FEW + 1, 200, 5_000])
def test_there_may_be_fewer_stamps_than_samples_or_more_or_more_than_fit_the_cache(asked: int) -> None:
    rng = np.random.default_rng(asked)

    def pose() -> Transform:
        rotation = rng.normal(size=4)
        return Transform(rng.normal(size=3), rotation / np.linalg.norm(rotation))

    tree = tree_of(*(TransformStamped("root", child, 0, pose(), static=True) for child in "pq"))
    for parent, child in ("pa", "ab", "qc"):
        for stamp in rng.choice(SECOND, 300, replace=False).tolist():
            now_on = "q" if child == "a" and stamp > SECOND // 2 else parent
            tree.insert(TransformStamped(now_on, child, stamp, pose()))
    stamps = rng.integers(SECOND // 10, SECOND - SECOND // 10, asked)
    for target, source in (("root", "b"), ("c", "b"), ("b", "c")):
        expected = [tree.lookup(target, source, at).transform for at in stamps.tolist()]
        assert_same(tree.lookup_many(target, source, stamps), expected)


# By hand: each question with few stamps and with many

each_number = pytest.mark.parametrize("asked", [list, more], ids=["few", "many"])
Asked = Callable[[Sequence[int]], list[int]]


def xs(found: TransformArray) -> list[float]:
    return [float(x) for x in found.translations[:, 0]]


@each_number
def test_stamps_come_in_any_order_and_more_than_once(asked: Asked) -> None:
    tree = tree_of(*over("a", "b", [0, 10, 20]), static("b", "c", 100.0))
    stamps = asked([20, 0, 7, 7, 13, 0])
    assert xs(tree.lookup_many("a", "c", stamps)) == pytest.approx([100.0 + stamp for stamp in stamps])
    assert xs(tree.lookup_many("c", "a", stamps)) == pytest.approx([-100.0 - stamp for stamp in stamps])


@each_number
def test_nothing_is_extrapolated_by_a_single_nanosecond(asked: Asked) -> None:
    tree = tree_of(*over("a", "b", [TODAY, TODAY + 10], speed=0.0))
    stamps = asked([TODAY, TODAY - 1, TODAY + 10, TODAY + 11])
    found = tree.lookup_many("a", "b", stamps, out_of_range="nan")
    assert found.valid.tolist() == [TODAY <= stamp <= TODAY + 10 for stamp in stamps]
    with pytest.raises(PastExtrapolationError) as past:
        tree.lookup_many("a", "b", stamps)
    assert (past.value.index, past.value.stamp, past.value.oldest) == (1, TODAY - 1, TODAY)
    with pytest.raises(FutureExtrapolationError) as future:
        tree.lookup_many("a", "b", stamps[2:])
    assert (future.value.index, future.value.stamp, future.value.newest) == (1, TODAY + 11, TODAY + 10)


@each_number
def test_what_has_left_the_window_is_out_of_range(asked: Asked) -> None:
    # The window's slack, a sixteenth, is ten here: what has left the window is still in memory.
    tree = tree_of(*over("a", "b", range(166)), keep=160e-9)
    found = tree.lookup_many("a", "b", asked([4, 5, 165]), out_of_range="nan")
    assert found.valid[:3].tolist() == [False, True, True]


@pytest.mark.parametrize("repeat", [1, 20])
def test_the_error_names_the_first_stamp_without_an_answer_and_the_window(repeat: int) -> None:
    tree = tree_of(*over("a", "b", [2 * SECOND, 12 * SECOND]))
    stamps = [5 * SECOND] * 17 + [SECOND, 13 * SECOND, 0] * repeat
    with pytest.raises(PastExtrapolationError) as caught:
        tree.lookup_many("a", "b", stamps)
    assert caught.value.index == 17
    text = "stamps[17]: frame 'b': asked for 1.000 s, oldest sample is 2.000 s (1 s too early)"
    assert str(caught.value) == text
    assert (caught.value.oldest, caught.value.newest) == (2 * SECOND, 12 * SECOND)


@each_number
def test_all_that_is_static_is_there_at_any_stamp(asked: Asked) -> None:
    tree = tree_of(static("a", "b", 1.0), static("b", "c", 2.0), static("a", "d", 10.0), moving("a", "e", 5))
    stamps = asked([STAMP_MIN, 0, STAMP_MAX])
    assert set(xs(tree.lookup_many("d", "c", stamps))) == {-7.0}
    assert set(xs(tree.lookup_many("e", "e", stamps))) == {0.0}


@each_number
def test_the_old_value_is_held_until_the_new_parent_begins(asked: Asked) -> None:
    tree = tree_of(
        *over("left", "b", [0, 10]),
        *over("right", "b", [20, 30]),
        static("w", "left", 100.0),
        static("w", "right", 5.0),
    )
    found = tree.lookup_many("w", "b", asked([25, 5, 10, 15, 19, 20]))
    assert xs(found)[:6] == pytest.approx([30.0, 105.0, 110.0, 110.0, 110.0, 25.0])


@each_number
def test_a_parent_in_another_tree_answers_only_for_its_own_time(asked: Asked) -> None:
    tree = tree_of(*over("old", "b", [0, 10]), *over("new", "b", [20, 30]))
    stamps = asked([5, 15, 20, 10])
    with pytest.raises(DisconnectedError) as caught:
        tree.lookup_many("old", "b", stamps)
    assert (caught.value.index, caught.value.stamp, caught.value.roots) == (2, 20, ("old", "new"))
    assert str(caught.value).startswith("stamps[2]: no path")
    found = tree.lookup_many("old", "b", stamps, out_of_range="nan")
    assert found.valid[:4].tolist() == [True, True, False, True]


@each_number
def test_where_there_is_no_path_at_any_stamp_nan_is_refused(asked: Asked) -> None:
    tree = tree_of(*over("a", "b", [0, 10]), *over("x", "y", [0, 10]))
    with pytest.raises(DisconnectedError) as caught:
        tree.lookup_many("b", "y", asked([5, 99]), out_of_range="nan")
    assert caught.value.index == 0


@each_number
def test_where_there_is_a_path_at_some_stamp_that_is_out_of_range_all_is_nan(asked: Asked) -> None:
    tree = tree_of(*over("old", "b", [0, 10]), *over("new", "b", [20, 30]))
    assert not tree.lookup_many("old", "b", asked([25, -1]), out_of_range="nan").valid.any()
    assert not tree.lookup_many("old", "b", asked([-1, 25]), out_of_range="nan").valid.any()


@each_number
def test_an_edge_that_turns_round_is_gone_along_the_way_it_has_at_each_stamp(asked: Asked) -> None:
    tree = tree_of(moving("earth", "map", 0), moving("map", "base", 0, 5.0))
    tree.insert_many([moving("base", "map", 10, -7.0), moving("world", "base", 10)])
    stamps = asked([0, 10])
    assert xs(tree.lookup_many("map", "base", stamps))[:2] == [5.0, 7.0]
    assert xs(tree.lookup_many("base", "map", stamps))[:2] == [-5.0, -7.0]


@each_number
def test_an_edge_that_has_lost_its_samples_covers_nothing(asked: Asked) -> None:
    tree = tree_of(*over("a", "b", [0, 10]), static("b", "c"))
    tree.clear()
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.lookup_many("a", "c", asked([5]))
    assert (caught.value.index, caught.value.child, caught.value.newest) == (0, "b", None)
    assert not tree.lookup_many("a", "c", asked([5]), out_of_range="nan").valid.any()


@each_number
def test_an_edge_above_the_common_ancestor_cannot_fail_a_lookup(asked: Asked) -> None:
    tree = tree_of(moving("map", "body", 1), *over("body", "left", [50, 60]), *over("body", "right", [50, 60], 2.0))
    stamps = asked([50, 55, 60])
    assert xs(tree.lookup_many("left", "right", stamps)) == pytest.approx([float(stamp) for stamp in stamps])


# Two instants


@each_number
def test_every_answer_may_have_two_instants_or_all_share_the_second(asked: Asked) -> None:
    tree = tree_of(*over("map", "cart", [0, 10]))
    stamps, then = asked([8, 2, 10]), asked([3, 9, 0])
    found = tree.lookup_many("cart", "cart", stamps, source_at=then, fixed="map")
    assert xs(found)[:3] == pytest.approx([-5.0, 7.0, -10.0])
    found = tree.lookup_many("cart", "cart", stamps, source_at=4, fixed="map")
    assert xs(found)[:3] == pytest.approx([-4.0, 2.0, -6.0])


@each_number
@pytest.mark.parametrize("at", [-1, 5, 99])
@pytest.mark.parametrize("source_at", [-1, 5, 99])
@pytest.mark.parametrize(("target", "source"), ["ab", "ay", "ya"])
def test_if_neither_instant_has_an_answer_the_error_is_that_of_the_scalar_lookup(
    asked: Asked, at: int, source_at: int, target: str, source: str
) -> None:
    tree = tree_of(*over("map", "a", [0, 10]), *over("map", "b", [0, 10]), *over("x", "y", [0, 10]))
    try:
        tree.lookup(target, source, at, source_at=source_at, fixed="map")
    except TransformLookupError as error:
        with pytest.raises(TransformLookupError) as caught:
            tree.lookup_many(target, source, asked([at]), source_at=source_at, fixed="map")
        assert caught.value.index == 0
        assert facts(caught.value) == facts(error)
    else:
        assert tree.lookup_many(target, source, asked([at]), source_at=source_at, fixed="map").valid.all()


@each_number
def test_each_instant_may_be_out_of_range_by_itself(asked: Asked) -> None:
    tree = tree_of(*over("map", "a", [0, 10]), *over("map", "b", [0, 20]))
    found = tree.lookup_many(
        "a", "b", asked([5, 11, 5, 11]), source_at=asked([15, 15, 21, 21]), fixed="map", out_of_range="nan"
    )
    assert found.valid[:4].tolist() == [True, False, False, False]
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.lookup_many("a", "b", asked([5, 5, 11]), source_at=asked([15, 21, 15]), fixed="map")
    assert (caught.value.index, caught.value.child) == (1, "b")


# What happens to the tree afterwards


@each_number
def test_answers_do_not_change_with_the_tree(asked: Asked) -> None:
    tree = tree_of(*over("a", "b", [0, 10, 20]))
    stamps = asked([1, 5, 15, 20])
    found = tree.lookup_many("a", "b", stamps)
    tree.insert_many([moving("a", "b", 10, -50.0), moving("z", "b", 20, -50.0)])
    tree.clear()
    tree.insert(static("a", "b", 7.0))
    assert xs(found) == pytest.approx([float(stamp) for stamp in stamps])
