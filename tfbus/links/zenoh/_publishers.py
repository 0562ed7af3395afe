"""The keys by which one session of a link sends: all live messages, parts of them, and the newest samples."""

from collections.abc import Container

import zenoh

from tfbus.links._message import Message
from tfbus.links.zenoh._keys import Keys


class Publishers:
    """Sends the messages of a link by one session; while the network is congested, they are dropped.

    Parameters
    ----------
    session : zenoh.Session
    keys : Keys
    """

    def __init__(self, session: zenoh.Session, keys: Keys) -> None:
        self._session = session
        self._keys = keys
        self._live = self._declare(keys.own("live"))
        self._slow = self._declare(keys.own("slow"))
        self._parts: dict[str, zenoh.Publisher] = {}

    def put(self, message: Message) -> None:
        """Send a live message to those that hear all."""
        self._live.put(message.payload, attachment=message.attachment)

    def put_part(self, name: str, message: Message) -> None:
        """Send a live message to those that have the filter of a name."""
        if name not in self._parts:
            self._parts[name] = self._declare(self._keys.part(name))
        self._parts[name].put(message.payload, attachment=message.attachment)

    def put_slowly(self, message: Message) -> None:
        """Send a message by the slow key."""
        self._slow.put(message.payload, attachment=message.attachment)

    def serve(self, names: Container[str]) -> None:
        """Send nothing any more for filters but those of some names."""
        for name in [name for name in self._parts if name not in names]:
            self._parts.pop(name).undeclare()

    def is_heard(self) -> bool:
        """Whether anybody subscribes to the live key; also if the session has ended, for that has to be reported."""
        return bool(self._live.matching_status.matching or self._session.is_closed())  # type: ignore[attr-defined]

    def is_heard_slowly(self) -> bool:
        """Whether anybody subscribes to the slow key."""
        return bool(self._slow.matching_status.matching)  # type: ignore[attr-defined]

    def _declare(self, key: str) -> zenoh.Publisher:
        # The link's own subscriptions must not count for somebody who hears it.
        return self._session.declare_publisher(
            key, congestion_control=zenoh.CongestionControl.DROP, allowed_destination=zenoh.Locality.REMOTE
        )
