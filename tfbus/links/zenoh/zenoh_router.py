"""A zenoh router in this process, which links and other routers connect to."""

import logging
from functools import partial
from types import TracebackType
from typing import Final, Self

from tfbus.links.zenoh.sessions import Addresses, Settings
from tfbus.links.zenoh.wire import ZenohWire
from tfbus.registration import AsyncOnly

ROUTER: Final = "tcp/127.0.0.1:17447"
"""The address of a router that is given none: only processes of this machine reach it."""


class ZenohRouter(AsyncOnly):
    """Passes on what links send each other: ``async with ZenohRouter("tcp/192.168.1.5:7447")``.

    It has no bus, knows no domains, and passes on only what a link behind it, or behind another router, has subscribed
    to. Routers that are connected are as one; each link needs one of them. A router begins anew, and its links connect
    again, if another one is connected and tells it nothing.

    Parameters
    ----------
    listen : str or iterable of str
        zenoh's endpoints; by default ``tcp/127.0.0.1:17447``, which only this machine reaches.
    connect : str or iterable of str, optional
        The addresses of other routers.
    config : mapping of str to any, or str or path, optional
        Settings of zenoh by their path: TLS, access control. Or the name of a file of them, as zenoh's own router
        takes it.
    lease : float, optional
        Seconds of silence after which the router is taken for lost, and so the time in which links notice that they are
        cut off from it; 4 s by default.

    Raises
    ------
    ValueError, TypeError
        If there is no address to listen at, zenoh does not take an address or a setting, or an argument has another
        type.
    OSError
        If the file of settings cannot be read; on entering, if the router cannot listen where it should, or zenoh
        finds that its rules do not fit together.
    RuntimeError
        On entering a second time.
    """

    def __init__(
        self,
        listen: Addresses = ROUTER,
        *,
        connect: Addresses | None = None,
        config: Settings | None = None,
        lease: float | None = None,
    ) -> None:
        # A link of no bus, which hears nobody.
        self._wire = ZenohWire("@router", listen=listen, connect=connect, config=config, lease=lease)
        self._warn_unless_entered()

    async def __aenter__(self) -> Self:
        self._enter_once()
        try:
            await self._wire.open((), lambda *_: None, partial(logging.getLogger("tfbus").warning, "%s"))
        except BaseException:
            await self._wire.close()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self._wire.close()
