"""Static frames on zenoh: one key each, with the last message kept for those who join late."""

from collections.abc import Mapping
from typing import Any
from urllib.parse import quote

import zenoh
from zenoh import ext

from tfbus.links.outbox import Message

_LINGERING = 1_000


class StaticKeys:
    """The publishers of one link's static frames.

    Declaring a publisher may take a while, so all of this is done in a worker thread, one call at a time.

    Parameters
    ----------
    session : zenoh.Session
    prefix : str
        The key of a frame is this and its quoted name.
    """

    def __init__(self, session: zenoh.Session, prefix: str) -> None:
        self._session = session
        self._prefix = prefix
        self._publishers: dict[str, ext.AdvancedPublisher] = {}
        self._lingering: dict[str, ext.AdvancedPublisher] = {}

    def apply(self, changes: Mapping[str, Message | None]) -> list[zenoh.ZError]:
        """Send what has changed; a frame that has become a moving one is only forgotten.

        Returns
        -------
        list of zenoh.ZError
            What went wrong with some frames, while the others were sent.
        """
        errors = []
        for frame, message in changes.items():
            try:
                self._apply(frame, message)
            except zenoh.ZError as error:
                errors.append(error)
        while len(self._lingering) > _LINGERING:
            self._undeclare(self._lingering.pop(next(iter(self._lingering))))
        return errors

    @property
    def linger(self) -> bool:
        """Whether there are tombstones, which `bury` takes away when they have been there for a while."""
        return bool(self._lingering)

    def bury(self) -> None:
        """Take away the publishers of frames that were removed."""
        while self._lingering:
            self._undeclare(self._lingering.popitem()[1])

    def _apply(self, frame: str, message: Message | None) -> None:
        if message is None:
            self._undeclare(self._publishers.pop(frame, None))
            return
        publisher = self._lingering.pop(frame, None) or self._publishers.get(frame) or self._declare(frame)
        publisher.put(message.payload, attachment=message.attachment)
        if message.samples:
            self._publishers[frame] = publisher
        else:
            # A tombstone can be lost like anything else; while its publisher is there, it is recovered.
            self._publishers.pop(frame, None)
            self._lingering[frame] = publisher

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


def hear_statics(session: zenoh.Session, keys: str, receive: Any) -> object:
    """Hear all static frames of a domain: those that are there, those that come, and those that were lost."""
    return ext.declare_advanced_subscriber(
        session,
        keys,
        receive,
        history=ext.HistoryConfig(detect_late_publishers=True),
        recovery=ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
    )
