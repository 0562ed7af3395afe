"""The answers of lookups with ``covariance=True``: the edges of an answer, each with the error of its samples.

The samples' covariances are kept beside their history, in `FrameHistory.beliefs`, only for frames that have some.
"""

from typing import Any, NamedTuple, cast

import numpy as np

from tfbus.errors import TransformLookupError
from tfbus.geometry.covariance import Matrix, lever_arm, turned
from tfbus.geometry.uncertain import Belief
from tfbus.rows import IDENTITY, Columns, Row, Vector, compose, invert
from tfbus.stamps import LATEST, AtLike, Stamps, as_at
from tfbus.tree.forest import Forest, Path
from tfbus.tree.history import FrameHistory, Samples
from tfbus.tree.lookup import Bounds, Extrapolation, Policy, answer, find, read_stamp
from tfbus.tree.lookup_many import OutOfRange, Segments, lookup_many, nanoseconds
from tfbus.uncertainty.answers import (
    Link,
    Name,
    UncertainTransform,
    UncertainTransformArray,
    rotation_matrices,
    uncertain,
    with_covariances,
)
from tfbus.uncertainty.correlation import EdgeError, Part


def uncertain_answer(
    forest: Forest,
    target: str,
    source: str,
    at: AtLike,
    source_at: AtLike | None,
    fixed: str | None,
    bounds: Bounds | None,
    policy: Policy | None,
) -> UncertainTransform:
    """The answer of `tfbus.tree.lookup.answer` to the same question, with the edges that it was made of."""
    links: list[Link] = []

    def read(stamp: int) -> None:
        if fixed is None:
            links.extend(_links(forest, target, source, stamp, policy))
            return
        extrapolation = None if policy is None else Extrapolation(policy)
        # Time travel without a stamp of source has raised its error.
        for above, below, when in ((target, fixed, at), (fixed, source, cast(AtLike, source_at))):
            half = find(forest, above, below, as_at(when), bounds, extrapolation)[0]
            links.extend(_links(forest, above, below, half, policy))

    return uncertain(answer(forest, target, source, at, source_at, fixed, bounds, policy, read), links)


def edges_of(path: Path, forest: Forest) -> list[tuple[FrameHistory, bool]]:
    """The edges of a path from target to source, and whether the way climbs each. The caller holds the lock."""
    turn = path.frames.index(path.root)
    climbed = [(forest.frames[child], True) for child in path.frames[:turn]]
    return climbed + [(forest.frames[child], False) for child in path.frames[turn + 1 :]]


def _links(forest: Forest, target: str, source: str, at: int, policy: Policy | None) -> list[Link]:
    if target == source:
        return []
    links = []
    for edge, climbs in edges_of(forest.find_path(target, source, at), forest):
        stamp = at if edge.static or policy is None else read_stamp(edge, at, policy).stamp
        row = edge.row_at(stamp)
        links.append(Link(edge.parent_at(stamp), edge.child, row, climbs, error_at(edge, stamp, row[:3])))
    return links


def error_at(edge: FrameHistory, at: int, place: Vector) -> EdgeError | None:
    """The error of an edge that covers a stamp; None if a sample that counts there has no covariance."""
    beliefs = edge.beliefs
    if beliefs is None:
        return None
    if edge.static:
        stamp = edge.static_stamp or 0
        belief = beliefs.get(stamp)
        if belief is None:
            return None
        # One error at all stamps, so the error has one stamp.
        return EdgeError(stamp, place, belief.kind, (Part(stamp, 1.0, belief.covariance.matrix),))
    before, after = edge.around(at)
    first = None if before is None else beliefs.get(before)
    if before is None or first is None:
        return None
    if before == at or after is None or not edge.is_segment(edge.find(after)):
        return EdgeError(at, place, first.kind, (Part(before, 1.0, first.covariance.matrix),))
    last = beliefs.get(after)
    if last is None:
        return None
    s = (at - before) / (after - before)
    parts = Part(before, 1.0 - s, first.covariance.matrix), Part(after, s, last.covariance.matrix)
    return EdgeError(at, place, last.kind, parts)


class _Edge(NamedTuple):
    """A copy of an edge for many stamps: a static row, or samples; and the covariances by stamp."""

    name: Name
    climbs: bool
    data: Row | Samples
    beliefs: dict[int, Belief]
    static_stamp: int


