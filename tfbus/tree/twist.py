"""The velocity of a frame: the analytic derivative of the interpolation.

Between two samples the origin moves on a straight line at a constant velocity, and slerp turns at a constant angular
velocity about an axis that stands still in the parent. At a sample, this is the left derivative; at the first sample of
a window, or of a new parent, the right derivative.
"""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tfbus.errors import PastExtrapolationError, TransformLookupError
from tfbus.rows import IDENTITY, Columns, Quaternion, Row, Vector, compose, invert, rotate
from tfbus.stamps import LATEST, SECOND, STAMP_MIN, Stamps
from tfbus.tree.forest import Forest, Step
from tfbus.tree.history import FrameHistory, Samples
from tfbus.tree.lookup import At, find
from tfbus.tree.lookup_many import Answers, OutOfRange, Query, Segments, check_out_of_range, copy_paths, nanoseconds

ZERO: Vector = (0.0, 0.0, 0.0)

Vectors = tuple[Any, Any, Any]
"""Three floats, or three arrays of shape (n,)."""


class Motion(NamedTuple):
    """The pose and the velocity of a frame in another, along the axes of that other frame; at one stamp or at many."""

    row: Row | Columns
    linear: Vectors
    """Velocity of the frame's origin in m/s."""
    angular: Vectors
    """Angular velocity in rad/s."""


def twist(forest: Forest, frame: str, reference: str, at: At, axes: str) -> tuple[int, Vector, Vector]:
    """The stamp, and a frame's linear and angular velocity seen from `reference`, along the axes of a third frame.

    It raises the errors of `TransformTree.twist`. The caller holds the lock.
    """
    stamp = _common_stamp(forest, frame, reference, axes) if at is LATEST else at
    # This lookup raises the error of the deciding edge where several have no answer.
    find(forest, reference, frame, stamp, None)
    turn = find(forest, axes, reference, stamp, None)[1][3:]
    path = forest.find_path(reference, frame, stamp)
    _, linear, angular = motion_of_path(
        *([_motion_of(step, stamp) for step in steps] for steps in (path.up, path.down))
    )
    return stamp, rotate(turn, *linear), rotate(turn, *angular)


def twist_many(
    forest: Forest, frame: str, reference: str, stamps: Stamps, axes: str, out_of_range: OutOfRange
) -> npt.NDArray[np.float64]:
    """The linear and the angular velocity of `TransformTree.twist_many`, shape (6, n)."""
    check_out_of_range(out_of_range)
    # At a sample, the segment before counts.
    query = Query(reference, frame, np.concatenate((stamps, np.maximum(stamps, STAMP_MIN + 1) - 1)))
    to_axes = Query(axes, reference, stamps)
    span = to_axes.span()
    while True:
        with forest.lock:
            paths, axes_paths = copy_paths(forest, query, span), copy_paths(forest, to_axes, span)
        turns = Answers(axes_paths, stamps, None)
        found = np.full((6, len(stamps)), np.nan)
        for places, path in paths.split(stamps):
            here = stamps[places]
            if path is not None and len(here):
                covered = path.covered(here)
                at = np.arange(len(stamps))[places][covered]
                up, down = ([_motions_of(step, stamps[at]) for step in steps] for steps in (path.up, path.down))
                _, linear, angular = motion_of_path(up, down)
                for row, column in enumerate(linear + angular):
                    found[row, at] = column
        turn = (*turns.columns()[3:],)
        found = np.stack((*rotate(turn, *found[:3]), *rotate(turn, *found[3:])))
        missing = np.isnan(found[0])
        connected = turns.connected and Answers(paths, stamps, None).connected
        if not missing.any() or (out_of_range == "nan" and connected):
            return found
        first = int(missing.argmax())
        try:
            with forest.lock:
                twist(forest, frame, reference, int(stamps[first]), axes)
        except TransformLookupError as error:
            error.index = first
            raise
        # The missing samples have arrived meanwhile.


def _common_stamp(forest: Forest, frame: str, reference: str, axes: str) -> int:
    """The newest stamp at which the frame and the axes are known; if nothing moves, the stamp of static samples."""
    stamp, _, frame_static = find(forest, reference, frame, LATEST, None)
    axes_stamp, _, axes_static = find(forest, axes, reference, LATEST, None)
    if axes_static or frame_static or stamp == axes_stamp:
        return stamp if axes_static else axes_stamp
    (lagging_end, ahead_end), common = ((frame, axes), stamp) if stamp < axes_stamp else ((axes, frame), axes_stamp)
    try:
        find(forest, reference, ahead_end, common, None)
    except PastExtrapolationError as error:
        # As on one path, the lagging edge has to reach the windows of the others.
        lagging = forest.find_path(reference, lagging_end, LATEST).newest_common()[1]
        raise lagging.extrapolation_error(common if error.oldest is None else error.oldest) from error
    return common


