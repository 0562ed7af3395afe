""""""

import inspect
import math
import pickle
import re
from functools import partial
from typing import Any

import numpy as np
import pytest
from support.samples import moving, over, static, tree_of, x_of

from tfbus import (
    LATEST,
    SECOND,
    Buffer,
    Bus,
    DisconnectedError,
    ExtrapolationError,
    FutureExtrapolationError,
    LaserScan,
    Latest,
    PastExtrapolationError,
    PointStamped,
    Transform,
    TransformLookupError,
    TransformStamped,
    TransformTree,
    UnknownFrameError,
    do_transform,
)
from tfbus.stamps import STAMP_MAX, STAMP_MIN
from tfbus.testing import assert_close
from tfbus.tree.forest import Forest
from tfbus.tree.lookup import Bounds, Extrapolation, Policy, find, find_in_time_travel, question_of
from tfbus.tree.tree import forest_of


def forest(*batch: TransformStamped) -> Forest:
    return forest_of(tree_of(*batch))


# Stamp, row and kind of an answer


def test_the_latest_answer_of_a_frame_in_itself_has_its_newest_stamp_and_zero_without_one() -> None:
    tree = tree_of(static("a", "b", stamp=0), moving("a", "c", 0), moving("a", "d", -7), moving("a", "e", 9))
    assert [tree.lookup(frame, frame).stamp for frame in "abcde"] == [0, 0, 0, -7, 9]
    tree.clear()
    assert [tree.lookup(frame, frame).stamp for frame in "abcde"] == [0, 0, 0, 0, 0]


def test_latest_is_looked_up_on_the_path_at_the_newest_common_stamp() -> None:
    known = forest(*over("map", "base", [0, 15]), *over("map", "tool", [0, 10], 3.0), *over("base", "tool", [20, 30]))
    stamp, row, is_static = find(known, "map", "tool", LATEST, None)
    assert (stamp, row[0], is_static) == (15, 30.0, False), "the new parent begins only at 20"


# Time travel


@pytest.mark.parametrize("target", ["wall", "map"])
@pytest.mark.parametrize(("source_at", "stamp"), [(3, 3), (LATEST, 10)])
def test_time_travel_to_latest_of_a_static_target_has_the_stamp_of_the_source(
    target: str, source_at: int | Latest, stamp: int
) -> None:
    known = forest(*over("map", "cart", [0, 10]), static("map", "wall", stamp=7))
    found = find_in_time_travel(known, target, "cart", LATEST, source_at, "map", None)
    assert (found[0], found[1][0], found[2]) == (stamp, float(stamp), False)
    assert find_in_time_travel(known, "wall", "map", LATEST, source_at, "map", None)[::2] == (7, True)


def test_time_travel_is_static_only_if_both_legs_are() -> None:
    tree = tree_of(*over("map", "cart", [0, 10]), static("map", "wall", 50.0), static("map", "door", 20.0))
    assert tree.lookup("wall", "door", 3, source_at=99, fixed="map").static
    assert not tree.lookup("wall", "cart", 99, source_at=3, fixed="map").static
    assert not tree.lookup("cart", "wall", 3, source_at=99, fixed="map").static


def test_a_leg_from_the_fixed_frame_to_itself_holds_at_any_stamp() -> None:
    tree = tree_of(*over("map", "cart", [0, 10]))
    assert x_of(tree, "map", "cart", 10**6, source_at=4, fixed="map") == 4.0
    assert x_of(tree, "map", "cart", 4, source_at=10**6, fixed="cart") == 4.0


@pytest.mark.parametrize(
    ("target", "at", "source", "source_at", "kind", "child"),
    [
        ("a", 99, "b", 5, FutureExtrapolationError, "a"),
        ("a", 5, "b", 99, FutureExtrapolationError, "b"),
        ("a", 99, "b", 99, FutureExtrapolationError, "b"),
        ("a", 99, "b", -1, PastExtrapolationError, "b"),
        ("a", 5, "b", -1, PastExtrapolationError, "b"),
        ("a", -1, "b", 5, PastExtrapolationError, "a"),
        ("a", -1, "b", 99, PastExtrapolationError, "a"),
        ("a", -1, "b", -1, PastExtrapolationError, "a"),
        ("y", 5, "b", 99, DisconnectedError, None),
        ("y", 5, "b", -1, PastExtrapolationError, "b"),
        ("a", 99, "y", 5, DisconnectedError, None),
        ("a", -1, "y", 5, PastExtrapolationError, "a"),
    ],
)
def test_of_two_failed_legs_the_one_that_waiting_cannot_help_raises(
    target: str, at: int, source: str, source_at: int, kind: type[TransformLookupError], child: str | None
) -> None:
    known = forest(*over("map", "a", [0, 10]), *over("map", "b", [0, 10]), *over("x", "y", [0, 10]))
    with pytest.raises(kind) as caught:
        find_in_time_travel(known, target, source, at, source_at, "map", None)
    assert getattr(caught.value, "child", None) == child


