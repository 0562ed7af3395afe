"""An explanation is compared with the lookups that it explains, and its text with the text that people read."""

import json
import pickle
from collections.abc import Iterable
from contextlib import suppress
from itertools import product
from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support.samples import any_samples, moving, static, tree_of

from tfbus import (
    LATEST,
    SECOND,
    Buffer,
    Bus,
    Covariance,
    Explanation,
    FutureExtrapolationError,
    Hold,
    InvalidTransformError,
    Latest,
    SimulatedClock,
    Transform,
    TransformLookupError,
    TransformStamped,
    TransformTree,
    UncertainSample,
    UnknownFrameError,
    from_seconds,
)
from tfbus.tree.tree import forest_of

NANO = 1e-9


def facts(error: TransformLookupError) -> tuple[type[TransformLookupError], str]:
    return type(error), str(error)


def at_hz(parent: str, child: str, hz: int, last: float, authority: str) -> Iterable[TransformStamped]:
    """Twenty samples at a rate, the last of them at so many s."""
    end, period = from_seconds(last), SECOND // hz
    return [moving(parent, child, end - i * period, authority=authority) for i in range(19, -1, -1)]


def robot() -> TransformTree:
    """A chain of six edges between the map's camera and a gripper, where the localisation lags."""
    return tree_of(
        *at_hz("map", "odom", 10, 12.4, "slam"),
        *at_hz("odom", "base_link", 100, 12.5, "odometry"),
        static("base_link", "torso", authority="calibration"),
        *at_hz("torso", "arm", 50, 12.493, "arm driver"),
        static("arm", "gripper", authority="calibration"),
        static("base_link", "camera"),
    )


# One edge


def test_between_samples_of_two_parents_the_fraction_is_zero() -> None:
    tree = tree_of(moving("map", "a", 100), moving("odom", "a", 200), static("map", "odom"))
    (edge,) = tree.explain("map", "a", 175).edges
    assert (edge.parent, edge.before, edge.after, edge.fraction) == ("map", 100, 200, 0.0)


def test_ages_are_counted_from_the_newest_stamp_in_the_tree_or_from_a_given_one() -> None:
    tree = tree_of(moving("map", "a", 2 * SECOND), moving("map", "b", 5 * SECOND))
    found = tree.explain("map", "a")
    assert (found.now, found.edges[0].newest, found.edges[0].age) == (5 * SECOND, 2 * SECOND, 3.0)
    assert tree.explain("map", "a", now=10 * SECOND).edges[0].age == 8.0
    clock = SimulatedClock(9 * SECOND)
    bus = Bus(clock)
    buffer = Buffer(bus)
    bus.publish(moving("map", "a", 2 * SECOND))
    assert buffer.explain("map", "a").edges[0].age == 7.0


# The whole path


def test_for_an_answer_that_is_too_old_every_edge_that_is_too_old_has_an_error() -> None:
    found = robot().explain("map", "gripper", not_before=from_seconds(12.495))
    assert [edge.child for edge in found.edges if edge.error is not None] == ["odom", "arm"]
    assert [error.child for error in found.errors if isinstance(error, FutureExtrapolationError)] == ["odom", "arm"]
    clock = SimulatedClock(from_seconds(13.0))
    bus = Bus(clock)
    buffer = Buffer(bus)
    bus.publish(moving("map", "a", from_seconds(12.4)))
    assert buffer.explain("map", "a", max_age=0.7).answerable
    assert not buffer.explain("map", "a", max_age=0.5).answerable


def test_both_unknown_frames_have_errors_with_similar_names() -> None:
    found = robot().explain("mapp", "base_lnk")
    assert found.chain == ()
    first, second = found.errors
    assert isinstance(first, UnknownFrameError)
    assert isinstance(second, UnknownFrameError)
    assert (first.frame, first.close_matches) == ("mapp", ("map",))
    assert (second.frame, second.close_matches[0]) == ("base_lnk", "base_link")
    assert len(robot().explain("no", "no").errors) == 1


def test_a_loop_in_the_past_is_shown_once() -> None:
    tree = tree_of(moving("a", "b", 10), moving("map", "b", 30), moving("other", "x", 5))
    tree.insert_many([moving("b", "a", 10), moving("map", "a", 30)])
    found = tree.explain("x", "a", 20)
    assert found.half_chains == (("x", "other"), ("a", "b", "a"))
    assert [(edge.parent, edge.child) for edge in found.edges] == [("other", "x"), ("b", "a"), ("a", "b")]
    assert "up from 'a' to 'a'" in str(found)


