"""The options of every command that joins a domain."""

import os
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import Annotated

import anyio
from cyclopts import Parameter

from tfbus.bus.bus import Bus
from tfbus.cli.options import Backend
from tfbus.cli.running import run

_SOON = 1.0


class UnusableError(Exception):
    """What the command was told to use cannot be used; one line, and status 2."""


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class LinkOptions:
    """How a command reaches others.

    Parameters
    ----------
    domain
        Only programs of the same domain hear each other.
    listen
        Where to listen, as tcp/192.168.1.5:7447; may be given several times. Without any address, programs on this
        machine find each other by themselves.
    connect
        Where others listen; may be given several times. Programs without an address are at tcp/127.0.0.1:17447.
    backend
        The event loop to run on.
    """

    domain: str = "tf"
    listen: Annotated[tuple[str, ...], Parameter(negative="", show_default=False)] = ()
    connect: Annotated[tuple[str, ...], Parameter(negative="", show_default=False)] = ()
    backend: Backend = "asyncio"

    @asynccontextmanager
    async def open(self, bus: Bus) -> AsyncIterator[None]:
        """The link, to be entered; whatever keeps it from being there is an `UnusableError`."""
        try:
            from tfbus.links.zenoh import ZenohLink
        except ImportError:
            raise UnusableError('joining a domain needs a package more: pip install "tfbus[cli,zenoh]"') from None
        async with AsyncExitStack() as stack:
            try:
                link = ZenohLink(bus, self.domain, listen=self.listen or None, connect=self.connect or None)
                await stack.enter_async_context(link)
            except ValueError as error:
                raise UnusableError(str(error)) from None
            except OSError as error:
                where = " or ".join(self.listen) or "the loopback"
                why = os.strerror(error.errno) if error.errno else error
                raise UnusableError(f"cannot listen at {where}: {why}") from None
            yield

    def run(self, program: Callable[[Bus], Awaitable[object]]) -> None:
        """Run a program on a bus that has joined the domain, on the event loop that was chosen. See `running.run`."""

        async def join_and_run() -> None:
            with Bus() as bus:
                async with self.open(bus):
                    await program(bus)

        run(join_and_run, self.backend)

    async def first_transform(self, bus: Bus) -> None:
        """Return when something has been published on the bus; say so if that takes more than a moment."""
        arrived = anyio.Event()
        with bus.subscribe(lambda _: arrived.set()):
            with bus.clock.move_on_after(_SOON):
                await arrived.wait()
                return
            say(f"waiting for transforms on domain {self.domain!r} …")
            await arrived.wait()


LOCAL = LinkOptions()
"""What holds where nothing is said."""


def say(line: str) -> None:
    """Print a line for people, which is not what was asked."""
    print(line, file=sys.stderr, flush=True)
