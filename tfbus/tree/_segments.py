"""Interpolation of one edge at many stamps.

Each segment between two samples is prepared once, so that a stamp costs one search, one sine and one cosine. If there
are fewer stamps than samples, only the segments that are needed are prepared.
"""

import numpy as np
import numpy.typing as npt

from tfbus.geometry.rows import Columns
from tfbus.stamps import Stamps
from tfbus.tree.history import Samples

Floats = npt.NDArray[np.float64]

_STRAIGHT = 1e-9
"""Replaces an angle that rounds to zero. Its cosine is one to the last digit, so the arc is a straight line."""


class Segments:
    """The segments of one edge, prepared for interpolation at given stamps.

    A segment goes from one sample to the next: ``t(s) = t0 + s v`` and ``q(s) = q0 cos(s w) + p sin(s w)``, with s the
    ns since its first sample, and p the unit quaternion a right angle away from q0 on the shorter arc to the next
    rotation. That is slerp with its two sines resolved (Shoemake 1985, section 3.3). The last sample has a segment of
    its own, which stays where it is, and so has one that is followed by another parent.
    """

    def __init__(self, samples: Samples, stamps: Stamps) -> None:
        own_stamps, rows = samples.stamps, samples.rows
        self._segments: npt.NDArray[np.intp] | None = own_stamps.searchsorted(stamps, "right") - 1
        self._elapsed = _nanoseconds(own_stamps[self._segments], stamps)
        first = np.arange(len(own_stamps))
        if len(stamps) < len(own_stamps):
            first, self._segments = self._segments, None
        last = np.minimum(first + 1, len(own_stamps) - 1)
        if samples.parents is not None:
            parents = np.array(samples.parents, object)
            last = np.where(parents[first] == parents[last], last, first)
        a, b = rows[first].T, rows[last].T
        duration = _nanoseconds(own_stamps[first], own_stamps[last])
        duration[first == last] = np.inf
        dot = (a[3:] * b[3:]).sum(axis=0)
        cosine = np.minimum(np.abs(dot), 1.0)
        angle = np.maximum(np.arccos(cosine), _STRAIGHT)
        sine = np.sin(angle)
        self._table = np.empty((15, len(first)))
        self._table[:7] = a
        self._table[7:10] = (b[:3] - a[:3]) / duration
        self._table[10:14] = (np.where(dot < 0.0, -b[3:], b[3:]) - cosine * a[3:]) / sine
        self._table[14] = angle / duration

    def at(self, part: slice) -> Columns:
        """The transforms at some of the stamps."""
        segments = self._segments
        table = self._table[:, part] if segments is None else self._table.take(segments[part], axis=1)
        elapsed = self._elapsed[part]
        angle = elapsed * table[14]
        moved = table[:3] + elapsed * table[7:10]
        turned = table[3:7] * np.cos(angle) + table[10:14] * np.sin(angle)
        return (*moved, *turned)


def _nanoseconds(begin: Stamps, end: Stamps) -> Floats:
    """The time between two stamps; exact for differences that exceed a signed 64-bit integer."""
    return (end - begin).view(np.uint64).astype(np.float64)
