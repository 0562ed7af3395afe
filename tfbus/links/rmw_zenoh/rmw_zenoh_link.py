"""A link to ROS 2 over zenoh: the transforms of ROS 2 programs with rmw_zenoh on a bus, and those of the bus there."""

import json
import re
from collections.abc import Mapping
from typing import Any, Unpack

import zenoh

from tfbus.bus.bus import Bus
from tfbus.links.rmw_zenoh._carrier import RmwZenohCarrier
from tfbus.links.ros.ros_link import RosLink
from tfbus.links.ros.settings import RosOptions, as_domain, settings_of

_NODE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


class RmwZenohLink(RosLink):
    """Joins a bus to ``/tf`` and ``/tf_static`` of ROS 2 programs with rmw_zenoh.

    It connects to their router, ``ros2 run rmw_zenoh_cpp rmw_zenohd``, as a client, and is a node of theirs.

    Parameters
    ----------
    bus : Bus
    router : str
        zenoh's endpoint of the router.
    domain : int, optional
        The number that ROS 2 programs have as ``ROS_DOMAIN_ID``; by default, this program's, or else 0.
    node : str
        The name of the node: letters, digits and ``_``.
    config : mapping of str to any, optional
        Settings of zenoh by their path, laid over those of the link, such as TLS.
    **options
        Those that all links to ROS share: see `tfbus.links.ros.RosLink`. By default, the authority of all samples is
        ``"rmw_zenoh"``.

    Attributes
    ----------
    bus : Bus
    domain : int
    id : str
        The name of this end.

    Raises
    ------
    ValueError
        If the domain is out of range, the node cannot have that name, zenoh does not take the address or a setting, or
        as `tfbus.links.ros.RosLink`.
    TypeError
        If an argument has the wrong type.
    OSError
        On entering, if no router can be reached.
    BusClosedError, RuntimeError
        On entering, if the bus is closed; if it belongs to another thread, or the link was entered before.
    ImportError
        On import, without the extra: ``pip install "tfbus[zenoh]"``.

    Notes
    -----
    The messages are those of rmw_zenoh 0.2.4 and later, so of ROS 2 Jazzy. Nobody is a peer, for the router tells of
    nobody. Whoever reaches the router can publish there, and read everything.
    """

    def __init__(
        self,
        bus: Bus,
        router: str = "tcp/localhost:7447",
        domain: int | None = None,
        *,
        node: str = "tfbus",
        config: Mapping[str, Any] | None = None,
        **options: Unpack[RosOptions],
    ) -> None:
        if not isinstance(router, str):
            raise TypeError(f"a router must be a str, not {router!r}")
        if not isinstance(node, str) or not _NODE.fullmatch(node):
            raise ValueError(f"{node!r} cannot be the name of a node: letters, digits and _")
        self.domain = as_domain(domain)
        carrier = RmwZenohCarrier(self.domain, node, _config(router, config or {}), settings_of(options))
        super().__init__(bus, carrier.id, carrier, **options)


def _config(router: str, own: Mapping[str, Any]) -> zenoh.Config:
    """As rmw_zenoh configures its sessions, but as a client."""
    config = zenoh.Config()
    values: dict[str, Any] = {
        "mode": "client",
        "connect/endpoints": [router],
        "scouting/multicast/enabled": False,
        # Messages that are kept for late joiners need it.
        "timestamping/enabled": True,
        **own,
    }
    try:
        for path, value in values.items():
            config.insert_json5(path, json.dumps(value))
    except zenoh.ZError as error:
        raise ValueError(f"zenoh does not take a setting: {error}") from None
    return config