@pytest.mark.parametrize("at", [1.5, None, True])
def test_wrong_arguments_are_type_errors(at: Any) -> None:
    with pytest.raises(TypeError):
        robot().explain("map", "odom", at)
    with pytest.raises(TypeError):
        robot().explain(5, "nowhere")  # type: ignore[arg-type]
    with pytest.raises(TypeError):
        robot().explain("nowhere", 5)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="LATEST"):
        robot().explain("map", "odom", 5, not_before=3)


def test_an_explanation_does_not_change_with_the_tree_and_pickles() -> None:
    tree = robot()
    found = tree.explain("map", "gripper", from_seconds(12.45))
    text = str(found)
    tree.clear()
    assert str(found) == text
    assert str(pickle.loads(pickle.dumps(found))) == text


# The text


def test_the_text_of_an_answer_is_a_heading_and_a_line_for_each_edge() -> None:
    assert str(robot().explain("camera", "gripper")).splitlines() == [
        "'gripper' in 'camera', latest: 12.493 s",
        "  camera -> base_link  static",
        "  base_link <- torso   static                       from 'calibration'",
        "  torso <- arm         50.0 Hz  age 7 ms  12.493 s  from 'arm driver'",
        "  arm <- gripper       static                       from 'calibration'",
    ]
    assert str(robot().explain("base_link", "gripper", from_seconds(12.433))).splitlines() == [
        "'gripper' in 'base_link' at 12.433 s",
        "  base_link <- torso  static                       from 'calibration'",
        "  torso <- arm        50.0 Hz  age 7 ms  12.433 s  from 'arm driver'",
        "  arm <- gripper      static                       from 'calibration'",
    ]


def test_the_text_marks_edges_with_errors_and_lists_the_errors_below() -> None:
    assert str(robot().explain("map", "gripper", from_seconds(12.45))).splitlines() == [
        "'gripper' in 'map' at 12.450 s: no answer",
        "! map <- odom         10.0 Hz   age 100 ms  12.400 s ..                  from 'slam'",
        "  odom <- base_link   100.0 Hz  age 0 ns    12.450 s                     from 'odometry'",
        "  base_link <- torso  static                                             from 'calibration'",
        "  torso <- arm        50.0 Hz   age 7 ms    12.433 s .. 12.453 s, 85.0%  from 'arm driver'",
        "  arm <- gripper      static                                             from 'calibration'",
        "! frame 'odom': asked for 12.450 s, newest sample is 12.400 s (50 ms short), from 'slam'",
    ]


def test_the_text_of_latest_without_an_answer_gives_the_reason() -> None:
    tree = tree_of(moving("map", "a", 10 * SECOND), moving("a", "b", 30 * SECOND))
    assert str(tree.explain("map", "b")).splitlines() == [
        "'b' in 'map', latest: no answer",
        "! map <- a  one sample  age 20 s  10.000 s",
        "  a <- b    one sample  age 0 ns  .. 30.000 s",
        "! frame 'a': asked for 30.000 s, newest sample is 10.000 s (20 s short)",
        "  because frame 'b': asked for 10.000 s, oldest sample is 30.000 s (20 s too early)",
    ]


def test_the_text_of_an_unknown_frame_has_similar_names() -> None:
    assert str(robot().explain("map", "base_lnk")).splitlines() == [
        "'base_lnk' in 'map', latest: no answer",
        "! frame 'base_lnk' is not known, did you mean 'base_link'?",
    ]


