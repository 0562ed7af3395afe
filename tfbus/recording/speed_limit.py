"""`SpeedLimit`, which leaves out samples that no robot can have reached."""

import math
from collections import Counter

from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.rows import Row
from tfbus.stamps import SECOND, is_real

_MAX_CANDIDATES = 16


class SpeedLimit:
    """Decides for each moving sample whether its frame can have moved there from the last one that was kept.

    Parameters
    ----------
    speed : float
        In m/s.

    Attributes
    ----------
    dropped : Counter
        The number of samples left out, under ``"speed"``.

    Raises
    ------
    TypeError, ValueError
        If the speed is not a number greater than zero.
    """

    def __init__(self, speed: float) -> None:
        if not is_real(speed):
            raise TypeError(f"max_speed must be a number of m/s, not {speed!r}")
        if not speed > 0:
            raise ValueError(f"max_speed must be greater than zero, got {speed!r}")
        self.dropped: Counter[str] = Counter()
        self._speed = float(speed)
        self._kept: dict[tuple[str, str], tuple[int, Row]] = {}
        self._candidates: dict[tuple[str, str], list[TransformStamped]] = {}

    def admit(self, batch: Batch) -> Batch:
        """The samples of a batch that are kept, with those from before that have become certain."""
        kept: list[TransformStamped] = []
        for sample in batch:
            if sample.static:
                kept.append(sample)
            else:
                kept += self._judge(sample)
        return tuple(kept)

    def undecided(self) -> Batch:
        """At the end of all samples: the first of each frame of which no two agree."""
        kept = []
        for candidates in self._candidates.values():
            kept.append(candidates[0])
            self._drop(len(candidates) - 1)
        self._candidates.clear()
        return tuple(kept)

    def _judge(self, sample: TransformStamped) -> list[TransformStamped]:
        parent, child, stamp, row, _, _ = sample._fields
        key = parent, child
        last = self._kept.get(key)
        if last is not None:
            if not self._reaches(*last, stamp, row):
                self._drop(1)
                return []
            self._kept[key] = stamp, row
            return [sample]
        candidates = self._candidates.setdefault(key, [])
        for candidate in candidates:
            if self._reaches(candidate.stamp, candidate._fields[3], stamp, row):
                del self._candidates[key]
                self._drop(len(candidates) - 1)
                self._kept[key] = stamp, row
                return [candidate, sample]
        candidates.append(sample)
        if len(candidates) > _MAX_CANDIDATES:
            del candidates[0]
            self._drop(1)
        return []

    def _reaches(self, stamp: int, row: Row, other_stamp: int, other: Row) -> bool:
        # Samples of one stamp replace each other: no speed is known.
        time = abs(other_stamp - stamp)
        return time == 0 or math.dist(row[:3], other[:3]) <= self._speed * time / SECOND

    def _drop(self, count: int) -> None:
        if count:
            self.dropped["speed"] += count
