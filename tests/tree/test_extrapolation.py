"""A policy on one edge, against the rule written down in the plainest way, and on whole paths."""

import math
import pickle
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.samples import moving, static

from tfbus import (
    SECOND,
    ExtrapolationError,
    FutureExtrapolationError,
    GapError,
    Hold,
    PastExtrapolationError,
    TransformTree,
)
from tfbus.stamps import STAMP_MAX, STAMP_MIN
from tfbus.tree.history import FrameHistory
from tfbus.tree.lookup import Policy, ReadStamp, policy_of, read_stamp, read_stamps, read_stamps_at_many

ROW = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def history(samples: Iterable[int] | dict[int, str], keep: int | None = None) -> FrameHistory:
    """A history with samples at some stamps; of a dict, each with its parent."""
    parents = samples if isinstance(samples, dict) else dict.fromkeys(samples, "world")
    made = FrameHistory("robot", next(iter(parents.values()), "world"), False, keep)
    for stamp, parent in parents.items():
        made.insert(parent, stamp, ROW, "odometry")
    return made


def rule(stamps: list[int], at: int, policy: Policy) -> ReadStamp | None:
    """Read at the stamp where it is a sample, or between two that are near enough; else the nearest that may."""
    if at in stamps:
        return ReadStamp(at, 0, 0)
    older = [stamp for stamp in stamps if stamp < at]
    newer = [stamp for stamp in stamps if stamp > at]
    if older and newer and (policy.max_gap is None or min(newer) - max(older) <= policy.max_gap):
        return ReadStamp(at, 0, min(newer) - max(older))
    allowed = [stamp for stamp in older if at - stamp <= max(policy.tolerance, policy.hold)]
    allowed += [stamp for stamp in newer if stamp - at <= policy.tolerance]
    if not allowed:
        return None
    nearest = min(allowed, key=lambda stamp: abs(at - stamp))
    return ReadStamp(nearest, abs(at - nearest), 0)


stamp_sets = st.sets(st.integers(-30, 30), max_size=8)
policies = st.builds(Policy, st.integers(0, 12), st.none() | st.integers(0, 20), st.integers(0, 25))


@given(stamp_sets, policies)
def test_the_stamp_read_for_a_question_follows_the_rule(stamps: set[int], policy: Policy) -> None:
    edge = history(sorted(stamps))
    for at in range(-60, 61):
        expected = rule(sorted(stamps), at, policy)
        try:
            found: ReadStamp | None = read_stamp(edge, at, policy)
        except ExtrapolationError:
            found = None
        assert found == expected


def test_distances_beyond_64_bits_are_not_within_a_tolerance() -> None:
    edge = history([STAMP_MIN, STAMP_MAX])
    policy = Policy(tolerance=5, max_gap=5)
    with pytest.raises(GapError):
        read_stamp(edge, 0, policy)
    _, away, _ = read_stamps_at_many(
        edge.samples_between(STAMP_MIN, STAMP_MAX), np.array([0, STAMP_MAX - 5, STAMP_MIN + 6]), policy
    )
    assert away.tolist() == [-1, 5, -1]
    for sample, at in ((STAMP_MIN, STAMP_MAX), (STAMP_MAX, STAMP_MIN)):
        assert read_stamps_at_many(history([sample]).samples_between(at, at), np.array([at]), policy)[1].tolist() == [
            -1
        ]


@pytest.mark.parametrize(
    ("at", "kind", "slack"),
    [(4, PastExtrapolationError, 5), (10 - 6, PastExtrapolationError, 5), (41, FutureExtrapolationError, 20)],
)
def test_the_error_of_an_edge_without_a_near_sample_has_the_slack(
    at: int, kind: type[ExtrapolationError], slack: int
) -> None:
    edge = history([10, 20])
    with pytest.raises(kind) as caught:
        read_stamp(edge, at, Policy(tolerance=5, hold=20))
    assert (caught.value.stamp, caught.value.slack) == (at, slack)
    assert (caught.value.oldest, caught.value.newest, caught.value.authority) == (10, 20, "odometry")