def test_the_text_of_two_trees_lists_one_after_the_other() -> None:
    tree = tree_of(moving("map", "a", 10 * SECOND, authority="slam"), static("drone", "eye"))
    assert str(tree.explain("a", "eye")).splitlines() == [
        "'eye' in 'a', latest: no answer",
        "  up from 'a' to 'map'",
        "    a -> map      one sample  age 0 ns  from 'slam'",
        "  up from 'eye' to 'drone'",
        "    eye -> drone  static",
        "! no path from 'eye' to 'a': they are in different trees, with roots 'map' and 'drone'",
    ]
    assert str(tree.explain("a", "drone")).splitlines()[1:-1] == [
        "  up from 'a' to 'map'",
        "    a -> map  one sample  age 0 ns  from 'slam'",
        "  'drone' is a root",
    ]
    assert str(tree.explain("map", "drone", SECOND)).splitlines() == [
        "'drone' in 'map' at 1.000 s: no answer",
        "  'map' is a root",
        "  'drone' is a root",
        "! no path from 'drone' to 'map': they are in different trees at 1.000 s, with roots 'map' and 'drone'",
    ]


def test_the_text_has_the_distance_of_an_extrapolation_and_marks_an_edge_without_samples() -> None:
    tree = tree_of(moving("map", "a", SECOND))
    held = str(tree.explain("map", "a", 2 * SECOND, extrapolate=Hold(5.0)))
    assert held.splitlines()[1] == "  map <- a  one sample  age 0 ns  1.000 s .., 1 s off"
    tree.clear()
    assert str(tree.explain("map", "a")).splitlines() == [
        "'a' in 'map', latest: no answer",
        "! map <- a  no samples",
        "! frame 'a': asked for the latest, it has no samples",
    ]


# As the lookup has it

FRAMES = "abcd"
batches = st.lists(any_samples(FRAMES, 5), min_size=1, max_size=14)
policies = st.fixed_dictionaries(
    {},
    optional={
        "tolerance": st.integers(0, 4).map(lambda n: n * NANO),
        "max_gap": st.integers(0, 6).map(lambda n: n * NANO),
        "extrapolate": st.integers(0, 6).map(lambda n: Hold(n * NANO)),
    },
)


def some_tree(samples: list[TransformStamped], keep: int | None, cleared: bool) -> TransformTree:
    tree = TransformTree(None if keep is None else keep * NANO)
    for sample in samples:
        with suppress(InvalidTransformError):
            tree.insert(sample)
    if cleared:
        tree.clear()
        with suppress(InvalidTransformError):
            tree.insert(samples[0])
    return tree


def questions() -> Iterable[tuple[str, str, int | Latest]]:
    return product((*FRAMES, "nobody"), FRAMES, (LATEST, *range(-1, 7)))


def has_a_loop(tree: TransformTree) -> bool:
    """Whether late samples have made frames hang on each other in the past; then an edge cannot be asked by itself."""
    frames = forest_of(tree).frames
    for frame, stamp in product(frames, range(-1, 7)):
        here, seen = frame, {frame}
        while here in frames:
            here = frames[here].parent_at(stamp)
            if here in seen:
                return True
            seen.add(here)
    return False


@given(batches, st.none() | st.integers(0, 5), st.booleans(), policies, st.none() | st.integers(0, 6))
def test_an_explanation_agrees_with_the_lookup(
    samples: list[TransformStamped], keep: int | None, cleared: bool, policy: dict[str, Any], not_before: int | None
) -> None:
    tree = some_tree(samples, keep, cleared)
    loop = has_a_loop(tree)
    for target, source, at in questions():
        question = policy if not_before is None or at is not LATEST else {**policy, "not_before": not_before}
        found = tree.explain(target, source, at, **question)
        assert found.answerable == tree.can_transform(target, source, at, **question)
        assert str(found)
        try:
            answer = tree.lookup(target, source, at, **question)
        except TransformLookupError as error:
            assert facts(error) in [facts(blocker) for blocker in found.errors]
            assert found.stamp is None
            assert len(found.edges) == max(0, len(found.chain) - 1) + sum(len(half) - 1 for half in found.half_chains)
        else:
            assert found.stamp == answer.stamp
            assert list(found.chain) == tree.chain(target, source, answer.stamp)
            assert max((edge.extrapolated_by for edge in found.edges), default=0) == answer.extrapolated_by
            if not loop:
                assert_edges_make_the_answer(tree, found, answer)


