"""Explanations: how each edge on a path contributes to an answer, and which edges block it.

`explain` finds the path under the lock, and then reads its edges some at a time, so that a long path does not hold up
insertions. Formatting an `Explanation` as text needs no lock.
"""

from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from tfbus.errors import DisconnectedError, ExtrapolationError, TransformLookupError, UnknownFrameError
from tfbus.plain import PlainData, printable
from tfbus.stamps import LATEST, Latest, format_age, format_duration, format_stamp, to_seconds
from tfbus.tree.forest import AT_A_TIME, Forest, Path
from tfbus.tree.history import FrameHistory
from tfbus.tree.lookup import At, Bounds, Extrapolation, Policy, find, read_stamp
from tfbus.tree.rendering import counted, format_rate
from tfbus.tree.uncertain import uncertain_answer


@dataclass(frozen=True, slots=True)
class ExplainedEdge(PlainData):
    """The contribution of one edge to an answer.

    Attributes
    ----------
    parent, child : str
    static : bool
    before, after : int or None
        The stamps of the samples on either side of the stamp that was asked, in ns: twice the same if a sample has it,
        None where there is none.
    fraction : float or None
        The weight of `after` in the answer, 0 to 1: 0 where a sample has the stamp, or where the parent changes at
        `after`. None if the edge is static or does not answer.
    extrapolated_by : int
        The distance to the sample that stands in for a missing one, in ns.
    newest : int or None
        The stamp of the newest sample, in ns; None if the edge is static or has none.
    age : float or None
        The age of the newest sample at `now`, in s; negative if the sample is ahead of it.
    rate : float or None
        Mean samples a second over the window; None for fewer than two.
    authority : str
        The sender of the newest sample; may be empty.
    error : ExtrapolationError or None
        The reason why this edge blocks the answer.
    shares : tuple of 6 floats
        The part of the variance of each number of the answer's error that comes from this edge, in the order of
        `Covariance`; empty if the edge gave no covariance.
    clock : str
        The clock of the sender beside the clock of the bus, in words, if a link knows that they differ; else empty.

    Examples
    --------
    >>> tree = TransformTree()
    >>> _ = tree.insert(TransformStamped("map", "cart", 10, Transform(), "odometry"))
    >>> tree.explain("map", "cart").edges[0].authority
    'odometry'
    """

    parent: str
    child: str
    static: bool
    before: int | None = None
    after: int | None = None
    fraction: float | None = None
    extrapolated_by: int = 0
    newest: int | None = None
    age: float | None = None
    rate: float | None = None
    authority: str = ""
    error: ExtrapolationError | None = None
    shares: tuple[float, ...] = ()
    clock: str = ""