def test_a_gap_error_has_the_stamps_of_both_samples() -> None:
    edge = history([0, SECOND, 4 * SECOND])
    with pytest.raises(GapError) as caught:
        read_stamp(edge, 2 * SECOND, Policy(max_gap=SECOND))
    error = caught.value
    assert (error.child, error.stamp, error.before, error.after) == ("robot", 2 * SECOND, SECOND, 4 * SECOND)
    assert (error.oldest, error.newest, error.max_gap) == (0, 4 * SECOND, SECOND)


def test_an_error_that_waiting_cannot_help_decides_else_that_of_the_edge_that_lags_most() -> None:
    empty, earliest, lagging, nearly = history([]), history([STAMP_MIN]), history([0, 15]), history([10, 20])
    past, gap = history([40, 50]), history([0, 100])
    for edges, decisive in (
        ((empty, past), past),
        ((past, empty), past),
        ((earliest, gap), gap),
        ((past, gap), past),
        ((gap, past), gap),
        ((nearly, lagging), lagging),
        ((nearly, earliest), earliest),
        ((nearly, empty), empty),
        ((earliest, empty), earliest),
        ((empty, earliest), empty),
    ):
        with pytest.raises(ExtrapolationError) as caught:
            read_stamps(edges, 30, Policy(max_gap=20))
        assert (caught.value.oldest, caught.value.newest) == (decisive.oldest, decisive.newest)
        assert isinstance(caught.value, FutureExtrapolationError) == (decisive not in (past, gap))


# On whole paths: odom -> base moves 1 m/s with samples at 0, 1, 2 and 6 s; base -> arm is sampled at 0 and 4 s.


@pytest.fixture
def tree() -> TransformTree:
    tree = TransformTree(keep=None)
    tree.insert_many(moving("odom", "base", second * SECOND, float(second)) for second in (0, 1, 2, 6))
    tree.insert_many(moving("base", "arm", second * SECOND, 10.0 * second) for second in (0, 4))
    tree.insert(static("arm", "tool", 0.5))
    return tree


def seconds(value: float) -> int:
    return round(value * SECOND)


@pytest.mark.parametrize(
    ("at", "policy", "x", "extrapolated_by", "gap"),
    [
        (1.5, {"max_gap": 4.0}, 1.5 + 15.0 + 0.5, 0.0, 4.0),
        (3.0, {"max_gap": 4.0}, 3.0 + 30.0 + 0.5, 0.0, 4.0),
        (3.0, {"max_gap": 3.9, "tolerance": 1.0}, 2.0 + 40.0 + 0.5, 1.0, 0.0),
        (2.0, {"max_gap": 3.9, "tolerance": 2.0}, 2.0 + 0.0 + 0.5, 2.0, 0.0),
        (4.5, {"tolerance": 0.5}, 4.5 + 40.0 + 0.5, 0.5, 4.0),
        (5.0, {"extrapolate": Hold(1.0)}, 5.0 + 40.0 + 0.5, 1.0, 4.0),
        (6.5, {"extrapolate": Hold(2.5)}, 6.0 + 40.0 + 0.5, 2.5, 0.0),
        (-0.25, {"tolerance": 0.25}, 0.0 + 0.0 + 0.5, 0.25, 0.0),
        (2.0, {"tolerance": 9.0, "extrapolate": Hold(9.0)}, 2.0 + 20.0 + 0.5, 0.0, 4.0),
    ],
)
def test_the_answer_has_its_extrapolation_and_gap(
    tree: TransformTree, at: float, policy: dict[str, Any], x: float, extrapolated_by: float, gap: float
) -> None:
    # Twice, because the kernel answers from a path that is known.
    for target, source, sign in (("odom", "tool", 1.0), ("tool", "odom", -1.0)) * 2:
        found = tree.lookup(target, source, seconds(at), **policy)
        assert found.transform.translation == pytest.approx((sign * x, 0.0, 0.0))
        assert (found.parent, found.child, found.stamp) == (target, source, seconds(at))
        assert (found.extrapolated_by, found.gap) == (seconds(extrapolated_by), seconds(gap))
        assert ("extrapolated by" in str(found)) == (extrapolated_by > 0.0)


