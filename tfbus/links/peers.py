"""The other ends of a link: who is there, how much each may send, and what was wrong with it."""

from collections import Counter
from collections.abc import Callable
from itertools import count

from tfbus._log import SeenKeys

MAX_PEERS = 1_000
MAX_AUTHORITIES = 1_000
_REASONS = 100

ages = count()
"""What comes later, a peer or a loss, takes a higher one."""


class Peer:
    """Another end of a link, as far as this one knows it.

    Attributes
    ----------
    id : str
    age : int
        Higher for one that was met later, also for one that has come back.
    present : bool
        Whether it has said that it is there.
    number : int
        That of its newest live message.
    authorities : set of str
        Whom it has spoken for.
    frames : set of (bytes, str)
        Origin and child of all that it has brought: what its limit counts.
    """

    __slots__ = ("age", "authorities", "frames", "id", "number", "present", "told")

    def __init__(self, id: str) -> None:  # noqa: A002 - it is called so on the wire
        self.id = id
        self.age = next(ages)
        self.present = False
        self.number = 0
        self.authorities: set[str] = set()
        self.frames: set[tuple[bytes, str]] = set()
        self.told = SeenKeys(_REASONS)


class Peers:
    """All of one link.

    Parameters
    ----------
    report : callable
        Called with a peer's id, a reason and an error, once for each peer and reason.

    Attributes
    ----------
    rejected : Counter
        What was refused, by reason.
    """

    def __init__(self, report: Callable[[str, str, Exception], object]) -> None:
        self._report = report
        self._peers: dict[str, Peer] = {}
        self._strangers = SeenKeys(_REASONS)
        self.rejected: Counter[str] = Counter()

    @property
    def present(self) -> tuple[str, ...]:
        """The ids of those who have said that they are there, sorted."""
        return tuple(sorted(peer.id for peer in self._peers.values() if peer.present))

    def find(self, id: str) -> Peer | None:  # noqa: A002
        """The peer of an id, new or known; None if there are too many."""
        peer = self._peers.get(id)
        if peer is None:
            if len(self._peers) >= MAX_PEERS:
                self.reject(id, "too many peers", ValueError(f"more than {MAX_PEERS} peers on one link"))
                return None
            peer = self._peers[id] = Peer(id)
        return peer

    def make_room(self, id: str) -> Peer | None:  # noqa: A002
        """Take out the first one that has not said that it is there, if there is no room for somebody new who has."""
        if id in self._peers or len(self._peers) < MAX_PEERS:
            return None
        stranger = next((peer for peer in self._peers.values() if not peer.present), None)
        return None if stranger is None else self._peers.pop(stranger.id)

    def forget(self, id: str) -> Peer | None:  # noqa: A002
        """Take out a peer that has gone, if it was known."""
        return self._peers.pop(id, None)

    def forget_all(self) -> list[Peer]:
        """Take out everybody."""
        peers = list(self._peers.values())
        self._peers.clear()
        return peers

    def reject(self, id: str, reason: str, error: Exception, count: int = 1) -> None:  # noqa: A002
        """Count what a peer sent and must not have, and report it if that is new."""
        self.rejected[reason] += count
        peer = self._peers.get(id)
        if peer.told.first(reason) if peer is not None else self._strangers.first(reason):
            self._report(id, reason, error)
