"""`RmwZenohLink`: the transforms of ROS 2 programs with rmw_zenoh on a bus, and those of the bus there, over zenoh.

The link is a node of ROS 2 as its middleware rmw_zenoh makes one, from version 0.2.4 on. Its design document and its
source tell how: a topic is the key ``<domain>/<topic>/<type>/<hash of the type>``; nodes, publishers and subscriptions
are liveliness tokens under ``@ros2_lv``, in which ``%`` stands for a slash; a message goes with its number, its time,
and the id of its publisher. The id keeps the link from hearing itself. A latched topic has a publisher with a cache,
which zenoh's advanced subscribers ask when they come.

zenoh's threads call with the messages that come, and `RosCarrier` hands them to the link. Opening and closing a session
block, so worker threads do that.
"""

import json
import re
import struct
import weakref
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from time import time_ns
from typing import Any, Final, NamedTuple, Unpack
from uuid import uuid4

import anyio
import anyio.to_thread
import zenoh
import zenoh.ext

from tfbus.bus.bus import Bus
from tfbus.geometry.stamped import TransformStamped
from tfbus.links.ros.ros_link import RosCarrier, RosLink, RosMessage
from tfbus.links.ros.settings import Other, RosOptions, RosSettings, as_domain, settings_of
from tfbus.links.seams import Received
from tfbus.links.zenoh.sessions import (
    begin_to_close,
    close_session,
    use_zenoh,
    wait_until_closed,
    without_source_location,
)
from tfbus.tf_message import MalformedMessageError, encode

TYPE: Final = "tf2_msgs::msg::dds_::TFMessage_"
HASH: Final = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
"""Of ``tf2_msgs/msg/TFMessage``, by REP 2016."""
JOINT_TYPE: Final = "sensor_msgs::msg::dds_::JointState_"
JOINT_HASH: Final = "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
"""Of ``sensor_msgs/msg/JointState``."""
CLOCK_TYPE: Final = "rosgraph_msgs::msg::dds_::Clock_"
CLOCK_HASH: Final = "RIHS01_692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564"
"""Of ``rosgraph_msgs/msg/Clock``."""
TEXT_TYPE: Final = "std_msgs::msg::dds_::String_"
TEXT_HASH: Final = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
"""Of ``std_msgs/msg/String``."""
ODOMETRY_TYPE: Final = "nav_msgs::msg::dds_::Odometry_"
ODOMETRY_HASH: Final = "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"
"""Of ``nav_msgs/msg/Odometry``."""
OTHER_TYPES: Final[dict[Other, tuple[str, str]]] = {
    "joints": (JOINT_TYPE, JOINT_HASH),
    "clock": (CLOCK_TYPE, CLOCK_HASH),
    "description": (TEXT_TYPE, TEXT_HASH),
    "odometry": (ODOMETRY_TYPE, ODOMETRY_HASH),
}
NODE_ID: Final = 0

_ATTACHMENT = struct.Struct("<qqB16s")
_ID_SIZE = 16
_MOVING_QOS = "::,100:,:,:,,"
_STATIC_QOS = ":1:,1:,:,:,,"
"""Reliable, volatile and a depth of 100; reliable, transient local and a depth of 1."""


class Attachment(NamedTuple):
    """The number, time and sender that go with a message."""

    number: int
    time: int
    """ns."""
    publisher: bytes
    """16 bytes."""


def pack(attachment: Attachment) -> bytes:
    """The bytes of an attachment."""
    return _ATTACHMENT.pack(attachment.number, attachment.time, _ID_SIZE, attachment.publisher)


def publisher_of(attachment: bytes) -> bytes | None:
    """The id of the publisher of a message; None if it does not tell it in this way."""
    if len(attachment) != _ATTACHMENT.size:
        return None
    _, _, size, publisher = _ATTACHMENT.unpack(attachment)
    return publisher if size == _ID_SIZE else None


def topic_key(domain: int, topic: str) -> str:
    """The key at which messages are published."""
    return f"{domain}/{topic.strip('/')}/{TYPE}/{HASH}"


