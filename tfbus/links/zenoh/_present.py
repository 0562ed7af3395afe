"""The peers that are there, and the ways that reach each of them."""

import threading
from collections.abc import Callable, Iterator, Mapping

from tfbus.links._peers import MAX_PEERS
from tfbus.links._receive_queue import Presence, Received
from tfbus.links.zenoh._keys import ANY_ROBOT, FIRST_SESSION, NO_ROBOT
from tfbus.links.zenoh._session import ZenohSession
from tfbus.tf_message import MalformedMessageError

Way = tuple[ZenohSession | None, str]
"""A connection between two links: the patch here, or None for the first session, and the name of the session there."""
DIRECT: Way = (None, FIRST_SESSION)
MOST_WAYS = 20
"""So many ways of one peer are noted."""


class Present(Mapping[str, frozenset[Way]]):
    """The ways of each peer that is there; may be used in any thread.

    Parameters
    ----------
    receive : callable
        Called with a `Received` item for each peer that comes or goes.
    note_change : callable
        Called with each peer that comes or goes, or does so by its direct way, and its `Presence`.
    """

    def __init__(self, receive: Callable[[Received], object], note_change: Callable[[str, Presence], object]) -> None:
        self._receive = receive
        self._note_change = note_change
        self._lock = threading.Lock()
        self._ways: dict[str, frozenset[Way]] = {}
        self._robots: dict[str, str] = {}
        self._of_several: set[str] = set()

    def __getitem__(self, peer: str) -> frozenset[Way]:
        return self._ways[peer]

    def __iter__(self) -> Iterator[str]:
        return iter(tuple(self._ways))

    def __len__(self) -> int:
        return len(self._ways)

    def __contains__(self, peer: object) -> bool:
        return peer in self._ways

    def is_direct(self, peer: str) -> bool:
        """Whether the first session of a peer is heard by the one of this link."""
        return DIRECT in self._ways.get(peer, ())

    def names(self, peer: str) -> list[str]:
        """The names of the sessions of a peer that are heard."""
        return sorted({name for _, name in self._ways.get(peer, ())})

    def robots(self) -> dict[str, str]:
        """The robot of each peer; if it was announced with several, the first."""
        with self._lock:
            return dict(self._robots)

    def robot(self, peer: str) -> str:
        """The robot of a peer; `ANY_ROBOT` if that is not known, or somebody has announced the peer with another."""
        return ANY_ROBOT if peer in self._of_several else self._robots.get(peer, ANY_ROBOT)

    def note(self, peer: str, way: Way, presence: Presence, robot: str = NO_ROBOT) -> None:
        """Note that a peer has come or gone by one of its ways."""
        with self._lock:
            before = self._ways.get(peer, frozenset())
            if presence is Presence.JOINED and way not in before and self._is_full(before):
                detail = f"more than {MAX_PEERS} peers, or {MOST_WAYS} sessions of one, have announced themselves"
                self._receive(Received(peer, MalformedMessageError("too many tokens", detail)))
                return
            after = before | {way} if presence is Presence.JOINED else before - {way}
            if after:
                self._ways[peer] = after
                if presence is Presence.JOINED and self._robots.setdefault(peer, robot) != robot:
                    self._of_several.add(peer)
            elif before:
                del self._ways[peer], self._robots[peer]
                self._of_several.discard(peer)
            changed = bool(after) is not bool(before)
            if changed:
                self._receive(Received(peer, presence))
            if changed or way == DIRECT:
                self._note_change(peer, presence)

    def _is_full(self, ways: frozenset[Way]) -> bool:
        return len(ways) >= MOST_WAYS if ways else len(self._ways) >= MAX_PEERS

    def end(self, peer: str, patch: ZenohSession) -> None:
        """Note that a peer is reached by a patch no more."""
        for way in self._ways.get(peer, ()):
            if way[0] is patch:
                self.note(peer, way, Presence.LEFT)
