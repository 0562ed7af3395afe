"""What a question amounts to: which stamp `LATEST` means, and the row along the path. The caller holds the lock."""

from contextlib import suppress

from tfbus.errors import DisconnectedError, ExtrapolationError, FutureExtrapolationError, GapError, TransformLookupError
from tfbus.geometry.rows import Row, compose
from tfbus.stamps import LATEST, Latest, as_stamp
from tfbus.tree._extrapolation import Leniency
from tfbus.tree._python_kernel import climb
from tfbus.tree.forest import Forest
from tfbus.tree.history import FrameHistory
from tfbus.tree.path import Path, find_path

At = int | Latest
Resolved = tuple[int, Row, bool]
"""Stamp in ns, row, and whether the whole path is static."""

GO_TOGETHER = "source_at and fixed go together: source at its stamp, carried through the fixed frame"


def resolve(
    forest: Forest, target: str, source: str, at: At, not_before: int | None, lenient: Leniency | None = None
) -> Resolved:
    """Source in target at one stamp. The errors are those of `TransformTree.lookup`."""
    path = forest.paths.get((target, source))
    if path is None:
        path = forest.find_path(target, source, at)
    if not path.moving:
        if isinstance(at, Latest):
            at = path.static_stamp if len(path.frames) > 1 else _newest_of(forest, target)
        return as_stamp(at), path.row(0), True
    if at is LATEST:
        return _resolve_latest(forest, path, not_before, lenient)
    if lenient is not None:
        return at, lenient.row(path, as_stamp(at)), False
    try:
        return at, climb(path.up, at) if not path.down else path.row(at), False
    except ExtrapolationError:
        # Another edge may decide; and the error that is raised for good keeps none of this alive.
        pass
    raise path.blocker(as_stamp(at))


def _resolve_latest(forest: Forest, path: Path, not_before: int | None, lenient: Leniency | None) -> Resolved:
    """As `resolve`, at the newest stamp that every moving edge has reached; under a policy, see `_missing`."""
    common, lagging = path.newest_common()
    if lenient is not None:
        common = min(common + lenient.policy.hold, max(edge.stamps[-1] for edge in path.moving))
    if not_before is not None and common < not_before:
        raise _missing(path, lagging, not_before, lenient, 0)
    try:
        there = path
        if not path.lasting:
            there = find_path(forest.frames, path.frames[0], path.frames[-1], common)
        return common, there.row(common) if lenient is None else lenient.row(there, common), False
    except TransformLookupError as error:
        # The lagging edge has to come as far as the others still reach back, or out of a gap of theirs; where a parent
        # has changed, each step of it may do.
        needed = common + 1
        if isinstance(error, GapError):
            needed = error.after
        elif path.lasting:
            needed = max(common if edge.oldest is None else edge.oldest for edge in path.moving)
        raise _missing(path, lagging, needed, lenient, 0 if lenient is None else lenient.policy.tolerance) from error


def _missing(
    path: Path, lagging: FrameHistory, needed: int, lenient: Leniency | None, slack: int
) -> ExtrapolationError:
    """The error that waits for the lagging edge.

    Under a policy the latest is the newest stamp of any edge, as far as the lagging one may be held, and an edge that
    lacks a sample may have another stand in: then a sample of any edge may help.
    """
    if lenient is None:
        return lagging.missing(needed)
    error = lagging.missing(needed, slack + lenient.policy.hold)
    if isinstance(error, FutureExtrapolationError):
        error.others = tuple(edge.child for edge in path.moving if edge is not lagging)
    return error


def resolve_travel(
    forest: Forest,
    target: str,
    source: str,
    at: At,
    source_at: At | None,
    fixed: str | None,
    not_before: int | None,
    lenient: Leniency | None = None,
) -> Resolved:
    """As `resolve`, with source at its own stamp, carried through the fixed frame."""
    if source_at is None or fixed is None:
        raise TypeError(GO_TOGETHER)
    if source_at is not LATEST:
        source_at = as_stamp(source_at)
    for name in (target, source, fixed):
        forest.check_known(name)
    try:
        stamp, target_from_fixed, static = resolve(forest, target, fixed, at, not_before, lenient)
    except FutureExtrapolationError:
        # Waiting for this leg is no use if it cannot help the other one.
        resolve(forest, fixed, source, source_at, not_before, lenient)
        raise
    except DisconnectedError:
        with suppress(DisconnectedError, FutureExtrapolationError):
            resolve(forest, fixed, source, source_at, not_before, lenient)
        raise
    source_stamp, fixed_from_source, still = resolve(forest, fixed, source, source_at, not_before, lenient)
    if at is LATEST and static and not still:
        stamp = source_stamp
    return stamp, compose(target_from_fixed, fixed_from_source), static and still


def _newest_of(forest: Forest, frame: str) -> int:
    history = forest.frames.get(frame)
    return 0 if history is None else history.static_stamp or history.newest or 0
