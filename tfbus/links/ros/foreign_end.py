"""The end of a link to another world, such as ROS, whose messages have neither origins nor numbers, and its carrier."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from tfbus.bus.bus import Bus
from tfbus.errors import InvalidTransformError
from tfbus.geometry.stamped import TransformStamped
from tfbus.links.endpoint import Endpoint
from tfbus.links.relay import Peer
from tfbus.links.replica import MANY_ORIGINS, Entry, FromLink, Provenance, RemovedFrame
from tfbus.links.seams import Received, SendReport


@dataclass(slots=True)
class Turn:
    """All that one turn of the event loop has published and removed.

    Attributes
    ----------
    entries : sequence of OutgoingBatch or RemovedFrame
        In the order in which it happened.
    statics : dict of str to TransformStamped or None
        The static frames whose state for late joiners has changed, for networks that keep messages for these: the
        newest sample of each, or None if the frame is not to be kept any more.
    time : int or None
        The time of the clock that the link tells, in ns, if it has to be told. A turn may have nothing else.
    """

    entries: Sequence[Entry]
    statics: dict[str, TransformStamped | None]
    time: int | None = None


@dataclass(slots=True)
class ReceivedMessage:
    """One message of another world, decoded.

    Attributes
    ----------
    samples : sequence of FromLink
        They are published as one batch.
    errors : list of InvalidTransformError
        One for each sample that was refused; `samples` has the others.
    time : int or None
        The time of the sender's clock, in ns, if it tells that.
    continues : bool
        Whether it is a later part of a message that was counted.
    """

    samples: Sequence[FromLink]
    errors: list[InvalidTransformError] = field(default_factory=list)
    time: int | None = None
    continues: bool = False


class Carrier(Protocol):
    """Sends the messages of a link over one network, and receives those of its peers.

    The link decides which samples go out, are news, or are refused. A carrier writes them, and keeps static frames for
    late joiners as its network allows. A carrier is used by one link, and opened once.

    The event loop calls everything here, in this order: `open`; then, while `run` runs as a task, `send` and `read`;
    when `run` has been cancelled, a last `send` may have come, and `close` is called.

    Attributes
    ----------
    id : str
        The name of this end for its peers.
    """

    id: str

    async def open(self, receive: Callable[[Received], object], report: SendReport) -> None:
        """Connect to the network.

        Parameters
        ----------
        receive : callable
            Takes an item that has come: a peer's message, that a peer has come or gone, or that a message was refused.
            Any thread may call it, from now until `close` has returned and later; it never blocks and never raises.
            Items are handled in the order of the calls, so a peer's `Left` has to be the last of its items. A
            carrier whose network tells nothing of presence leaves presence out.
        report : SendReport
            Counts sent and unsent messages; for the event loop only.

        Raises
        ------
        OSError
            If there is no connection. After any error, also when cancelled, the link calls `close` next.
        """

    def send(self, turn: Turn) -> None:
        """Send what one turn of the event loop has published and removed; a turn is never empty.

        It must not block and must not raise: entries that the carrier's messages cannot hold, and messages that the
        network does not accept, go to the report. Entries leave in order; the changes of static frames go out behind
        the entries of the same turn and may be conflated with later ones.
        """

    def split(self, content: Any) -> Iterator[Any]:
        """The content of an item in parts, for `read` one by one; an item that is small is its only part.

        It may also yield None, where other tasks may have their turn before there is a part.

        Raises
        ------
        MalformedMessageError
            If the rest of the message cannot be used; the parts before it are.
        """
        return iter((content,))

    def read(self, content: Any) -> ReceivedMessage:
        """Decode a message: the content of an item that the carrier has passed to `receive`.

        Its samples become this bus's own, and go out by the other links of the bus and never by this one. Samples that
        cannot be decoded are in the message's errors.

        Raises
        ------
        MalformedMessageError
            If nothing of it can be used; it is counted by its reason.
        """

    async def run(self) -> None:
        """Do the work that takes time, such as declaring static frames, until cancelled; may return early.

        An error that it raises ends the link's body, as that of any task does.
        """

    async def close(self) -> None:
        """Disconnect, also if `open` has failed or was cancelled; all that was sent before still goes out.

        The closing has to begin before the first checkpoint, because asyncio's own cancellation knows no shield, and
        has to return within about a second, whatever the network does.
        """


class ForeignEnd(Endpoint):
    """The end of a link to a world whose messages have neither origins nor numbers, such as ROS.

    Such a world keeps messages with static frames for late joiners. If this link has sent a frame, and the world sends
    a newer sample of it, the newer sample replaces the kept message.

    Parameters
    ----------
    bus, name, frames, drop_lost, max_frames
        As for `Endpoint`.
    carrier : Carrier
    """

    def __init__(
        self,
        bus: Bus,
        name: str,
        carrier: Carrier,
        frames: Iterable[str] | None = None,
        drop_lost: bool = False,
        max_frames: int = 10_000,
    ) -> None:
        super().__init__(bus, name, carrier, frames, drop_lost, max_frames)
        self._carrier = carrier
        self._latched: set[str] = set()
        self._changes: dict[str, TransformStamped | None] = {}

    async def open(self) -> None:
        await self._carrier.open(self.host.receive, self.report)

    def detach(self) -> None:
        self.peers.clear()
        self.relay.detach(self)

    def split(self, item: Received) -> Iterator[Any]:
        return self._carrier.split(item.content)

    def add(self, published: Entry, echo: bool) -> None:
        super().add(published, echo)
        entry = published.within(self.frames)
        if entry is None:
            return
        said: list[tuple[str, TransformStamped | None]]
        if isinstance(entry, RemovedFrame):
            said = [(entry.frame, None)]
        else:
            said = [(sample.child, sample if sample.static else None) for sample in entry.samples]
        for frame, latched in said:
            if frame in self._latched or not (echo or latched is None):
                (self._latched.discard if latched is None else self._latched.add)(frame)
                self._changes[frame] = latched
                self.host.send_soon(self.pending)

    def _send(self, entries: Sequence[Entry], time: int | None) -> None:
        changes, self._changes = self._changes, {}
        if entries or changes or time is not None:
            self._carrier.send(Turn(entries, changes, time))

    def _lose(self, peer: Peer) -> tuple[str, ...]:
        frames = self.relay.frames_of(lambda shown: shown.peer is peer)
        if self.drop_lost:
            self.relay.take_off(lambda shown: shown.peer is peer, lambda: self._source(peer))
        return frames

    def _source(self, peer: Peer) -> Provenance:
        """The source of the next batch of this world: it has the name and the next number of this bus."""
        relay = self.relay
        return Provenance(relay.replica.origin, relay.next_number(), self, peer, clock=relay.clock.base())

    def _take(self, sender: str, content: Any) -> None:
        message = self._carrier.read(content)
        if message.time is not None:
            self._hear_time(sender, message.time)
        peer = self._find(sender)
        if peer is None or self.bus.closed:
            return
        if not message.continues:
            self.messages += 1
        for error in message.errors:
            self.reject(sender, error.reason, error)
        if self._admit_authorities(peer, message.samples):
            self._publish(peer, [one for one in message.samples if self.frames is None or one.child in self.frames])

    def _publish(self, peer: Peer, samples: Sequence[FromLink]) -> None:
        """Publish those samples that did not go over this bus before, within the bounds on frames."""
        source, news, refused = self._source(peer), [], 0
        known = self.relay.replica.entries
        for sample in samples:
            if self.relay.has_passed(sample):
                continue
            is_full = len(peer.frames) >= self.max_frames or len(known) >= MANY_ORIGINS * self.max_frames
            if is_full and sample.child not in peer.frames:
                refused += 1
                continue
            peer.frames.add(sample.child)
            sample._provenance = source  # type: ignore[misc]
            news.append(sample)
        if news:
            self.bus.publish(news, invalid="drop")
        self.samples += len(news)
        self.duplicates += len(samples) - len(news) - refused
        if refused:
            error = ValueError(f"the peer has announced more than {self.max_frames} frames")
            self.reject(peer.id, "too many frames", error, refused)
