"""Walks along all edges of all stamps: the frames above or below some others, and loops of parents at past stamps.

All of them climb from the frames that are asked for, so their cost depends on the height of the tree, not on its size.
"""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from tfbus.tree.history import FrameHistory

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
    """Those of `names` that are in `above`, or below one of these by any parent that a sample in the window names."""
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
    """The loop of parents that the sample of a frame at a stamp is part of, if there is one.

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
