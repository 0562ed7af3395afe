"""Lookups at one stamp: the stamp that `LATEST` means, the transform along the path, and the error if there is none.

A policy says which stamps a lookup may answer although no two close samples surround them. Without a policy a lookup
extrapolates nothing, and interpolates between any two samples, however far apart they are.
"""

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple, TypedDict

import numpy as np

from tfbus.data import Stamped, check_registered
from tfbus.errors import (
    AheadError,
    DisconnectedError,
    ExtrapolationError,
    FutureExtrapolationError,
    GapError,
    TransformLookupError,
)
from tfbus.geometry.stamped import TransformStamped, answer_of, qualified_answer
from tfbus.rows import Row, compose
from tfbus.stamps import (
    LATEST,
    STAMP_MAX,
    STAMP_MIN,
    AtLike,
    Latest,
    StampLike,
    Stamps,
    as_at,
    as_duration,
    as_stamp,
    from_seconds,
)
from tfbus.tree.forest import Forest, Path
from tfbus.tree.history import FrameHistory, Samples


@dataclass(frozen=True, slots=True)
class Hold:
    """Let a sample stand in for the stamps after it, up to the edge's next sample.

    It does so where an edge has no sample after the stamp, or where `max_gap` forbids interpolation to that sample.

    Parameters
    ----------
    max_age : float
        For how long, in s.

    Examples
    --------
    >>> tree = TransformTree()
    >>> _ = tree.insert(TransformStamped("map", "cart", 0, Transform()))
    >>> answer = tree.lookup("map", "cart", from_seconds(0.1), extrapolate=Hold(0.5))
    >>> answer.extrapolated_by
    100000000
    """

    max_age: float
    _nanoseconds: int = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_nanoseconds", _nanoseconds(self.max_age, "max_age"))


@dataclass(frozen=True, slots=True)
class Policy:
    """The limits of how far an answer may depart from its stamp; all in ns. Made by `policy_of`.

    Parameters
    ----------
    tolerance : int
        The greatest distance of a sample that stands in, at a stamp that is not covered or lies in a gap too long.
    max_gap : int or None
        The greatest distance between two samples for interpolation; None for any distance.
    hold : int
        For how long a sample may stand in for the stamps after it.
    """

    tolerance: int = 0
    max_gap: int | None = None
    hold: int = 0

    @property
    def longest_hold(self) -> int:
        """The longest time that a sample may stand in for later stamps, by `tolerance` or by `hold`, in ns."""
        return max(self.tolerance, self.hold)


def policy_of(tolerance: float, max_gap: float | None, extrapolate: Hold | None) -> Policy | None:
    """The policy of a lookup by its three arguments, in s; None if they allow and refuse nothing.

    Raises
    ------
    TypeError, ValueError
        If one is not a duration, or `extrapolate` not a `Hold`.
    """
    if tolerance == 0.0 and max_gap is None and extrapolate is None:
        return None
    if extrapolate is not None and not isinstance(extrapolate, Hold):
        raise TypeError(f"extrapolate must be a Hold, not {extrapolate!r}")
    return Policy(
        _nanoseconds(tolerance, "tolerance"),
        None if max_gap is None else _nanoseconds(max_gap, "max_gap"),
        0 if extrapolate is None else extrapolate._nanoseconds,
    )


def _nanoseconds(seconds: float, name: str) -> int:
    duration = as_duration(seconds, name)
    return STAMP_MAX if duration == math.inf else from_seconds(duration)


class Question(NamedTuple):
    """The arguments of a lookup: stamps in ns, `max_age` in s.

    Examples
    --------
    >>> question = Question("map", "cart", LATEST)
    >>> question.is_plain
    True
    """

    target: str
    source: str
    at: int | Latest
    source_at: int | Latest | None = None
    fixed: str | None = None
    max_age: float | None = None
    policy: Policy | None = None

    @property
    def is_plain(self) -> bool:
        """Whether it asks for nothing but a stamp, so that the kernel may answer it."""
        return self.source_at is None and self.fixed is None and self.max_age is None and self.policy is None


