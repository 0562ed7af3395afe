"""A zenoh router in this process, for links that cannot reach each other."""

import weakref
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self

import anyio
import anyio.to_thread
import zenoh

from tfbus.links.zenoh._closing import begin_to_close, close_session, wait_until_closed
from tfbus.links.zenoh._opening import open_session
from tfbus.links.zenoh._settings import MEETING_POINT, Addresses, settings


class ZenohRouter:
    """Passes on what links send each other: ``async with ZenohRouter("tcp/192.168.1.5:7447")``.

    Links connect to it as peers, which talk directly where they can, or as clients, ``config={"mode": "client"}``,
    which hear everybody through the router. It has no bus, knows no domains, and passes on only what somebody behind it
    has subscribed to.

    Parameters
    ----------
    listen : str or iterable of str
        zenoh's endpoints; by default the address at which links without an address meet.
    connect : str or iterable of str, optional
        The addresses of other routers.
    config : mapping of str to any, optional
        Settings of zenoh by their path: TLS, access control.
    lease : float, optional
        Seconds of silence after which the router is taken for lost, and takes others for lost by theirs; by default, as
        that of a `ZenohLink`.

    Raises
    ------
    ValueError, TypeError
        If zenoh does not take an address or a setting, or an argument has another type.
    OSError
        On entering, if it cannot listen where it should.
    RuntimeError
        On entering a second time.
    """

    def __init__(
        self,
        listen: Addresses = MEETING_POINT,
        *,
        connect: Addresses | None = None,
        config: Mapping[str, Any] | None = None,
        lease: float | None = None,
    ) -> None:
        self._config = settings(listen, connect or [], {"mode": "router", **(config or {})}, lease)
        self._entered = False
        self._session: zenoh.Session | None = None

    async def __aenter__(self) -> Self:
        if self._entered:
            raise RuntimeError("a router is entered once: make another one")
        self._entered = True
        self._session = await anyio.to_thread.run_sync(open_session, self._config)
        # A program may exit without the end of its router.
        self._close_at_exit = weakref.finalize(self, close_session, self._session)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._close_at_exit.detach()
        await wait_until_closed([begin_to_close(self._session)])
