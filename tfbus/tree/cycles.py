"""Loops of parents: refused among the newest edges, and announced when late samples form one in the past.

The newest edges of all frames must form a forest. `admit` judges a batch as a whole, so one batch may turn an edge
round: with ``b`` below ``a``, a batch ``b below r, a below b`` is fine, though ``a below b`` alone would close a loop.

A loop in the past can form although the newest edges never form one, because samples may come late. An edge holds from
its sample to its next sample::

    stamp        10      20      30
    a below      b       b       r        (published in order)
    b below      r       r       r
    late: b below a, at 15

At 30 all is well. From 15 to 20 ``a`` is below ``b`` and ``b`` below ``a``: no way leads to ``r``. If the late sample
were refused, answers would depend on the order of arrival. So it is stored, and an event announces the loop
(`past_loop` finds it). `tfbus.tree.forest.path_at` says which way round the loop a lookup takes.

All walks climb from the frames that are asked for, so their cost depends on the height of the tree, not on its size.
"""

from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence
from typing import NamedTuple, Protocol

from tfbus.errors import InvalidTransformError, loop_text
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.tree.history import FrameHistory

_SENDERS = 5


class NewestEdge(Protocol):
    """The newest edge of one child. `newest` is its stamp in ns, None if there is no moving sample."""

    @property
    def parent(self) -> str: ...

    @property
    def static(self) -> bool: ...

    @property
    def newest(self) -> int | None: ...

    @property
    def authority(self) -> str: ...


def admit(
    edges: Mapping[str, NewestEdge], batch: Sequence[TransformStamped], parents: Container[str]
) -> tuple[Batch, list[InvalidTransformError]]:
    """Split a batch into the samples that close no loop of parents, and the errors of the others.

    Of the samples that close a loop, the last one in the batch is refused, and so on until no loop is left.

    Parameters
    ----------
    edges : mapping of child to its newest edge
        A child that is neither static nor has a newest stamp counts as having no parent.
    batch : sequence of TransformStamped
    parents : container of str
        The parents of the edges; further names do no harm. A loop consists of parents only, so a chain that grows at
        its end needs no walk up to its root.
    """
    accepted: Sequence[TransformStamped] = batch
    refused: list[InvalidTransformError] = []
    while loops := _find_loops(edges, changes := changed_parents(edges, accepted), parents):
        loop_of = {frame: loop for loop in loops for frame in loop}
        kept: list[TransformStamped] = []
        for sample in reversed(accepted):
            loop = loop_of.get(sample.child)
            if loop is not None and changes.get(sample.child) == sample.parent:
                refused.append(_cycle(edges, sample, loop))
                for frame in loop:
                    del loop_of[frame]
            else:
                kept.append(sample)
        accepted = kept[::-1]
    return tuple(accepted), refused


def _cycle(edges: Mapping[str, NewestEdge], sample: TransformStamped, loop: tuple[str, ...]) -> InvalidTransformError:
    start = loop.index(sample.child)
    circle = (*loop[start:], *loop[: start + 1])
    others = sorted({edges[frame].authority for frame in loop if frame in edges and frame != sample.child} - {""})
    named = " and ".join(map(repr, others[:_SENDERS]))
    more = f" and {len(others) - _SENDERS} more" if len(others) > _SENDERS else ""
    return InvalidTransformError(
        f"the edge {sample.parent!r} -> {sample.child!r} would close a loop of parents: {loop_text(circle)}"
        + (f", with edges from {named}{more}" if others else ""),
        reason="cycle",
        parent=sample.parent,
        child=sample.child,
        authority=sample.authority,
        loop=circle,
    )


def _parent(edge: NewestEdge | None) -> str | None:
    return None if edge is None or (edge.newest is None and not edge.static) else edge.parent


