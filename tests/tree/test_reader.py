import math
import random
import sys
import threading
from array import array
from collections.abc import Callable
from functools import partial
from itertools import permutations, product
from types import FrameType
from typing import Any

import numpy as np
import pytest
from support.samples import moving, over, static, tree_of, x_of
from support.strategies import TODAY
from support.threads import threads_that

from tfbus import (
    LATEST,
    SECOND,
    Buffer,
    Bus,
    DisconnectedError,
    ExtrapolationError,
    FutureExtrapolationError,
    Latest,
    PastExtrapolationError,
    PointCloud,
    Transform,
    TransformStamped,
    TransformTree,
    UnknownFrameError,
)
from tfbus.stamps import STAMP_MAX, STAMP_MIN
from tfbus.testing import assert_close
from tfbus.tree._lookup_many import FEW, OutOfRange

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


def test_time_travel_to_the_latest_of_a_still_target_carries_the_stamp_of_the_source() -> None:
    tree = TransformTree()
    tree.insert_many([moving("map", "cart", 4, 4.0), moving("map", "cart", 6, 6.0)])
    found = tree.lookup("map", "cart", source_at=5, fixed="map")
    assert (found.stamp, found.static, found.transform.translation) == (5, False, (5.0, 0.0, 0.0))


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


# Many stamps


@pytest.mark.parametrize("times", [1, FEW])
@pytest.mark.parametrize(
    "made",
    [
        list,
        tuple,
        np.array,
        lambda stamps: np.array(stamps, np.uint8),
        lambda stamps: np.array(stamps, np.uint64),
        lambda stamps: np.array(stamps, ">i8"),
        lambda stamps: np.array(stamps, object),
        lambda stamps: np.repeat(stamps, 2)[::2],
        lambda stamps: array("q", stamps),
        lambda stamps: [np.int32(stamp) for stamp in stamps],
    ],
)
def test_any_integers_are_stamps_and_stay_as_they_are(made: Callable[[list[int]], Any], times: int) -> None:
    tree = tree_of(*over("a", "b", [0, 10]))
    stamps = made([7, 3, 10] * times)
    if isinstance(stamps, np.ndarray):
        stamps.flags.writeable = False
    expected = [7.0, 3.0, 10.0] * times
    assert tree.lookup_many("a", "b", stamps).translations[:, 0].tolist() == pytest.approx(expected)
    found = tree.lookup_many("a", "b", [99] * len(expected), source_at=stamps, fixed="a")
    assert found.translations[:, 0].tolist() == pytest.approx(expected)
    assert list(stamps) == [7, 3, 10] * times


@pytest.mark.parametrize("stamps", [[], (), np.array([], np.int64), np.array([])])
def test_of_no_stamps_there_are_no_transforms(stamps: Any) -> None:
    tree = tree_of(*over("a", "b", [0, 10]))
    for source in "ab":
        assert len(tree.lookup_many("a", source, stamps)) == 0
        assert len(tree.lookup_many("a", source, stamps, source_at=stamps, fixed="a")) == 0
        assert len(tree.lookup_many("a", source, stamps, source_at=5, fixed="a", out_of_range="nan")) == 0


@pytest.mark.parametrize("stamps", [[], [5], [5] * 100])
@pytest.mark.parametrize("names", [("nobody", "b", "a"), ("a", "nobody", "b"), ("a", "b", "nobody")])
@pytest.mark.parametrize("out_of_range", ["raise", "nan"])
def test_many_lookups_are_of_known_frames_even_if_there_are_none(
    stamps: list[int], names: tuple[str, str, str], out_of_range: OutOfRange
) -> None:
    tree = tree_of(*over("a", "b", [0, 10]))
    target, source, fixed = names
    with pytest.raises(UnknownFrameError) as caught:
        tree.lookup_many(target, source, stamps, source_at=stamps, fixed=fixed, out_of_range=out_of_range)
    assert (caught.value.frame, caught.value.index) == ("nobody", None)
    if "nobody" in (target, source):
        with pytest.raises(UnknownFrameError):
            tree.lookup_many(target, source, stamps, out_of_range=out_of_range)


@pytest.mark.parametrize("bad", [1.5, True, None, LATEST, "5", np.float64(5.0), np.True_])
@pytest.mark.parametrize("others", [[], [5], [5] * 100])
def test_stamps_that_are_no_integers_are_a_type_error_wherever_they_stand(bad: Any, others: list[int]) -> None:
    tree = tree_of(*over("a", "b", [0, 10]), static("a", "c"))
    for stamps in ([bad, *others], [*others, bad], np.array([bad, bad])):
        for source in "bc":
            with pytest.raises(TypeError, match="a stamp is an int"):
                tree.lookup_many("a", source, stamps)
            with pytest.raises(TypeError, match="a stamp is an int"):
                tree.lookup_many("a", source, [5] * len(stamps), source_at=stamps, fixed="a")


