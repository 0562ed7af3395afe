"""Loops of parents.

The newest edges of all frames must form a forest. A batch is judged as a whole, so one batch may turn an edge round.
"""

from collections import Counter
from collections.abc import Container, Mapping, Sequence
from typing import Protocol

from tfbus.errors import InvalidTransformError, loop_text
from tfbus.geometry.stamped import Batch, TransformStamped

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
    """Split a batch into the samples that close no loop of parents, and the errors of those that do.

    Of the samples that close a loop, the last one in the batch is refused, and so on until no loop is left.

    Parameters
    ----------
    edges : mapping of child to its newest edge
        A child that is neither static nor has a newest stamp counts as having no parent.
    batch : sequence of TransformStamped
    parents : container of str
        The frames that are a parent of one of the edges; more names do no harm. No loop leads through a frame that is
        not, so a chain that grows at its end needs no walk up to its root.
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
        # The last kind wins; of moving samples, the newest stamp.
        if static or newest is None or stamp >= newest:
            parents[child] = parent
            stamps[child] = None if static else stamp
    return {child: parent for child, parent in parents.items() if parent != _parent(edges.get(child))}


def _possibly_looped(changes: Mapping[str, str], parents: Container[str]) -> list[str]:
    """The changed children, without those that have no children themselves, and so on."""
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
