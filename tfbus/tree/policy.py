"""Policies: which stamps a lookup may answer although no two close samples surround them.

Without a policy nothing is extrapolated, and any two samples are interpolated between, however far apart they are.
"""

import math
from dataclasses import dataclass

from tfbus.stamps import STAMP_MAX, as_duration, from_seconds


@dataclass(frozen=True, slots=True)
class Hold:
    """Let a sample stand in for the stamps after it, up to the edge's next sample.

    It does so where an edge has no sample after the stamp, or none that `max_gap` lets it interpolate to.

    Parameters
    ----------
    max_age : float
        For how long, in s.
    """

    max_age: float

    def __post_init__(self) -> None:
        as_duration(self.max_age, "max_age")


@dataclass(frozen=True, slots=True)
class Policy:
    """The limits of how far an answer may depart from its stamp; all in ns. Made by `policy_of`.

    Parameters
    ----------
    tolerance : int
        How far the nearest sample may be from a stamp that is not covered, or in a gap that is too long.
    max_gap : int or None
        How far two samples may be apart that are interpolated between; None for any distance.
    hold : int
        For how long a sample may stand in for the stamps after it.
    """

    tolerance: int = 0
    max_gap: int | None = None
    hold: int = 0

    @property
    def longest_hold(self) -> int:
        """The longest time that a sample may stand in for later stamps, by `tolerance` or by `hold`, in ns."""
        return max(self.tolerance, self.hold)


def policy_of(tolerance: float, max_gap: float | None, extrapolate: Hold | None) -> Policy | None:
    """The policy that three arguments in s make; None if they allow and refuse nothing.

    Raises
    ------
    TypeError, ValueError
        If one is not a duration, or `extrapolate` not a `Hold`.
    """
    if tolerance == 0.0 and max_gap is None and extrapolate is None:
        return None
    if extrapolate is not None and not isinstance(extrapolate, Hold):
        raise TypeError(f"extrapolate must be a Hold, not {extrapolate!r}")
    return Policy(
        _nanoseconds(tolerance, "tolerance"),
        None if max_gap is None else _nanoseconds(max_gap, "max_gap"),
        0 if extrapolate is None else _nanoseconds(extrapolate.max_age, "max_age"),
    )


def _nanoseconds(seconds: float, name: str) -> int:
    duration = as_duration(seconds, name)
    return STAMP_MAX if duration == math.inf else from_seconds(duration)
