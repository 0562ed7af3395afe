"""The carrier of links to rmw_zenoh."""

import weakref
from collections.abc import Callable, Sequence
from functools import partial
from time import time_ns
from typing import Any, Literal
from uuid import uuid4

import anyio
import anyio.to_thread
import zenoh
import zenoh.ext

from tfbus.geometry.stamped import TransformStamped
from tfbus.links.rmw_zenoh._wire import (
    CLOCK_HASH,
    CLOCK_TYPE,
    JOINT_HASH,
    JOINT_TYPE,
    TEXT_HASH,
    TEXT_TYPE,
    Attachment,
    endpoint_token,
    node_token,
    other_token,
    pack,
    publisher_of,
    topic_expression,
    topic_key,
)
from tfbus.links.ros._carrier import RosCarrier, RosMessage
from tfbus.links.ros.settings import RosSettings
from tfbus.links.zenoh._closing import begin_to_close, close_session, use_zenoh, wait_until_closed
from tfbus.links.zenoh._opening import directly, refusal
from tfbus.links.zenoh._settings import without_source_location
from tfbus.tf_message import encode

_HEARTBEAT = 0.5
_AUTHORITY = "rmw_zenoh"
_Other = Literal["joints", "clock", "description"]


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
        # A program may exit without the end of its link. A callback of zenoh while the interpreter ends is an abort.
        self._close_at_exit = weakref.finalize(self, close_session, session)
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

        others: tuple[tuple[_Other, str, str, str], ...] = (
            *(("joints", topic, JOINT_TYPE, JOINT_HASH) for topic in self.settings.joint_topic),
            *(("clock", topic, CLOCK_TYPE, CLOCK_HASH) for topic in self.settings.clock_topic),
            *(("description", topic, TEXT_TYPE, TEXT_HASH) for topic in self.settings.description_topic),
        )
        for number, (content, topic, kind, digest) in enumerate(others, len(topics) + 1):
            latched = content == "description"
            key = topic_expression(self._domain, topic, kind)
            self._declared.append(self._subscriber(session, key, latched, partial(self._take_other, content)))
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
        return directly(take, lambda error: self._receive(refusal(error, _AUTHORITY)))

    async def close(self) -> None:
        """Close the session, or give up waiting for that."""
        session, self._session = self._session, None
        self._publishers.clear()
        if self._close_at_exit is not None:
            self._close_at_exit.detach()
        # Closing the session undeclares all that was declared.
        late = await wait_until_closed([begin_to_close(session)])
        if late is not None:
            self._report.failed(late)
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

    def _take_other(self, content: _Other, sample: zenoh.Sample) -> None:
        """Take positions of joints, the time, or the description of a robot, in zenoh's threads."""
        other = {content: True}
        self._pass_on(_AUTHORITY, RosMessage(bytes(sample.payload), static=False, authority=_AUTHORITY, **other))
