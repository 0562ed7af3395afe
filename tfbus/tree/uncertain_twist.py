"""The covariance of a velocity: that of the samples at both ends of each segment, carried through the derivative.

A velocity is the difference of two samples by their time, so its error is that of the difference: for a drift, only
the part that was added between the two. The Jacobian of the twist by each sample is taken by differences, because the
lever arms of all edges, their velocities and the interpolation are in it.
"""

from typing import NamedTuple

import numpy as np

from tfbus.geometry.covariance import Matrix
from tfbus.rows import Row, Vector, interpolate, invert, rotate
from tfbus.tree.forest import Forest
from tfbus.tree.history import FrameHistory
from tfbus.tree.lookup import At
from tfbus.tree.twist import ZERO, Motion, motion_between, motion_of_path, twist
from tfbus.tree.uncertain import edges_of, error_at
from tfbus.uncertainty.answers import Name, disturbed
from tfbus.uncertainty.correlation import EdgeError, covariances

_STEP = 1e-6
"""In m and rad: the step of the differences."""


class _Segment(NamedTuple):
    """One edge on the way from reference to frame, at the two samples around a stamp, or at a single one."""

    name: Name
    climbs: bool
    stamps: tuple[int, ...]
    rows: tuple[Row, ...]
    errors: tuple[EdgeError | None, ...]

    def motion(self, rows: tuple[Row, ...], at: int) -> Motion:
        """The motion of the edge at a stamp if it had other rows."""
        if len(rows) == 1:
            return Motion(rows[0], ZERO, ZERO)
        first, last = self.stamps
        row = interpolate(rows[0], rows[1], (at - first) / (last - first))
        return motion_between(row, rows[0], rows[1], last - first)


def uncertain_twist(
    forest: Forest, frame: str, reference: str, at: At, in_frame: bool
) -> tuple[int, Vector, Vector, Matrix, list[Name]]:
    """As `tfbus.tree.twist.twist`, with the covariance, and the edges that gave none. The caller holds the lock.

    The twist is along the axes of `reference`, or of `frame` with `in_frame`.
    """
    stamp, linear, angular = twist(forest, frame, reference, at, frame if in_frame else reference)
    if frame == reference:
        return stamp, linear, angular, np.zeros((6, 6)), []
    path = forest.find_path(reference, frame, stamp)
    segments = [_segment(edge, climbs, stamp) for edge, climbs in edges_of(path, forest)]
    motions = [segment.motion(segment.rows, stamp) for segment in segments]

    def twist_with(place: int, rows: tuple[Row, ...]) -> list[float]:
        """The twist if the segment at a place had other rows."""
        changed = [*motions[:place], segments[place].motion(rows, stamp), *motions[place + 1 :]]
        down = [motion for segment, motion in zip(segments, changed, strict=True) if segment.climbs]
        up = [motion for segment, motion in zip(segments, changed, strict=True) if not segment.climbs]
        row, moved, turned = motion_of_path(up[::-1], down)
        if in_frame:
            back = invert(row)[3:]
            moved, turned = rotate(back, *moved), rotate(back, *turned)
        return [*moved, *turned]

    total, exact = np.zeros((6, 6)), []
    for place, segment in enumerate(segments):
        known = [error for error in segment.errors if error is not None]
        if len(known) < len(segment.rows):
            exact.append(segment.name)
            continue
        parts = []
        for i, row in enumerate(segment.rows):
            moved = np.stack(np.broadcast_arrays(*disturbed(row, _STEP * np.vstack((np.eye(6), -np.eye(6))))), axis=1)
            found = [
                twist_with(place, (*segment.rows[:i], _row(other), *segment.rows[i + 1 :])) for other in moved.tolist()
            ]
            parts.append((np.array(found[:6]) - np.array(found[6:])).T / (2.0 * _STEP))
        jacobian, size = np.hstack(parts), 6 * len(known)
        total += jacobian @ covariances(known).swapaxes(1, 2).reshape(size, size) @ jacobian.T
    return stamp, linear, angular, 0.5 * (total + total.T), exact


def _segment(edge: FrameHistory, climbs: bool, at: int) -> _Segment:
    """The samples of an edge that its velocity at a stamp is made of, as `tfbus.tree.twist` chooses them."""
    ends: tuple[tuple[int, Row], ...] = ((at, edge.row_at(at)),)
    if not edge.static:
        i = edge.find(at)
        if edge.stamp(i) == at and not edge.is_segment(i):
            i += 1
        if edge.is_segment(i):
            ends = edge.sample(i - 1), edge.sample(i)
    errors = tuple(error_at(edge, stamp, row[:3]) for stamp, row in ends)
    stamps, rows = zip(*ends, strict=True)
    return _Segment((edge.parent_at(at), edge.child), climbs, stamps, rows, errors)


def _row(numbers: list[float]) -> Row:
    x, y, z, qx, qy, qz, qw = numbers
    return x, y, z, qx, qy, qz, qw
