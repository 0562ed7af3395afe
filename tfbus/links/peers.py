"""The peers of a link: who is present, how much each may send, and what was refused of it."""

from collections import Counter
from collections.abc import Callable, Collection, Iterator

from tfbus.bus.subscribers import SeenKeys

MAX_PEERS = 1_000
MAX_AUTHORITIES = 1_000
MOST_AUTHORITY_TEXT = 2**20
"""Letters of all authorities of one peer together."""
_REMEMBERED_REASONS = 100


class Peer:
    """The other end of a link, as far as this end knows it.

    Attributes
    ----------
    id : str
    present : bool
        Whether it has announced that it is there.
    robot : str
        The robot whose link it is; empty without one.
    number : int
        The number of its newest live message; 0 before the first.
    authorities : set of str
        The authorities whose samples it has sent.
    authority_text : int
        The letters of these.
    frames : set of str
        The frames that it was the first to bring from a world without origins; their number is limited.
    paths : dict of bytes to tuple of bytes
        The buses that are reached through it, its own among them, each with the buses on the way there.
    reported : SeenKeys
        The reasons of refusals that were reported.
    """

    __slots__ = ("authorities", "authority_text", "frames", "id", "number", "paths", "present", "reported", "robot")

    def __init__(self, id: str) -> None:  # noqa: A002 - the wire calls it so
        self.id = id
        self.present = False
        self.robot = ""
        self.number = 0
        self.authorities: set[str] = set()
        self.authority_text = 0
        self.frames: set[str] = set()
        self.paths: dict[bytes, tuple[bytes, ...]] = {}
        self.reported = SeenKeys(_REMEMBERED_REASONS)


class Peers:
    """All peers of one link.

    Parameters
    ----------
    report : callable
        Called with a peer's id, a reason and an error, once for each peer and reason.

    Attributes
    ----------
    rejected : Counter
        How many messages and samples were refused, by reason.
    """

    def __init__(self, report: Callable[[str, str, Exception], object]) -> None:
        self._report = report
        self._peers: dict[str, Peer] = {}
        self._reported_of_unknown = SeenKeys(_REMEMBERED_REASONS)
        self.rejected: Counter[str] = Counter()

    def __iter__(self) -> Iterator[Peer]:
        return iter(self._peers.values())

    def __len__(self) -> int:
        """The number of peers that are known, present or not."""
        return len(self._peers)

    @property
    def present(self) -> tuple[str, ...]:
        """The ids of the peers that have announced themselves, sorted."""
        return tuple(sorted(peer.id for peer in self._peers.values() if peer.present))

    def find(self, id: str) -> Peer | None:  # noqa: A002
        """The peer of an id, known or new; None if it is new and there are too many."""
        peer = self._peers.get(id)
        if peer is None:
            if len(self._peers) >= MAX_PEERS:
                self.reject(id, "too many peers", ValueError(f"more than {MAX_PEERS} peers on one link"))
                return None
            peer = self._peers[id] = Peer(id)
        return peer

    def get(self, id: str) -> Peer | None:  # noqa: A002
        """The peer of an id, if it is known."""
        return self._peers.get(id)

    def join(self, id: str) -> tuple[Peer | None, Peer | None]:  # noqa: A002
        """Note that a peer is there.

        Returns
        -------
        peer : Peer or None
            None if it was present before, or there is no place.
        evicted : Peer or None
            A peer that has never announced itself, and had to make room.
        """
        evicted = None
        if id not in self._peers and len(self._peers) >= MAX_PEERS:
            evicted = next((peer for peer in self._peers.values() if not peer.present), None)
            if evicted is not None:
                del self._peers[evicted.id]
        peer = self.find(id)
        if peer is None or peer.present:
            return None, evicted
        peer.present = True
        return peer, evicted

    def forget(self, id: str) -> Peer | None:  # noqa: A002
        """Remove a peer that has gone; returns it if it was known."""
        return self._peers.pop(id, None)

    def forget_all(self) -> list[Peer]:
        """Remove all peers, and return them."""
        peers = list(self._peers.values())
        self._peers.clear()
        return peers

    def reject(self, id: str, reason: str, error: Exception, count: int = 1) -> None:  # noqa: A002
        """Count what was refused of a peer, and report the first refusal for each reason."""
        self.rejected[reason] += count
        peer = self._peers.get(id)
        reported = self._reported_of_unknown if peer is None else peer.reported
        if reported.add(reason):
            self._report(id, reason, error)

    def admit_authorities(self, peer: Peer, authorities: Collection[str], samples: int) -> bool:
        """Note the authorities that a batch names; returns False, and refuses the batch, if they are too many."""
        for authority in authorities:
            if authority not in peer.authorities:
                text = peer.authority_text + len(authority)
                if len(peer.authorities) >= MAX_AUTHORITIES or text > MOST_AUTHORITY_TEXT:
                    error = ValueError(
                        f"the peer has spoken for more than {MAX_AUTHORITIES} authorities, or for very long ones"
                    )
                    self.reject(peer.id, "too many authorities", error, samples)
                    return False
                peer.authorities.add(authority)
                peer.authority_text = text
        return True
