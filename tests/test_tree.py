import gc
import math
import random
import sys
import threading
import tracemalloc
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from itertools import pairwise, permutations, product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import any_samples, moving, static
from strategies import TODAY

from tfbus import (
    LATEST,
    SECOND,
    DisconnectedError,
    Edge,
    ExtrapolationError,
    FutureExtrapolationError,
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
from tfbus.stamps import STAMP_MAX, STAMP_MIN
from tfbus.testing import assert_close


def tree_of(*batch: TransformStamped, keep: float | None = 10.0) -> TransformTree:
    tree = TransformTree(keep)
    tree.insert_many(batch)
    return tree


def over(parent: str, child: str, stamps: Iterable[int], speed: float = 1.0) -> list[TransformStamped]:
    """Samples at some stamps, x going at `speed` m a ns."""
    return [moving(parent, child, stamp, speed * stamp) for stamp in stamps]


def x_of(tree: TransformTree, target: str, source: str, at: int | Latest = LATEST, **question: Any) -> float:
    return tree.lookup(target, source, at, **question).transform.translation[0]


# The configurations of tf2's own tests: each child with its parent and its distance from it

CONFIGURATIONS = {
    "one link": {"2": ("1", 1.0)},
    "i": {"b": ("a", 1.0), "c": ("b", 2.0)},
    "v": {"b": ("a", 1.0), "c": ("b", 2.0), "f": ("a", 4.0), "g": ("f", 8.0)},
    "y": {"b": ("a", 1.0), "c": ("b", 2.0), "d": ("b", 4.0), "e": ("d", 8.0)},
}


def positions(edges: dict[str, tuple[str, float]]) -> dict[str, float]:
    """How far each frame is from the root."""
    places: dict[str, float] = {}
    for child, (parent, distance) in edges.items():
        places[child] = places.setdefault(parent, 0.0) + distance
    return places


@pytest.mark.parametrize("name", CONFIGURATIONS)
@pytest.mark.parametrize("stamp", [0, SECOND, 10 * SECOND, TODAY])
@pytest.mark.parametrize("space", [2, 1_000, 2 * SECOND])
def test_every_pair_of_a_configuration_is_answered_between_two_samples(name: str, stamp: int, space: int) -> None:
    edges = CONFIGURATIONS[name]
    tree = TransformTree()
    for child, (parent, distance) in edges.items():
        tree.insert(moving(parent, child, stamp - space // 2, distance - 0.5))
        tree.insert(moving(parent, child, stamp + space // 2, distance + 0.5))
    places = positions(edges)
    for target, source in product(places, places):
        found = tree.lookup(target, source, stamp)
        assert (found.parent, found.child, found.stamp) == (target, source, stamp)
        assert_close(found, Transform((places[source] - places[target], 0.0, 0.0)))


def test_two_trees_in_one_answer_inside_each_and_not_across() -> None:
    one, v = CONFIGURATIONS["one link"], CONFIGURATIONS["v"]
    tree = tree_of(*(moving(parent, child, 5, distance) for child, (parent, distance) in {**one, **v}.items()))
    inside = positions(one), positions(v)
    for places in inside:
        for target, source in product(places, places):
            assert x_of(tree, target, source, 5) == places[source] - places[target]
    for numbered, lettered in product(*inside):
        assert not tree.can_transform(numbered, lettered, 5)
        with pytest.raises(DisconnectedError) as caught:
            tree.lookup(lettered, numbered, 5)
        assert caught.value.roots == ("a", "1")


def test_a_ring_of_45_degrees_each_way_closes_after_eight_links() -> None:
    def place(number: int) -> Transform:
        """A frame on a circle of 1 m round (-1, 0), looking outwards, seen from number 0."""
        angle = number * math.pi / 4
        return Transform.from_axis_angle((0, 0, 1), angle, (math.cos(angle) - 1.0, math.sin(angle), 0.0))

    tree = TransformTree()
    for number in range(8):
        tree.insert(TransformStamped(str(number), str(number + 1), 5, place(1)))
        tree.insert(TransformStamped(str(-number), str(-number - 1), 5, place(-1)))
    for target, source in product(range(-8, 9), repeat=2):
        assert_close(tree.lookup(str(target), str(source), 5), place(source - target))
    assert_close(tree.lookup("0", "8", 5), Transform())


def test_a_compound_of_turned_links_is_the_product_of_their_matrices() -> None:
    links = {
        "a": ("root", Transform.from_xyz_rpy((1, 2, 3), (0.1, 0.2, 0.3))),
        "b": ("root", Transform.from_xyz_rpy((-1, 0, 2), (-1.2, 0.4, 2.0))),
        "c": ("b", Transform.from_xyz_rpy((0, -3, 1), (2.5, -0.7, -0.9))),
        "d": ("c", Transform.from_xyz_rpy((4, 1, -2), (0.0, 1.5, 3.0))),
    }
    tree = tree_of(*(TransformStamped(parent, child, 0, pose) for child, (parent, pose) in links.items()))
    root_from = {"root": np.eye(4)}
    for child, (parent, pose) in links.items():
        root_from[child] = root_from[parent] @ pose.matrix()
    for target, source in product(root_from, root_from):
        expected = np.linalg.inv(root_from[target]) @ root_from[source]
        assert np.allclose(tree.lookup(target, source, 0).transform.matrix(), expected, atol=1e-12)


# A carriage climbs at 0.5 m/s; on it an arm of 2 m turns at 0.3 rad/s: its tip runs on a helix.


def carriage(seconds: float) -> Transform:
    return Transform((0.0, 0.0, 0.5 * seconds))


def hub(seconds: float) -> Transform:
    return Transform.from_axis_angle((0, 0, 1), 0.3 * seconds)


def tip_in_world(seconds: float) -> Transform:
    angle = 0.3 * seconds
    centre = (2.0 * math.cos(angle), 2.0 * math.sin(angle), 0.5 * seconds)
    return Transform.from_axis_angle((0, 0, 1), angle, centre)


@pytest.fixture
def helix() -> TransformTree:
    tree = TransformTree(keep=None)
    for second in range(21):
        tree.insert(TransformStamped("world", "carriage", second * SECOND, carriage(second)))
        tree.insert(TransformStamped("carriage", "hub", second * SECOND, hub(second)))
    tree.insert(TransformStamped("hub", "tip", 0, Transform((2.0, 0.0, 0.0)), static=True))
    return tree


@pytest.mark.parametrize("seconds", [0.0, 0.25, 7.5, 19.875, 20.0])
def test_the_tip_of_a_turning_arm_on_a_climbing_carriage_runs_on_a_helix(helix: TransformTree, seconds: float) -> None:
    at = int(seconds * SECOND)
    assert_close(helix.lookup("world", "tip", at), tip_in_world(seconds))
    assert_close(helix.lookup("tip", "world", at), tip_in_world(seconds).inverse())


@pytest.mark.parametrize(("then", "now"), [(2.5, 11.25), (11.25, 2.5), (4.0, 4.0)])
def test_a_fixed_frame_joins_two_instants(helix: TransformTree, then: float, now: float) -> None:
    found = helix.lookup("tip", "tip", int(now * SECOND), source_at=int(then * SECOND), fixed="world")
    assert (found.parent, found.child, found.stamp, found.static) == ("tip", "tip", int(now * SECOND), False)
    assert_close(found, tip_in_world(now).inverse() @ tip_in_world(then))


def test_each_fixed_frame_gives_its_own_answer(helix: TransformTree) -> None:
    then, now = 2.5, 10.0
    question = partial(helix.lookup, "hub", "tip", int(now * SECOND), source_at=int(then * SECOND))
    # Seen from the carriage the hub only turns; seen from itself nothing has moved.
    turn = Transform.from_axis_angle((0, 0, 1), -0.3 * (now - then))
    assert_close(question(fixed="carriage"), turn @ Transform((2.0, 0.0, 0.0)))
    assert_close(question(fixed="hub"), Transform((2.0, 0.0, 0.0)))
    climbed = Transform((0.0, 0.0, -0.5 * (now - then)))
    assert_close(question(fixed="world"), turn @ Transform((2.0, 0.0, 0.0)) @ climbed)


# No extrapolation


@pytest.mark.parametrize("late", [0, 1, 7, 9, 10])
def test_between_two_samples_everything_is_answered_both_ways(late: int) -> None:
    tree = tree_of(
        *over("a", "b", [TODAY, TODAY + 10], speed=0.0), moving("b", "c", TODAY), moving("b", "c", TODAY + 10, 5.0)
    )
    assert x_of(tree, "a", "c", TODAY + late) == pytest.approx(late / 2, abs=1e-12)
    assert x_of(tree, "c", "a", TODAY + late) == pytest.approx(-late / 2, abs=1e-12)


@pytest.mark.parametrize(("at", "kind"), [(9, PastExtrapolationError), (21, FutureExtrapolationError)])
@pytest.mark.parametrize(("target", "source"), [("a", "b"), ("b", "a"), ("a", "c"), ("c", "a")])
def test_one_nanosecond_outside_is_an_error_with_all_facts(
    at: int, kind: type[ExtrapolationError], target: str, source: str
) -> None:
    tree = tree_of(
        moving("a", "b", 10, authority="odometry"), moving("a", "b", 20, authority="odometry"), static("b", "c")
    )
    with pytest.raises(kind) as caught:
        tree.lookup(target, source, at)
    error = caught.value
    assert (error.child, error.stamp, error.oldest, error.newest, error.authority) == ("b", at, 10, 20, "odometry")


@pytest.mark.parametrize("links", [1, 2])
def test_one_sample_answers_only_at_its_own_stamp_until_there_is_a_second(links: int) -> None:
    tree = tree_of(moving("a", "b", 10, 1.0), moving("b", "c", 10, 2.0))
    source = "bc"[links - 1]
    assert x_of(tree, "a", source, 10) == (1.0, 3.0)[links - 1]
    with pytest.raises(PastExtrapolationError):
        tree.lookup("a", source, 9)
    with pytest.raises(FutureExtrapolationError):
        tree.lookup(source, "a", 11)
    tree.insert_many([moving("a", "b", 12, 1.0), moving("b", "c", 12, 2.0)])
    assert x_of(tree, "a", source, 11) == (1.0, 3.0)[links - 1]


def test_a_stamp_of_zero_and_before_is_as_good_as_any() -> None:
    tree = tree_of(*over("a", "b", [-10, 0, 10]))
    assert x_of(tree, "a", "b", 0) == 0.0
    assert x_of(tree, "a", "b", -5) == -5.0
    assert not tree.can_transform("a", "b", -11)


def test_the_first_and_last_possible_stamps_can_be_asked() -> None:
    tree = tree_of(moving("a", "b", STAMP_MIN, 1.0), moving("a", "b", STAMP_MAX, 2.0), keep=None)
    assert x_of(tree, "a", "b", STAMP_MIN) == 1.0
    assert x_of(tree, "a", "b") == 2.0
    assert x_of(tree, "a", "b", 0) == pytest.approx(1.5)


def test_an_edge_that_is_over_decides_before_one_that_may_still_come() -> None:
    tree = tree_of(*over("a", "b", [0, 10]), *over("b", "c", [20, 30]))
    for target, source in (("a", "c"), ("c", "a")):
        with pytest.raises(PastExtrapolationError) as caught:
            tree.lookup(target, source, 15)
        assert caught.value.child == "c"


def test_of_several_edges_that_may_still_come_the_one_that_lags_most_is_named() -> None:
    tree = tree_of(*over("a", "b", [0, 12]), *over("b", "c", [0, 10]), *over("c", "d", [0, 11]))
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.lookup("a", "d", 15)
    assert (caught.value.child, caught.value.newest) == ("c", 10)


def test_an_edge_above_the_common_ancestor_neither_fails_a_lookup_nor_decides_its_stamp() -> None:
    tree = tree_of(*over("map", "body", [1, 2]), *over("body", "left", [50, 60]), *over("body", "right", [50, 60]))
    assert tree.lookup("left", "right", 55).stamp == 55
    assert tree.lookup("left", "right").stamp == 60
    assert tree.lookup("body", "right").stamp == 60
    with pytest.raises(ExtrapolationError) as caught:
        tree.lookup("map", "right", 55)
    assert caught.value.child == "body"


# LATEST


def test_latest_is_the_newest_stamp_that_every_moving_edge_can_answer() -> None:
    tree = tree_of(*over("a", "b", [0, 30]), *over("b", "c", [0, 20]), static("c", "d", 100.0, stamp=999))
    found = tree.lookup("a", "d")
    assert (found.stamp, found.static) == (20, False)
    assert found.transform.translation[0] == 20.0 + 20.0 + 100.0
    assert tree.latest_common_stamp("a", "d") == 20


def test_latest_follows_the_lagging_edge_whatever_the_order_of_insertion() -> None:
    for order in permutations([*over("a", "b", [10, 20]), *over("a", "c", [12, 17])]):
        tree = tree_of(*order)
        assert tree.latest_common_stamp("b", "c") == 17
        assert tree.lookup("c", "b").stamp == 17
        tree.insert(moving("a", "c", 25))
        assert tree.lookup("c", "b").stamp == 20


def test_an_edge_whose_newest_stamp_is_zero_has_its_say_in_what_is_latest() -> None:
    tree = tree_of(moving("a", "b", 0, 1.0), *over("b", "c", [-10, 10]))
    found = tree.lookup("a", "c")
    assert (found.stamp, found.transform.translation[0]) == (0, 1.0)


def test_latest_of_an_all_static_path_is_static_and_has_no_stamp_in_common() -> None:
    tree = tree_of(static("a", "b", 1.0, stamp=5), static("b", "c", 1.0, stamp=9), static("a", "d", stamp=7))
    assert tree.latest_common_stamp("a", "c") is None
    found = tree.lookup("a", "c")
    assert (found.static, found.stamp) == (True, 9)
    assert tree.lookup("b", "d").stamp == 7


def test_a_static_sample_sent_again_renews_the_stamp_of_latest() -> None:
    tree = tree_of(static("a", "b", stamp=5))
    assert tree.lookup("a", "b").stamp == 5
    tree.insert(static("a", "b", stamp=8))
    assert tree.lookup("a", "b").stamp == 8


@pytest.mark.parametrize(("target", "source"), [("a", "c"), ("c", "a")])
def test_where_an_edge_does_not_reach_back_to_latest_the_lagging_edge_is_short_of_it(target: str, source: str) -> None:
    tree = tree_of(moving("a", "b", 2, authority="dead"), *over("b", "c", [20, 22]))
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.lookup(target, source)
    error = caught.value
    assert (error.child, error.stamp, error.oldest, error.newest, error.authority) == ("b", 20, 2, 2, "dead")
    tree.insert(moving("a", "b", 20))
    assert tree.lookup(target, source).stamp == 20


def test_where_an_edge_does_not_reach_back_before_zero_the_lagging_edge_is_still_the_one_to_wait_for() -> None:
    tree = tree_of(moving("a", "b", -5), *over("b", "c", [0, 10]))
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.lookup("a", "c")
    assert (caught.value.child, caught.value.stamp) == ("b", 0)


def test_latest_with_an_edge_that_has_lost_its_samples_asks_for_any_of_it() -> None:
    tree = tree_of(moving("a", "b", 5), static("b", "c"))
    tree.clear()
    for question in (tree.lookup, tree.latest_common_stamp):
        with pytest.raises(FutureExtrapolationError) as caught:
            question("a", "c")
        error = caught.value
        assert (error.child, error.stamp, error.oldest, error.newest) == ("b", LATEST, None, None)


def test_latest_over_a_new_parent_asks_the_lagging_edge_to_come_further() -> None:
    tree = tree_of(*over("map", "base", [0, 5]), *over("elsewhere", "tool", [0, 4]), *over("base", "tool", [8, 9]))
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.lookup("map", "tool")
    assert (caught.value.child, caught.value.stamp) == ("base", 6)
    tree.insert(moving("map", "base", 8, 8.0))
    assert x_of(tree, "map", "tool") == 16.0


@pytest.mark.parametrize("not_before", [20, 19, -1])
def test_an_answer_that_is_not_older_than_asked_for_is_given(not_before: int) -> None:
    tree = tree_of(*over("a", "b", [0, 20]))
    assert tree.lookup("a", "b", not_before=not_before).stamp == 20


def test_an_older_answer_than_asked_for_counts_as_not_yet_arrived() -> None:
    tree = tree_of(*over("a", "b", [0, 30]), *over("b", "c", [0, 20]))
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.lookup("a", "c", not_before=21)
    assert (caught.value.child, caught.value.stamp, caught.value.newest) == ("c", 21, 20)
    assert not tree.can_transform("a", "c", not_before=21)


def test_what_is_static_is_never_too_old() -> None:
    tree = tree_of(static("a", "b", stamp=1))
    assert tree.lookup("a", "b", not_before=10**18).static
    assert tree.lookup("a", "a", not_before=10**18).static


def test_not_before_reaches_both_legs_of_a_lookup_over_a_fixed_frame() -> None:
    tree = tree_of(*over("map", "a", [0, 30]), *over("map", "b", [0, 20]))
    assert tree.lookup("a", "b", source_at=5, fixed="map", not_before=30).stamp == 30
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.lookup("a", "b", source_at=LATEST, fixed="map", not_before=30)
    assert caught.value.child == "b"


# The window


def test_exactly_the_length_of_the_window_can_be_asked_back() -> None:
    for keep in range(1, 100):
        tree = TransformTree(float(keep))
        for second in range(101):
            tree.insert(moving("a", "b", second * SECOND, float(second)))
        edge = (100 - keep) * SECOND
        assert x_of(tree, "a", "b", edge) == 100.0 - keep
        with pytest.raises(PastExtrapolationError) as caught:
            tree.lookup("a", "b", edge - 1)
        assert caught.value.oldest == edge


def test_each_edge_has_its_own_window() -> None:
    tree = tree_of(*over("a", "b", [0, 5]), *over("b", "c", [0, 1_000]), keep=10e-9)
    assert tree.lookup("a", "b", 0).stamp == 0
    assert not tree.can_transform("b", "c", 0)


def test_outcomes_are_given_and_counted() -> None:
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


def test_an_expired_sample_makes_no_frame_known() -> None:
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


def test_a_parent_that_only_a_late_sample_named_is_forgotten_as_soon_as_that_expires() -> None:
    tree = tree_of(moving("new", "b", 100), moving("old", "b", 90), keep=10e-9)
    assert "old" in tree
    tree.insert(moving("new", "b", 101))
    assert "old" not in tree


@pytest.mark.parametrize("stamp", [0, 10, 20])
def test_the_last_of_two_samples_at_one_stamp_wins(stamp: int) -> None:
    tree = tree_of(*over("a", "b", [0, 10, 20]))
    tree.lookup("a", "b", stamp)
    assert tree.insert(moving("a", "b", stamp, 500.0)) is Outcome.REPLACED
    assert x_of(tree, "a", "b", stamp) == 500.0


def test_late_data_change_the_answer_between_their_neighbours() -> None:
    tree = tree_of(*over("a", "b", [0, 20]))
    assert x_of(tree, "a", "b", 10) == 10.0
    tree.insert(moving("a", "b", 10, -7.0))
    assert x_of(tree, "a", "b", 10) == -7.0
    assert x_of(tree, "a", "b", 15) == pytest.approx(6.5)


def test_late_data_lengthen_the_past_of_a_path_that_was_asked_before() -> None:
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
def test_a_window_must_be_a_duration(keep: Any, error: type[Exception]) -> None:
    with pytest.raises(error, match="keep"):
        TransformTree(keep)


# Loops


def test_an_edge_that_closes_a_loop_is_refused_and_nothing_is_stored() -> None:
    tree = tree_of(moving("a", "b", 0), moving("b", "c", 0))
    edges, frames = tree.edges(), tree.frames()
    with pytest.raises(InvalidTransformError) as caught:
        tree.insert_many([moving("x", "y", 1), moving("c", "a", 1, authority="culprit"), moving("a", "b", 1)])
    error = caught.value
    assert (error.reason, error.parent, error.child, error.authority) == ("cycle", "c", "a", "culprit")
    assert error.loop == ("a", "c", "b", "a")
    assert (tree.edges(), tree.frames(), tree.inserted) == (edges, frames, 2)


def test_one_batch_may_turn_an_edge_round() -> None:
    tree = tree_of(moving("map", "base", 0, 5.0))
    tree.insert_many([moving("base", "map", 10, -7.0), moving("world", "base", 10, 100.0)])
    assert tree.chain("world", "map") == ["world", "base", "map"]
    assert x_of(tree, "world", "map", 10) == 93.0
    assert x_of(tree, "base", "map", 10) == -7.0
    assert x_of(tree, "map", "base", 0) == 5.0, "the past stays as it was"


def test_a_loop_that_late_data_form_in_the_past_is_an_error_there_and_only_there() -> None:
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
def test_no_order_of_parents_over_time_makes_a_lookup_hang(history: list[tuple[str, str, int]]) -> None:
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


# Parents over time


def test_old_stamps_answer_with_the_old_parent_and_the_old_value_is_held_until_the_new_one() -> None:
    tree = tree_of(
        *over("left", "b", [0, 10]),
        *over("right", "b", [20, 30]),
        static("root", "left", 100.0),
        static("root", "right", 500.0),
    )
    assert [x_of(tree, "root", "b", at) for at in (5, 10, 15, 19, 20, 25)] == [105.0, 110.0, 110.0, 110.0, 520.0, 525.0]
    assert [tree.parent("b", at) for at in (5, 19, 20, LATEST)] == ["left", "left", "right", "right"]
    assert tree.chain("root", "b", 19) == ["root", "left", "b"]
    assert tree.chain("root", "b") == ["root", "right", "b"]


def test_a_parent_in_another_tree_answers_only_for_its_own_time() -> None:
    tree = tree_of(*over("old", "b", [0, 10]), *over("new", "b", [20, 30]))
    assert x_of(tree, "old", "b", 5) == 5.0
    for at in (LATEST, 25):
        with pytest.raises(DisconnectedError) as caught:
            tree.lookup("old", "b", at)
        assert caught.value.roots == ("old", "new")


def test_two_parents_that_alternate_each_hold_until_the_next() -> None:
    tree = tree_of(static("w", "p", 0.0), static("w", "q", 100.0))
    for stamp in range(0, 50, 10):
        tree.insert(moving("pq"[stamp // 10 % 2], "b", stamp, float(stamp)))
    assert [x_of(tree, "w", "b", at) for at in (0, 5, 10, 15, 20, 40)] == [0.0, 0.0, 110.0, 110.0, 20.0, 40.0]


def test_a_new_parent_makes_a_frame_leave_its_subtree_with_all_below_it() -> None:
    tree = tree_of(*over("arm", "hand", [0, 10]), static("hand", "cup", 1.0), static("arm", "camera", 5.0))
    assert x_of(tree, "camera", "cup") == 10.0 + 1.0 - 5.0
    tree.insert(moving("table", "hand", 20, 3.0))
    with pytest.raises(DisconnectedError):
        tree.lookup("camera", "cup")
    assert x_of(tree, "table", "cup") == 4.0
    assert x_of(tree, "camera", "cup", 10) == 6.0


# Static


@pytest.mark.parametrize("at", [STAMP_MIN, -1, 0, 100, 1_000, STAMP_MAX])
def test_a_static_edge_answers_at_every_stamp_with_that_stamp(at: int) -> None:
    tree = tree_of(static("a", "b", 1.0, stamp=50), static("b", "c", 2.0))
    found = tree.lookup("a", "c", at)
    assert (found.stamp, found.static, found.transform.translation[0]) == (at, True, 3.0)


def test_a_static_and_a_moving_edge_answer_where_the_moving_one_does() -> None:
    tree = tree_of(static("a", "b", 1.0), *over("b", "c", [10, 20]), static("c", "d", 2.0))
    assert [tree.can_transform("a", "d", at) for at in (0, 9, 10, 15, 20, 21)] == [
        False,
        False,
        True,
        True,
        True,
        False,
    ]
    assert x_of(tree, "a", "d", 15) == 18.0
    assert not tree.lookup("a", "d", 15).static


def test_a_new_static_parent_moves_all_below_and_cuts_the_old_link() -> None:
    tree = tree_of(static("a", "b", 1.0), static("b", "c", 2.0), static("a", "d", 10.0))
    assert x_of(tree, "a", "c") == 3.0
    tree.insert(static("d", "b", 5.0))
    assert x_of(tree, "a", "c", 0) == 17.0
    assert tree.chain("a", "c") == ["a", "d", "b", "c"]
    tree.insert(static("elsewhere", "b"))
    with pytest.raises(DisconnectedError):
        tree.lookup("a", "c")


def test_static_data_drop_the_moving_history_of_a_frame() -> None:
    tree = tree_of(*over("a", "b", [0, 10]))
    assert not tree.can_transform("a", "b", 99)
    tree.insert(static("a", "b", 7.0))
    assert x_of(tree, "a", "b", 99) == 7.0
    assert x_of(tree, "a", "b", 5) == 7.0


def test_moving_data_drop_the_static_value_of_a_frame() -> None:
    tree = tree_of(static("a", "b", 7.0, stamp=100))
    assert x_of(tree, "a", "b", 50) == 7.0
    tree.insert(moving("a", "b", 10, 1.0))
    assert x_of(tree, "a", "b", 10) == 1.0
    with pytest.raises(FutureExtrapolationError):
        tree.lookup("a", "b", 50)


def test_after_a_clear_a_frame_may_become_static() -> None:
    tree = tree_of(*over("a", "b", [0, 10]))
    tree.clear()
    tree.insert(static("a", "b", 2.0))
    assert [x_of(tree, "a", "b", at) for at in (0, 5, 10**15)] == [2.0, 2.0, 2.0]


# Names


def test_a_frame_is_where_it_is() -> None:
    tree = tree_of(*over("a", "b", [0, 10]), static("a", "c", stamp=3))
    for frame, newest in (("a", 0), ("b", 10), ("c", 3)):
        found = tree.lookup(frame, frame)
        assert (found.transform, found.static, found.stamp) == (Transform.identity(), True, newest)
        assert tree.lookup(frame, frame, 12_345).stamp == 12_345


@pytest.mark.parametrize(
    ("target", "source", "missing"),
    [
        ("a", "nobody", "nobody"),
        ("nobody", "a", "nobody"),
        ("x", "y", "x"),
        ("x", "x", "x"),
        ("", "a", ""),
        ("a", "/b", "/b"),
    ],
)
@pytest.mark.parametrize("at", [LATEST, 0])
def test_an_unknown_frame_is_named_the_target_first(target: str, source: str, missing: str, at: int | Latest) -> None:
    tree = tree_of(moving("a", "b", 0))
    for question in (tree.lookup, tree.chain):
        with pytest.raises(UnknownFrameError) as caught:
            question(target, source, at)
        assert caught.value.frame == missing
    assert not tree.can_transform(target, source, at)


def test_an_unknown_frame_brings_the_names_that_look_like_it() -> None:
    tree = tree_of(moving("base_link", "base_laser", 0))
    with pytest.raises(UnknownFrameError, match="did you mean") as caught:
        tree.lookup("base_link", "base_lasr")
    assert caught.value.close_matches[0] == "base_laser"


def test_an_empty_tree_knows_nothing() -> None:
    tree = TransformTree()
    assert (tree.frames(), tree.edges()) == ([], [])
    with pytest.raises(UnknownFrameError):
        tree.lookup("a", "a")


def test_two_trees_are_disconnected_even_where_their_windows_would_not_cover_the_stamp() -> None:
    tree = tree_of(*over("a", "b", [0, 10]), *over("x", "y", [0, 10]))
    for at in (-100, 5, 100, LATEST):
        with pytest.raises(DisconnectedError) as caught:
            tree.lookup("b", "y", at)
        error = caught.value
        assert (error.target, error.source, error.roots) == ("b", "y", ("a", "x"))
        assert error.stamp == (None if at is LATEST else at)


def test_any_name_will_do_even_one_that_tf2_keeps_for_itself() -> None:
    tree = tree_of(moving("NO_PARENT", "base link", 0, 1.0), moving("base link", "küche/🦾", 0, 1.0))
    assert x_of(tree, "NO_PARENT", "küche/🦾", 0) == 2.0


def test_each_frame_has_the_parent_that_its_samples_name() -> None:
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


def test_frames_are_those_that_any_sample_names_sorted() -> None:
    tree = tree_of(moving("world", "base", 0), static("base", "camera"))
    assert tree.frames() == ["base", "camera", "world"]
    assert "world" in tree
    assert "moon" not in tree


def test_edges_tell_what_there_is_of_each_frame_sorted_by_name() -> None:
    tree = tree_of(
        *over("map", "base", range(0, SECOND + 1, SECOND // 10)), static("base", "arm", authority="urdf"), keep=0.5
    )
    assert tree.edges() == [
        Edge("base", "arm", static=True, samples=1, oldest=None, newest=None, authority="urdf"),
        Edge("map", "base", static=False, samples=6, oldest=SECOND // 2, newest=SECOND, authority=""),
    ]
    assert tree.edges()[1].rate == 10.0


@pytest.mark.parametrize("at", [LATEST, 5])
def test_the_chain_goes_from_target_to_source_and_back(at: int | Latest) -> None:
    tree = tree_of(*(moving(parent, child, 5) for child, (parent, _) in CONFIGURATIONS["v"].items()))
    assert tree.chain("c", "g", at) == ["c", "b", "a", "f", "g"]
    assert tree.chain("a", "c", at) == ["a", "b", "c"]
    assert tree.chain("c", "b", at) == ["c", "b"]
    assert tree.chain("g", "g", at) == ["g"]


# Two instants


def test_the_motion_of_a_frame_between_two_instants_needs_a_fixed_frame() -> None:
    tree = tree_of(*over("map", "cart", [0, 10]))
    assert x_of(tree, "cart", "cart", 8, source_at=3, fixed="map") == -5.0
    assert x_of(tree, "map", "cart", 8, source_at=3, fixed="map") == 3.0
    assert x_of(tree, "cart", "cart", source_at=3, fixed="map") == -7.0
    assert x_of(tree, "cart", "cart", 8, source_at=LATEST, fixed="map") == 2.0


def test_a_fixed_frame_that_is_target_or_source_holds_at_any_stamp() -> None:
    tree = tree_of(*over("map", "cart", [0, 10]))
    assert x_of(tree, "map", "cart", 10**6, source_at=4, fixed="map") == 4.0
    assert x_of(tree, "map", "cart", 4, source_at=10**6, fixed="cart") == 4.0


def test_an_answer_between_two_instants_is_static_only_if_both_ways_are() -> None:
    tree = tree_of(*over("map", "cart", [0, 10]), static("map", "wall", 50.0), static("map", "door", 20.0))
    assert tree.lookup("wall", "door", 3, source_at=99, fixed="map").static
    assert not tree.lookup("wall", "cart", 99, source_at=3, fixed="map").static
    assert not tree.lookup("cart", "wall", 3, source_at=99, fixed="map").static


@pytest.mark.parametrize("names", [("nobody", "b", "a"), ("a", "nobody", "b"), ("a", "b", "nobody")])
def test_every_frame_of_a_lookup_between_two_instants_must_be_known(names: tuple[str, str, str]) -> None:
    tree = tree_of(*over("a", "b", [0, 10]))
    target, source, fixed = names
    with pytest.raises(UnknownFrameError) as caught:
        tree.lookup(target, source, 0, source_at=10**6, fixed=fixed)
    assert caught.value.frame == "nobody"


@pytest.mark.parametrize(
    ("at", "source_at", "kind"),
    [
        (99, 5, FutureExtrapolationError),
        (5, 99, FutureExtrapolationError),
        (-1, 5, PastExtrapolationError),
        (5, -1, PastExtrapolationError),
        (99, -1, PastExtrapolationError),
        (-1, 99, PastExtrapolationError),
    ],
)
def test_waiting_is_of_no_use_if_either_instant_is_over(
    at: int, source_at: int, kind: type[ExtrapolationError]
) -> None:
    tree = tree_of(*over("map", "a", [0, 10]), *over("map", "b", [0, 10]))
    with pytest.raises(kind):
        tree.lookup("a", "b", at, source_at=source_at, fixed="map")


def test_a_fixed_frame_in_another_tree_is_disconnected_whatever_the_stamps() -> None:
    tree = tree_of(*over("map", "a", [0, 10]), *over("world", "b", [0, 10]))
    for at, source_at in ((5, 5), (99, 99), (99, 5)):
        with pytest.raises(DisconnectedError):
            tree.lookup("a", "b", at, source_at=source_at, fixed="map")


# Arguments


@pytest.mark.parametrize("question", [{"at": 1.5}, {"at": 5, "source_at": 1.5, "fixed": "a"}])
def test_a_float_for_a_stamp_names_the_way_to_convert_it(question: dict[str, Any]) -> None:
    tree = tree_of(moving("a", "b", 5))
    with pytest.raises(TypeError, match=r"from_seconds\(1\.5\)"):
        tree.lookup("a", "b", **question)
    with pytest.raises(TypeError, match="from_seconds"):
        tree.can_transform("a", "b", **question)


@pytest.mark.parametrize("question", [{"source_at": 5}, {"fixed": "a"}, {"source_at": LATEST}])
def test_a_second_instant_and_a_fixed_frame_go_together(question: dict[str, Any]) -> None:
    with pytest.raises(TypeError, match="source_at and fixed go together"):
        tree_of(moving("a", "b", 5)).lookup("a", "b", 5, **question)


def test_not_before_goes_with_latest() -> None:
    tree = tree_of(moving("a", "b", 5))
    with pytest.raises(TypeError, match="LATEST"):
        tree.lookup("a", "b", 5, not_before=1)
    with pytest.raises(TypeError, match="LATEST"):
        tree.lookup("a", "b", 5, source_at=5, fixed="a", not_before=1)


@pytest.mark.parametrize("at", [True, None, "5", np.float64(5.0)])
def test_what_is_no_integer_is_no_stamp(at: Any) -> None:
    tree = tree_of(moving("a", "b", 5), static("a", "c"))
    for source in ("b", "c"):
        for question in (tree.lookup, tree.chain):
            with pytest.raises(TypeError, match="a stamp is an int"):
                question("a", source, at)


def test_any_integer_is_a_stamp_and_comes_back_as_an_int() -> None:
    tree = tree_of(moving("a", "b", 5))
    found = tree.lookup("a", "b", np.int64(5))  # type: ignore[arg-type]
    assert type(found.stamp) is int
    assert found.stamp == 5


@pytest.mark.parametrize("source", ["b", "c", "a"])
def test_a_stamp_beyond_64_bits_is_a_value_error(source: str) -> None:
    tree = tree_of(moving("a", "b", 5), static("a", "c"))
    with pytest.raises(ValueError, match="64-bit"):
        tree.lookup("a", source, 2**63)


@pytest.mark.parametrize("names", [("a", 5), (None, "a"), ("a", b"b")])
def test_a_frame_that_is_no_string_is_a_type_error(names: tuple[Any, Any]) -> None:
    with pytest.raises(TypeError, match="must be a str"):
        tree_of(moving("a", "b", 5)).lookup(*names)


@pytest.mark.parametrize("sample", [None, "a", {"parent": "a"}, Transform()])
def test_only_samples_are_inserted_and_a_batch_with_anything_else_is_not(sample: Any) -> None:
    tree = TransformTree()
    with pytest.raises(TypeError, match="TransformStamped"):
        tree.insert(sample)
    with pytest.raises(TypeError, match="TransformStamped"):
        tree.insert_many([moving("a", "b", 0), sample])
    assert tree.frames() == []


# Clearing, removing, copying


def test_clear_drops_what_moves_and_keeps_what_is_static_and_all_names() -> None:
    tree = tree_of(*over("map", "base", [0, 10]), static("base", "camera", 1.0))
    tree.clear()
    assert tree.frames() == ["base", "camera", "map"]
    assert x_of(tree, "base", "camera", 5) == 1.0
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.lookup("map", "camera", 5)
    error = caught.value
    assert (error.child, error.stamp, error.oldest, error.newest) == ("base", 5, None, None)


def test_after_a_clear_time_may_start_again() -> None:
    tree = tree_of(moving("map", "base", 100 * SECOND))
    tree.clear()
    assert tree.insert(moving("map", "base", 1, 4.0)) is Outcome.INSERTED
    assert x_of(tree, "map", "base", 1) == 4.0


@pytest.mark.parametrize("commit", [False, True])
@pytest.mark.parametrize("known", [False, True])
def test_after_a_clear_an_edge_may_come_back_the_other_way_round(commit: bool, known: bool) -> None:
    tree = tree_of(moving("map", "base", 0, 5.0))
    if known:
        tree.insert(moving("world", "map", 0))
    tree.clear()
    turned = moving("base", "map", 1, -2.0)
    if commit:
        tree.commit((turned,))
    else:
        tree.insert(turned)
    assert x_of(tree, "base", "map") == -2.0
    assert x_of(tree, "map", "base", 1) == 2.0
    assert tree.parent("base") is None


def test_a_removed_frame_leaves_its_parent_and_those_below_it_become_a_tree_of_their_own() -> None:
    tree = tree_of(static("map", "a"), *over("a", "b", [0, 10]), static("b", "c", 1.0), static("c", "d", 2.0))
    assert tree.can_transform("map", "d")
    tree.remove_frame("b")
    with pytest.raises(DisconnectedError) as caught:
        tree.lookup("map", "d")
    assert caught.value.roots == ("map", "b")
    assert x_of(tree, "b", "d", 5) == 3.0


def test_a_removed_leaf_is_unknown_with_the_parent_that_only_it_named() -> None:
    tree = tree_of(moving("a", "b", 0), moving("b", "c", 0))
    tree.remove_frame("b")
    assert tree.frames() == ["b", "c"]
    tree.remove_frame("c")
    assert tree.frames() == []
    with pytest.raises(UnknownFrameError):
        tree.remove_frame("c")


def test_a_root_stays_known_as_long_as_a_frame_hangs_on_it() -> None:
    tree = tree_of(moving("a", "b", 0))
    tree.remove_frame("a")
    assert tree.frames() == ["a", "b"]
    assert tree.lookup("a", "b", 0).stamp == 0


def test_a_removed_frame_may_come_back_elsewhere_and_earlier() -> None:
    tree = tree_of(moving("a", "b", 100 * SECOND), static("b", "c", 1.0))
    tree.remove_frame("b")
    tree.insert(moving("z", "b", 1, 3.0))
    assert x_of(tree, "z", "c", 1) == 4.0


def test_a_copy_answers_the_same_and_is_independent_of_the_original() -> None:
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


def test_a_chain_of_any_length_is_climbed_without_recursion(deep: TransformTree) -> None:
    assert sys.getrecursionlimit() < 5_000
    for at in (LATEST, 7):
        assert x_of(deep, "frame 0", "frame 5000", at) == 5_000.0
        assert x_of(deep, "frame 5000", "frame 0", at) == -5_000.0
    assert len(deep.chain("frame 5000", "frame 0")) == 5_001
    assert deep.describe().count("\n") == 5_000


def test_a_loop_of_any_length_is_found_and_named_in_full(deep: TransformTree) -> None:
    with pytest.raises(InvalidTransformError) as caught:
        deep.insert(moving("frame 5000", "frame 0", 7))
    assert caught.value.loop == ("frame 0", *(f"frame {depth}" for depth in reversed(range(5_001))))


def test_the_roots_of_deep_trees_are_found(deep: TransformTree) -> None:
    tree = deep.copy()
    tree.insert(moving("island", "palm", 7))
    with pytest.raises(DisconnectedError) as caught:
        tree.lookup("palm", "frame 5000", 7)
    assert caught.value.roots == ("island", "frame 0")


@pytest.mark.parametrize("seed", range(5))
def test_a_random_balanced_tree_has_its_frames_at_their_depth(seed: int) -> None:
    rng = random.Random(seed)
    depths = {"root": 0}
    tree = TransformTree()
    for number in range(200):
        parent = rng.choice(list(depths))
        depths[f"frame {number}"] = depths[parent] + 1
        tree.insert(moving(parent, f"frame {number}", 3, 1.0))
    for target, source in (rng.choices(list(depths), k=2) for _ in range(200)):
        assert x_of(tree, target, source) == depths[source] - depths[target]


# What is remembered between lookups

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
def test_no_lookup_ever_changes_what_a_later_one_answers(given: list[TransformStamped], keep: float | None) -> None:
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
def test_a_batch_that_was_judged_before_is_stored_as_any_other(
    batches: list[list[TransformStamped]], keep: float | None
) -> None:
    judged, committed = TransformTree(keep), TransformTree(keep)
    for batch in batches:
        try:
            judged.insert_many(batch)
        except InvalidTransformError:
            continue
        committed.commit(tuple(batch))
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
def test_any_order_of_insertion_gives_the_same_answers(order: list[int], parents: list[str]) -> None:
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
    """Fails if more than `limit` bytes are allocated in the block and not given back."""
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        yield
        gc.collect()
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after - before < limit


def test_memory_is_flat_while_samples_come_and_go() -> None:
    tree = TransformTree(keep=1e-6)

    def go_on(first: int, last: int) -> None:
        for stamp in range(first, last):
            tree.commit((moving("a", "b", stamp), moving("b", "c", stamp)))
            if stamp % 100 == 0:
                tree.lookup("a", "c")

    go_on(0, 2_000)
    with no_growth(200_000):
        go_on(2_000, 40_000)
    assert [edge.samples for edge in tree.edges()] == [1_001, 1_001]


def test_memory_is_flat_while_frames_of_ever_new_names_come_and_go() -> None:
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


def test_memory_is_flat_while_a_frame_gets_ever_new_parents() -> None:
    tree = TransformTree(keep=100e-9)
    for number in range(3_000):
        tree.insert(moving(f"parent {number}", "b", number))
        assert len(tree.frames()) <= 102


# Threads


@contextmanager
def threads_that(read: Callable[[], None]) -> Iterator[None]:
    """Two threads call `read` over and over while the block runs, and take turns as often as they can."""
    begun, done = threading.Barrier(3), threading.Event()

    def go_on() -> None:
        begun.wait()
        while not done.is_set():
            read()

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(2) as pool:
            readers = [pool.submit(go_on) for _ in range(2)]
            begun.wait()
            try:
                yield
            finally:
                done.set()
        for reader in readers:
            reader.result()
    finally:
        sys.setswitchinterval(interval)


@pytest.mark.parametrize("insert", [TransformTree.insert_many, TransformTree.commit])
def test_other_threads_see_all_of_a_batch_or_nothing(insert: Callable[[TransformTree, Any], object]) -> None:
    # Only the newest samples are kept, so half a batch would be an extrapolation.
    tree = tree_of(moving("body", "left", 0), moving("body", "right", 0), keep=0.0)

    def read() -> None:
        first, second = tree.lookup("left", "right"), tree.lookup("right", "left")
        assert first.transform == second.transform == Transform.identity()
        assert first.stamp <= second.stamp

    with threads_that(read):
        for stamp in range(1, 3_000):
            insert(tree, (moving("body", "left", stamp, float(stamp)), moving("body", "right", stamp, float(stamp))))


def test_other_threads_may_look_at_the_whole_tree_while_frames_come_and_go() -> None:
    tree = tree_of(static("map", "base"))

    def read() -> None:
        assert tree.parent("base") == "map"
        assert Edge("map", "base", True, 1, None, None, "") in tree.copy().edges()
        assert {"base", "map"} <= set(tree.frames())
        assert all("base" in picture for picture in (tree.describe(), tree.to_dot(), tree.to_yaml()))

    with threads_that(read):
        for number in range(500):
            frames = [f"frame {number} {below}" for below in range(5)]
            tree.insert_many([moving(parent, child, number) for parent, child in pairwise(["map", *frames])])
            for frame in frames:
                tree.remove_frame(frame)


def test_time_travel_to_the_latest_of_a_still_target_carries_the_stamp_of_the_source() -> None:
    tree = TransformTree()
    tree.insert_many([moving("map", "cart", 4, 4.0), moving("map", "cart", 6, 6.0)])
    found = tree.lookup("map", "cart", source_at=5, fixed="map")
    assert (found.stamp, found.static, found.transform.translation) == (5, False, (5.0, 0.0, 0.0))
