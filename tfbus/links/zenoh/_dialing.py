"""The times at which a link dials peers that it has lost, at the addresses where it had reached them."""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import anyio

FIRST_PAUSE = 0.3
SHORT_PAUSE = 2.0
LONG_PAUSE = 30.0
"""s between two attempts: at first, for a while, and then for as long as the peer is remembered."""
SHORT_TIME = 120.0
"""s; so long after the loss the pause is short."""
MOST_PEERS = 1_000
"""So many lost peers are remembered, the newest."""
MOST_ADDRESSES = 4
_PROBE_TIME = 3.0
"""s; on a busy machine a connection on the loopback may take more than one."""
_TCP = re.compile(r"(?:tcp|tls)/(?:\[(?P<six>[^\]]+)\]|(?P<four>[^:/?#\s]+)):(?P<port>\d+)")


@dataclass(slots=True)
class _Lost:
    since: float
    due: float
    pause: float = FIRST_PAUSE


class Dialing:
    """Remembers where peers were reached, and decides when to try again.

    A link that has dialled another one gives up when their connection breaks: zenoh repeats only the addresses that
    were given to it, and not those that it has heard of from other peers.

    Parameters
    ----------
    now : callable
        Returns a monotonic time in s.
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._addresses: dict[str, list[str]] = {}
        self._lost: dict[str, _Lost] = {}

    def reached(self, peer: str, address: str) -> None:
        """A peer has been reached at an address, or listens there."""
        self._addresses[peer] = newest_first(address, self._addresses.pop(peer, []))
        if len(self._addresses) > MOST_PEERS:
            oldest = next(iter(self._addresses))
            del self._addresses[oldest]
            self._lost.pop(oldest, None)

    def refused(self, peer: str, address: str) -> None:
        """Nobody listens at an address: forget it, unless it is the only one."""
        known = self._addresses.get(peer, [])
        if len(known) > 1 and address in known:
            known.remove(address)

    def taken(self, peer: str, address: str) -> None:
        """Somebody else listens at an address, so this peer does so no more: forget it."""
        known = self._addresses.get(peer, [])
        if address in known:
            known.remove(address)
            if not known:
                del self._addresses[peer]
                self._lost.pop(peer, None)

    def addresses(self, peer: str) -> list[str]:
        """The addresses of a peer, the newest first."""
        return list(self._addresses.get(peer, ()))

    def is_dialled(self, peer: str) -> bool:
        """Whether a peer is lost, and dialled now and then."""
        return peer in self._lost

    def joined(self, peer: str) -> None:
        """A peer is there."""
        self._lost.pop(peer, None)

    def left(self, peer: str) -> None:
        """A peer is lost."""
        if peer in self._addresses:
            now = self._now()
            self._lost[peer] = _Lost(now, now + FIRST_PAUSE)

    def next_due(self) -> float | None:
        """The time of the next call of `take_due`; None while nobody is lost."""
        return min((lost.due for lost in self._lost.values()), default=None)

    def take_due(self) -> list[tuple[str, str]]:
        """The peers to dial now, each with one of its addresses in turn."""
        now = self._now()
        due = [peer for peer, lost in self._lost.items() if lost.due <= now]
        for peer in due:
            lost = self._lost[peer]
            lost.pause = min(2 * lost.pause, SHORT_PAUSE) if now - lost.since < SHORT_TIME else LONG_PAUSE
            lost.due = now + lost.pause
            self._addresses[peer].append(self._addresses[peer].pop(0))
        return [(peer, self._addresses[peer][-1]) for peer in due]


def newest_first(address: str, known: Iterable[str]) -> list[str]:
    """An address and those known before it, each once, and at most `MOST_ADDRESSES` of them."""
    return [address, *(other for other in known if other != address)][:MOST_ADDRESSES]


async def is_reachable(address: str) -> bool:
    """Whether somebody listens at an address; True for the kinds of addresses that only zenoh can try.

    Raises
    ------
    ConnectionRefusedError
        If nobody does, rather than that the address cannot be reached.
    """
    found = _TCP.match(address)
    if found is None:
        return True
    try:
        with anyio.fail_after(_PROBE_TIME):
            stream = await anyio.connect_tcp(found["six"] or found["four"], int(found["port"]))
    except OSError as error:
        if isinstance(error.__cause__, ConnectionRefusedError):
            raise ConnectionRefusedError from error
        return False
    await stream.aclose()
    return True