def test_an_answer_without_a_policy_has_no_extrapolation_and_gap_and_a_static_path_needs_none(
    tree: TransformTree,
) -> None:
    found = tree.lookup("odom", "tool", seconds(3.0))
    assert (found.extrapolated_by, found.gap) == (0, None)
    assert found == tree.lookup("odom", "tool", seconds(3.0), tolerance=0.1)
    found = tree.lookup("arm", "tool", seconds(99.0), tolerance=0.1)
    assert (found.static, found.extrapolated_by, found.gap) == (True, 0, 0)


@pytest.mark.parametrize(
    ("at", "policy", "kind", "child"),
    [
        (4.6, {"tolerance": 0.5}, FutureExtrapolationError, "arm"),
        (6.5, {"extrapolate": Hold(2.4)}, FutureExtrapolationError, "arm"),
        (-0.1, {"extrapolate": Hold(9.0)}, PastExtrapolationError, "arm"),
        (3.0, {"max_gap": 3.9}, GapError, "arm"),
        (5.0, {"max_gap": 3.9}, GapError, "base"),
    ],
)
def test_the_error_names_the_deciding_edge(
    tree: TransformTree, at: float, policy: dict[str, Any], kind: type[ExtrapolationError], child: str
) -> None:
    with pytest.raises(kind) as caught:
        tree.lookup("odom", "tool", seconds(at), **policy)
    assert caught.value.child == child
    assert not tree.can_transform("odom", "tool", seconds(at), **policy)


def test_latest_in_the_gap_of_another_edge_waits_for_the_end_of_the_gap(tree: TransformTree) -> None:
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.lookup("odom", "tool", max_gap=3.9)
    assert (caught.value.child, caught.value.stamp) == ("arm", seconds(6.0))
    assert isinstance(caught.value.__cause__, GapError)
    assert tree.lookup("odom", "tool").stamp == seconds(4.0)


@pytest.mark.parametrize(
    ("policy", "stamp", "x", "extrapolated_by"),
    [
        ({}, 4.0, 4.0 + 40.0, 0.0),
        ({"extrapolate": Hold(1.5)}, 5.5, 5.5 + 40.0, 1.5),
        ({"tolerance": 0.5}, 4.0, 4.0 + 40.0, 0.0),
        ({"extrapolate": Hold(9.0)}, 6.0, 6.0 + 40.0, 2.0),
    ],
)
def test_latest_goes_as_far_as_the_lagging_edge_may_be_held_but_not_beyond_the_newest(
    tree: TransformTree, policy: dict[str, Any], stamp: float, x: float, extrapolated_by: float
) -> None:
    for _ in range(2):
        found = tree.lookup("odom", "arm", **policy)
        assert found.stamp == seconds(stamp)
        assert found.transform.translation[0] == pytest.approx(x)
        assert found.extrapolated_by == seconds(extrapolated_by)


def test_time_travel_has_the_greater_extrapolation_and_gap_of_both_legs(tree: TransformTree) -> None:
    found = tree.lookup("base", "base", seconds(6.5), source_at=seconds(1.5), fixed="odom", extrapolate=Hold(1.0))
    assert found.transform.translation == pytest.approx((1.5 - 6.0, 0.0, 0.0))
    assert (found.extrapolated_by, found.gap) == (seconds(0.5), seconds(1.0))


# Many stamps.

