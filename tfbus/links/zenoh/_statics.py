"""Static frames on zenoh: one key each, whose last message is cached for late joiners."""

from collections.abc import Mapping
from typing import Any
from urllib.parse import quote

import zenoh
from zenoh import ext

from tfbus.links._message import Message

_MOST_TOMBSTONES = 1_000


class StaticKeys:
    """The publishers of one link's static frames.

    Declaring a publisher may take a while, so a worker thread makes all calls, one at a time.

    Parameters
    ----------
    session : zenoh.Session
    prefix : str
        The key of a frame is this prefix and the quoted name.
    """

    def __init__(self, session: zenoh.Session, prefix: str) -> None:
        self._session = session
        self._prefix = prefix
        self._publishers: dict[str, ext.AdvancedPublisher] = {}
        self._tombstones: dict[str, ext.AdvancedPublisher] = {}

    def publish(self, changes: Mapping[str, Message | None]) -> list[zenoh.ZError]:
        """Publish the new message of each frame, or with None stop to keep the frame, which moves now.

        Returns
        -------
        list of zenoh.ZError
            The errors of some frames, while the others were published.
        """
        errors = []
        for frame, message in changes.items():
            try:
                self._publish(frame, message)
            except zenoh.ZError as error:
                errors.append(error)
        while len(self._tombstones) > _MOST_TOMBSTONES:
            self._undeclare(self._tombstones.pop(next(iter(self._tombstones))))
        return errors

    @property
    def has_tombstones(self) -> bool:
        """Whether there are publishers of removed frames, for `drop_tombstones` to end after a while."""
        return len(self._tombstones) > 0

    def drop_tombstones(self) -> None:
        """End the publishers of removed frames."""
        while self._tombstones:
            self._undeclare(self._tombstones.popitem()[1])

    def _publish(self, frame: str, message: Message | None) -> None:
        if message is None:
            self._undeclare(self._publishers.pop(frame, None))
            return
        publisher = self._tombstones.pop(frame, None) or self._publishers.get(frame) or self._declare(frame)
        publisher.put(message.payload, attachment=message.attachment)
        if message.samples:
            self._publishers[frame] = publisher
        else:
            # The network can lose a tombstone; while its publisher exists, receivers recover it.
            self._publishers.pop(frame, None)
            self._tombstones[frame] = publisher

    def _declare(self, frame: str) -> ext.AdvancedPublisher:
        return ext.declare_advanced_publisher(
            self._session,
            f"{self._prefix}/{quote(frame, safe='')}",
            congestion_control=zenoh.CongestionControl.DROP,
            cache=ext.CacheConfig(max_samples=1),
            sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
            publisher_detection=True,
        )

    def _undeclare(self, publisher: ext.AdvancedPublisher | None) -> None:
        if publisher is not None:
            publisher.undeclare()


def subscribe_statics(session: zenoh.Session, keys: str, receive: Any) -> object:
    """Subscribe to all static frames of a domain: existing ones, future ones, and those that the network lost."""
    return ext.declare_advanced_subscriber(
        session,
        keys,
        receive,
        history=ext.HistoryConfig(detect_late_publishers=True),
        recovery=ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
    )