@pytest.mark.parametrize("bad", [1.5, True, LATEST, "5", np.float64(5.0)])
def test_a_second_instant_for_all_is_an_integer(bad: Any) -> None:
    with pytest.raises(TypeError, match="a stamp is an int"):
        tree_of(moving("a", "b", 5)).lookup_many("a", "b", [5], source_at=bad, fixed="a")


def test_floats_for_stamps_name_the_way_to_convert_them() -> None:
    with pytest.raises(TypeError, match=r"from_seconds\(1\.5\)"):
        tree_of(moving("a", "b", 5)).lookup_many("a", "b", [5, 1.5])


@pytest.mark.parametrize("stamps", [5, [[5]], np.zeros((2, 2), int), np.zeros((0, 3), int)])
def test_stamps_are_a_row(stamps: Any) -> None:
    with pytest.raises(ValueError, match="shape"):
        tree_of(moving("a", "b", 5)).lookup_many("a", "b", stamps)


@pytest.mark.parametrize("source_at", [[], [5], [5] * 3, [[5, 5]]])
def test_second_instants_are_one_or_as_many(source_at: Any) -> None:
    with pytest.raises(ValueError, match="shape"):
        tree_of(moving("a", "b", 5)).lookup_many("a", "b", [5, 5], source_at=source_at, fixed="a")


@pytest.mark.parametrize("stamps", [[2**63], [-1, 2**63], [-(2**63) - 1], np.array([2**63], np.uint64)])
def test_stamps_beyond_64_bits_are_a_value_error(stamps: Any) -> None:
    tree = tree_of(moving("a", "b", 5), static("a", "c"))
    for source in "bc":
        with pytest.raises(ValueError, match="64-bit"):
            tree.lookup_many("a", source, stamps)


@pytest.mark.parametrize("question", [{"source_at": [5]}, {"source_at": 5}, {"fixed": "a"}])
def test_for_many_too_a_second_instant_and_a_fixed_frame_go_together(question: dict[str, Any]) -> None:
    with pytest.raises(TypeError, match="source_at and fixed go together"):
        tree_of(moving("a", "b", 5)).lookup_many("a", "b", [5], **question)


@pytest.mark.parametrize("stamps", [[], [5], [5] * 100])
def test_what_is_out_of_range_is_raised_or_nan_and_nothing_else(stamps: list[int]) -> None:
    with pytest.raises(ValueError, match="'drop'"):
        tree_of(moving("a", "b", 5)).lookup_many("a", "b", stamps, out_of_range="drop")  # type: ignore[arg-type]


def test_many_lookups_find_the_frames_whole_while_another_thread_inserts() -> None:
    # With so short a window, nearly every insertion moves the samples down.
    tree = tree_of(moving("body", "left", 0), moving("body", "right", 0), static("left", "tip", 1.0), keep=60e-9)

    def read() -> None:
        newest = tree.lookup("body", "left").stamp
        stamps = np.arange(max(0, newest - 50), newest + 1)
        for few_or_many in (stamps[-20:], stamps):
            seen = tree.lookup_many("body", "tip", few_or_many, out_of_range="nan")
            assert (seen.translations[:, 0] == few_or_many + 1)[seen.valid].all()
            between = tree.lookup_many("left", "right", few_or_many, out_of_range="nan")
            assert not between.translations[between.valid].any()

    with threads_that(read):
        for stamp in range(1, 10_000):
            tree.insert_many(moving("body", side, stamp, float(stamp)) for side in ("left", "right"))