@pytest.mark.parametrize("names", [("nobody", "b", "a"), ("a", "nobody", "b"), ("a", "b", "nobody")])
def test_an_unknown_frame_raises_before_any_leg_is_looked_up(names: tuple[str, str, str]) -> None:
    target, source, fixed = names
    with pytest.raises(UnknownFrameError) as caught:
        find_in_time_travel(forest(moving("a", "b", 5)), target, source, -1, 99, fixed, None)
    assert caught.value.frame == "nobody"


# A carriage climbs at 0.5 m/s; on it an arm of 2 m turns at 0.3 rad/s: its tip moves on a helix


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
def test_the_tip_of_the_arm_moves_on_a_helix(helix: TransformTree, seconds: float) -> None:
    at = int(seconds * SECOND)
    assert_close(helix.lookup("world", "tip", at), tip_in_world(seconds))
    assert_close(helix.lookup("tip", "world", at), tip_in_world(seconds).inverse())


@pytest.mark.parametrize(("then", "now"), [(2.5, 11.25), (11.25, 2.5), (4.0, 4.0)])
def test_time_travel_composes_two_stamps_in_the_fixed_frame(helix: TransformTree, then: float, now: float) -> None:
    found = helix.lookup("tip", "tip", int(now * SECOND), source_at=int(then * SECOND), fixed="world")
    assert (found.parent, found.child, found.stamp, found.static) == ("tip", "tip", int(now * SECOND), False)
    assert_close(found, tip_in_world(now).inverse() @ tip_in_world(then))


def test_another_fixed_frame_gives_another_answer(helix: TransformTree) -> None:
    then, now = 2.5, 10.0
    question = partial(helix.lookup, "hub", "tip", int(now * SECOND), source_at=int(then * SECOND))
    # Seen from the carriage the hub only turns; seen from itself nothing has moved.
    turn = Transform.from_axis_angle((0, 0, 1), -0.3 * (now - then))
    assert_close(question(fixed="carriage"), turn @ Transform((2.0, 0.0, 0.0)))
    assert_close(question(fixed="hub"), Transform((2.0, 0.0, 0.0)))
    climbed = Transform((0.0, 0.0, -0.5 * (now - then)))
    assert_close(question(fixed="world"), turn @ Transform((2.0, 0.0, 0.0)) @ climbed)


# Stamps that are not covered


@pytest.mark.parametrize(("at", "kind"), [(9, PastExtrapolationError), (21, FutureExtrapolationError)])
@pytest.mark.parametrize(("target", "source"), [("a", "b"), ("b", "a"), ("a", "c"), ("c", "a")])
def test_one_nanosecond_outside_the_samples_is_an_error_with_all_facts(
    at: int, kind: type[ExtrapolationError], target: str, source: str
) -> None:
    tree = tree_of(
        moving("a", "b", 10, authority="odometry"), moving("a", "b", 20, authority="odometry"), static("b", "c")
    )
    with pytest.raises(kind) as caught:
        tree.lookup(target, source, at)
    error = caught.value
    assert (error.child, error.stamp, error.oldest, error.newest, error.authority) == ("b", at, 10, 20, "odometry")


def test_the_first_and_last_possible_stamps_can_be_looked_up() -> None:
    tree = tree_of(moving("a", "b", STAMP_MIN, 1.0), moving("a", "b", STAMP_MAX, 2.0), keep=None)
    assert x_of(tree, "a", "b", STAMP_MIN) == 1.0
    assert x_of(tree, "a", "b") == 2.0
    assert x_of(tree, "a", "b", 0) == pytest.approx(1.5)


def test_an_edge_above_the_common_ancestor_neither_fails_a_lookup_nor_decides_its_stamp() -> None:
    tree = tree_of(*over("map", "body", [1, 2]), *over("body", "left", [50, 60]), *over("body", "right", [50, 60]))
    assert tree.lookup("left", "right", 55).stamp == 55
    assert tree.lookup("left", "right").stamp == 60
    assert tree.lookup("body", "right").stamp == 60
    with pytest.raises(ExtrapolationError) as caught:
        tree.lookup("map", "right", 55)
    assert caught.value.child == "body"


# LATEST


