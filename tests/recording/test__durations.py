import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.processes import peak_of

from tfbus import SECOND
from tfbus.recording.summary import _SINGLE, Durations

delays = st.lists(st.integers(-(10**15), 10**15), min_size=1, max_size=300)


@given(parts=st.lists(delays, min_size=1, max_size=3), singles=st.lists(st.integers(-(10**15), 10**15), max_size=3))
def test_mean_and_maximum_are_exact_and_the_quantile_is_within_1_percent(
    parts: list[list[int]], singles: list[int]
) -> None:
    counted = []
    for part in parts:
        each = Durations()
        each.add(np.array(part))
        for duration in singles:
            each.add_one(duration)
        part += singles
        counted.append(each)
    spread = Durations.joined(counted).spread()
    assert spread is not None
    whole = sorted(delay for part in parts for delay in part)
    assert spread.mean == pytest.approx(sum(whole) / len(whole) / SECOND, rel=1e-9, abs=1e-9)
    assert spread.max == whole[-1] / SECOND
    exact = whole[-(-99 * len(whole) // 100) - 1] / SECOND
    assert spread.p99 == pytest.approx(exact, rel=0.0101, abs=1e-12)
    assert spread.p99 <= spread.max


def test_two_of_two_hundred_are_beyond_the_quantile_and_three_are_not() -> None:
    for late, p99 in ((2, 1.0), (3, 100.0)):
        durations = Durations()
        durations.add(np.array([SECOND] * (200 - late) + [100 * SECOND] * late))
        spread = durations.spread()
        assert spread is not None
        # 99 % do not exceed it, so it is rounded up.
        assert p99 <= spread.p99 <= p99 * 1.0101
        assert spread.max == 100.0


def test_zero_is_exact_and_nothing_has_no_spread() -> None:
    zero = Durations()
    zero.add(np.zeros(3, np.int64))
    spread = zero.spread()
    assert spread is not None
    assert (spread.mean, spread.p99, spread.max) == (0.0, 0.0, 0.0)
    assert Durations().spread() is None


@pytest.mark.parametrize("at_once", [1, _SINGLE - 1])
def test_durations_that_come_in_few_take_no_more_memory_the_more_there_are(at_once: int) -> None:
    durations = Durations()

    def count() -> None:
        for _ in range(30 * _SINGLE // at_once):
            if at_once == 1:
                durations.add_one(7)
            else:
                durations.add(np.full(at_once, 7))

    # Half of what they would take, at 8 bytes each.
    assert peak_of(count) < 30 * _SINGLE * 8 / 2


@pytest.mark.parametrize("at_once", [1, 7, _SINGLE - 1, _SINGLE, _SINGLE + 1, 2_500])
def test_thousands_are_all_counted_however_many_come_at_once(at_once: int) -> None:
    durations = Durations()
    whole = SECOND * np.arange(1, 2_501)
    for begin in range(0, 2_500, at_once):
        if at_once == 1:
            durations.add_one(int(whole[begin]))
        else:
            durations.add(whole[begin : begin + at_once])
    spread = durations.spread()
    assert spread is not None
    assert (spread.mean, spread.max) == (1_250.5, 2_500.0)
    assert 2_475.0 <= spread.p99 <= 2_475.0 * 1.0101
