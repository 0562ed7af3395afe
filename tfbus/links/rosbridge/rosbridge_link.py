"""A link through rosbridge: the transforms of ROS 1 or ROS 2 on a bus, and those of the bus there."""

from typing import Unpack

from tfbus.bus.bus import Bus
from tfbus.links.ros.ros_link import RosLink
from tfbus.links.ros.settings import RosOptions, settings_of
from tfbus.links.rosbridge._carrier import RosbridgeCarrier
from tfbus.links.rosbridge._websocket import check_url


class RosbridgeLink(RosLink):
    """Joins a bus to ``/tf`` and ``/tf_static`` of ROS 1 or ROS 2: ``async with RosbridgeLink(bus, url) as link``.

    A rosbridge server, from the package ``rosbridge_suite``, has to run beside ROS. Nothing of ROS is needed here. When
    the server goes, the link connects again, with pauses from a quarter of a second to five seconds.

    Parameters
    ----------
    bus : Bus
    url : str
        Such as ``ws://192.168.1.5:9090``, which is the port if none is given, or ``wss://...`` for a server with TLS.
    **options
        Those that all links to ROS share: see `tfbus.links.ros.RosLink`. By default, the authority of all samples is
        ``"rosbridge"``, because the server does not tell who has published them.

    Attributes
    ----------
    bus : Bus
    url : str
    id : str
        The name of this end.

    Raises
    ------
    ValueError
        If it is no URL of a websocket, or as `tfbus.links.ros.RosLink`.
    TypeError
        If an argument has the wrong type.
    OSError
        On entering, if the server cannot be reached.
    BusClosedError, RuntimeError
        On entering, if the bus is closed; if it belongs to another thread, or the link was entered before.
    ImportError
        On import, without the extra: ``pip install "tfbus[rosbridge]"``.

    Notes
    -----
    Messages come as the server can send them: the bytes of ROS (``cbor-raw``), CBOR, or JSON. One larger than 4 MiB
    ends the connection. The only peer is the server. While a lookup waits on the bus, the static frames are asked for
    now and then, because a server for ROS 2 may have had them before this link came.

    A server asks ROS once for each topic, for all its clients, as the first of them wants it. Where that is this link,
    with ``cbor-raw``, a client that wants JSON, such as roslib in a browser, hears nothing on the same topics; where it
    came first, this link hears nothing. Give such clients a server of their own.

    A server keeps one latched message of ``/tf_static`` for all its clients. So of several programs that send static
    frames through one server, late joiners hear only the last.

    Whoever reaches the server can publish and read everything.
    """

    def __init__(self, bus: Bus, url: str, **options: Unpack[RosOptions]) -> None:
        if not isinstance(url, str):
            raise TypeError(f"a URL must be a str, not {url!r}")
        check_url(url)
        self.url = url
        carrier = RosbridgeCarrier(
            url, settings_of(options), lambda: any(buffer.waiting for buffer in bus.statistics().buffers)
        )
        super().__init__(bus, url, carrier, **options)
