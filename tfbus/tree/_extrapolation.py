"""Where a policy reads an edge: at the stamp itself, at a sample that stands in for it, or nowhere."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from tfbus.errors import ExtrapolationError, FutureExtrapolationError, GapError
from tfbus.geometry.rows import IDENTITY, Row, compose, invert
from tfbus.stamps import STAMP_MAX, STAMP_MIN, Stamps
from tfbus.tree._python_kernel import Step, climb
from tfbus.tree.history import FrameHistory, Samples
from tfbus.tree.path import Path
from tfbus.tree.policy import Policy


class Place(NamedTuple):
    """Where an edge is read, and how far that departs from what was asked; all in ns."""

    stamp: int
    extrapolated_by: int
    gap: int


def place(edge: FrameHistory, at: int, policy: Policy) -> Place:
    """Where to read an edge for a stamp.

    Raises
    ------
    ExtrapolationError
        If the policy does not allow any sample to stand in.
    """
    before, after = edge.around(at)
    if after == at:
        return Place(at, 0, 0)
    if before is not None and after is not None and (policy.max_gap is None or after - before <= policy.max_gap):
        return Place(at, 0, after - before)
    patience = policy.patience
    standing_in = []
    if before is not None and at - before <= patience:
        standing_in.append(Place(before, at - before, 0))
    if after is not None and after - at <= policy.tolerance and edge.parent_at(after) == edge.parent_at(at):
        standing_in.append(Place(after, after - at, 0))
    if standing_in:
        return min(standing_in, key=lambda found: found.extrapolated_by)
    if before is None or after is None or policy.max_gap is None:
        raise edge.missing(at, patience if after is None else policy.tolerance)
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


def place_all(edges: tuple[FrameHistory, ...], at: int, policy: Policy) -> list[Place]:
    """Where to read each edge for a stamp.

    Raises
    ------
    ExtrapolationError
        That of the edge that decides: the first that waiting cannot help, or the last to come.
    """
    found: list[Place] = []
    errors: list[ExtrapolationError] = []
    for edge in edges:
        try:
            found.append(place(edge, at, policy))
        except ExtrapolationError as error:
            errors.append(error)
    if errors:
        raise min(errors, key=_decisive)
    return found


def _decisive(error: ExtrapolationError) -> int:
    if not isinstance(error, FutureExtrapolationError):
        return STAMP_MIN - 1
    return STAMP_MIN if error.newest is None else error.newest


def place_many(samples: Samples, stamps: Stamps, policy: Policy) -> tuple[Stamps, Stamps, Stamps]:
    """As `place`, for many stamps: where to read, `extrapolated_by` (-1 for nowhere), and `gap`, each of shape (n,)."""
    own = np.frombuffer(samples.stamps, np.int64)
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
    by_before = alone & has_before & (late <= policy.patience)
    by_after = alone & has_after & (early <= policy.tolerance) & ~(by_before & (late <= early))
    if samples.parents is not None:
        parents = np.array(samples.parents, object)
        same = np.concatenate(([True], parents[1:] == parents[:-1]))
        by_after &= same[following]
    read_at = np.where(by_after, after, np.where(by_before, before, stamps))
    away = np.where(by_after, early, np.where(by_before, late, 0)).astype(np.int64)
    away[alone & ~by_before & ~by_after] = -1
    return read_at, away, np.minimum(np.where(between, gap, 0), STAMP_MAX).astype(np.int64)


class Leniency:
    """Reads paths as a policy allows, and remembers what that took.

    Attributes
    ----------
    policy : Policy
    extrapolated_by, gap : int
        The greatest over all edges that were read, in ns, as `TransformStamped` has them.
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
        places = place_all(path.moving, at, self.policy)
        for found in places:
            self.extrapolated_by = max(self.extrapolated_by, found.extrapolated_by)
            self.gap = max(self.gap, found.gap)
        ahead = iter(places)
        up = _climb(path.up, ahead)
        return up if not path.down else compose(invert(_climb(path.down, ahead)), up)


def _climb(steps: tuple[Step, ...], places: Iterator[Place]) -> Row:
    row = IDENTITY
    for step in steps:
        here = climb((step,), next(places).stamp) if isinstance(step, FrameHistory) else step
        row = compose(here, row)
    return row
