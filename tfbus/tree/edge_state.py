"""The states of an edge that pictures tell apart, each with its colour."""

from enum import Enum

from tfbus.stamps import SECOND
from tfbus.tree.history import Edge

STALE_AFTER = 1.0
"""s; the age from which pictures show a moving frame as stale unless they are told otherwise."""


class EdgeState(Enum):
    """A state, and the colour of its edges in every picture.

    The colours are those of M. Okabe and K. Ito, "Color Universal Design" (2008), which people tell apart with any
    kind of colour vision.
    """

    STATIC = "#0072b2"
    """It holds at every stamp."""
    MOVING = "#009e73"
    """It has a sample that is recent enough."""
    STALE = "#d55e00"
    """Its newest sample is too old."""
    SILENT = "#767676"
    """It has no sample."""


def state_of(edge: Edge, now: int, stale_after: float = STALE_AFTER) -> EdgeState:
    """The state of an edge at the stamp `now` (ns); moving edges are stale after so many s."""
    if edge.static:
        return EdgeState.STATIC
    if edge.newest is None:
        return EdgeState.SILENT
    return EdgeState.STALE if now - edge.newest > stale_after * SECOND else EdgeState.MOVING
