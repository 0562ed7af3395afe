"""The inbox of a link: it publishes on the bus what peers have sent, within the limits of each peer."""

from collections.abc import Collection, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field

from tfbus.bus.bus import Bus
from tfbus.errors import InvalidTransformError
from tfbus.links._entries import MovingFrame, RemovedFrame
from tfbus.links._mirror import Mirror
from tfbus.links._outbox import Outbox
from tfbus.links._peers import MAX_AUTHORITIES, Peer, Peers
from tfbus.links._provenance import Provenance, ReceivedTransform
from tfbus.links._relay import Relay
from tfbus.links._state import StateStep

_LARGEST_GAP = 2**32


class ReceivedBatch:
    """Samples of one batch, as they came in.

    Attributes
    ----------
    samples : list of ReceivedTransform
        Their provenance is not set yet.
    authorities : collection of str
        The authorities that the batch names; a peer may name only so many.
    origin : bytes or None
        The bus on which the batch was published first, 16 bytes; None if the sender knows no buses, as ROS.
    sequence : int
        The batch's number on that bus; without an origin it is not used.
    """

    __slots__ = ("authorities", "origin", "samples", "sequence")

    def __init__(
        self,
        samples: list[ReceivedTransform],
        authorities: Collection[str],
        origin: bytes | None = None,
        sequence: int = 0,
    ) -> None:
        self.samples = samples
        self.authorities = authorities
        self.origin = origin
        self.sequence = sequence


@dataclass(slots=True)
class ReceivedMessage:
    """One message of a peer, decoded.

    Attributes
    ----------
    entries : list of ReceivedBatch or RemovedFrame
        In the order in which it happened.
    number : int
        The sender numbers its live messages 1, 2, 3, so that gaps are noticed; 0 for a message without a number: one
        that was kept for late joiners, or one of a sender that does not number.
    errors : list of InvalidTransformError
        One for each sample that was refused; `entries` has the others.
    step : StateStep or None
        What the message claims to tell of the peer's state, if it claims that.
    time : int or None
        The time of the sender's clock, in ns, if it tells that.
    continues : bool
        Whether it is a later part of a message that was counted.
    goes_on : bool
        Whether a later part follows; the peer's state is that of `step` only after the last one.
    """

    entries: list[ReceivedBatch | RemovedFrame | MovingFrame]
    number: int = 0
    errors: list[InvalidTransformError] = field(default_factory=list)
    step: StateStep | None = None
    time: int | None = None
    continues: bool = False
    goes_on: bool = False