def changed_parents(edges: Mapping[str, NewestEdge], batch: Sequence[TransformStamped]) -> dict[str, str]:
    """The new parent of each child whose newest parent the batch changes."""
    parents: dict[str, str] = {}
    stamps: dict[str, int | None] = {}
    for sample in batch:
        parent, child, stamp, _, _, static = sample._fields
        if child not in stamps:
            edge = edges.get(child)
            stamps[child] = None if edge is None else edge.newest
        newest = stamps[child]
        # The last kind wins; among moving samples, the newest stamp wins.
        if static or newest is None or stamp >= newest:
            parents[child] = parent
            stamps[child] = None if static else stamp
    return {child: parent for child, parent in parents.items() if parent != _parent(edges.get(child))}


def _possibly_looped(changes: Mapping[str, str], parents: Container[str]) -> list[str]:
    """The changed children that may be in a loop: childless ones are removed until every remaining one has a child."""
    children = Counter(changes.values())
    childless = [child for child in changes if child not in parents and child not in children]
    left_out = set(childless)
    while childless:
        parent = changes[childless.pop()]
        children[parent] -= 1
        if not children[parent] and parent in changes and parent not in parents:
            childless.append(parent)
            left_out.add(parent)
    return [child for child in changes if child not in left_out]


def _find_loops(
    edges: Mapping[str, NewestEdge], changes: Mapping[str, str], parents: Container[str]
) -> list[tuple[str, ...]]:
    """The loops through a changed child, as frames in the order of their parents. They share no frame."""
    loops: list[tuple[str, ...]] = []
    judged: set[str] = set()
    for child in _possibly_looped(changes, parents):
        walk: dict[str, None] = {}
        here: str | None = child
        while here is not None and here not in judged and here not in walk:
            walk[here] = None
            here = changes[here] if here in changes else _parent(edges.get(here))
        if here in walk:
            frames = list(walk)
            circle = tuple(frames[frames.index(here) :])
            # A loop that this batch does not change is not judged here.
            if not changes.keys().isdisjoint(circle):
                loops.append(circle)
        judged.update(walk)
    return loops


Frames = Mapping[str, FrameHistory]
"""By child."""


class Loop(NamedTuple):
    """A loop of parents at a stamp.

    Attributes
    ----------
    stamp : int
        ns.
    frames : tuple of str
        From child to parent, the first one repeated at the end.
    """

    stamp: int
    frames: tuple[str, ...]


def edges_above(frames: Frames, names: Iterable[str]) -> dict[str, FrameHistory]:
    """The edges of some frames and of all above them, by any parent that a sample in the window names."""
    found: dict[str, FrameHistory] = {}
    ahead = list(names)
    while ahead:
        edge = frames.get(ahead.pop())
        if edge is not None and edge.child not in found:
            found[edge.child] = edge
            ahead += edge.named_parents
    return found


def names_below(frames: Frames, names: Iterable[str], above: set[str]) -> set[str]:
    """The `names` that are in `above`, or below one of these by any parent that a sample in the window names."""
    asked = set(names)
    children: dict[str, list[str]] = {}
    for child, edge in edges_above(frames, asked).items():
        for parent in edge.named_parents:
            children.setdefault(parent, []).append(child)
    found = set(above)
    ahead = list(above)
    while ahead:
        new = [child for child in children.get(ahead.pop(), ()) if child not in found]
        found.update(new)
        ahead += new
    return found & asked


def past_loop(frames: Frames, child: str, stamp: int) -> Loop | None:
    """The loop of parents that contains the sample of a frame at a stamp, or None.

    The sample holds from its stamp to the next one. An edge counts from its oldest sample on.
    """
    edge = frames[child]
    above = edges_above(frames, edge.named_parents)
    if child not in above:
        return None
    _, until = edge.neighbours(stamp + 1)
    instants = {stamp}
    for other in above.values():
        instants.update(at for at in other.beginnings() if stamp < at and (until is None or at < until))
    for at in sorted(instants):
        walk = {child: None}
        here = edge.parent_at(at)
        while here not in walk and (up := frames.get(here)) is not None and up.begins_by(at):
            walk[here] = None
            here = up.parent_at(at)
        if here == child:
            return Loop(at, (*walk, child))
    return None
