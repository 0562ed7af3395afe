import dataclasses
import math
import pickle
from typing import Any

import pytest

from tfbus import Hold
from tfbus.stamps import STAMP_MAX
from tfbus.tree.lookup import Policy, policy_of


def test_three_arguments_make_a_policy_in_nanoseconds() -> None:
    assert policy_of(0.05, 0.5, Hold(0.2)) == Policy(50_000_000, 500_000_000, 200_000_000)


def test_default_arguments_make_no_policy() -> None:
    assert policy_of(0.0, None, None) is None


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


@pytest.mark.parametrize("bad", [-1.0, math.nan])
def test_a_negative_duration_is_an_error_that_names_the_argument(bad: float) -> None:
    with pytest.raises(ValueError, match="tolerance"):
        policy_of(bad, None, None)
    with pytest.raises(ValueError, match="max_gap"):
        policy_of(0.0, bad, None)
    with pytest.raises(ValueError, match="max_age"):
        Hold(bad)


@pytest.mark.parametrize("bad", ["1", None, True])
def test_an_argument_that_is_no_number_of_seconds_is_a_type_error(bad: Any) -> None:
    with pytest.raises(TypeError, match="tolerance"):
        policy_of(bad, None, None)
    with pytest.raises(TypeError, match="max_age"):
        Hold(bad)


def test_an_age_alone_is_no_extrapolation() -> None:
    with pytest.raises(TypeError, match=r"extrapolate must be a Hold, not 0\.2"):
        policy_of(0.0, None, 0.2)  # type: ignore[arg-type]


def test_a_hold_is_a_value() -> None:
    hold = Hold(0.2)
    assert pickle.loads(pickle.dumps(hold)) == hold == Hold(0.2)
    assert len({hold, Hold(0.2), Hold(0.3)}) == 2
    for value, name in ((hold, "max_age"), (Policy(), "hold")):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(value, name, 1)
        assert not hasattr(value, "__dict__")