class NumpyFreeLock:
    """A lock that notes the functions which work on arrays while it is held."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.taken = 0
        self.seen: list[str] = []

    def __enter__(self) -> None:
        self._lock.acquire()
        self.taken += 1
        sys.setprofile(self._note)

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)
        self._lock.release()

    def _note(self, frame: FrameType, event: str, called: Any) -> None:
        at_hand = frame.f_locals.values() if event == "return" else [getattr(called, "__self__", None)]
        if any(isinstance(value, np.ndarray) for value in at_hand):
            self.seen.append(frame.f_code.co_qualname)


STAMPS = np.arange(10_000) % 2_001 * 10
LOCKED_QUESTIONS: list[Any] = [
    pytest.param(lambda tree: tree.lookup_many("map", "cart", STAMPS), id="plain"),
    pytest.param(lambda tree: tree.lookup_many("cart", "map", STAMPS + 50, tolerance=1.0, max_gap=1.0), id="policy"),
    pytest.param(lambda tree: tree.lookup_many("map", "guest", STAMPS), id="reparented"),
    pytest.param(lambda tree: tree.lookup_many("map", "guest", STAMPS, tolerance=1.0), id="reparented with a policy"),
    pytest.param(lambda tree: tree.lookup_many("map", "cart", STAMPS - 50, out_of_range="nan"), id="nan"),
    pytest.param(
        lambda tree: tree.lookup_many("cart", "cart", STAMPS, source_at=STAMPS[::-1], fixed="map"), id="time travel"
    ),
    pytest.param(lambda tree: tree.deskew(scan(np.zeros((10_000, 3)), STAMPS), "cart", "map"), id="deskew"),
    pytest.param(
        lambda tree: tree.deskew(scan(np.zeros((10_000, 3)), STAMPS - 50, 0), "cart", "map", out_of_range="nan"),
        id="deskew with nan",
    ),
]


@pytest.mark.parametrize("ask", LOCKED_QUESTIONS)
def test_no_array_is_worked_on_while_the_tree_is_locked(ask: Callable[[TransformTree], object]) -> None:
    tree = tree_of(*over("map", "cart", range(0, 20_001, 10)), static("cart", "lidar"))
    tree.insert_many([*over("cart", "guest", range(0, 10_000, 10)), *over("map", "guest", range(10_000, 20_001, 10))])
    watched: Any = tree
    watched._lock = lock = NumpyFreeLock()
    ask(tree)
    assert lock.taken
    assert lock.seen == []


def test_a_subscriber_may_ask_for_many_lookups_with_what_it_was_just_sent() -> None:
    bus = Bus()
    seen: list[list[float]] = []

    def ask(batch: tuple[TransformStamped, ...]) -> None:
        found = buffer.tree.lookup_many("a", "b", [sample.stamp for sample in batch])
        seen.append(found.translations[:, 0].tolist())

    with Buffer(bus) as buffer, bus.subscribe(ask):
        bus.publish(over("a", "b", [1, 2, 3]))
        bus.publish(over("a", "b", range(10, 100)))
    assert seen == [[1.0, 2.0, 3.0], [float(stamp) for stamp in range(10, 100)]]


# Clouds from a moving sensor


def scan(points: Any, stamps: Any, stamp: int | Latest = LATEST, **fields: Any) -> PointCloud:
    return PointCloud("lidar", stamp, np.asarray(points), stamps, fields)


def straight(time: float) -> Transform:
    return Transform((time, 0.0, 0.0))


def along(path: Callable[[float], Transform]) -> TransformTree:
    """A cart that goes on a path for 1 s, with a lidar on it, 1 m ahead and turned by a right angle."""
    tree = TransformTree()
    for percent in range(0, 101, 5):
        tree.insert(TransformStamped("odom", "cart", percent * SECOND // 100, path(percent / 100)))
    mount = Transform.from_axis_angle((0, 0, 1), math.pi / 2, (1.0, 0.0, 0.0))
    tree.insert(TransformStamped("cart", "lidar", 0, mount, static=True))
    return tree


def wall() -> tuple[Any, Any]:
    """300 points of a wall 9 m ahead of the start, and when each is seen."""
    y = np.linspace(-4.0, 4.0, 300)
    return np.column_stack((np.full(300, 9.0), y, y / 8.0)), np.linspace(0, SECOND, 300).astype(np.int64)


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(lambda time: Transform((3.0 * time, 0.0, 0.0)), id="straight on"),
        pytest.param(lambda time: Transform.from_axis_angle((0, 0, 1), 2.5 * time), id="on the spot"),
        pytest.param(lambda time: Transform.from_axis_angle((1, 2, 3), 2.5 * time, (time, -2 * time, 0)), id="both"),
    ],
)
@pytest.mark.parametrize("at", [LATEST, 0, SECOND // 2, SECOND])
def test_a_wall_that_was_seen_on_the_move_becomes_straight(
    path: Callable[[float], Transform], at: int | Latest
) -> None:
    tree = along(path)
    expected, stamps = wall()
    cart_from_lidar = Transform.from_axis_angle((0, 0, 1), math.pi / 2, (1.0, 0.0, 0.0))
    odom_from_lidar = [path(stamp / SECOND) @ cart_from_lidar for stamp in stamps.tolist()]
    seen = [pose.inverse().apply(tuple(point)) for pose, point in zip(odom_from_lidar, expected.tolist(), strict=True)]
    cloud = scan(seen, stamps, at)
    np.testing.assert_allclose(tree.deskew(cloud, "odom", "odom").points, expected, rtol=0, atol=1e-12)
    found = tree.deskew(cloud, "cart", "odom")
    now = SECOND if isinstance(at, Latest) else at
    assert (found.frame, found.stamp, found.stamps) == ("cart", now, None)
    np.testing.assert_allclose(found.points, path(now / SECOND).inverse().apply(expected), rtol=0, atol=1e-12)


def shaken(seed: int) -> TransformTree:
    """Two moving edges above the lidar and one beside it, each with poses of its own."""
    rng = np.random.default_rng(seed)
    tree = TransformTree()
    for parent, child in (("map", "odom"), ("odom", "cart"), ("map", "beacon")):
        for stamp in range(0, 1_001, 50):
            rotation = rng.normal(size=4)
            pose = Transform(rng.normal(size=3), rotation / np.linalg.norm(rotation))
            tree.insert(TransformStamped(parent, child, stamp, pose))
    tree.insert(TransformStamped("cart", "lidar", 0, Transform.from_xyz_rpy((1, 2, 3), (0.1, 0.2, 0.3)), static=True))
    return tree


FRAMES = ("lidar", "cart", "odom", "map", "beacon")


@pytest.mark.parametrize("target", FRAMES)
@pytest.mark.parametrize("fixed", FRAMES)
def test_a_cloud_is_moved_as_its_points_are_one_by_one(target: str, fixed: str) -> None:
    tree, rng = shaken(1), np.random.default_rng(2)
    points, stamps = rng.normal(size=(60, 3)), rng.integers(0, 1_001, 60)
    found = tree.deskew(scan(points, stamps, 333), target, fixed)
    one_by_one = [
        tree.lookup(target, "lidar", 333, source_at=stamp, fixed=fixed).transform.apply(tuple(point))
        for point, stamp in zip(points.tolist(), stamps.tolist(), strict=True)
    ]
    np.testing.assert_allclose(found.points, one_by_one, rtol=0, atol=1e-12 * 10)
    assert (found.frame, found.stamp) == (target, 333)


def test_a_cloud_of_more_points_than_fit_the_cache_is_moved_as_its_parts_are() -> None:
    tree, rng = shaken(1), np.random.default_rng(2)
    points, stamps = rng.normal(size=(5_000, 3)), rng.integers(0, 1_001, 5_000)
    whole = tree.deskew(scan(points, stamps, 500), "map", "odom").points
    for first in range(0, 5_000, 700):
        part = slice(first, first + 700)
        again = tree.deskew(scan(points[part], stamps[part], 500), "map", "odom").points
        np.testing.assert_allclose(whole[part], again, rtol=0, atol=1e-12)


def test_points_of_float32_stay_so_and_lose_only_their_own_rounding() -> None:
    tree, rng = shaken(1), np.random.default_rng(2)
    points, stamps = rng.normal(size=(500, 3)).astype(np.float32), rng.integers(0, 1_001, 500)
    single = tree.deskew(scan(points, stamps, 500), "map", "odom").points
    double = tree.deskew(scan(points.astype(np.float64), stamps, 500), "map", "odom").points
    assert (single.dtype, double.dtype) == (np.dtype(np.float32), np.dtype(np.float64))
    np.testing.assert_array_equal(single, double.astype(np.float32))


def test_what_else_is_known_of_the_points_is_carried_and_the_cloud_stays_as_it_was() -> None:
    points, stamps = np.zeros((2, 3)), np.array([0, SECOND])
    cloud = scan(points, stamps, SECOND, intensity=[0.5, 0.7], ring=[[1, 2], [3, 4]])
    found = along(straight).deskew(cloud, "cart", "odom")
    assert {name: column.tolist() for name, column in found.fields.items()} == {
        "intensity": [0.5, 0.7],
        "ring": [[1, 2], [3, 4]],
    }
    assert found.points.tolist() == [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    assert (cloud.frame, cloud.stamp, cloud.stamps is None) == ("lidar", SECOND, False)
    assert (points.tolist(), stamps.tolist()) == ([[0.0] * 3] * 2, [0, SECOND])


def test_the_latest_of_a_cloud_is_the_stamp_of_its_newest_point() -> None:
    tree = along(straight)
    cloud = scan(np.zeros((3, 3)), [SECOND // 4, SECOND // 2, 0])
    found = tree.deskew(cloud, "cart", "odom")
    assert found.stamp == SECOND // 2
    assert found.points[:, 0].tolist() == pytest.approx([0.75, 1.0, 0.5])


def test_a_missing_point_stays_missing_and_spoils_no_other() -> None:
    tree = along(straight)
    nowhere = (math.nan, 0.0, 0.0)
    found = tree.deskew(scan([(0, 0, 0), nowhere, (0, 0, 0)], [0, 5, SECOND]), "odom", "odom")
    assert found.points[[0, 2]].tolist() == pytest.approx(np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]))
    assert np.isnan(found.points[1]).any()


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_an_infinite_point_stays_not_finite_without_a_warning(dtype: Any) -> None:
    tree = along(lambda time: Transform.from_axis_angle((1, 2, 3), time, (time, 0.0, 0.0)))
    points = np.array([(np.inf, 0, 0), (0, -np.inf, 0), (np.inf, -np.inf, np.nan), (1, 2, 3)], dtype)
    for target in ("odom", "cart"):
        found = tree.deskew(scan(points, [0, 5, SECOND, SECOND // 2]), target, "odom")
        assert np.isfinite(found.points).all(axis=1).tolist() == [False, False, False, True]


def test_points_that_cannot_be_placed_are_an_error_that_names_the_first_or_nan() -> None:
    tree = along(straight)
    cloud = scan(np.zeros((4, 3), np.float32), [5, SECOND + 1, -1, 5], 0, ring=[1, 2, 3, 4])
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.deskew(cloud, "cart", "odom")
    assert (caught.value.index, caught.value.child, caught.value.stamp) == (1, "cart", SECOND + 1)
    found = tree.deskew(cloud, "cart", "odom", out_of_range="nan")
    assert np.isnan(found.points).all(axis=1).tolist() == [False, True, True, False]
    assert (found.points.dtype, found.fields["ring"].tolist()) == (np.dtype(np.float32), [1, 2, 3, 4])
    with pytest.raises(ValueError, match="'drop'"):
        tree.deskew(cloud, "cart", "odom", out_of_range="drop")  # type: ignore[arg-type]


@pytest.mark.parametrize("out_of_range", ["raise", "nan"])
def test_a_cloud_that_no_path_joins_with_the_fixed_frame_or_that_with_the_target_is_disconnected(
    out_of_range: OutOfRange,
) -> None:
    tree = along(straight)
    tree.insert_many([static("world", "tower")])
    for target, fixed in (("tower", "odom"), ("tower", "world")):
        with pytest.raises(DisconnectedError):
            tree.deskew(scan(np.zeros((2, 3)), [0, 5]), target, fixed, out_of_range=out_of_range)


def test_the_stamp_of_the_cloud_must_be_covered_though_its_points_are() -> None:
    tree = along(straight)
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.deskew(scan(np.zeros((2, 3)), [0, 5], 2 * SECOND), "cart", "odom")
    assert (caught.value.index, caught.value.stamp) == (None, 2 * SECOND)


@pytest.mark.parametrize("at", [LATEST, SECOND // 2])
def test_an_empty_cloud_stays_empty(at: int | Latest) -> None:
    tree = along(straight)
    found = tree.deskew(scan(np.zeros((0, 3), np.float32), [], at, ring=[]), "cart", "odom")
    assert (found.points.shape, found.points.dtype, found.frame) == ((0, 3), np.dtype(np.float32), "cart")
    assert found.stamp == (SECOND if at is LATEST else at)


@pytest.mark.parametrize("count", [0, 2])
@pytest.mark.parametrize(
    "names", [("nobody", "cart", "odom"), ("lidar", "nobody", "odom"), ("lidar", "cart", "nobody")]
)
def test_a_cloud_needs_three_frames_that_are_known(count: int, names: tuple[str, str, str]) -> None:
    frame, target, fixed = names
    cloud = PointCloud(frame, 0, np.zeros((count, 3)), [0] * count)  # type: ignore[arg-type]
    with pytest.raises(UnknownFrameError) as caught:
        along(straight).deskew(cloud, target, fixed)
    assert caught.value.frame == "nobody"


def test_points_without_stamps_cannot_be_deskewed() -> None:
    with pytest.raises(ValueError, match="no stamps"):
        along(straight).deskew(scan(np.zeros((2, 3)), None), "cart", "odom")
