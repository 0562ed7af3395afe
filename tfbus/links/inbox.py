"""What one link has received, from bytes to samples on the bus."""

from collections.abc import Collection

from tfbus.bus.bus import Bus
from tfbus.links.attachment import Attachment, PublishedBatch, unpack
from tfbus.links.peers import MAX_AUTHORITIES, Peer, Peers
from tfbus.links.provenance import ReceivedTransform, Source
from tfbus.links.relay import Relay
from tfbus.tf_message import MalformedMessageError, decode

_MOST_LOST = 2**32


class Inbox:
    """The receiving half of a link; nothing that a peer can send makes it raise.

    Parameters
    ----------
    bus : Bus
    relay : Relay
    link : object
        The sending half, which is not to pass on what comes in here.
    frames : collection of str or None
        The children that may come in; None for all.
    max_frames : int
        How many frames a peer may have.
    peers : Peers

    Attributes
    ----------
    messages, samples : int
        What was taken in, and published.
    lost : int
        Live messages that never came, by their numbers.
    duplicates : int
        Samples that were no news.
    """

    def __init__(
        self, bus: Bus, relay: Relay, link: object, frames: Collection[str] | None, max_frames: int, peers: Peers
    ) -> None:
        self._bus = bus
        self._relay = relay
        self._link = link
        self._frames = frames
        self._max_frames = max_frames
        self._peers = peers
        self.messages = 0
        self.samples = 0
        self.lost = 0
        self.duplicates = 0

    def receive(self, sender: str, payload: bytes, attachment: bytes) -> None:
        """Take in one message of a peer."""
        try:
            entries = unpack(attachment)
            decoded = decode(payload, entries.tags(), ReceivedTransform)
        except MalformedMessageError as error:
            self._peers.reject(sender, error.reason, error)
            return
        peer = self._peers.find(sender)
        if peer is None or self._bus.closed:
            return
        self.messages += 1
        self._count(peer, entries.number)
        for refused in decoded.errors:
            self._peers.reject(sender, refused.reason, refused)
        self._take(peer, entries, decoded.samples)

    def _take(self, peer: Peer, entries: Attachment, samples: list[ReceivedTransform | None]) -> None:
        start = 0
        live = entries.number > 0
        for entry in entries.entries:
            if self._bus.closed:
                # By a subscriber, in the middle of this.
                return
            if isinstance(entry, PublishedBatch):
                source = Source(entry.origin, entry.sequence, self._link, peer, live)
                end = start + entry.count
                batch = [sample for sample in samples[start:end] if sample is not None]
                if self._knows_authorities(peer, entry, len(batch)):
                    self._publish(source, batch)
                start = end
            elif self._frames is None or entry.frame in self._frames:
                source = Source(entry.origin, entry.sequence, self._link, peer, live, entry.lost)
                self._relay.remove(source, entry.frame)

    def _publish(self, source: Source, samples: list[ReceivedTransform]) -> None:
        if self._frames is not None:
            samples = [sample for sample in samples if sample.child in self._frames]
        published, refused = self._relay.publish(source, samples, self._max_frames)
        self.samples += published
        self.duplicates += len(samples) - published - refused
        if refused:
            peer = source.peer
            error = ValueError(f"the peer has announced more than {self._max_frames} frames")
            self._peers.reject(peer.id, "too many frames", error, refused)

    def _knows_authorities(self, peer: Peer, batch: PublishedBatch, count: int) -> bool:
        for authority, _, _ in batch.runs:
            if authority not in peer.authorities:
                if len(peer.authorities) >= MAX_AUTHORITIES:
                    error = ValueError(f"the peer has spoken for more than {MAX_AUTHORITIES} authorities")
                    self._peers.reject(peer.id, "too many authorities", error, count)
                    return False
                peer.authorities.add(authority)
        return True

    def _count(self, peer: Peer, number: int) -> None:
        if number > peer.number:
            missing = number - peer.number - 1
            # More than that never were: the number is a lie.
            if peer.number and missing <= _MOST_LOST:
                self.lost += missing
            peer.number = number