def topic_expression(domain: int, topic: str, kind: str = TYPE) -> str:
    """The keys at which messages come: ROS 2 Humble has no hash."""
    return f"{domain}/{topic.strip('/')}/{kind}/*"


def node_token(domain: int, session: str, node: str) -> str:
    """The liveliness token of a node."""
    return f"@ros2_lv/{domain}/{session}/{NODE_ID}/{NODE_ID}/NN/%/%/{node}"


def endpoint_token(domain: int, session: str, number: int, node: str, topic: str, static: bool, publishes: bool) -> str:
    """The liveliness token of a publisher or a subscription of a node."""
    kind, qos = "MP" if publishes else "MS", _STATIC_QOS if static else _MOVING_QOS
    name = topic.replace("/", "%")
    return f"@ros2_lv/{domain}/{session}/{NODE_ID}/{number}/{kind}/%/%/{node}/{name}/{TYPE}/{HASH}/{qos}"


def other_token(
    domain: int, session: str, number: int, node: str, topic: str, kind: str, digest: str, latched: bool = False
) -> str:
    """The liveliness token of a subscription to messages of another type, with the hash of that."""
    name, qos = topic.replace("/", "%"), _STATIC_QOS if latched else _MOVING_QOS
    return f"@ros2_lv/{domain}/{session}/{NODE_ID}/{number}/MS/%/%/{node}/{name}/{kind}/{digest}/{qos}"


_HEARTBEAT = 0.5
_AUTHORITY = "rmw_zenoh"


