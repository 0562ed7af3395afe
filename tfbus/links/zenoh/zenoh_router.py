"""A zenoh router in this process, which links and other routers connect to."""

import threading
from time import monotonic
from types import TracebackType
from typing import Final, Self

import anyio
import anyio.to_thread
import zenoh

from tfbus.links.zenoh.neighbours import PAUSE_TO_BEGIN, PAUSE_TO_LISTEN, PERIOD, Neighbours, open_router
from tfbus.links.zenoh.sessions import (
    CLOSING_TIME,
    Addresses,
    Keeper,
    Settings,
    begin_to_close,
    close_session,
    os_error,
    router_config,
)
from tfbus.registration import AsyncOnly, warn_unless_entered

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
        If zenoh does not take an address or a setting, or an argument has another type.
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
        self._config = router_config(listen, connect or (), config, lease)
        self._keeper = Keeper(self._keep)
        self._entered = False
        self._opened = threading.Event()
        self._failure: OSError | None = None
        self._never_entered = warn_unless_entered(self)

    async def __aenter__(self) -> Self:
        if self._entered:
            raise RuntimeError("a router is entered once: make another one")
        self._entered = True
        self._never_entered.detach()
        self._keeper.start()
        try:
            await anyio.to_thread.run_sync(self._opened.wait, abandon_on_cancel=True)
            if self._failure is not None:
                raise self._failure
        except BaseException:
            await self._keeper.end()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self._keeper.end()

    def _open(self) -> Neighbours:
        session = open_router(self._config)
        try:
            return Neighbours(session)
        except zenoh.ZError as error:
            # zenoh may not end it, if a client asks for tokens at this moment.
            begin_to_close(session).join(CLOSING_TIME)
            raise os_error(error, "the session of a router broke at once") from error

    def _keep(self) -> None:
        """Have one session after another, until the router is closed; the first one has to open."""
        keeper = self._keeper
        while not (self._opened.is_set() and keeper.stopped):
            try:
                router = self._open()
            except OSError as error:
                if not self._opened.is_set():
                    self._failure = error
                    return
                # The session before may not have freed the address yet.
                keeper.wait(PAUSE_TO_LISTEN)
                continue
            finally:
                self._opened.set()
            while not (keeper.stopped or router.are_silent(monotonic())):
                keeper.wait(PERIOD)
            if keeper.stopped:
                close_session(router)
            else:
                begin_to_close(router)
                keeper.rest(PAUSE_TO_BEGIN)
