"""`Publishers`, the names of the nodes whose messages come in."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from threading import Lock
from time import monotonic

PATIENCE = 0.5
"""s; a message waits so long for the name of its node, which ROS 2 tells on another topic."""
NODE_PATIENCE = 5.0
"""s; and so long if its participant is known to be of ROS 2: what was lost while two meet is sent again after 3."""
MOST_WAITING = 1_000
MOST_BYTES = 2**24
"""Bytes of all messages that wait; beyond that, none of their publisher does."""
_MOST_PUBLISHERS = 10_000

Deliver = Callable[[str, str, bytes, bool], object]


@dataclass(slots=True)
class _Publisher:
    """One publisher; `name` is empty until it is known."""

    participant: str
    until: float
    name: str = ""
    waiting: list[tuple[bytes, bool]] = field(default_factory=list)


class Publishers:
    """Holds each message until the name of its node is known, or it has waited long enough; for any thread.

    Without that, the first messages of a publisher would come from another authority than the later ones.

    Parameters
    ----------
    deliver : callable
        Called with the id of the participant, the name of the node, the payload, and whether the topic is one of static
        frames. The name of a publisher that is no node's is the id of its participant.
    is_of_ros : callable
        Whether a participant, by its id, is known to be of ROS 2, and so will tell the names of its nodes.
    now : callable
        Returns a monotonic time in s.
    """

    def __init__(
        self, deliver: Deliver, is_of_ros: Callable[[str], bool], now: Callable[[], float] = monotonic
    ) -> None:
        self._deliver = deliver
        self._is_of_ros = is_of_ros
        self._now = now
        self._lock = Lock()
        self._publishers: dict[str, _Publisher] = {}
        self._names: dict[str, dict[str, str]] = {}
        self._named = 0
        self._bytes = 0

    def message(self, publisher: str, participant: str, payload: bytes, static: bool) -> None:
        """Take a message of a publisher."""
        with self._lock:
            known = self._publishers.get(publisher)
            if known is None:
                if len(self._publishers) >= _MOST_PUBLISHERS:
                    self._flush(self._publishers.pop(next(iter(self._publishers))))
                patience = NODE_PATIENCE if self._is_of_ros(participant) else PATIENCE
                known = self._publishers[publisher] = _Publisher(participant, self._now() + patience)
                known.name = self._names.get(participant, {}).get(publisher, "")
            known.waiting.append((payload, static))
            self._bytes += len(payload)
            if known.name or len(known.waiting) > MOST_WAITING or self._bytes > MOST_BYTES:
                self._flush(known)

    def nodes(self, participant: str, names: Iterable[tuple[str, Iterable[str]]]) -> None:
        """Take the names of all nodes of a participant, each with its publishers."""
        with self._lock:
            known = {publisher: name for name, publishers in names for publisher in publishers}
            self._named += len(known) - len(self._names.pop(participant, ()))
            if known:
                self._names[participant] = known
            while self._named > _MOST_PUBLISHERS:
                self._named -= len(self._names.pop(next(iter(self._names))))
            for id_, name in known.items():
                publisher = self._publishers.get(id_)
                if publisher is not None and publisher.waiting:
                    publisher.name = name
                    self._flush(publisher)

    def expire(self) -> None:
        """Deliver what has waited long enough."""
        with self._lock:
            for publisher in self._publishers.values():
                if publisher.waiting and self._now() >= publisher.until:
                    self._flush(publisher)

    def keep_only(self, participants: set[str]) -> None:
        """Forget the publishers of all other participants, which have gone."""
        with self._lock:
            for publisher in [id_ for id_, each in self._publishers.items() if each.participant not in participants]:
                self._flush(self._publishers.pop(publisher))

    def _flush(self, publisher: _Publisher) -> None:
        publisher.name = publisher.name or publisher.participant
        waiting, publisher.waiting = publisher.waiting, []
        self._bytes -= sum(len(payload) for payload, _ in waiting)
        for payload, static in waiting:
            self._deliver(publisher.participant, publisher.name, payload, static)
