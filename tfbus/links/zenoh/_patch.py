"""A session that mends a broken connection to one peer."""

from collections.abc import Callable

import anyio
import zenoh

from tfbus.links._receive_queue import Presence, Received
from tfbus.links.zenoh._filters import Filters
from tfbus.links.zenoh._keys import FIRST_SESSION, Keys, new_id
from tfbus.links.zenoh._session import ZenohSession


class Patch(ZenohSession):
    """A session for one peer, connected to the address where the peer was.

    Parameters
    ----------
    config : zenoh.Config
    keys : Keys
    peer : str
    receive : callable
        Called in zenoh's threads with each `Received` item of the peer, and of nobody in particular.
    note_presence : callable
        Called in zenoh's threads with this patch, the name of a session of the peer, its `Presence`, and its robot.
    filters : Filters
    note_served, robot_of : callable
        As for `ZenohSession`.

    Attributes
    ----------
    peer : str
    """

    def __init__(
        self,
        config: zenoh.Config,
        keys: Keys,
        peer: str,
        receive: Callable[[Received], object],
        note_presence: Callable[["Patch", str, Presence, str], object],
        filters: Filters,
        note_served: Callable[[str, bool], object],
        robot_of: Callable[[str], str],
    ) -> None:
        self.peer = peer
        self._receive_of_peer = receive
        self._note_of_peer = note_presence
        self._ends: dict[str, None] = {}
        self._others: set[str] = set()
        super().__init__(
            config,
            keys,
            self._receive_any,
            self._note_any,
            new_id(),
            note_connection=lambda session, *_: self._ends.setdefault(session),
            filters=filters,
            note_served=note_served,
            robot_of=robot_of,
        )

    async def meet(self, is_present: Callable[[], bool], seconds: float) -> None:
        """Wait until the peer is present, or another link has come in its place, but no longer than some time, in s."""
        with anyio.move_on_after(seconds):
            while not is_present() and self._others.isdisjoint(tuple(self._ends)):  # noqa: ASYNC110 - zenoh wakes none
                await anyio.sleep(0.05)

    def found_instead(self) -> tuple[str, bool] | None:
        """Return the session at the address that is not the peer, and whether it is a link that is to be heard."""
        if self.peer in self._ends:
            return None
        return next(((end, end in self._others) for end in tuple(self._ends)), None)

    def _receive_any(self, item: Received) -> None:
        if item.sender in ("", self.peer):
            self._receive_of_peer(item)

    def _note_any(self, link: str, name: str, presence: Presence, robot: str) -> None:
        if link == self.peer:
            self._note_of_peer(self, name, presence, robot)
        elif name == FIRST_SESSION:
            self._others.add(link)
