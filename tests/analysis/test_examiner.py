"""Findings about streams of samples and about trees."""

import math
import random
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from support.samples import moving, static, tree_of

from tfbus import SECOND, Finding, Transform, TransformStamped, diagnose
from tfbus.analysis import Examiner, Limits
from tfbus.analysis.examiner import ADVICE, MovingSamples

MS = SECOND // 1_000


def drive(count: int = 100, period: int = 100 * MS, speed: float = 1.0) -> list[TransformStamped]:
    """A base that moves at a constant speed."""
    return [moving("odom", "base", k * period, speed * k * period / SECOND, "odometry") for k in range(count)]


def examine(samples: list[TransformStamped], delay: int = MS, **limits: float) -> dict[tuple[str, str | None], Finding]:
    examiner = Examiner(Limits(**limits))
    for sample in samples:
        examiner.add([sample], sample.stamp + delay)
    findings = examiner.findings()
    found = {(finding.kind, finding.frame): finding for finding in findings}
    assert len(found) == len(findings)
    return found


def test_nothing_is_wrong_with_a_robot_that_drives() -> None:
    assert examine([static("base", "laser", 0.5), *drive()]) == {}


def facts(finding: Finding) -> tuple[int, int | None, float | None, int | None]:
    return finding.count, finding.first, None if finding.worst is None else round(finding.worst, 6), finding.at


@pytest.mark.parametrize(
    ("ahead", "drift", "detail"),
    [
        (0.3, 0.0, "the clock of 'odometry' is 0.3 s ahead, or more"),
        (-7.0, 50e-6, "the clock of 'odometry' is 6.99 s behind, or less, and gains 50 us a second"),
        (-7.0, -50e-6, "the clock of 'odometry' is 7 s behind, or less, and loses 50 us a second"),
        (-1.4e9, 0.0, "'odometry' stamps by another clock (simulated?)"),
        (-0.1, 5e-6, None),
        (-0.1, 0.0, None),
    ],
)
def test_the_clock_of_a_sender_is_fitted_by_arrivals_behind_stamps(
    ahead: float, drift: float, detail: str | None
) -> None:
    examiner, draw = Examiner(), random.Random(3)
    for k in range(2_000):
        received = k * SECOND // 10
        stamp = round(received * (1 + drift) + ahead * SECOND - draw.expovariate(1 / 0.003) * SECOND)
        examiner.add([moving("odom", "base", stamp, k / 10, "odometry")], received)
    found = [finding.detail for finding in examiner.findings() if finding.kind == "clock"]
    assert found == ([] if detail is None else [detail])


def placed(samples: list[TransformStamped], places: dict[int, float]) -> list[TransformStamped]:
    """The samples, some of which are at another x."""
    found = list(samples)
    for at, x in places.items():
        found[at] = moving("odom", "base", samples[at].stamp, x, "odometry")
    return found


TEN = drive(10)
FEW = [moving("odom", "base", k * SECOND, x) for k, x in enumerate((0.0, 9.0, 9.0))]
BOXES = [moving("a", "box", k * 100 * MS, 0.0) for k in range(30)]
BOXES += [moving("b", "box", k * 100 * MS, 500.0) for k in range(30, 60)]


@pytest.mark.parametrize(
    ("samples", "options", "expected"),
    [
        # A place that cannot be is no jump.
        (placed(drive(), {40: 1e32, 50: 1e9}), {}, {("translation", "base"): (2, 4 * SECOND, 1e32, 4 * SECOND)}),
        # From 0.1 m/s to 3 m/s and back: far beyond the usual speed, and far below the bound.
        (placed(drive(speed=0.1), {40: 0.7}), {}, {("jump", "base"): (2, 4 * SECOND, 3.1, 4 * SECOND)}),
        # Without a usual speed, only the bound counts.
        (FEW, {}, {}),
        (FEW, {"speed": 8.0}, {("jump", "base"): (1, SECOND, 9.0, SECOND)}),
        # Another parent is no jump.
        ([*BOXES, static("a", "b", 1.0)], {}, {("two parents", "box"): (1, 3 * SECOND, None, None)}),
        (
            [*TEN[:3], TEN[5], TEN[4], TEN[3], *TEN[6:]],
            {},
            {("stamps go back", "base"): (2, 4 * 100 * MS, 0.2, 300 * MS)},
        ),
        (
            TEN,
            {"delay": -80 * MS},
            {("ahead", "base"): (10, 0, 0.08, 0), ("clock", None): (10, None, 0.08, None)},
        ),
        (TEN, {"delay": -50 * MS}, {}),
        (
            [*TEN, TEN[4], TEN[4], TEN[7]],
            {},
            {
                ("duplicate stamps", "base"): (3, 400 * MS, None, None),
                ("stamps go back", "base"): (3, 400 * MS, 0.5, 400 * MS),
            },
        ),
        (
            [static("base", "arm", float(x), stamp=at) for at, x in enumerate([1, 1, 2, 2, 3])],
            {},
            {("static changes", "arm"): (2, 2, None, None)},
        ),
        ([static("base", "arm", 1e9)], {}, {("translation", "arm"): (1, None, 1e9, None)}),
        (
            [static("odom", "base", authority="odometry"), *drive(5)],
            {},
            {("two kinds", "base"): (5, 0, None, None)},
        ),
    ],
)
def test_a_fault_is_found_with_its_number_first_stamp_and_worst_value(
    samples: list[TransformStamped], options: dict[str, Any], expected: dict[tuple[str, str], object]
) -> None:
    assert {key: facts(finding) for key, finding in examine(samples, **options).items()} == expected


