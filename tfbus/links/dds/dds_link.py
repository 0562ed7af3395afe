"""A link to ROS 2 over DDS: the transforms of a ROS 2 system on a bus, and those of the bus there."""

import os
from collections.abc import Iterable
from typing import Unpack, get_args

from tfbus.bus.bus import Bus
from tfbus.links.dds._carrier import DdsCarrier
from tfbus.links.dds._domains import Discovery, configuration
from tfbus.links.ros.ros_link import RosLink
from tfbus.links.ros.settings import RosOptions, as_domain, settings_of


class DdsLink(RosLink):
    """Joins a bus to ``/tf`` and ``/tf_static`` of ROS 2 over DDS: ``async with DdsLink(bus) as link``.

    No ROS is needed, here or while it is installed. It speaks with ROS 2 programs of any vendor of DDS, as they are.

    Parameters
    ----------
    bus : Bus
    domain : int, optional
        The number that ROS 2 programs have as ``ROS_DOMAIN_ID``, from 0 to 232; by default, this program's
        ``ROS_DOMAIN_ID``, or else 0.
    discovery : {"localhost", "subnet"}, optional
        Whether only programs on this machine are found, or those on the local network too; by default as
        ``ROS_AUTOMATIC_DISCOVERY_RANGE`` says, or else ``"localhost"``.
    peers : iterable of str
        Machines beyond that, by name or address.
    config : str, optional
        A configuration of Cyclone DDS in place of the two, XML or the URL of a file, by default the variable
        ``CYCLONEDDS_URI``.
    **options
        Those that all links to ROS share: see `tfbus.links.ros.RosLink`. By default, the authority of a sample is the
        node that has published it, such as ``/robot_state_publisher``.

    Attributes
    ----------
    bus : Bus
    domain : int
    id : str
        The name of this end.

    Raises
    ------
    ValueError
        If the domain or the discovery is out of range, or as `tfbus.links.ros.RosLink`.
    TypeError
        If an argument has the wrong type.
    OSError
        On entering, if the domain cannot be joined, or is open in this process with other settings.
    BusClosedError, RuntimeError
        On entering, if the bus is closed; if it belongs to another thread, or the link was entered before.
    ImportError
        On import, without the extra: ``pip install "tfbus[dds]"``.

    Notes
    -----
    The qualities of service are those of tf2: all is reliable, ``/tf_static`` is transient local. A peer is a process
    with a broadcaster. Entering takes up to 1.6 s where there are ROS 2 programs, and then their frames come at once.
    Whoever reaches the domain can publish there, and read everything.
    """

    def __init__(
        self,
        bus: Bus,
        domain: int | None = None,
        *,
        discovery: Discovery | None = None,
        peers: Iterable[str] = (),
        config: str | None = None,
        **options: Unpack[RosOptions],
    ) -> None:
        if isinstance(peers, str):
            raise TypeError(f"peers must be several machines, not {peers!r}")
        self.domain = as_domain(domain)
        config = config or os.environ.get("CYCLONEDDS_URI") or None
        carrier = DdsCarrier(
            self.domain, configuration(_as_discovery(discovery), tuple(peers), config), settings_of(options)
        )
        super().__init__(bus, carrier.id, carrier, **options)


def _as_discovery(discovery: Discovery | None) -> Discovery:
    if discovery is None:
        return "subnet" if os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "SUBNET" else "localhost"
    if discovery not in get_args(Discovery):
        raise ValueError(f"discovery must be 'localhost' or 'subnet', not {discovery!r}")
    return discovery