def assert_edges_make_the_answer(tree: TransformTree, found: Explanation, answer: TransformStamped) -> None:
    """The frames have no rotations, so x is the sum of what the edges say."""
    x = 0.0
    for nearer, edge in zip(found.chain, found.edges, strict=False):
        if edge.static:
            here = tree.lookup(edge.parent, edge.child, answer.stamp).transform.translation[0]
        else:
            assert edge.fraction is not None
            here = 0.0
            for stamp, share in ((edge.before, 1.0 - edge.fraction), (edge.after, edge.fraction)):
                if share:
                    assert stamp is not None
                    here += share * tree.lookup(edge.parent, edge.child, stamp).transform.translation[0]
        x += here if edge.parent == nearer else -here
    assert x == pytest.approx(answer.transform.translation[0], abs=1e-9)


@given(batches, st.none() | st.integers(0, 5), policies)
def test_at_a_stamp_exactly_the_edges_without_an_answer_of_their_own_have_errors(
    samples: list[TransformStamped], keep: int | None, policy: dict[str, Any]
) -> None:
    tree = some_tree(samples, keep, cleared=False)
    assume(not has_a_loop(tree))
    for target, source, at in questions():
        if at is LATEST:
            continue
        found = tree.explain(target, source, at, **policy)
        if found.chain:
            for edge in found.edges:
                assert (edge.error is None) == tree.can_transform(edge.parent, edge.child, at, **policy)


PARENT = {"b": "a", "c": "b", "d": "a"}
steady = st.lists(st.tuples(st.sampled_from("bcd"), st.integers(0, 9)), max_size=12)


@given(steady, st.none() | st.integers(0, 12), st.integers(0, 3).map(lambda n: n * NANO))
def test_latest_has_an_answer_only_after_the_missing_sample_of_every_edge_with_an_error(
    arrivals: list[tuple[str, int]], not_before: int | None, tolerance: float
) -> None:
    tree = tree_of(*(moving(PARENT[child], child, stamp) for child, stamp in arrivals), keep=None)
    for target, source in product(FRAMES, FRAMES):
        question: dict[str, Any] = {"tolerance": tolerance, "not_before": not_before}
        found = tree.explain(target, source, **question)
        lacking = [error for error in found.errors if isinstance(error, FutureExtrapolationError)]
        assert len(lacking) == len(found.errors) or not found.chain
        for left_out in (None, *lacking):
            later = tree.copy()
            for error in lacking:
                if error is not left_out:
                    assert isinstance(error.stamp, int)
                    later.insert(moving(PARENT[error.child], error.child, error.stamp))
            if left_out is not None:
                assert not later.can_transform(target, source, **question)
            elif lacking and not_before is None:
                assert later.can_transform(target, source, **question)


def test_an_explanation_is_plain_data_and_comes_back() -> None:
    for found in (
        robot().explain("map", "gripper"),
        robot().explain("map", "gripper", from_seconds(12.45)),
        robot().explain("mapp", "base_lnk"),
    ):
        back = Explanation.from_dict(json.loads(json.dumps(found.to_dict())))
        assert str(back) == str(found)
        assert back.edges[:2] == found.edges[:2] or not found.answerable
        assert [type(error) for error in back.errors] == [type(error) for error in found.errors]


def test_an_explanation_tells_which_edge_an_error_comes_from() -> None:
    tree = TransformTree()
    assert tree_of(moving("a", "b", 0)).explain("a", "b").sigmas == ()
    yaw, place = Covariance.of(rpy=(0.0, 0.0, 0.01)), Covariance.of(xyz=(0.0, 0.04, 0.0))
    tree.insert(UncertainSample("map", "base\n", 0, Transform(), covariance=yaw))
    tree.insert(UncertainSample("base\n", "arm", 0, Transform((3.0, 0.0, 0.0)), static=True, covariance=place))
    tree.insert(static("arm", "hand"))
    found = tree.explain("map", "hand")
    # 3 m times 0.01 rad, and 0.04 m: 0.05 m.
    assert found.sigmas == pytest.approx((0.0, 0.05, 0.0, 0.0, 0.0, 0.01))
    assert [edge.shares[1:2] for edge in found.edges] == [(pytest.approx(0.36),), (pytest.approx(0.64),), ()]
    assert str(found).splitlines()[-4:] == [
        "~ error of one sigma: x 0, y 0.05, z 0 m, roll 0, pitch 0, yaw 0.01 rad",
        r"  64% of the variance of y is from base\n -> arm",
        r"  100% of the variance of yaw is from map -> base\n",
        "  taken as exact: arm -> hand",
    ]
    assert Explanation.from_dict(found.to_dict()) == found
