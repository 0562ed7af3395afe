"""`Periods`, the times between the different stamps in some arrays, found with little memory beside the arrays."""

from array import array
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from tfbus.recording._durations import Durations
from tfbus.recording.spread import Spread
from tfbus.stamps import SECOND, time_between, to_seconds

_AT_ONCE: Final = 50_000
"""So many stamps are merged at once, roughly."""


class Periods:
    """The periods of all stamps together.

    Parameters
    ----------
    arrays : sequence of array of int
        Stamps in ns, in any order; they are sorted in place.

    Attributes
    ----------
    oldest, newest : int or None
        ns; None without any stamp.
    longest : float or None
        The longest period, in s; None for fewer than two different stamps.
    """

    def __init__(self, arrays: Sequence["array[int]"]) -> None:
        columns = [np.frombuffer(stamps, np.int64) for stamps in arrays if stamps]
        for column in columns:
            if (column[1:] < column[:-1]).any():
                column.sort()
        self.oldest = min((int(column[0]) for column in columns), default=None)
        self.newest = max((int(column[-1]) for column in columns), default=None)
        self._durations = Durations()
        self._different = 0
        total = sum(map(len, columns))
        longest = max(columns, key=len, default=np.empty(0, np.int64))
        # Windows that end at stamps of the longest one hold about as many stamps of all others.
        step = max(1, _AT_ONCE * len(longest) // max(total, 1))
        ends = [*longest[step::step].tolist(), None] if columns else []
        firsts = [0] * len(columns)
        before: int | None = None
        for end in ends:
            parts = []
            for at, column in enumerate(columns):
                first = firsts[at]
                firsts[at] = len(column) if end is None else int(np.searchsorted(column, end))
                parts.append(column[first : firsts[at]])
            merged = np.sort(np.concatenate(parts))
            before = self._add(merged[np.append(True, merged[1:] != merged[:-1])] if len(merged) else merged, before)
        maximum = None if self._different < 2 else self._durations.spread()
        self.longest = None if maximum is None else maximum.max

    def _add(self, stamps: npt.NDArray[np.int64], before: int | None) -> int | None:
        """Count the periods of different stamps that ascend; returns the last stamp."""
        if not len(stamps):
            return before
        self._different += len(stamps)
        ends = stamps if before is None else np.concatenate(([np.int64(before)], stamps))
        periods = time_between(ends[:-1], ends[1:])
        if len(periods):
            self._durations.add(periods)
        return int(stamps[-1])

    @property
    def rate(self) -> float | None:
        """Different stamps per second; None for fewer than two."""
        if self._different < 2 or self.oldest is None or self.newest is None:
            return None
        return (self._different - 1) * SECOND / (self.newest - self.oldest)

    def spread(self) -> Spread | None:
        """Their spread; None for fewer than two different stamps."""
        spread = self._durations.spread()
        if spread is None or self.oldest is None or self.newest is None:
            return None
        # The mean of the histogram has rounding errors.
        return replace(spread, mean=to_seconds(self.newest - self.oldest) / (self._different - 1))