def motion_of_path(up: Iterable[Motion], down: Iterable[Motion]) -> Motion:
    """The pose and the velocity of a path's source, seen from its target, by the motions of its edges.

    Both are computed in the common ancestor. The target's own motion is subtracted (Craig, "Introduction to Robotics",
    3rd edition, section 5.3), and the difference is rotated into the target's axes.
    """
    above, below = _climb(up), _climb(down)
    arm = _difference(above.row[:3], below.row[:3])
    linear = _difference(_difference(above.linear, below.linear), _cross(below.angular, arm))
    angular = _difference(above.angular, below.angular)
    back = invert(below.row)
    return Motion(compose(back, above.row), rotate(back[3:], *linear), rotate(back[3:], *angular))


def _climb(edges: Iterable[Motion]) -> Motion:
    """The motion of the first edge's child, seen from the last edge's parent."""
    row, linear, angular = Motion(IDENTITY, ZERO, ZERO)
    for here in edges:
        turn = here.row[3:]
        arm = rotate(turn, *row[:3])
        linear = _sum(_sum(here.linear, _cross(here.angular, arm)), rotate(turn, *linear))
        angular = _sum(here.angular, rotate(turn, *angular))
        row = compose(here.row, row)
    return Motion(row, linear, angular)


def _motion_of(edge: Step, at: int) -> Motion:
    if not isinstance(edge, FrameHistory):
        return Motion(edge, ZERO, ZERO)
    row = edge.row_at(at)
    i = edge.find(at)
    if edge.stamp(i) == at and not edge.is_segment(i):
        i += 1
        if i == edge.count:
            # A lone sample has a pose but no velocity.
            raise edge.extrapolation_error(at + 1)
    if not edge.is_segment(i):
        return Motion(row, ZERO, ZERO)
    stamp, before = edge.sample(i - 1)
    until, after = edge.sample(i)
    return motion_between(row, before, after, until - stamp)


def motion_between(row: Row, before: Row, after: Row, duration: int) -> Motion:
    """The motion of an edge that is at `row` between two samples, by the time between them in ns."""
    rate = SECOND / duration
    x, y, z = _difference(after[:3], before[:3])
    return Motion(row, (x * rate, y * rate, z * rate), _turn_rate(before[3:], after[3:], rate))


def _motions_of(edge: Samples | Row, stamps: Stamps) -> Motion:
    """The motion of an edge at many stamps that it covers, by the rules of `_motion_of`; NaN for a lone sample."""
    if not isinstance(edge, Samples):
        return Motion(edge, ZERO, ZERO)
    own, rows = edge.stamps, edge.rows
    last = len(own) - 1
    parents = np.zeros(last + 1) if edge.parents is None else np.unique(edge.parents, return_inverse=True)[1]
    # Whether each sample ends a segment; behind the last one, nothing does.
    ends_segment = np.append(np.insert(parents[1:] == parents[:-1], 0, False), False)
    end = own.searchsorted(stamps)
    end += (own[end] == stamps) & ~ends_segment[end]
    at, before = np.minimum(end, last), np.maximum(np.minimum(end, last) - 1, 0)
    rate = np.where(ends_segment[end], SECOND / np.maximum(nanoseconds(own[before], own[at]), 1.0), 0.0)
    rate[end > last] = np.nan
    a, b = rows[before].T, rows[at].T
    moved = (*((b[:3] - a[:3]) * rate),)
    x, y, z, _ = compose((0.0, 0.0, 0.0, *b[3:]), invert((0.0, 0.0, 0.0, *a[3:])))[3:]
    sine = np.hypot(np.hypot(x, y), z)
    dot = a[3] * b[3] + a[4] * b[4] + a[5] * b[5] + a[6] * b[6]
    scale = 2.0 * np.arctan2(sine, np.abs(dot)) / np.where(sine == 0.0, 1.0, sine) * np.where(dot < 0.0, -rate, rate)
    return Motion(Segments(edge, stamps).at(slice(None)), moved, (x * scale, y * scale, z * scale))


def _turn_rate(before: Quaternion, after: Quaternion, rate: float) -> Vector:
    """The constant angular velocity that turns one rotation into the next along the shorter arc, in the parent."""
    x, y, z, _ = compose((0.0, 0.0, 0.0, *after), invert((0.0, 0.0, 0.0, *before)))[3:]
    sine = math.hypot(x, y, z)
    if sine == 0.0:
        return ZERO
    # The same order of additions as in the lookup: in a half turn, rounding decides the direction.
    ai, aj, ak, aw = before
    bi, bj, bk, bw = after
    dot = ai * bi + aj * bj + ak * bk + aw * bw
    scale = 2.0 * math.atan2(sine, abs(dot)) / sine * (-rate if dot < 0.0 else rate)
    return x * scale, y * scale, z * scale


def _sum(a: Vectors, b: Vectors) -> Vectors:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _difference(a: Vectors, b: Vectors) -> Vectors:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _cross(a: Vectors, b: Vectors) -> Vectors:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
