"""Lookups at one stamp: the stamp that `LATEST` means, the transform along the path, and the error if there is none."""

from contextlib import suppress
from typing import NamedTuple

from tfbus.errors import (
    AheadError,
    DisconnectedError,
    ExtrapolationError,
    FutureExtrapolationError,
    GapError,
    TransformLookupError,
)
from tfbus.geometry.rows import Row, compose
from tfbus.geometry.stamped import TransformStamped, answer_of, qualified_answer
from tfbus.stamps import LATEST, STAMP_MAX, STAMP_MIN, AtLike, Latest, StampLike, as_at, as_stamp
from tfbus.tree.extrapolation import Extrapolation
from tfbus.tree.forest import Forest
from tfbus.tree.history import FrameHistory
from tfbus.tree.path import Path
from tfbus.tree.policy import Policy

At = int | Latest
Found = tuple[int, Row, bool]
"""Stamp in ns, row, and whether the whole path is static."""

GO_TOGETHER = "source_at and fixed go together: source at its stamp, carried through the fixed frame"
AT_LATEST_ONLY = "not_before and not_after go with LATEST: an answer at a given stamp never gets newer"


class Bounds(NamedTuple):
    """The oldest and the newest stamp that count as `LATEST`, in ns."""

    not_before: int
    not_after: int


def bounds_of(not_before: StampLike | None, not_after: StampLike | None) -> Bounds | None:
    """The bounds that two arguments make; None if they allow every stamp.

    Raises
    ------
    TypeError, ValueError
        If one is not a stamp.
    """
    if not_before is None and not_after is None:
        return None
    return Bounds(
        STAMP_MIN if not_before is None else as_stamp(not_before),
        STAMP_MAX if not_after is None else as_stamp(not_after),
    )


def answer(
    forest: Forest,
    target: str,
    source: str,
    at: AtLike,
    source_at: AtLike | None,
    fixed: str | None,
    bounds: Bounds | None,
    policy: Policy | None,
) -> TransformStamped:
    """The answer of `TransformTree.lookup`, without keywords: each of them costs a twentieth of a lookup."""
    if policy is None and bounds is None and source_at is None and fixed is None:
        found = forest.paths.answer(target, source, at)
        if found is not None:
            return found
    if bounds is not None and at is not LATEST and source_at is not LATEST:
        raise TypeError(AT_LATEST_ONLY)
    if type(at) is not int and at is not LATEST:
        at = as_stamp(at)
    extrapolation = None if policy is None else Extrapolation(policy)
    if fixed is None:
        forest.search(target, source)
    else:
        forest.search(target, fixed)
        forest.search(fixed, source)
    with forest.lock:
        if source_at is None and fixed is None:
            stamp, row, static = find(forest, target, source, at, bounds, extrapolation)
        else:
            stamp, row, static = find_in_time_travel(
                forest, target, source, at, source_at, fixed, bounds, extrapolation
            )
    if extrapolation is None:
        return answer_of(target, source, stamp, row, static)
    return qualified_answer(target, source, stamp, row, static, extrapolation.extrapolated_by, extrapolation.gap)


def find(
    forest: Forest, target: str, source: str, at: At, bounds: Bounds | None, extrapolation: Extrapolation | None = None
) -> Found:
    """Source in target at one stamp. The caller holds the lock; the errors are those of `TransformTree.lookup`."""
    path = forest.paths.find(target, source)
    if path is None:
        path = forest.find_path(target, source, at)
    if not path.moving:
        if isinstance(at, Latest):
            at = path.static_stamp if len(path.frames) > 1 else _newest_stamp(forest, target)
        return as_stamp(at), path.row_at(0), True
    if at is LATEST:
        return _find_latest(forest, path, bounds, extrapolation)
    if extrapolation is not None:
        return at, _extrapolated(forest.find_path(target, source, at), at, extrapolation), False
    try:
        return at, path.row_at(as_stamp(at)), False
    except ExtrapolationError:
        # Another edge, or another way, may decide. That is found outside, so that an error keeps no traceback of this
        # one alive.
        pass
    if path.root in forest.frames:
        path = forest.find_path(target, source, at)
        if path.covers(at):
            return at, path.row_at(at), False
    raise path.deciding_error(as_stamp(at))