def test_latest_of_an_all_static_path_is_static_without_a_common_stamp() -> None:
    tree = tree_of(static("a", "b", 1.0, stamp=5), static("b", "c", 1.0, stamp=9), static("a", "d", stamp=7))
    assert tree.latest_common_stamp("a", "c") is None
    found = tree.lookup("a", "c")
    assert (found.static, found.stamp) == (True, 9)
    assert tree.lookup("b", "d").stamp == 7


@pytest.mark.parametrize(("target", "source"), [("a", "c"), ("c", "a")])
def test_latest_waits_for_the_lagging_edge_until_all_edges_cover_a_common_stamp(target: str, source: str) -> None:
    tree = tree_of(moving("a", "b", 2, authority="dead"), *over("b", "c", [20, 22]))
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.lookup(target, source)
    error = caught.value
    assert (error.child, error.stamp, error.oldest, error.newest, error.authority) == ("b", 20, 2, 2, "dead")
    tree.insert(moving("a", "b", 20))
    assert tree.lookup(target, source).stamp == 20


def test_latest_waits_for_any_sample_of_an_edge_without_samples() -> None:
    tree = tree_of(moving("a", "b", 5), static("b", "c"))
    tree.clear()
    for question in (tree.lookup, tree.latest_common_stamp):
        with pytest.raises(FutureExtrapolationError) as caught:
            question("a", "c")
        error = caught.value
        assert (error.child, error.stamp, error.oldest, error.newest) == ("b", LATEST, None, None)


def test_latest_before_a_change_of_parent_waits_for_the_next_stamp_of_the_lagging_edge() -> None:
    tree = tree_of(*over("map", "base", [0, 5]), *over("elsewhere", "tool", [0, 4]), *over("base", "tool", [8, 9]))
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.lookup("map", "tool")
    assert (caught.value.child, caught.value.stamp) == ("base", 6)
    tree.insert(moving("map", "base", 8, 8.0))
    assert x_of(tree, "map", "tool") == 16.0


@pytest.mark.parametrize(("not_before", "fresh"), [(-1, True), (19, True), (20, True), (21, False)])
def test_latest_older_than_not_before_is_not_yet_available(not_before: int, fresh: bool) -> None:
    tree = tree_of(*over("a", "b", [0, 30]), *over("b", "c", [0, 20]))
    assert tree.can_transform("a", "c", not_before=not_before) is fresh
    if fresh:
        assert tree.lookup("a", "c", not_before=not_before).stamp == 20
    else:
        with pytest.raises(FutureExtrapolationError) as caught:
            tree.lookup("a", "c", not_before=not_before)
        assert (caught.value.child, caught.value.stamp, caught.value.newest) == ("c", not_before, 20)


def test_static_answers_are_never_too_old() -> None:
    tree = tree_of(static("a", "b", stamp=1))
    assert tree.lookup("a", "b", not_before=10**18).static
    assert tree.lookup("a", "a", not_before=10**18).static


def test_not_before_applies_to_both_legs_of_time_travel() -> None:
    tree = tree_of(*over("map", "a", [0, 30]), *over("map", "b", [0, 20]))
    assert tree.lookup("a", "b", source_at=5, fixed="map", not_before=30).stamp == 30
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.lookup("a", "b", source_at=LATEST, fixed="map", not_before=30)
    assert caught.value.child == "b"


# Parents over time


# Static edges


# Frames


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
def test_the_error_names_an_unknown_target_before_an_unknown_source(
    target: str, source: str, missing: str, at: int | Latest
) -> None:
    tree = tree_of(moving("a", "b", 0))
    for question in (tree.lookup, tree.chain):
        with pytest.raises(UnknownFrameError) as caught:
            question(target, source, at)
        assert caught.value.frame == missing
    assert not tree.can_transform(target, source, at)


def test_two_trees_are_disconnected_at_stamps_outside_their_windows_too() -> None:
    tree = tree_of(*over("a", "b", [0, 10]), *over("x", "y", [0, 10]))
    for at in (-100, 5, 100, LATEST):
        with pytest.raises(DisconnectedError) as caught:
            tree.lookup("b", "y", at)
        error = caught.value
        assert (error.target, error.source, error.roots) == ("b", "y", ("a", "x"))
        assert error.stamp == (None if at is LATEST else at)


def test_any_text_is_a_frame_name_also_one_that_tf2_reserves() -> None:
    tree = tree_of(moving("NO_PARENT", "base link", 0, 1.0), moving("base link", "küche/🦾", 0, 1.0))
    assert x_of(tree, "NO_PARENT", "küche/🦾", 0) == 2.0


