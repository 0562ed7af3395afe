"""The peers of a link: who is present, how much each may send, and what was refused of it."""

from collections import Counter
from collections.abc import Callable
from itertools import count

from tfbus.bus.subscribers import SeenKeys
from tfbus.links._mirror import Mirror

MAX_PEERS = 1_000
MAX_AUTHORITIES = 1_000
_REMEMBERED_REASONS = 100

_ages = count()


def next_age() -> int:
    """A number higher than all before it: it tells which of two meetings and losses of peers was later."""
    return next(_ages)


class Peer:
    """The other end of a link, as far as this end knows it.

    Attributes
    ----------
    id : str
    age : int
        From `next_age`, when it was met; a peer that was lost and comes back is met anew.
    present : bool
        Whether it has announced that it is there.
    number : int
        The number of its newest live message.
    authorities : set of str
        The authorities whose samples it has sent.
    frames : set of (bytes, str)
        Origin and child of all frames that it was the first to bring; their number is limited.
    mirror : Mirror or None
        What it has told of its state, once it is present, if the carrier can ask it.
    reported : SeenKeys
        The reasons of refusals that were reported.
    """

    __slots__ = ("age", "authorities", "frames", "id", "mirror", "number", "present", "reported")

    def __init__(self, id: str) -> None:  # noqa: A002 - the wire calls it so
        self.id = id
        self.age = next_age()
        self.present = False
        self.number = 0
        self.authorities: set[str] = set()
        self.frames: set[tuple[bytes, str]] = set()
        self.mirror: Mirror | None = None
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

    def brings(self, frame: str, besides: Peer | None) -> bool:
        """Whether any peer but one has told that it brings a frame."""
        return any(
            peer.mirror is not None and peer is not besides and frame in peer.mirror for peer in self._peers.values()
        )

    def make_room(self, id: str) -> Peer | None:  # noqa: A002
        """Evict a peer that has not announced itself, if all places are taken, for a new one that has.

        Returns
        -------
        Peer or None
            The evicted one.
        """
        if id in self._peers or len(self._peers) < MAX_PEERS:
            return None
        unannounced = next((peer for peer in self._peers.values() if not peer.present), None)
        return None if unannounced is None else self._peers.pop(unannounced.id)

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
