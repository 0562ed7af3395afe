"""`ZenohLink`: joins a bus to the buses of other machines by zenoh's routers."""

from typing import Unpack

from tfbus.bus.bus import Bus
from tfbus.links.domain import DomainOptions
from tfbus.links.link import DomainLink, check_domain
from tfbus.links.zenoh.sessions import Addresses, Settings
from tfbus.links.zenoh.wire import ZenohWire


class ZenohLink(DomainLink):
    """Joins a bus to the buses behind a zenoh router: ``async with ZenohLink(bus, connect="tcp/host:7447")``.

    The router is ``tfbus router``, a `ZenohRouter`, anybody's ``zenohd``, or the process of a link that listens. For
    the processes of one machine there is `tfbus.LocalLink`.

    Parameters
    ----------
    bus : Bus
    domain : str
        Links hear each other if they have the same one.
    connect : str or iterable of str, optional
        The addresses of routers, such as ``tcp/192.168.1.5:7447``. They are tried in turn until one answers, and again
        when the connection breaks.
    listen : str or iterable of str, optional
        Run a router in this process that listens at these addresses, and connects to those of `connect`.
    config : mapping of str to any, or str or path, optional
        Settings of zenoh by their path, such as ``transport/link/tls/root_ca_certificate``. Or the name of a file of
        them, as zenoh's own router takes it.
    lease : float, optional
        Seconds of silence after which a router takes this link for lost; 4 s by default. A process that dies is lost at
        once.
    **options
        The options of `tfbus.links.DomainLink`: `robot`, `robots`, `slow_rate`, `frames`, `drop_lost`, `max_frames`,
        `capacity`, `history`, `max_offset`, `correct_clocks`, `clock` and `tell_clock`.

    Raises
    ------
    ValueError, TypeError
        As for `DomainLink`; if there is no address, or zenoh does not take an address or a setting.
    OSError
        On entering, if it cannot listen where it should. Without a router the link is entered, warns in the log, and
        connects when there is one.
    BusClosedError, RuntimeError
        On entering, as for `DomainLink`.
    ImportError
        On import, without the extra: ``pip install "tfbus[zenoh]"``.
    """

    def __init__(
        self,
        bus: Bus,
        domain: str = "tf",
        *,
        connect: Addresses | None = None,
        listen: Addresses | None = None,
        config: Settings | None = None,
        lease: float | None = None,
        **options: Unpack[DomainOptions],
    ) -> None:
        robot = options.get("robot") or ""
        wire = ZenohWire(check_domain(domain), robot, connect=connect, listen=listen, config=config, lease=lease)
        super().__init__(bus, domain, wire, **options)
