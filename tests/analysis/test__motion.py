import math

import numpy as np
import pytest

from tfbus.analysis.examiner import Limits, MovingSamples

ROW = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]


def test_a_single_sample_has_nothing_wrong() -> None:
    none = np.zeros(1, np.int64)
    samples = MovingSamples("base", none, np.array([ROW]), none, none, none)
    assert list(samples.findings(Limits())) == []


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
        # The fifth tenth begins after 40 s.
        assert {stamp for finding in found for stamp in (finding.first, finding.at)} <= {40 * 10**9}


@pytest.mark.parametrize("angle", [0.2, 0.9, 1.0, math.pi / 2, 3.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_speed_of_a_turn_is_its_angle_over_the_time(angle: float, sign: float) -> None:
    # About z in half a second; a quaternion and its opposite are one rotation.
    turned = [3.0, 4.0, 0.0, 0.0, 0.0, sign * math.sin(angle / 2), sign * math.cos(angle / 2)]
    stamps, none = np.array([0, 5 * 10**8]), np.zeros(2, np.int64)
    samples = MovingSamples("base", stamps, np.array([ROW, turned]), none, none, None)
    jump, turn = samples.findings(Limits(speed=9.9, turn_rate=0.3))
    assert [(found.kind, found.at) for found in (jump, turn)] == [("jump", 5 * 10**8), ("turn", 5 * 10**8)]
    assert [jump.worst, turn.worst] == pytest.approx([10.0, 2 * angle])


@pytest.mark.parametrize(("moves", "kinds"), [(19, []), (20, ["jump"])])
def test_a_step_stands_out_among_twenty_and_not_among_fewer(moves: int, kinds: list[str]) -> None:
    # 1 cm every second, and 10 m at last.
    x = np.append(np.arange(moves) * 0.01, 10.0)
    rows = np.column_stack((x, np.zeros((len(x), 5)), np.ones(len(x))))
    stamps, none = np.arange(len(x)) * 10**9, np.zeros(len(x), np.int64)
    samples = MovingSamples("base", stamps, rows, none, none, None)
    assert [found.kind for found in samples.findings(Limits())] == kinds