@dataclass(frozen=True, slots=True, repr=False)
class Explanation(PlainData):
    """The path and the samples behind an answer, or the errors that block it. ``str`` gives a text of several lines.

    Attributes
    ----------
    target, source : str
    at : int or LATEST
        The stamp that was asked, in ns.
    stamp : int or None
        The stamp of the answer, in ns; None if there is none.
    now : int or None
        The stamp that ages are counted from, in ns.
    chain : tuple of str
        The frames from target to source; empty where there is no path.
    half_chains : tuple of tuple of str
        If the two frames are in different trees: the frames from target up to its root, and those from source. In a
        loop of parents, the frame where it closes comes twice. Otherwise empty.
    edges : tuple of ExplainedEdge
        One for each two neighbours in the chain, in its order; or in the two half chains, target's first.
    errors : tuple of TransformLookupError
        All errors that block the answer, among them the error that a lookup raises.
    sigmas : tuple of 6 floats
        The standard deviations of the answer's error, in the order of `Covariance`, in m and rad; empty if no edge gave
        a covariance.

    Examples
    --------
    >>> tree = TransformTree()
    >>> _ = tree.insert(TransformStamped("map", "cart", 10, Transform()))
    >>> tree.explain("map", "cart", 10)
    <Explanation of 'cart' in 'map', 1 edge: 0.00000001 s>
    """

    target: str
    source: str
    at: At
    stamp: int | None = None
    now: int | None = None
    chain: tuple[str, ...] = ()
    half_chains: tuple[tuple[str, ...], ...] = ()
    edges: tuple[ExplainedEdge, ...] = ()
    errors: tuple[TransformLookupError, ...] = ()
    sigmas: tuple[float, ...] = ()

    @property
    def answerable(self) -> bool:
        """Whether a lookup had an answer."""
        return not self.errors

    def __repr__(self) -> str:
        answer = "no answer" if self.stamp is None else format_stamp(self.stamp)
        return f"<Explanation of {self.source!r} in {self.target!r}, {counted(len(self.edges), 'edge')}: {answer}>"

    def _repr_html_(self) -> str:
        from html import escape

        return f"<pre>{escape(str(self))}</pre>"

    def __str__(self) -> str:
        when = ", latest" if isinstance(self.at, Latest) else f" at {format_stamp(self.at)}"
        if not self.answerable:
            when += ": no answer"
        elif isinstance(self.at, Latest) and self.stamp is not None:
            when += f": {format_stamp(self.stamp)}"
        lines = [f"{self.source!r} in {self.target!r}{when}"]
        top = self._top()
        rows = _aligned([_cells(edge, self.now, place >= top) for place, edge in enumerate(self.edges)])
        if self.half_chains:
            up = len(self.half_chains[0]) - 1
            for half, of_it in zip(self.half_chains, (rows[:up], rows[up:]), strict=True):
                lines += [f"  {half[0]!r} is a root" if len(half) == 1 else f"  up from {half[0]!r} to {half[-1]!r}"]
                lines += [f"  {row}" for row in of_it]
        else:
            lines += rows
        for error in self.errors:
            lines.append(f"! {error}")
            if isinstance(error.__cause__, TransformLookupError):
                lines.append(f"  because {error.__cause__}")
        return "\n".join(lines + self._told_errors())

    def _told_errors(self) -> list[str]:
        """The lines on the answer's error: its size, the edge that most of it comes from, and the exact edges."""
        if not self.sigmas:
            return []
        x, y, z, roll, pitch, yaw = (f"{sigma:.3g}" for sigma in self.sigmas)
        lines = [f"~ error of one sigma: x {x}, y {y}, z {z} m, roll {roll}, pitch {pitch}, yaw {yaw} rad"]
        known = [edge for edge in self.edges if edge.shares]
        for half in (range(3), range(3, 6)):
            axis = max(half, key=self.sigmas.__getitem__)
            if self.sigmas[axis]:
                shares = [edge.shares[axis] for edge in known]
                most = known[shares.index(max(shares))]
                lines.append(f"  {most.shares[axis]:.0%} of the variance of {_AXES[axis]} is from {_edge_text(most)}")
        exact = [_edge_text(edge) for edge in self.edges if not edge.shares]
        return [*lines, f"  taken as exact: {', '.join(exact)}"] if exact else lines

    def _top(self) -> int:
        """The number of edges from target up to the common ancestor; the later edges lead down to source."""
        for place, edge in enumerate(self.edges):
            if not self.half_chains and edge.parent == self.chain[place]:
                return place
        return len(self.edges)


_AXES = ("x", "y", "z", "roll", "pitch", "yaw")


def _edge_text(edge: ExplainedEdge) -> str:
    return f"{printable(edge.parent)} -> {printable(edge.child)}"


def _cells(edge: ExplainedEdge, now: int | None, below: bool) -> list[str]:
    """The cells of one edge's line of text."""
    parent, child = printable(edge.parent), printable(edge.child)
    age = ""
    if edge.newest is not None and now is not None:
        age = format_age(edge.newest, now)
    return [
        "!" if edge.error is not None else " ",
        f"{parent} <- {child}" if below else f"{child} -> {parent}",
        format_rate(edge.static, edge.newest, edge.rate),
        age,
        _samples(edge),
        "; ".join(filter(None, (f"from {edge.authority!r}" if edge.authority else "", edge.clock))),
    ]


