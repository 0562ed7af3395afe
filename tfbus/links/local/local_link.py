"""`LocalLink`: joins a bus to the buses of other processes on this machine."""

from typing import Unpack

from tfbus.bus.bus import Bus
from tfbus.links.domain import DomainOptions
from tfbus.links.link import DomainLink
from tfbus.links.local.local_wire import LocalWire


class LocalLink(DomainLink):
    """Joins a bus to the buses of the user's other processes on this machine: ``async with LocalLink(bus)``.

    Nothing has to be configured or started, and no port is opened: each two links have a socket in a directory that
    only the user can enter. For other machines there is `tfbus.links.zenoh.ZenohLink`; a bus may have both, and passes
    on the samples between them.

    Parameters
    ----------
    bus : Bus
    domain : str
        Links hear each other if they have the same one.
    directory : str, optional
        The directory in which links meet, by default that of ``TFBUS_RUNTIME_DIR``, or else ``tfbus`` in
        ``XDG_RUNTIME_DIR``, or else ``tfbus-UID`` in the directory for temporary files.
    loopback : bool, optional
        Use ports of the loopback, with a key in the directory, in place of Unix sockets. By default only where there
        are none, as on Windows; all links of a domain have to use the same.
    **options
        The options of `tfbus.links.DomainLink`: `robot`, `robots`, `slow_rate`, `frames`, `drop_lost`, `max_frames`,
        `capacity`, `history`, `max_offset`, `correct_clocks`, `clock` and `tell_clock`.

    Raises
    ------
    ValueError, TypeError
        As for `DomainLink`.
    PermissionError
        On entering, if others can enter the directory.
    OSError, BusClosedError, RuntimeError
        On entering, as for `DomainLink`.

    Notes
    -----
    A peer is lost when its process or its link has ended, which the kernel tells at once. A process that is busy or
    stopped is not lost; its frames grow old.

    At Ctrl-C the event loop ends the ``async with`` in order, and then Python shows some 50 lines of traceback, unless
    the program says that this is its end. The star counts on trio, which raises a group of exceptions::

        try:
            asyncio.run(main())  # or anyio.run(main), or trio.run(main)
        except* KeyboardInterrupt:
            pass

    Examples
    --------
    >>> async def main() -> None:
    ...     with Bus() as bus, Buffer(bus) as buffer:
    ...         async with LocalLink(bus):
    ...             print(await buffer.lookup("map", "base_link"))
    """

    def __init__(
        self,
        bus: Bus,
        domain: str = "tf",
        *,
        directory: str | None = None,
        loopback: bool | None = None,
        **options: Unpack[DomainOptions],
    ) -> None:
        wire = LocalWire(domain, options.get("robot") or "", directory=directory, loopback=loopback)
        super().__init__(bus, domain, wire, **options)
        wire.turn = self._received.answer
