"""The provenance of samples that came over a link, so that no link sends them back."""

from typing import Any

from tfbus.geometry.stamped import TransformStamped
from tfbus.links._outbox import Outbox
from tfbus.links._peers import Peer

Rank = tuple[int, bytes]
"""Of two things that were said of a frame, the one of the higher rank holds: number, and then origin."""
LOWEST: Rank = (-1, b"")


class Provenance:
    """The source of a received batch or removal.

    Attributes
    ----------
    origin : bytes
        The bus on which it was published first, 16 bytes.
    sequence : int
        Its number on that bus; later ones have higher numbers.
    outbox : Outbox or None
        That of the link that brought it: what came in there does not go out there. None for this bus's own.
    peer : Peer or None
        The other end of that link; None for this bus's own.
    live : bool
        Whether it came in order with everything else of that peer, rather than out of what is kept for late joiners.
    lost : bool
        Of a removal: whether the frame was not removed but the peer that brought it was lost.
    """

    __slots__ = ("live", "lost", "origin", "outbox", "peer", "sequence")

    def __init__(
        self,
        origin: bytes,
        sequence: int,
        outbox: Outbox | None,
        peer: Peer | None,
        live: bool = True,
        lost: bool = False,
    ) -> None:
        self.origin = origin
        self.sequence = sequence
        self.outbox = outbox
        self.peer = peer
        self.live = live
        self.lost = lost

    @property
    def rank(self) -> Rank:
        """Of two things that were said of a frame, the one of the higher rank holds."""
        return self.sequence, self.origin


class ReceivedTransform(TransformStamped):
    """A sample that came over a link; equal to one that did not."""

    __slots__ = ("_provenance",)
    _provenance: Provenance

    def __reduce__(self) -> tuple[Any, ...]:
        # A copy in another process has not come over this link.
        return TransformStamped, (self.parent, self.child, self.stamp, self.transform, self.authority, self.static)
