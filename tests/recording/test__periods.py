from array import array

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tfbus import SECOND
from tfbus.recording import summary
from tfbus.recording.summary import Periods

columns = st.lists(st.lists(st.integers(0, 10**4), max_size=60), max_size=4)


@given(columns=columns, at_once=st.sampled_from([1, 7, 10**6]))
@example(columns=[], at_once=1)
@example(columns=[[5], [], [5, 5]], at_once=1)
@example(columns=[[5], [7, 7]], at_once=1)
@example(columns=[[9, 3, 6], [0, 3, 1]], at_once=1)
@example(columns=[[3, 0], [9, 12, 10]], at_once=10**6)
def test_the_periods_are_those_of_all_different_stamps(columns: list[list[int]], at_once: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(summary, "_AT_ONCE", at_once)
        periods = Periods([array("q", [stamp * SECOND for stamp in column]) for column in columns])
    stamps = sorted({stamp for column in columns for stamp in column})
    differences = np.diff(stamps)
    assert periods.oldest == (stamps[0] * SECOND if stamps else None)
    assert periods.newest == (stamps[-1] * SECOND if stamps else None)
    spread = periods.spread()
    if len(stamps) < 2:
        assert (periods.rate, periods.longest, spread) == (None, None, None)
        return
    assert spread is not None
    assert periods.rate == pytest.approx(1 / differences.mean())
    assert periods.longest == spread.max == differences.max()
    assert spread.mean == pytest.approx(differences.mean(), rel=1e-12)
    assert spread.p99 == pytest.approx(sorted(differences)[-(-99 * len(differences) // 100) - 1], rel=0.0101)


def test_the_stamps_stay_in_their_arrays_sorted() -> None:
    stamps = array("q", [3, 1, 2])
    Periods([stamps])
    stamps.append(9)
    assert list(stamps) == [1, 2, 3, 9]