def _samples(edge: ExplainedEdge) -> str:
    before, after = ("" if stamp is None else format_stamp(stamp) for stamp in (edge.before, edge.after))
    samples = before if before == after else f"{before} .. {after}".strip()
    if edge.extrapolated_by:
        return f"{samples}, {format_duration(edge.extrapolated_by)} off"
    return f"{samples}, {edge.fraction:.1%}" if edge.fraction is not None and before != after else samples


def _aligned(rows: list[list[str]]) -> list[str]:
    """Rows of cells, each column as wide as its widest."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    gaps = [1, *(2 if width else 0 for width in widths[1:])]
    return [
        "".join(f"{cell:<{width}}{' ' * gap}" for cell, width, gap in zip(row, widths, gaps, strict=True)).rstrip()
        for row in rows
    ]


class _Finding(NamedTuple):
    """The answer of a lookup or its error, and the path; without a path, the frames that each end reaches."""

    stamp: int | None
    raised: TransformLookupError | None
    instant: int | None
    path: Path | None = None
    half_chains: tuple[tuple[str, ...], ...] = ()

    def links(self) -> list[tuple[str, str]]:
        """The edges to explain, each as child and parent."""
        if self.path is None:
            return [link for half in self.half_chains for link in pairwise(half)]
        chain, top = self.path.frames, self.path.frames.index(self.path.root)
        return [*pairwise(chain[: top + 1]), *((child, parent) for parent, child in pairwise(chain[top:]))]


def explain(
    forest: Forest, target: str, source: str, at: At, bounds: Bounds | None, policy: Policy | None, now: int | None
) -> Explanation:
    """The explanation of a lookup, with the parameters of `TransformTree.explain`. Takes the lock."""
    forest.search(target, source)
    with forest.lock:
        found = _find(forest, target, source, at, bounds, policy)
        if isinstance(found.raised, UnknownFrameError):
            return Explanation(target, source, at, None, now, errors=_unknown(forest, target, source))
    if now is None:
        reached = forest.read_all(lambda history: history.newest).values()
        now = max((stamp for stamp in reached if stamp is not None), default=None)
    raised = found.raised
    links = found.links()
    edges: list[ExplainedEdge] = []
    for first in range(0, len(links), AT_A_TIME):
        with forest.lock:
            for child, parent in links[first : first + AT_A_TIME]:
                edge = forest.frames.get(child)
                if edge is None:
                    # Another thread has removed it meanwhile.
                    edges.append(ExplainedEdge(parent, child, False))
                    continue
                blocked = _block(edge, at, raised, policy) if isinstance(raised, ExtrapolationError) else None
                edges.append(_explained(edge, parent, found.instant, now, policy, blocked))
    errors: tuple[TransformLookupError, ...] = tuple(edge.error for edge in edges if edge.error is not None)
    if raised is not None and raised not in errors:
        errors = (raised, *errors)
    chain = () if found.path is None else found.path.frames
    sigmas: tuple[float, ...] = ()
    if found.stamp is not None and any(_is_unsure(forest, child) for child, _ in links):
        sigmas, edges = _with_shares(forest, target, source, found.stamp, policy, edges)
    return Explanation(target, source, at, found.stamp, now, chain, found.half_chains, tuple(edges), errors, sigmas)


def _is_unsure(forest: Forest, child: str) -> bool:
    edge = forest.frames.get(child)
    return edge is not None and edge.beliefs is not None


def _with_shares(
    forest: Forest, target: str, source: str, stamp: int, policy: Policy | None, edges: list[ExplainedEdge]
) -> tuple[tuple[float, ...], list[ExplainedEdge]]:
    """The standard deviations of an answer's error, and its edges with their shares of the variances."""
    try:
        answer = uncertain_answer(forest, target, source, stamp, None, None, None, policy)
    except TransformLookupError:
        # Its samples have left the window meanwhile.
        return (), edges
    total = answer.covariance.matrix.diagonal()
    scale = np.divide(1.0, total, out=np.zeros(6), where=total > 0.0)
    shares = {(share.parent, share.child): share.matrix.diagonal() * scale for share in answer.shares()}
    shared = [
        replace(edge, shares=tuple(shares[edge.parent, edge.child].tolist()))
        if (edge.parent, edge.child) in shares
        else edge
        for edge in edges
    ]
    return tuple(answer.covariance.sigmas.tolist()), shared


