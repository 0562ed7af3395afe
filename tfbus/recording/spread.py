"""`Spread`, the mean, the 99th percentile and the maximum of some durations."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Spread:
    """The mean of some durations, the one that 99 % of them do not exceed, and the greatest; in s.

    The one that 99 % do not exceed is known to 1 %.
    """

    mean: float
    p99: float
    max: float