def question_of(
    data: Stamped, target: str, at: int | Latest | None, fixed: str | None, max_age: float | None, policy: Policy | None
) -> Question:
    """The question whose answer moves `data`, with the arguments of `Buffer.transform`.

    Raises
    ------
    TypeError
        If `data` are of a type that is not registered or has no frame and stamp, or only one of `at` and `fixed` is
        given.
    """
    check_registered(data)
    if not (hasattr(data, "frame") and hasattr(data, "stamp")):
        kind = type(data).__name__
        raise TypeError(f"a {kind} has no frame and stamp of its own: look the transform up and call do_transform")
    if at is None and fixed is None:
        return Question(target, data.frame, data.stamp, max_age=max_age, policy=policy)
    if at is None or fixed is None:
        raise TypeError("at and fixed go together: the data at their stamp, carried to `at` through the fixed frame")
    return Question(target, data.frame, at, data.stamp, fixed, max_age, policy)


class Options(TypedDict, total=False):
    """The arguments that all lookups at one stamp share, for type checkers."""

    source_at: AtLike | None
    fixed: str | None
    tolerance: float
    max_gap: float | None
    extrapolate: Hold | None


class ReadStamp(NamedTuple):
    """The stamp at which an edge is read, its distance from the stamp that was asked, and the gap around it; in ns."""

    stamp: int
    extrapolated_by: int
    gap: int


def read_stamp(edge: FrameHistory, at: int, policy: Policy) -> ReadStamp:
    """The stamp at which to read an edge for the stamp `at`.

    Raises
    ------
    ExtrapolationError
        If the policy does not allow any sample to stand in.
    """
    before, after = edge.neighbours(at)
    if after == at:
        return ReadStamp(at, 0, 0)
    if before is not None and after is not None and (policy.max_gap is None or after - before <= policy.max_gap):
        return ReadStamp(at, 0, after - before)
    patience = policy.longest_hold
    standing_in = []
    if before is not None and at - before <= patience:
        standing_in.append(ReadStamp(before, at - before, 0))
    if after is not None and after - at <= policy.tolerance and edge.parent_at(after) == edge.parent_at(at):
        standing_in.append(ReadStamp(after, after - at, 0))
    if standing_in:
        return min(standing_in, key=lambda found: found.extrapolated_by)
    if before is None or after is None or policy.max_gap is None:
        raise edge.extrapolation_error(at, patience if after is None else policy.tolerance)
    raise GapError(
        child=edge.child,
        stamp=at,
        oldest=edge.oldest,
        newest=edge.newest,
        authority=edge.authority,
        slack=patience,
        before=before,
        after=after,
        max_gap=policy.max_gap,
    )


def read_stamps(edges: tuple[FrameHistory, ...], at: int, policy: Policy) -> list[ReadStamp]:
    """The stamps at which to read some edges for the stamp `at`.

    Raises
    ------
    ExtrapolationError
        The error of the deciding edge: of the first edge that waiting cannot help, else of the edge that lags most.
    """
    found: list[ReadStamp] = []
    errors: list[ExtrapolationError] = []
    for edge in edges:
        try:
            found.append(read_stamp(edge, at, policy))
        except ExtrapolationError as error:
            errors.append(error)
    if errors:
        raise min(errors, key=_decisive)
    return found


def _decisive(error: ExtrapolationError) -> int:
    if not isinstance(error, FutureExtrapolationError):
        return STAMP_MIN - 1
    return STAMP_MIN if error.newest is None else error.newest


def read_stamps_at_many(samples: Samples, stamps: Stamps, policy: Policy) -> tuple[Stamps, Stamps, Stamps]:
    """The fields of `ReadStamp` at many stamps, as arrays of shape (n,); `extrapolated_by` is -1 without an answer."""
    own = samples.stamps
    if not len(own):
        return stamps, np.full(len(stamps), -1), np.zeros(len(stamps), np.int64)
    i = own.searchsorted(stamps)
    following = np.minimum(i, len(own) - 1)
    before, after = own[np.maximum(i - 1, 0)], own[following]
    has_before, has_after = i > 0, i < len(own)
    exact = after == stamps
    # Unsigned, because the distance of two stamps may exceed a signed 64-bit integer.
    late, early, gap = (difference.view(np.uint64) for difference in (stamps - before, after - stamps, after - before))
    between = has_before & has_after & ~exact
    if policy.max_gap is not None:
        between &= gap <= policy.max_gap
    alone = ~(exact | between)
    by_before = alone & has_before & (late <= policy.longest_hold)
    by_after = alone & has_after & (early <= policy.tolerance) & ~(by_before & (late <= early))
    if samples.parents is not None:
        parents = np.array(samples.parents, object)
        same = np.concatenate(([True], parents[1:] == parents[:-1]))
        by_after &= same[following]
    read_at = np.where(by_after, after, np.where(by_before, before, stamps))
    away = np.where(by_after, early, np.where(by_before, late, 0)).astype(np.int64)
    away[alone & ~by_before & ~by_after] = -1
    return read_at, away, np.minimum(np.where(between, gap, 0), STAMP_MAX).astype(np.int64)


