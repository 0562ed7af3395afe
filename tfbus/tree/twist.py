"""The velocity of a frame: the analytic derivative of the interpolation.

Between two samples the origin moves on a straight line at a constant velocity, and slerp turns at a constant angular
velocity about an axis that stands still in the parent. At a sample, this is the left derivative; at the first sample of
a window, or of a new parent, the right derivative.
"""

import math
from typing import NamedTuple

from tfbus.errors import PastExtrapolationError
from tfbus.rows import IDENTITY, Quaternion, Row, Vector, compose, invert, rotate
from tfbus.stamps import LATEST, SECOND
from tfbus.tree.forest import Forest, Path, Step
from tfbus.tree.history import FrameHistory
from tfbus.tree.lookup import At, find

ZERO: Vector = (0.0, 0.0, 0.0)


class Motion(NamedTuple):
    """The pose and the velocity of a frame in another, along the axes of that other frame."""

    row: Row
    linear: Vector
    """Velocity of the frame's origin in m/s."""
    angular: Vector
    """Angular velocity in rad/s."""


def twist(forest: Forest, frame: str, reference: str, at: At, axes: str) -> tuple[int, Vector, Vector]:
    """The stamp, and a frame's linear and angular velocity seen from `reference`, along the axes of a third frame.

    It raises the errors of `TransformTree.twist`. The caller holds the lock.
    """
    stamp = _common_stamp(forest, frame, reference, axes) if at is LATEST else at
    # This lookup raises the error of the deciding edge where several have no answer.
    find(forest, reference, frame, stamp, None)
    turn = find(forest, axes, reference, stamp, None)[1][3:]
    linear, angular = _motion(forest.find_path(reference, frame, stamp), stamp)
    return stamp, rotate(turn, *linear), rotate(turn, *angular)


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


def _motion(path: Path, at: int) -> tuple[Vector, Vector]:
    """The linear and angular velocity of a path's source, seen from its target.

    Both are computed in the common ancestor. The target's own motion is subtracted (Craig, "Introduction to Robotics",
    3rd edition, section 5.3), and the difference is rotated into the target's axes.
    """
    above, below = _climb(path.up, at), _climb(path.down, at)
    arm = _difference(above.row[:3], below.row[:3])
    linear = _difference(_difference(above.linear, below.linear), _cross(below.angular, arm))
    angular = _difference(above.angular, below.angular)
    turn = invert(below.row)[3:]
    return rotate(turn, *linear), rotate(turn, *angular)


def _climb(steps: tuple[Step, ...], at: int) -> Motion:
    """The motion of the first step's child, seen from the last step's parent."""
    row, linear, angular = Motion(IDENTITY, ZERO, ZERO)
    for step in steps:
        here = _edge_motion(step, at) if isinstance(step, FrameHistory) else Motion(step, ZERO, ZERO)
        turn = here.row[3:]
        arm = rotate(turn, *row[:3])
        linear = _sum(_sum(here.linear, _cross(here.angular, arm)), rotate(turn, *linear))
        angular = _sum(here.angular, rotate(turn, *angular))
        row = compose(here.row, row)
    return Motion(row, linear, angular)


def _edge_motion(edge: FrameHistory, at: int) -> Motion:
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
    rate = SECOND / (until - stamp)
    x, y, z = _difference(after[:3], before[:3])
    return Motion(row, (x * rate, y * rate, z * rate), _turn_rate(before[3:], after[3:], rate))


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


def _sum(a: Vector, b: Vector) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _difference(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