@pytest.mark.parametrize("at", [LATEST, 5])
def test_the_chain_lists_the_frames_from_target_to_source(at: int | Latest) -> None:
    tree = tree_of(*(moving(parent, child, 5) for parent, child in ("ab", "bc", "af", "fg")))
    assert tree.chain("c", "g", at) == ["c", "b", "a", "f", "g"]
    assert tree.chain("a", "c", at) == ["a", "b", "c"]
    assert tree.chain("c", "b", at) == ["c", "b"]
    assert tree.chain("g", "g", at) == ["g"]


# Arguments


@pytest.mark.parametrize("question", [{"at": 1.5}, {"at": np.float64(1.5)}, {"at": 5, "source_at": 1.5, "fixed": "a"}])
def test_a_float_for_a_stamp_is_a_type_error_that_names_from_seconds(question: dict[str, Any]) -> None:
    tree = tree_of(moving("a", "b", 5))
    for ask in (tree.lookup, tree.can_transform):
        with pytest.raises(TypeError, match=r"from_seconds\(.*1\.5\)"):
            ask("a", "b", **question)


@pytest.mark.parametrize("question", [{"source_at": 5}, {"fixed": "a"}, {"source_at": LATEST}])
def test_source_at_without_fixed_and_fixed_without_source_at_are_type_errors(question: dict[str, Any]) -> None:
    tree = tree_of(moving("a", "b", 5))
    # The second time the path is known, and the question without these arguments has a plain answer.
    for _ in range(2):
        with pytest.raises(TypeError, match="source_at and fixed go together"):
            tree.lookup("a", "b", 5, **question)
        assert tree.lookup("a", "b", 5).stamp == 5


def test_not_before_without_latest_is_a_type_error() -> None:
    tree = tree_of(moving("a", "b", 5))
    assert tree.lookup("a", "b", 5).stamp == 5
    with pytest.raises(TypeError, match="LATEST"):
        tree.lookup("a", "b", 5, not_after=9)
    with pytest.raises(TypeError, match="LATEST"):
        tree.lookup("a", "b", 5, not_before=1)
    with pytest.raises(TypeError, match="LATEST"):
        tree.lookup("a", "b", 5, source_at=5, fixed="a", not_before=1)


@pytest.mark.parametrize("stamp", [True, None, "5"])
@pytest.mark.parametrize("source", ["b", "c"])
def test_a_stamp_that_is_no_integer_is_a_type_error(stamp: Any, source: str) -> None:
    tree = tree_of(moving("a", "b", 5), static("a", "c"))
    for ask in (tree.lookup, tree.chain):
        with pytest.raises(TypeError, match="a stamp is an int"):
            ask("a", source, stamp)
    if stamp is not None:
        with pytest.raises(TypeError, match="a stamp is an int"):
            tree.lookup("a", source, 5, source_at=stamp, fixed="a")


@pytest.mark.parametrize("at", [np.int64(5), np.datetime64(5, "ns")])
def test_a_number_or_a_date_of_numpy_is_a_stamp_and_is_returned_as_an_int(at: Any) -> None:
    tree = tree_of(moving("a", "b", 5), moving("z", "c", 1), moving("b", "c", 5), static("a", "d"))
    for question in ({}, {"tolerance": 1.0}, {"source_at": 5, "fixed": "a"}, {"source_at": at, "fixed": "a"}):
        for source in "bcd":
            found = tree.lookup("a", source, at, **question)
            assert type(found.stamp) is int
            assert found.stamp == 5


@pytest.mark.parametrize("source", ["b", "c", "a"])
def test_a_stamp_beyond_64_bits_is_a_value_error(source: str) -> None:
    tree = tree_of(moving("a", "b", 5), static("a", "c"))
    with pytest.raises(ValueError, match="64-bit"):
        tree.lookup("a", source, 2**63)


@pytest.mark.parametrize("names", [("a", 5), (None, "a"), ("a", b"b")])
def test_a_frame_name_that_is_no_str_is_a_type_error(names: tuple[Any, Any]) -> None:
    with pytest.raises(TypeError, match="must be a str"):
        tree_of(moving("a", "b", 5)).lookup(*names)


def test_what_is_too_old_for_latest_lacks_what_cannot_be_held() -> None:
    forest = forest_of(tree_of(*over("map", "base", (5, 10)), moving("base", "arm", 5)))
    extrapolation = Extrapolation(Policy(hold=3))
    with pytest.raises(FutureExtrapolationError) as caught:
        find(forest, "map", "arm", LATEST, Bounds(9, STAMP_MAX), extrapolation)
    assert (caught.value.child, caught.value.stamp, caught.value.slack) == ("arm", 9, 3)
    assert caught.value.others == ("base",), "a sample of it may stand in for a missing one"
    assert find(forest, "map", "arm", LATEST, Bounds(8, STAMP_MAX), extrapolation)[0] == 8


