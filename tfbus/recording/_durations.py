"""Many durations in little memory: a histogram with buckets of 1 %."""

import math
from array import array
from collections import Counter
from collections.abc import Iterable
from typing import Final

import numpy as np
import numpy.typing as npt

from tfbus.recording.spread import Spread
from tfbus.stamps import SECOND, STAMP_MAX, to_seconds

_GROWTH: Final = math.log(1.01)
_SINGLE: Final = 1_000
"""Durations that come in few are counted so many at once."""


class Durations:
    """Counts durations by their size; mean and maximum are exact."""

    def __init__(self) -> None:
        self._single = array("q")
        self._count = 0
        self._total = 0.0
        self._max = -math.inf
        self._buckets: Counter[int] = Counter()

    @classmethod
    def joined(cls, parts: Iterable["Durations"]) -> "Durations":
        """The durations of all parts."""
        whole = cls()
        for part in parts:
            part._count_single()
            whole._count += part._count
            whole._total += part._total
            whole._max = max(whole._max, part._max)
            whole._buckets.update(part._buckets)
        return whole

    def add_one(self, duration: int) -> None:
        """Count a duration in ns; one that does not fit 64 bits as the longest that does."""
        self._single.append(max(-STAMP_MAX, min(duration, STAMP_MAX)))
        if len(self._single) >= _SINGLE:
            self._count_single()

    def add(self, durations: npt.NDArray[np.int64]) -> None:
        """Count durations in ns; there is at least one."""
        if len(durations) < _SINGLE:
            self._single.frombytes(durations.astype(np.int64, copy=False).tobytes())
            if len(self._single) >= _SINGLE:
                self._count_single()
        else:
            self._count_all(durations)

    def _count_single(self) -> None:
        if self._single:
            single, self._single = self._single, array("q")
            self._count_all(np.array(single, np.int64))

    def _count_all(self, durations: npt.NDArray[np.int64]) -> None:
        self._count += len(durations)
        self._total += float(durations.sum(dtype=np.float64)) / SECOND
        self._max = max(self._max, to_seconds(int(durations.max())))
        # The number of a bucket is the logarithm of its upper end, with the sign of the durations; 0 ns has its own.
        sizes = np.ceil(np.log(np.maximum(np.abs(durations.astype(np.float64)), 1.0)) / _GROWTH).astype(np.int64) + 1
        buckets, counts = np.unique(np.sign(durations) * sizes, return_counts=True)
        for bucket, count in zip(buckets.tolist(), counts.tolist(), strict=True):
            self._buckets[bucket] += count

    def spread(self) -> Spread | None:
        """Their spread; None if there are none."""
        self._count_single()
        if not self._count:
            return None
        rank = math.ceil(0.99 * self._count)
        for bucket in sorted(self._buckets):
            rank -= self._buckets[bucket]
            if rank <= 0:
                break
        size = math.exp((abs(bucket) - 1) * _GROWTH) / SECOND if bucket else 0.0
        return Spread(self._total / self._count, min(math.copysign(size, bucket), self._max), self._max)