keywords = st.fixed_dictionaries(
    {
        "tolerance": st.sampled_from((0.0, 0.3, 1.0)),
        "max_gap": st.sampled_from((None, 0.9, 2.0, 3.9)),
        "extrapolate": st.none() | st.builds(Hold, st.sampled_from((0.2, 2.0))),
    }
)
tenths = st.integers(-20, 90).map(lambda tenth: tenth * SECOND // 10)


@given(keywords, st.lists(tenths, max_size=60), st.sampled_from((("odom", "tool"), ("tool", "odom"), ("base", "arm"))))
def test_many_lookups_under_a_policy_equal_single_lookups(
    policy: dict[str, Any], asked: list[int], frames: tuple[str, str]
) -> None:
    tree = TransformTree(keep=None)
    tree.insert_many(moving("odom", "base", second * SECOND, float(second)) for second in (0, 1, 2, 6))
    tree.insert_many(
        moving("odom" if second < 3 else "base", "arm", second * SECOND, second) for second in (0, 2, 4, 5)
    )
    tree.insert(static("arm", "tool", 0.5))
    found = tree.lookup_many(*frames, asked, out_of_range="nan", **policy)
    faults = []
    for i, at in enumerate(asked):
        try:
            one = tree.lookup(*frames, at, **policy)
        except ExtrapolationError as error:
            faults.append((i, error))
            assert not found.valid[i]
            assert found.extrapolated_by[i] == 0
            continue
        assert found[i].is_close(one.transform)
        assert found.extrapolated_by[i] == one.extrapolated_by
        assert (found.gap is None) == (one.gap is None)
        assert found.gap is None or found.gap[i] == one.gap
    if faults:
        i, expected = faults[0]
        with pytest.raises(type(expected)) as caught:
            tree.lookup_many(*frames, asked, **policy)
        assert caught.value.index == i
        assert str(caught.value) == f"stamps[{i}]: {expected}"
    else:
        tree.lookup_many(*frames, asked, **policy)


@pytest.mark.parametrize(
    ("arguments", "policy"),
    [
        ((0.05, None, None), Policy(tolerance=50_000_000)),
        ((0.0, 0.0, None), Policy(max_gap=0)),
        ((0.0, None, Hold(0.0)), Policy()),
        ((math.inf, None, Hold(math.inf)), Policy(tolerance=STAMP_MAX, hold=STAMP_MAX)),
    ],
)
def test_each_argument_may_be_given_alone_and_be_infinite(arguments: Any, policy: Policy) -> None:
    assert policy_of(*arguments) == policy


@pytest.mark.parametrize(
    ("policy", "error", "text"),
    [
        ({"tolerance": -1.0}, ValueError, "tolerance"),
        ({"max_gap": math.nan}, ValueError, "max_gap"),
        ({"tolerance": "1"}, TypeError, "tolerance"),
        ({"tolerance": True}, TypeError, "tolerance"),
        ({"extrapolate": 0.2}, TypeError, r"extrapolate must be a Hold, not 0\.2"),
    ],
)
def test_a_wrong_policy_is_an_error_that_names_the_argument(
    tree: TransformTree, policy: dict[str, Any], error: type[Exception], text: str
) -> None:
    with pytest.raises(error, match=text):
        tree.lookup("odom", "tool", 0, **policy)


@pytest.mark.parametrize(("bad", "error"), [(-1.0, ValueError), (math.nan, ValueError), ("1", TypeError)])
def test_a_hold_has_a_duration(bad: Any, error: type[Exception]) -> None:
    with pytest.raises(error, match="max_age"):
        Hold(bad)


def test_a_hold_is_a_value() -> None:
    hold = Hold(0.2)
    assert pickle.loads(pickle.dumps(hold)) == hold == Hold(0.2)
    assert len({hold, Hold(0.2), Hold(0.3)}) == 2


def test_many_time_travels_have_the_greater_extrapolation_and_gap_of_both_legs(tree: TransformTree) -> None:
    found = tree.lookup_many(
        "base", "base", [seconds(6.5)] * 2, source_at=[seconds(1.5), seconds(6.25)], fixed="odom", extrapolate=Hold(1.0)
    )
    assert found.translations[:, 0] == pytest.approx([1.5 - 6.0, 0.0])
    assert found.extrapolated_by.tolist() == [seconds(0.5), seconds(0.5)]
    assert found.gap is not None
    assert found.gap.tolist() == [seconds(1.0), 0]
    assert found[1:].extrapolated_by.tolist() == [seconds(0.5)]
