"""The times at which a link looks after connections behind which it has met nobody.

Where two dial each other at once, or have little time, connections break and are made again from both ends. In the end
zenoh sometimes has none, or one of which both ends have lost all that the other end has declared. Then neither hears
the other, so neither asks whether it is heard, as in `tfbus.links.zenoh._hearing`. All that they know is that they are
connected, or were, and at which address, if they have dialled.
"""

from collections.abc import Callable, Container, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import anyio.to_thread
import zenoh

from tfbus.links.zenoh._dialing import newest_first
from tfbus.links.zenoh._keys import Keys
from tfbus.links.zenoh._session import ZenohSession

PAUSES = 3.0, 10.0, 30.0
"""s before each look; whoever is not met after the last one is no link, or has no right to be heard."""
MOST_UNMET = 1_000
"""So many connections are remembered, the first."""
MOST_ROUTERS = 100
_ANSWER_TIME = 1.0


@dataclass(slots=True)
class _Look:
    due: float
    number: int
    addresses: list[str]


class Unmet:
    """Decides when to look after which connection.

    Parameters
    ----------
    own : ZenohSession
        That of the link, which has the connections.
    keys : Keys
    now : callable
        Returns a monotonic time in s.
    """

    def __init__(self, own: ZenohSession, keys: Keys, now: Callable[[], float]) -> None:
        self._own = own
        self._keys = keys
        self._now = now
        self._looks: dict[str, _Look] = {}
        self._routers: dict[str, None] = {}

    async def find(
        self, connected: Sequence[tuple[str, str | None]], present: Container[str], is_dialled: Callable[[str], bool]
    ) -> list[tuple[str, str]]:
        """The sessions to dial now, each with an address.

        Parameters
        ----------
        connected : sequence of (str, str or None)
            Sessions to which connections have come or gone since the last call, and where they listen, if it is known.
        present : container of str
            The peers that are there.
        is_dialled : callable
            Whether a peer is dialled anyway.
        """
        for session, address in connected:
            self.connected(session, address)
        due = [look for look in self.take_due(present) if not is_dialled(look[0])]
        if not due:
            return []
        # Not before: on a busy machine each question to zenoh takes seconds, and by now most have been met.
        for router in await anyio.to_thread.run_sync(self._own.routers):
            self.is_router(router)
        due = [look for look in due if look[0] not in self._routers]
        return await anyio.to_thread.run_sync(find_deaf, self._own, self._keys, due)

    def is_router(self, session: str) -> None:
        """A session is that of a router, which is no link."""
        self._routers[session] = None
        if len(self._routers) > MOST_ROUTERS:
            del self._routers[next(iter(self._routers))]
        self._looks.pop(session, None)

    def connected(self, session: str, address: str | None) -> None:
        """A connection to a session has come or gone; it is looked after unless a peer is behind it."""
        if session in self._routers or (session not in self._looks and len(self._looks) >= MOST_UNMET):
            return
        before = self._looks.get(session)
        known = [] if before is None else before.addresses
        addresses = known if address is None else newest_first(address, known)
        self._looks[session] = _Look(self._now() + PAUSES[0], 1, addresses)

    def next_due(self) -> float | None:
        """The time of the next look; None while all that are connected have been met."""
        return min((look.due for look in self._looks.values()), default=None)

    def take_due(self, present: Container[str]) -> list[tuple[str, list[str]]]:
        """The sessions to look after now, with their addresses; those that are present are left out for good."""
        now, due = self._now(), []
        for session, look in tuple(self._looks.items()):
            if session in present:
                del self._looks[session]
            elif look.due <= now:
                due.append((session, look.addresses))
                if look.number < len(PAUSES):
                    look.due, look.number = now + PAUSES[look.number], look.number + 1
                else:
                    del self._looks[session]
        return due


def find_deaf(own: ZenohSession, keys: Keys, sessions: Iterable[tuple[str, list[str]]]) -> list[tuple[str, str]]:
    """The sessions to dial, with addresses, because they may be links that this one ought to hear. Blocks.

    Parameters
    ----------
    own : ZenohSession
    keys : Keys
    sessions : iterable of (str, list of str)
        Each with its known addresses.
    """
    connected = own.connected()
    return [
        (session, address)
        for session, known in sessions
        if session not in connected or not _is_of_others(own, keys, session)
        for address in known
    ]


def _is_of_others(own: ZenohSession, keys: Keys, session: str) -> bool:
    """Whether a session is that of a link of another domain, or of a robot that this link does not hear."""
    heard = [zenoh.KeyExpr(key) for key in keys.heard("@alive")]
    with suppress(zenoh.ZError):
        for reply in own.session.liveliness().get(f"tfbus/**/@alive/{session}/*", timeout=_ANSWER_TIME):
            if reply.ok is not None and not any(key.includes(reply.ok.key_expr) for key in heard):
                return True
    return False
