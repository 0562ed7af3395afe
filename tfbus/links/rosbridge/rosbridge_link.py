"""A link through rosbridge: the transforms of ROS 1 or ROS 2 on a bus, and those of the bus there."""

from typing import Unpack, get_args

from tfbus.bus.bus import Bus
from tfbus.links.ros.ros_link import RosLink
from tfbus.links.ros.settings import RosOptions, settings_of
from tfbus.links.rosbridge._carrier import Encoding, RosbridgeCarrier
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
    encoding : {"cbor", "cbor-raw"}
        The encoding in which messages are asked for; a server that does not know it sends JSON, which is read too. See
        the notes before you take ``"cbor-raw"``.
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
        If it is no URL of a websocket, the encoding is neither of the two, or as `tfbus.links.ros.RosLink`.
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
    One message larger than 4 MiB ends the connection. A large message is read and published in parts, so that other
    tasks have their turn whatever the server sends; one with CBOR that no message of ROS has is refused. The only peer
    is the server. While a lookup waits on the bus, the static frames are asked for now and then, because a server for
    ROS 2 may have had them before this link came.

    A server asks ROS once for each topic, for all its clients, as the first of them wants it: decoded, or as bytes.
    With ``"cbor"`` this link and clients that want JSON, such as roslib in a browser, hear the same topics side by
    side. ``"cbor-raw"`` passes on the bytes of ROS, which costs the server half as much for messages of 20 transforms,
    and hardly less for one; but beside a client that wants anything else, whoever came second hears nothing, and no
    server tells it. Take ``"cbor-raw"`` for a server of your own, or for one whose other clients take it too. Positions
    of joints are asked for in JSON, unless you take it, because a server of ROS 1 cannot put their names into CBOR.

    A server keeps one latched message of ``/tf_static`` for all its clients. So of several programs that send static
    frames through one server, late joiners hear only the last.

    A server tells its clients nothing of what it refuses, but gives back what it takes. Static frames that do not come
    back within 2 s are told in a log line, counted in `LinkStatistics.not_sent` as ``"not confirmed"``, and advertised
    and sent again until they do.

    Whoever reaches the server can publish and read everything.
    """

    def __init__(self, bus: Bus, url: str, *, encoding: Encoding = "cbor", **options: Unpack[RosOptions]) -> None:
        if not isinstance(url, str):
            raise TypeError(f"a URL must be a str, not {url!r}")
        check_url(url)
        if encoding not in get_args(Encoding):
            raise ValueError(f"encoding must be 'cbor' or 'cbor-raw', not {encoding!r}")
        self.url = url
        carrier = RosbridgeCarrier(
            url, settings_of(options), encoding, lambda: any(buffer.waiting for buffer in bus.statistics().buffers)
        )
        super().__init__(bus, url, carrier, **options)