class RmwZenohCarrier(RosCarrier):
    """Speaks as a node of ROS 2 with rmw_zenoh does; see `RosCarrier`.

    Parameters
    ----------
    domain : int
    node : str
        The name of the node.
    config : zenoh.Config
    settings : RosSettings
    """

    def __init__(self, domain: int, node: str, config: zenoh.Config, settings: RosSettings) -> None:
        super().__init__(f"{_AUTHORITY}:{domain}", settings)
        self._domain = domain
        self._node = node
        self._config = config
        self._session: zenoh.Session | None = None
        self._ended = False
        self._close_at_exit: weakref.finalize[..., RmwZenohCarrier] | None = None
        self._declared: list[Any] = []
        self._publishers: dict[bool, zenoh.Publisher | zenoh.ext.AdvancedPublisher] = {}
        self._ids = {static: uuid4().bytes for static in (False, True)}
        self._numbers = {False: 0, True: 0}

    async def _connect(self) -> None:
        try:
            await anyio.to_thread.run_sync(self._join)
        except zenoh.ZError as error:
            raise ConnectionError(f"no router of rmw_zenoh: {without_source_location(error)}") from error

    def _join(self) -> None:
        use_zenoh()
        session = self._session = zenoh.open(self._config)
        if self._ended:
            # asyncio has cancelled the task that waits for this thread.
            close_session(session.close)
            return
        # A program may exit without the end of its link. A callback of zenoh while the interpreter ends is an abort.
        self._close_at_exit = weakref.finalize(self, close_session, session.close)
        name = str(session.zid())
        self._token(node_token(self._domain, name, self._node))
        topics = [
            *((topic, True, publishes) for topic in self.settings.tf_static for publishes in (False, True)),
            *((topic, False, publishes) for topic in self.settings.tf for publishes in (False, True)),
        ]
        first = {True: self.settings.tf_static[0], False: self.settings.tf[0]}
        for number, (topic, static, publishes) in enumerate(topics, 1):
            if publishes and (not self.settings.send or topic != first[static]):
                continue
            if publishes:
                self._publishers[static] = self._publisher(session, topic, static)
            else:
                key = topic_expression(self._domain, topic)
                self._declared.append(self._subscriber(session, key, static, partial(self._take, static)))
            self._token(endpoint_token(self._domain, name, number, self._node, topic, static, publishes))

        others = [(other, topic) for other, names in self.settings.others.items() for topic in names]
        for number, (other, topic) in enumerate(others, len(topics) + 1):
            latched, (kind, digest) = other == "description", OTHER_TYPES[other]
            key = topic_expression(self._domain, topic, kind)
            self._declared.append(self._subscriber(session, key, latched, partial(self._take_other, other, topic)))
            self._token(other_token(self._domain, name, number, self._node, topic, kind, digest, latched))

    def _token(self, key: str) -> None:
        assert self._session is not None
        self._declared.append(self._session.liveliness().declare_token(key))

    def _publisher(
        self, session: zenoh.Session, topic: str, static: bool
    ) -> zenoh.Publisher | zenoh.ext.AdvancedPublisher:
        key = topic_key(self._domain, topic)
        if not static:
            return session.declare_publisher(key)
        return zenoh.ext.declare_advanced_publisher(
            session,
            key,
            cache=zenoh.ext.CacheConfig(max_samples=1),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT),
            publisher_detection=True,
        )

    def _subscriber(
        self, session: zenoh.Session, key: str, latched: bool, take: Callable[[zenoh.Sample], None]
    ) -> object:
        if not latched:
            return session.declare_subscriber(key, self._directly(take))
        return zenoh.ext.declare_advanced_subscriber(
            session,
            key,
            self._directly(take),
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
            recovery=zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
            subscriber_detection=True,
        )

    def _directly(self, take: Callable[[zenoh.Sample], None]) -> Any:
        """A callback for zenoh's threads; what `take` raises is received as a refusal, for zenoh would print it."""

        def call(sample: zenoh.Sample) -> None:
            try:
                take(sample)
            except Exception as error:  # noqa: BLE001 - see above
                if not isinstance(error, MalformedMessageError):
                    detail = f"{type(error).__name__}: {error}"[:200]
                    error = MalformedMessageError("unreadable", detail)
                # The traceback would keep what was sent.
                self._receive(Received(_AUTHORITY, error.with_traceback(None)))

        # Otherwise each subscriber has a thread of its own, and one overtakes the other.
        return zenoh.handlers.Callback(call, indirect=False)

    async def close(self) -> None:
        """Close the session, or give up waiting for that."""
        self._ended = True
        session, self._session = self._session, None
        self._publishers.clear()
        if self._close_at_exit is not None:
            self._close_at_exit.detach()
        # Closing the session undeclares all that was declared.
        if session is not None:
            await wait_until_closed([begin_to_close(session.close)], self._report.failed)
        self._declared.clear()

    def _publish(self, samples: Sequence[TransformStamped], static: bool) -> bool:
        publisher = self._publishers.get(static)
        if publisher is None:
            return False
        self._numbers[static] += 1
        attachment = pack(Attachment(self._numbers[static], time_ns(), self._ids[static]))
        try:
            publisher.put(encode(samples), attachment=attachment)
        except zenoh.ZError as error:
            self._report.failed(error)
            return False
        return True

    def _take(self, static: bool, sample: zenoh.Sample) -> None:
        """Take a message, in zenoh's threads."""
        attachment = sample.attachment
        if attachment is not None and publisher_of(bytes(attachment)) in self._ids.values():
            return
        self._pass_on(_AUTHORITY, RosMessage(bytes(sample.payload), static, _AUTHORITY))

    def _take_other(self, other: Other, topic: str, sample: zenoh.Sample) -> None:
        """Take a message of another topic, in zenoh's threads."""
        self._pass_on(_AUTHORITY, RosMessage(bytes(sample.payload), False, topic, other))


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
        All links to ROS share them: see `tfbus.links.ros.RosLink`. By default, the authority of all samples is
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
    nobody. Every program that reaches the router can publish there, and read everything.
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
        self.domain: int = as_domain(domain)
        carrier = RmwZenohCarrier(self.domain, node, configuration(router, config or {}), settings_of(options))
        super().__init__(bus, carrier.id, carrier, **options)


def configuration(router: str, own: Mapping[str, Any]) -> zenoh.Config:
    """As rmw_zenoh configures its sessions, but as a client.

    Raises
    ------
    ValueError
        If zenoh does not take a setting.
    """
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
