"""`BusServer`, the common part of all servers that show a bus to web pages: one address, and a door."""

from collections.abc import Iterable
from types import TracebackType
from typing import Self

from tfbus._aio.web_door import WebDoor
from tfbus._aio.web_server import Answer, WebServer
from tfbus.bus.bus import Bus
from tfbus.errors import BusClosedError
from tfbus.registration import AsyncOnly


class BusServer(AsyncOnly):
    """Listens for as long as its ``async with`` lasts; a subclass answers, and says what the arguments are.

    Parameters
    ----------
    bus : Bus
    host, port, origins
        As for `WebServer` and `WebDoor`.
    answer : callable
        The `Answer` of the `WebServer`.
    search : bool
        As for `WebServer`.
    """

    _scheme = "ws"

    def __init__(
        self, bus: Bus, host: str, port: int, origins: Iterable[str], answer: Answer, search: bool = False
    ) -> None:
        self.bus = bus
        self.address: str = ""
        self._front = WebServer(host, port, WebDoor(host, origins), answer, search)
        self._warn_unless_entered()

    @property
    def refused(self) -> int:
        """Connections that were refused."""
        return self._front.refused

    async def __aenter__(self) -> Self:
        self._enter_once()
        self.bus._check_thread()
        if self.bus.closed:
            raise BusClosedError
        self.bus._entered.add(self)
        try:
            await self._open()
            await self._front.__aenter__()
        except BaseException:
            await self._stop()
            raise
        self.address = f"{self._scheme}://{self._front.place}"
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            await self._front.__aexit__(None, None, None)
        finally:
            await self._stop()

    async def _stop(self) -> None:
        self.address = ""
        self.bus._entered.discard(self)
        await self._close()

    async def _open(self) -> None:
        """Prepare to answer."""

    async def _close(self) -> None:
        """End the work that `_open` has begun."""