def test_the_latest_answer_goes_the_way_that_an_answer_at_its_stamp_goes() -> None:
    tree = tree_of(
        moving("map", "b", 100, 1.0),
        moving("b", "c", 103, 2.0),
        moving("c", "b", 97, 4.0),
        moving("b", "tool", 97, 8.0),
    )
    # The newest way, down to c, has no sample at 97, but that of c's former child has one.
    assert tree.lookup("c", "tool").stamp == 97
    assert x_of(tree, "c", "tool") == x_of(tree, "c", "tool", 97) == 12.0


class Smell:
    """Data with a frame and a stamp, of a type that is not registered."""

    frame = "map"
    stamp = LATEST


class Message:
    """Registered data that have their frame and stamp in a header, as a message of ROS."""

    header = ("base", 0)


class Note:
    """Registered data with a frame, but no stamp."""

    frame = "map"


@do_transform.register
def _(data: Note, transform: TransformStamped) -> Note:  # noqa: ARG001
    return data


@do_transform.register
def _(data: Message, transform: TransformStamped) -> Message:  # noqa: ARG001
    return data


POINT = PointStamped("laser", 2, (1.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("data", "at", "fixed", "message"),
    [
        pytest.param(Smell(), None, None, "@do_transform.register(Smell)", id="unregistered type"),
        pytest.param(("map", 0), 5, None, "@do_transform.register(tuple)", id="no data at all"),
        pytest.param(
            LaserScan("laser", 2, np.array([4.0]), angle_min=0.0, angle_increment=0.0),
            None,
            None,
            "transform its to_points() instead",
            id="laser scan",
        ),
        pytest.param(
            Message(),
            None,
            None,
            "a Message has no frame and stamp of its own: look the transform up and call do_transform",
            id="no frame and stamp",
        ),
        pytest.param(Note(), None, None, "a Note has no frame and stamp of its own", id="no stamp"),
        pytest.param(POINT, 5, None, "at and fixed go together", id="at alone"),
        pytest.param(POINT, LATEST, None, "at and fixed go together", id="latest alone"),
        pytest.param(POINT, None, "map", "at and fixed go together", id="fixed alone"),
    ],
)
def test_wrong_arguments_are_a_type_error(data: Any, at: int | Latest | None, fixed: str | None, message: str) -> None:
    with pytest.raises(TypeError, match=re.escape(message)):
        question_of(data, "map", at, fixed, None, None)


METHODS: list[Any] = [TransformTree.lookup, TransformTree.lookup_many, Buffer.lookup_nowait]


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.__qualname__)
def test_it_has_the_signature_and_the_documentation_of_the_method(method: Any) -> None:
    function = inspect.unwrap(method)
    assert inspect.isfunction(function)
    assert inspect.signature(method) == inspect.signature(function)
    assert [*inspect.signature(method).parameters][:3] == ["self", "target", "source"]
    assert method.__doc__.startswith("The transform")
    names = (method.__module__, method.__name__, method.__annotations__)
    assert names == (function.__module__, function.__name__, function.__annotations__)
    assert inspect.isroutine(method)


def test_it_binds_pickles_and_is_overridden_as_a_method() -> None:
    class Counted(TransformTree):
        asked = 0

        def lookup(self, *args: Any, **options: Any) -> Any:
            self.asked += 1
            return super().lookup(*args, **options)

    tree = tree_of(moving("map", "cart", 1, 1.0))
    counted = Counted()
    counted.insert(moving("map", "cart", 1, 1.0))
    assert counted.can_transform("map", "cart", 1)
    assert counted.lookup("map", "cart") == tree.lookup("map", "cart") == TransformTree.lookup(tree, "map", "cart", 1)
    assert counted.asked == 2
    assert pickle.loads(pickle.dumps(tree.lookup))("map", "cart").stamp == 1
    assert tree.lookup.__self__ is tree  # type: ignore[attr-defined]


def test_a_buffer_with_a_prefix_answers_by_its_own_names() -> None:
    with Bus() as bus, Buffer(bus, prefix="r/") as buffer, Buffer(bus) as all_frames:
        bus.publish([moving("r/map", "r/cart", 1, 1.0), moving("map", "cart", 1, 2.0)])
        for _ in range(2):
            assert buffer.lookup_nowait("map", "cart", 1).transform.translation[0] == 1.0
            assert all_frames.lookup_nowait("map", "cart", 1).transform.translation[0] == 2.0
