"""Samples that came from another bus know where from, so that no link sends them back there."""

from typing import Any

from tfbus.geometry.stamped import TransformStamped
from tfbus.links.peers import Peer


class Source:
    """Where a batch came from.

    Attributes
    ----------
    origin : bytes
        The bus on which it was published first, 16 bytes.
    sequence : int
        Its number there; what comes later has a higher one.
    link : object
        The sending half of the link that brought it.
    peer : Peer
        The other end, which sent it.
    live : bool
        Whether it came in order with all else from there, and not out of what is kept for late joiners.
    lost : bool
        Of a removal, whether it is only that the frame's way here has broken.
    """

    __slots__ = ("link", "live", "lost", "origin", "peer", "sequence")

    def __init__(
        self, origin: bytes, sequence: int, link: object, peer: Peer, live: bool = True, lost: bool = False
    ) -> None:
        self.origin = origin
        self.sequence = sequence
        self.link = link
        self.peer = peer
        self.live = live
        self.lost = lost


class ReceivedTransform(TransformStamped):
    """A sample that came from another bus; equal to one that did not."""

    __slots__ = ("_source",)
    _source: Source

    def __reduce__(self) -> tuple[Any, ...]:
        # Elsewhere it has not come over this link.
        return TransformStamped, (self.parent, self.child, self.stamp, self.transform, self.authority, self.static)
