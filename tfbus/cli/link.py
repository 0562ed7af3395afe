"""The options of every command that joins a domain."""

from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from typing import Any

from cyclopts import Parameter

from tfbus.bus import Bus
from tfbus.cli.options import Backend


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
        Where others listen; may be given several times.
    backend
        The event loop to run on.
    """

    domain: str = "tf"
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    backend: Backend = "asyncio"

    def open(self, bus: Bus, **options: Any) -> AbstractAsyncContextManager[object]:
        """The link, to be entered."""
        try:
            from tfbus.links.zenoh import ZenohLink
        except ImportError as error:
            raise UnusableError(str(error)) from None
        try:
            return ZenohLink(bus, self.domain, listen=self.listen or None, connect=self.connect or None, **options)
        except ValueError as error:
            raise UnusableError(str(error)) from None
