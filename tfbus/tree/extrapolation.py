"""Extrapolation as a policy allows it: the stamp at which an edge is read, which may be that of a nearby sample."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from tfbus.errors import ExtrapolationError, FutureExtrapolationError, GapError
from tfbus.geometry.rows import IDENTITY, Row, compose, invert
from tfbus.stamps import STAMP_MAX, STAMP_MIN, Stamps
from tfbus.tree.history import FrameHistory, Samples
from tfbus.tree.path import Path, Step
from tfbus.tree.policy import Policy


class ReadStamp(NamedTuple):
    """The stamp at which an edge is read in place of the one that was asked, and how far they differ; all in ns."""

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
        Of the deciding edge: the first that waiting cannot help, else the one that lags most.
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
    # Unsigned, because two stamps may be further apart than a signed difference can say.
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
    """Reads the edges of one lookup as a policy allows, and records how far that went.

    Attributes
    ----------
    policy : Policy
    extrapolated_by, gap : int
        The greatest values over all edges that were read, in ns, as in `TransformStamped`.
    """

    __slots__ = ("extrapolated_by", "gap", "policy")

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        self.extrapolated_by = 0
        self.gap = 0

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
        up = _climb(path.up, ahead)
        return up if not path.down else compose(invert(_climb(path.down, ahead)), up)


def _climb(steps: tuple[Step, ...], stamps: Iterator[ReadStamp]) -> Row:
    row = IDENTITY
    for step in steps:
        here = step.row_at(next(stamps).stamp) if isinstance(step, FrameHistory) else step
        row = compose(here, row)
    return row