class Inbox:
    """The receiving half of a link; nothing that a peer sends makes it raise.

    Parameters
    ----------
    bus : Bus
    relay : Relay
    outbox : Outbox
        The sending half of the same link, which does not send back what comes in here.
    frames : collection of str or None
        The children that may come in; None for all.
    max_frames : int
        How many frames one peer may have.
    peers : Peers

    Attributes
    ----------
    messages, samples : int
        How many messages were accepted, and how many samples were published.
    lost : int
        How many live messages never came, by their numbers.
    duplicates : int
        How many samples were no news.
    """

    def __init__(
        self, bus: Bus, relay: Relay, outbox: Outbox, frames: Collection[str] | None, max_frames: int, peers: Peers
    ) -> None:
        self._bus = bus
        self._relay = relay
        self._outbox = outbox
        self._frames = frames
        self._max_frames = max_frames
        self._peers = peers
        self.messages = 0
        self.samples = 0
        self.lost = 0
        self.duplicates = 0

    def receive(self, sender: str, message: ReceivedMessage) -> None:
        """Publish and remove what a live message of a peer says."""
        peer = self._peers.find(sender)
        if peer is None or self._bus.closed:
            return
        step = message.step
        newest = message.number or (0 if step is None else step.message)
        if (message.number or step is None) and not message.continues:
            self.messages += 1
        missing = self._count_gap(peer, newest, was_sent=message.number > 0)
        if missing and peer.mirror is not None:
            peer.mirror.lost_message()
        self._take(peer, message, live=message.number > 0)
        if peer.mirror is not None and step is not None and not message.goes_on:
            if step.number - peer.mirror.number > _LARGEST_GAP:
                error = ValueError(f"a state with the number {step.number}, {peer.mirror.number} was the newest")
                self._peers.reject(sender, "number", error)
            else:
                peer.mirror.claimed(step)

    def receive_answer(self, sender: str, message: ReceivedMessage) -> bool:
        """Publish and remove what an answer says of a peer's state; returns whether it has told anything.

        When a peer has told its whole state, the frames that it brought before and does not bring now are removed.
        """
        peer, step = self._peers.get(sender), message.step
        if peer is None or peer.mirror is None or step is None or self._bus.closed:
            return False
        self.messages += 1
        mirror = peer.mirror
        before = mirror.number
        if mirror.agrees and 0 < step.number <= before:
            # The peer was asked twice, because its first answer took long.
            return False
        if step.since == 0:
            mirror.begins_anew()
        elif step.since != before:
            return False
        self._take(peer, message, live=False)
        mirror.answered(step)
        if mirror.agrees and mirror.take_whole() and not self._bus.closed:
            self._relay.keep_only(peer, mirror, self._outbox)
        return mirror.number > before

    def receive_history(self, sender: str, message: ReceivedMessage) -> None:
        """Publish the samples of the last seconds that a peer has told."""
        peer = self._peers.get(sender)
        if peer is None or self._bus.closed:
            return
        self.messages += 1
        for error in message.errors:
            self._peers.reject(sender, error.reason, error)
        batches = [entry for entry in message.entries if isinstance(entry, ReceivedBatch) and entry.origin is not None]
        self._publish(peer, batches, live=False)

    def _take(self, peer: Peer, message: ReceivedMessage, live: bool) -> None:
        for error in message.errors:
            self._peers.reject(peer.id, error.reason, error)
        mirror, step = peer.mirror, message.step
        if live and mirror is not None and step is not None and step.number <= mirror.number:
            # An answer has overtaken it, or it changes nothing.
            mirror = None
        together: list[ReceivedBatch] = []
        for entry in message.entries:
            if isinstance(entry, ReceivedBatch):
                if mirror is not None:
                    _note(mirror, entry)
                together.append(entry)
                # The batches of an answer were never one batch, but nothing is between them.
                if not live and entry.origin is not None:
                    continue
            self._publish(peer, together, live)
            together.clear()
            if self._bus.closed:
                # A subscriber may have closed it since the last entry.
                return
            if isinstance(entry, ReceivedBatch):
                continue
            if mirror is not None:
                mirror.entry(entry)
            if not isinstance(entry, RemovedFrame) or not self._admit_number(peer, entry.sequence, 1):
                continue
            if self._frames is None or entry.frame in self._frames:
                provenance = Provenance(entry.origin, entry.sequence, self._outbox, peer, live, entry.lost)
                self._relay.remove(provenance, entry.frame)
        self._publish(peer, together, live)

    def _publish(self, peer: Peer, batches: Sequence[ReceivedBatch], live: bool) -> None:
        received: list[tuple[Provenance, list[ReceivedTransform]]] = []
        count = published = refused = 0
        for batch in batches:
            if not self._admit_number(peer, batch.sequence, len(batch.samples)):
                continue
            if not self._admit_authorities(peer, batch):
                continue
            samples = batch.samples
            if self._frames is not None:
                samples = [sample for sample in samples if sample.child in self._frames]
            count += len(samples)
            if batch.origin is None:
                published, refused = self._relay.publish_foreign(self._outbox, peer, samples, self._max_frames)
            else:
                received.append((Provenance(batch.origin, batch.sequence, self._outbox, peer, live), samples))
        if received:
            with nullcontext() if live else self._bus._kept_samples():
                published, refused = self._relay.publish(received, self._max_frames)
        self.samples += published
        self.duplicates += count - published - refused
        if refused:
            error = ValueError(f"the peer has announced more than {self._max_frames} frames")
            self._peers.reject(peer.id, "too many frames", error, refused)

    def _admit_authorities(self, peer: Peer, batch: ReceivedBatch) -> bool:
        """Note the authorities that a batch names; returns False, and refuses the batch, if they are too many."""
        for authority in batch.authorities:
            if authority not in peer.authorities:
                if len(peer.authorities) >= MAX_AUTHORITIES:
                    error = ValueError(f"the peer has spoken for more than {MAX_AUTHORITIES} authorities")
                    self._peers.reject(peer.id, "too many authorities", error, len(batch.samples))
                    return False
                peer.authorities.add(authority)
        return True

    def _admit_number(self, peer: Peer, number: int, count: int) -> bool:
        """Refuse a number that no bus can have given; else all later ones of its origin would be no news."""
        if self._relay.is_plausible(number):
            return True
        error = ValueError(f"a batch with the number {number}, which is too far ahead of all others")
        self._peers.reject(peer.id, "number", error, count)
        return False

    def _count_gap(self, peer: Peer, number: int, was_sent: bool) -> bool:
        """Count the live messages that have not come; returns whether there are any.

        Parameters
        ----------
        number : int
            That of the newest live message; 0 for a message that does not tell it.
        was_sent : bool
            Whether that is the message which has come, rather than one before it.
        """
        if not number:
            return False
        missing = number - peer.number - was_sent
        # Nobody has sent so many messages: a larger gap means that one of the two numbers is made up.
        if abs(missing) > _LARGEST_GAP:
            peer.number = number
            return True
        if number <= peer.number:
            return False
        known = peer.number > 0
        peer.number = number
        if known:
            self.lost += missing
        return missing > 0


def _note(mirror: Mirror, batch: ReceivedBatch) -> None:
    """Note in a peer's mirror which frames it brings with a batch."""
    for sample in batch.samples:
        _, child, _, _, _, static = sample._fields
        if static:
            mirror.static(child, batch.origin or b"", batch.sequence)
        elif not mirror.has_moving(child):
            mirror.moving(child)