def _find(forest: Forest, target: str, source: str, at: At, bounds: Bounds | None, policy: Policy | None) -> _Finding:
    extrapolation = None if policy is None else Extrapolation(policy)
    stamp: int | None = None
    raised: TransformLookupError | None = None
    try:
        stamp, _, _ = find(forest, target, source, at, bounds, extrapolation)
    except UnknownFrameError as error:
        return _Finding(None, error, None)
    except DisconnectedError as error:
        halves = tuple(_up_to_root(forest, frame, error.stamp) for frame in (target, source))
        return _Finding(None, error, error.stamp, half_chains=halves)
    except TransformLookupError as error:
        raised = error
    path = forest.find_path(target, source, at)
    if stamp is not None and not path.permanent:
        path = forest.find_path(target, source, stamp)
    instant = stamp
    if raised is not None:
        instant = path.latest() if isinstance(at, Latest) else at
    return _Finding(stamp, raised, instant, path)


def _unknown(forest: Forest, *frames: str) -> tuple[UnknownFrameError, ...]:
    errors = []
    for frame in dict.fromkeys(frames):
        try:
            forest.check_known(frame)
        except UnknownFrameError as error:
            errors.append(error)
    return tuple(errors)


def _up_to_root(forest: Forest, frame: str, instant: int | None) -> tuple[str, ...]:
    """A frame and its ancestors, up to the root or to the first frame that comes again."""
    walk = {frame: None}
    here = frame
    while (edge := forest.frames.get(here)) is not None:
        here = edge.parent if instant is None else edge.parent_at(instant)
        if here in walk:
            return (*walk, here)
        walk[here] = None
    return tuple(walk)


def _explained(
    edge: FrameHistory,
    parent: str,
    instant: int | None,
    now: int | None,
    policy: Policy | None,
    error: ExtrapolationError | None = None,
) -> ExplainedEdge:
    if edge.static:
        return ExplainedEdge(parent, edge.child, True, authority=edge.authority)
    facts = edge.edge()
    age = None if facts.newest is None or now is None else to_seconds(now - facts.newest)
    before = after = fraction = None
    away = 0
    if instant is not None:
        before, after = edge.neighbours(instant)
        with suppress(ExtrapolationError):
            found = read_stamp(edge, instant, policy or Policy())
            away = found.extrapolated_by
            fraction = _fraction(edge, found.stamp, before, after)
    return ExplainedEdge(
        parent, edge.child, False, before, after, fraction, away, facts.newest, age, facts.rate, facts.authority, error
    )


def _fraction(edge: FrameHistory, stamp: int, before: int | None, after: int | None) -> float:
    """The weight of `after` in the interpolation at a covered stamp."""
    if before is None or after is None or stamp == before:
        return 0.0 if stamp == before else 1.0
    if stamp < after and edge.parent_at(before) != edge.parent_at(after):
        return 0.0
    return (stamp - before) / (after - before)


def _block(edge: FrameHistory, at: At, raised: ExtrapolationError, policy: Policy | None) -> ExtrapolationError | None:
    """The error of an edge that blocks an answer; `raised` is the error of the lookup."""
    if edge.child == raised.child:
        return raised
    if edge.static:
        return None
    if not isinstance(at, Latest):
        try:
            read_stamp(edge, at, policy or Policy())
        except ExtrapolationError as error:
            return error
        return None
    # `LATEST` waits until the lagging edges reach the windows of the others.
    if isinstance(raised.stamp, Latest):
        return None if len(edge) else edge.extrapolation_error(LATEST)
    if edge.newest is not None and edge.newest >= raised.stamp - raised.slack:
        return None
    return edge.extrapolation_error(raised.stamp, raised.slack)