def uncertain_many(
    forest: Forest,
    target: str,
    source: str,
    stamps: Stamps,
    source_stamps: Stamps | None,
    fixed: str | None,
    out_of_range: OutOfRange,
    policy: Policy | None,
) -> UncertainTransformArray:
    """The answers of `lookup_many` to the same question, each with its covariance.

    Along one path they are computed in numpy. In time travel, with a policy, or if a frame on the path changes its
    parent, they are computed one by one.
    """
    found = lookup_many(forest, target, source, stamps, source_stamps, fixed, out_of_range, policy)
    answered = found.valid
    edges = None
    if fixed is None and policy is None and answered.any():
        wanted = stamps[answered]
        with forest.lock:
            edges = _copied(forest, target, source, int(wanted.min()), int(wanted.max()))
    matrices, exact = np.full((len(stamps), 6, 6), np.nan), dict[Name, None]()
    if edges is not None:
        matrices[answered] = _sum(edges, wanted, exact)
    else:
        for i in np.flatnonzero(answered):
            source_at = None if source_stamps is None else int(source_stamps[i])
            try:
                one = uncertain_answer(forest, target, source, int(stamps[i]), source_at, fixed, None, policy)
            except TransformLookupError:
                # Its samples have left the window meanwhile: an unknown error is not given as none.
                continue
            matrices[i] = one.covariance.matrix
            exact |= dict.fromkeys(one.exact)
    return with_covariances(found, matrices, exact)


def _copied(forest: Forest, target: str, source: str, low: int, high: int) -> list[_Edge] | None:
    """Copies of the edges of the path between two frames, from target to source; None if it may change."""
    if target == source:
        return []
    path = forest.find_path(target, source, LATEST)
    if not path.permanent or path.root in forest.frames or not (path.covers(low) and path.covers(high)):
        return None
    return [
        _Edge(
            (edge.parent, edge.child),
            climbs,
            edge.static_row if edge.static else edge.samples_between(low, high),
            dict(edge.beliefs or ()),
            edge.static_stamp or 0,
        )
        for edge, climbs in edges_of(path, forest)
    ]


def _sum(edges: list[_Edge], stamps: Stamps, exact: dict[Name, None]) -> Matrix:
    """The covariances of the answers along some edges at n stamps, shape (n, 6, 6): sum J S J^T at each."""
    count = len(stamps)
    here: Columns = tuple(np.full(count, number) for number in IDENTITY)  # type: ignore[assignment]
    walked: list[tuple[_Edge, Matrix, Matrix]] = []
    for edge in edges:
        row: Any = edge.data if isinstance(edge.data, tuple) else Segments(edge.data, stamps).at(slice(None))
        before, here = here, compose(here, invert(row) if edge.climbs else row)
        at_parent, at_child = (here, before) if edge.climbs else (before, here)
        walked.append((edge, np.stack(at_parent[3:], axis=1), np.stack(at_child[:3], axis=1)))
    end = np.stack(here[:3], axis=1)
    found = np.zeros((count, 6, 6))
    for edge, rotation, place in walked:
        own, known = _matrices_of(edge, stamps)
        if not known.all():
            exact[edge.name] = None
        jacobian = lever_arm(end - place) @ turned(rotation_matrices(rotation))
        found += np.where(known[:, None, None], jacobian @ own @ jacobian.swapaxes(1, 2), 0.0)
    return np.asarray(0.5 * (found + found.swapaxes(1, 2)))


def _matrices_of(edge: _Edge, stamps: Stamps) -> tuple[Matrix, Any]:
    """The covariance of one edge at n stamps that it covers, shape (n, 6, 6), and whether each is known."""
    beliefs, nothing = edge.beliefs, np.full((6, 6), np.nan)
    own = np.array([edge.static_stamp]) if isinstance(edge.data, tuple) else edge.data.stamps
    known = [beliefs.get(stamp) for stamp in own.tolist()]
    matrices = np.array([nothing if belief is None else belief.covariance.matrix for belief in known])
    if len(own) == 1:
        found = np.broadcast_to(matrices, (len(stamps), 6, 6))
    else:
        first = own.searchsorted(stamps, "right") - 1
        last = np.minimum(first + 1, len(own) - 1)
        s = (nanoseconds(own[first], stamps) / np.maximum(nanoseconds(own[first], own[last]), 1.0))[:, None, None]
        # A sample answers alone at its own stamp, even if the next one has no covariance.
        found = np.where(s == 0.0, matrices[first], (1.0 - s) * matrices[first] + s * matrices[last])
    return found, np.isfinite(found[:, 0, 0])