def turned(stamp: int, angle: float) -> TransformStamped:
    return TransformStamped("odom", "base", stamp, Transform.from_axis_angle((0, 0, 1), angle))


@pytest.mark.parametrize("angle", [1e-3, 0.5, 3.0])
def test_a_turn_rate_is_exact_for_small_angles_and_large_ones(angle: float) -> None:
    samples = [turned(0, 0.0), turned(SECOND, angle), turned(2 * SECOND, 2 * angle)]
    assert examine(samples, turn_rate=angle * 1.001) == {}
    finding = examine(samples, turn_rate=angle * 0.999)["turn", "base"]
    assert (finding.count, finding.first) == (2, SECOND)
    assert finding.worst == pytest.approx(angle)


def test_a_gap_is_long_and_unusual() -> None:
    samples = drive()
    found = examine(samples[:50] + samples[70:])
    assert facts(found.pop(("gap", "base"))) == (1, 4_900 * MS, 2.1, 4_900 * MS)
    assert found == {}
    # A frame that is always slow has no gap, nor has a short pause of a fast one.
    assert examine(drive(20, period=2 * SECOND)) == {}
    fast = drive(2_000, period=MS)
    assert examine(fast[:500] + fast[900:], gap=0.41) == {}


def test_a_rate_that_breaks_down_is_found() -> None:
    samples = drive(1_000, period=10 * MS)
    # In the third tenth, only every fifth comes.
    kept = [sample for at, sample in enumerate(samples) if not 200 <= at < 300 or at % 5 == 0]
    found = examine(kept)
    finding = found.pop(("rate", "base"))
    assert (finding.count, finding.unit) == (1, "Hz")
    assert finding.worst == pytest.approx(20.0, rel=0.1)
    assert finding.first == pytest.approx(2 * SECOND, rel=0.01)
    assert "from 100" in finding.detail
    assert found == {}