class Extrapolation:
    """Reads the edges of one lookup as a policy allows, and records the greatest extrapolation and gap.

    Attributes
    ----------
    policy : Policy
    extrapolated_by, gap : int
        The greatest values over all edges that were read, in ns, as in `TransformStamped`.
    """

    __slots__ = ("extrapolated_by", "gap", "policy")

    def __init__(self, policy: Policy) -> None:
        self.policy: Policy = policy
        self.extrapolated_by: int = 0
        self.gap: int = 0

    def row(self, path: Path, at: int) -> Row:
        """Source in target along a path.

        Raises
        ------
        ExtrapolationError
        """
        stamps = read_stamps(path.moving, at, self.policy)
        for found in stamps:
            self.extrapolated_by = max(self.extrapolated_by, found.extrapolated_by)
            self.gap = max(self.gap, found.gap)
        ahead = iter(stamps)
        return path.product(lambda edge: edge.row_at(next(ahead).stamp))


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
    """The bounds of a `LATEST` lookup by its two arguments; None if they allow every stamp.

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
    read: Callable[[int], object] | None = None,
) -> TransformStamped:
    """The answer of `TransformTree.lookup` to a question that has no plain answer, or is not plain.

    With `read`, the caller reads more of the tree at the stamp of the answer, while the tree stays as it is.
    """
    if bounds is not None and at is not LATEST and source_at is not LATEST:
        raise TypeError(AT_LATEST_ONLY)
    if type(at) is not int and at is not LATEST:
        at = as_stamp(at)
    extrapolation = None if policy is None else Extrapolation(policy)
    known = True
    if fixed is None:
        known = forest.search(target, source)
    else:
        forest.search(target, fixed)
        forest.search(fixed, source)
    with forest.lock:
        if source_at is None and fixed is None:
            if not known:
                forest.check_known(target)
                forest.check_known(source)
            stamp, row, static = find(forest, target, source, at, bounds, extrapolation)
        else:
            stamp, row, static = find_in_time_travel(
                forest, target, source, at, source_at, fixed, bounds, extrapolation
            )
        if read is not None:
            read(stamp)
    if extrapolation is None:
        return answer_of(target, source, stamp, row, static)
    return qualified_answer(target, source, stamp, row, static, extrapolation.extrapolated_by, extrapolation.gap)


def find(
    forest: Forest, target: str, source: str, at: At, bounds: Bounds | None, extrapolation: Extrapolation | None = None
) -> Found:
    """Source in target at one stamp, or an error of `TransformTree.lookup`. The caller holds the lock."""
    path = forest.paths.find(target, source)
    if path is None:
        path = forest.find_path(target, source, at)
    if not path.moving:
        if isinstance(at, Latest):
            newest = path.latest()
            at = _newest_stamp(forest, target) if newest is None else newest
        return as_stamp(at), path.row_at(0), True
    if at is LATEST:
        return _find_latest(forest, path, bounds, extrapolation)
    if extrapolation is not None:
        return at, _extrapolated(forest.find_path(target, source, at), at, extrapolation), False
    stamp = as_stamp(at)
    row = path.row(stamp)
    if row is not None:
        return stamp, row, False
    if not (path.covers(stamp) or path.alone) and path.root in forest.frames:
        # Another edge, or another way, may decide.
        path = forest.find_path(target, source, stamp)
    if not path.covers(stamp):
        raise path.deciding_error(stamp)
    return stamp, path.row_at(stamp), False


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
            # Another way may count there. It is sought outside, so that its error does not keep this traceback alive.
            pass
    try:
        chosen = path
        if not path.permanent or path.root in forest.frames:
            chosen = forest.find_path(path.frames[0], path.frames[-1], common)
        row = chosen.row_at(common) if extrapolation is None else extrapolation.row(chosen, common)
    except TransformLookupError as error:
        # The lagging edge has to reach the windows of the others, or the far end of their gap. Where a parent has
        # changed, any later stamp of the lagging edge may be enough.
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