def _extrapolated(path: Path, at: int, extrapolation: Extrapolation) -> Row:
    """Source in target at a stamp, as far as a policy allows."""
    try:
        return extrapolation.row(path, at)
    except ExtrapolationError as error:
        decisive = path.with_rival(error, at)
    raise decisive


def _find_latest(forest: Forest, path: Path, bounds: Bounds | None, extrapolation: Extrapolation | None) -> Found:
    """Source in target at the newest stamp that every moving edge has reached.

    Under a policy it is the newest stamp of any edge, as far as the lagging edge may be held.
    """
    common, lagging = path.newest_common()
    if extrapolation is not None:
        common = min(common + extrapolation.policy.hold, max(map(_newest, path.moving)))
    if bounds is not None and common < bounds.not_before:
        raise _latest_error(path, lagging, bounds.not_before, extrapolation, 0)
    if bounds is not None and common > bounds.not_after:
        edge = lagging if extrapolation is None else max(path.moving, key=_newest)
        raise AheadError(
            child=edge.child, stamp=bounds.not_after, oldest=edge.oldest, newest=edge.newest, authority=edge.authority
        )
    if extrapolation is None and path.permanent:
        try:
            return common, path.row_at(common), False
        except ExtrapolationError:
            # Another way may count there. It is found outside, so that an error keeps no traceback of this one alive.
            pass
    try:
        way = path
        if not path.permanent or path.root in forest.frames:
            way = forest.find_path(path.frames[0], path.frames[-1], common)
        row = way.row_at(common) if extrapolation is None else extrapolation.row(way, common)
    except TransformLookupError as error:
        # The lagging edge has to reach what the others still hold, or the far end of their gap. Where a parent has
        # changed, any later stamp of it may be enough.
        needed = common + 1
        if isinstance(error, GapError):
            needed = error.after
        elif path.permanent:
            needed = max(common if edge.oldest is None else edge.oldest for edge in path.moving)
        tolerance = 0 if extrapolation is None else extrapolation.policy.tolerance
        raise _latest_error(path, lagging, needed, extrapolation, tolerance) from error
    return common, row, False


def _latest_error(
    path: Path, lagging: FrameHistory, needed: int, extrapolation: Extrapolation | None, slack: int
) -> ExtrapolationError:
    """The error of a `LATEST` lookup that waits until the lagging edge reaches `needed`.

    Under a policy, a sample of any other edge may help as well, because it may stand in for a missing one.
    """
    if extrapolation is None:
        return lagging.extrapolation_error(needed)
    error = lagging.extrapolation_error(needed, slack + extrapolation.policy.hold)
    if isinstance(error, FutureExtrapolationError):
        error.others = tuple(edge.child for edge in path.moving if edge is not lagging)
    return error


def find_in_time_travel(
    forest: Forest,
    target: str,
    source: str,
    at: AtLike,
    source_at: AtLike | None,
    fixed: str | None,
    bounds: Bounds | None,
    extrapolation: Extrapolation | None = None,
) -> Found:
    """Source at its own stamp, carried through the fixed frame into target at another. The caller holds the lock."""
    if source_at is None or fixed is None:
        raise TypeError(GO_TOGETHER)
    if source_at is not LATEST:
        source_at = as_stamp(source_at)
    at = as_at(at)
    for name in (target, source, fixed):
        forest.check_known(name)
    try:
        stamp, target_from_fixed, target_static = find(forest, target, fixed, at, bounds, extrapolation)
    except FutureExtrapolationError:
        # Waiting for this half is useless if waiting cannot help the other one: then that error is raised.
        find(forest, fixed, source, source_at, bounds, extrapolation)
        raise
    except DisconnectedError:
        with suppress(DisconnectedError, FutureExtrapolationError):
            find(forest, fixed, source, source_at, bounds, extrapolation)
        raise
    source_stamp, fixed_from_source, source_static = find(forest, fixed, source, source_at, bounds, extrapolation)
    if at is LATEST and target_static and not source_static:
        stamp = source_stamp
    return stamp, compose(target_from_fixed, fixed_from_source), target_static and source_static


def _newest(edge: FrameHistory) -> int:
    """The newest stamp of an edge that has samples, in ns."""
    return STAMP_MIN if edge.newest is None else edge.newest


def _newest_stamp(forest: Forest, frame: str) -> int:
    history = forest.frames.get(frame)
    return 0 if history is None else history.static_stamp or history.newest or 0