def test_two_authorities_are_found_with_their_changes() -> None:
    samples = [sample.replace(authority=("slam", "odometry")[at // 10 % 2]) for at, sample in enumerate(drive(30))]
    found = examine(samples)
    assert facts(found["two authorities", "base"]) == (2, SECOND, None, None)
    assert found["two authorities", "base"].detail == "2 senders: 'slam', 'odometry'"


def test_trees_that_are_not_connected_are_found_by_the_newest_parents() -> None:
    assert examine([static("a", "b"), static("b", "c")]) == {}
    found = examine([static("a", "b"), static("x", "y")])
    assert found["disconnected", None].count == 2
    assert found["disconnected", None].detail == "separate trees, below 'a', 'x'"
    for roots, shown in (("abcde", "'a', 'b', 'c', 'd', 'e'"), ("abcdef", "'a', 'b', 'c', 'd', 'e', ...")):
        found = examine([static(root, f"of {root}") for root in roots])
        assert found["disconnected", None].detail == f"separate trees, below {shown}"


def test_norms_and_refusals_are_told() -> None:
    examiner = Examiner()
    examiner.add([static("a", "b")])
    for stamp, norm in ((1, 1.00005), (2, 1.002), (3, 0.99)):
        examiner.add_norm("b", stamp, norm)
    examiner.add_refused(["not finite", "cycle", "not finite"])
    assert [(each.kind, each.frame, each.count, each.first) for each in examiner.findings()] == [
        ("refused", None, 1, None),
        ("refused", None, 2, None),
        ("rotation", "b", 2, 2),
    ]
    assert examiner.findings()[-1].worst == pytest.approx(0.01)


def test_any_numbers_are_examined_without_an_error() -> None:
    rng = random.Random(3)
    numbers: list[Any] = [0.0, 1e300, -1e-300, 1.0, math.pi]
    samples = [
        TransformStamped(
            "a", rng.choice("bcd"), rng.choice([0, 1, -(2**63), 2**62]), Transform(rng.choices(numbers, k=3))
        )
        for _ in range(200)
    ]
    assert ("translation", "b") in examine(samples, delay=0)


def test_a_frame_that_is_sent_as_moving_and_never_moves_is_a_hint() -> None:
    still = [moving("a", "box", k * 100 * MS, 2.0) for k in range(10)]
    found = examine(still)
    finding = found.pop(("never moves", "box"))
    assert facts(finding) == (10, 0, None, None)
    assert (finding.is_hint, "for 0.9 s" in finding.detail) == (True, True)
    assert found == {}
    assert examine(still[:9]) == {}
    assert examine([*still, moving("a", "box", SECOND, 2.0 + 1e-12)]) == {}
    assert ("never moves", "box") not in examine([*still, static("a", "box", 2.0)])
    assert not drive(10)[0].static
    assert not any(finding.is_hint for finding in examine(drive(10), delay=-80 * MS).values())


def test_a_tree_is_examined_with_its_senders_and_parents() -> None:
    drive = [moving("odom", "base", k * SECOND, float(k), "odometry") for k in range(10)]
    tree = tree_of(static("base", "laser"), *drive, keep=None)
    assert diagnose(tree) == []
    tree.insert(moving("odom", "base", 10 * SECOND, 1e10, "slam"))
    tree.insert(static("x", "y"))
    assert [(each.kind, each.frame, each.count, each.first) for each in diagnose(tree)] == [
        ("disconnected", None, 2, None),
        ("two authorities", "base", 1, 10 * SECOND),
        ("translation", "base", 1, 10 * SECOND),
    ]
    assert [each.kind for each in diagnose(tree, Limits(speed=0.5)) if each.frame == "base"][-1] == "jump"


def test_each_sample_has_its_own_sender_even_if_it_came_late() -> None:
    tree = tree_of(*(moving("odom", "base", k * SECOND, float(k), "odometry") for k in range(0, 10, 2)), keep=None)
    tree.insert_many([moving("odom", "base", k * SECOND, float(k), "slam") for k in (3, 7)])
    found = [(each.kind, each.frame, each.count, each.first) for each in diagnose(tree)]
    assert found == [("two authorities", "base", 4, 3 * SECOND)]


def test_only_the_window_is_examined() -> None:
    tree = tree_of(moving("a", "b", 0, 1e10), *(moving("a", "b", k * SECOND) for k in range(11, 15)))
    assert diagnose(tree) == []


ROW = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]


def test_without_arrivals_the_order_is_not_judged() -> None:
    stamps, none = np.array([3, 2, 1]) * 10**9, np.zeros(3, np.int64)
    samples = MovingSamples("base", stamps, np.array([ROW] * 3), none, none, None)
    assert list(samples.findings(Limits())) == []
    received = stamps + 5 * 10**9
    late = MovingSamples("base", stamps, np.array([ROW] * 3), none, none, received)
    assert [(finding.kind, finding.count) for finding in late.findings(Limits())] == [("stamps go back", 2)]


def test_a_rate_breaks_down_where_fewer_than_half_of_the_samples_come() -> None:
    expected: list[tuple[int, list[str]]] = [(5, []), (4, ["rate"])]
    for left, kinds in expected:
        # Ten samples in each tenth of 100 s, and fewer in the fifth one, at even distances.
        counts = [10, 10, 10, 10, left, 10, 10, 10, 10, 10]
        seconds = [10 * tenth + 10 * number / count for tenth, count in enumerate(counts) for number in range(count)]
        stamps = (np.array([*seconds, 100.0]) * 10**9).astype(np.int64)
        none = np.zeros(len(stamps), np.int64)
        samples = MovingSamples("base", stamps, np.array([ROW] * len(stamps)), none, none, None)
        found = list(samples.findings(Limits()))
        assert [finding.kind for finding in found] == kinds
        assert [finding.worst for finding in found] == [left / 10.0] * len(kinds)
        # The fifth tenth begins after 40 s.
        assert {stamp for finding in found for stamp in (finding.first, finding.at)} <= {40 * 10**9}


@pytest.mark.parametrize(("moves", "kinds"), [(19, []), (20, ["jump"])])
def test_a_step_stands_out_among_twenty_and_not_among_fewer(moves: int, kinds: list[str]) -> None:
    # 1 cm every second, and 10 m at last.
    x = np.append(np.arange(moves) * 0.01, 10.0)
    rows = np.column_stack((x, np.zeros((len(x), 5)), np.ones(len(x))))
    stamps, none = np.arange(len(x)) * 10**9, np.zeros(len(x), np.int64)
    samples = MovingSamples("base", stamps, rows, none, none, None)
    assert [found.kind for found in samples.findings(Limits())] == kinds


def test_a_finding_says_which_frame_what_how_often_the_worst_and_when() -> None:
    finding = Finding("jump", "base", 1_234, 1_500_000_000, 12.3456, "m/s", "moves faster than it can", 2_000_000_000)
    assert str(finding) == ("'base': moves faster than it can, 1,234 x, worst 12.35 m/s at 2.000 s, first at 1.500 s")
    assert finding.advice == ADVICE["jump"]


def test_what_is_not_known_is_left_out() -> None:
    assert str(Finding("disconnected", None, 2, None, None, "", "separate trees")) == "separate trees, 2 x"


@pytest.mark.parametrize("kind", ADVICE)
def test_every_kind_has_an_advice_of_one_line(kind: str) -> None:
    assert ADVICE[kind]
    assert "\n" not in ADVICE[kind]


@pytest.mark.parametrize("name", [field.name for field in fields(Limits)])
@pytest.mark.parametrize(
    ("value", "error"), [(0.0, ValueError), (-1.0, ValueError), ("1", TypeError), (True, TypeError)]
)
def test_a_limit_is_a_number_greater_than_zero(name: str, value: Any, error: type[Exception]) -> None:
    with pytest.raises(error, match=name):
        Limits(**{name: value})
