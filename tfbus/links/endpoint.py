"""One end of a link without its event loop: it publishes what peers have sent, within limits, and tells of them.

`ForeignEnd` is the end of a link to another world, over a carrier; `tfbus.links.domain.DomainEnd` that of a link of
tfbus, over a wire. Nothing that a peer sends makes either of them raise.
"""

import logging
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from copy import copy
from math import inf
from typing import Any, Protocol

from tfbus.bus.bus import Bus
from tfbus.bus.subscribers import OnceLogger, SeenKeys
from tfbus.events import PeerJoined, PeerLost, PeerRejected
from tfbus.geometry.stamped import TransformStamped
from tfbus.links.relay import REMEMBERED_REASONS, Outbox, OutgoingBatch, Peer, Rank, Turn, relay_of
from tfbus.links.seams import Carrier, Presence, Received, SendReport, SplittingCarrier
from tfbus.tf_message import MalformedMessageError

MAX_PEERS = 1_000
MAX_AUTHORITIES = 1_000
MOST_AUTHORITY_TEXT = 2**20
"""Letters of all authorities of one peer together."""


class Peers:
    """All peers of one link.

    Parameters
    ----------
    report : callable
        Called with a peer's id, a reason and an error, once for each peer and reason.

    Attributes
    ----------
    rejected : Counter
        How many messages and samples were refused, by reason.
    """

    def __init__(self, report: Callable[[str, str, Exception], object]) -> None:
        self._report = report
        self._peers: dict[str, Peer] = {}
        self._reported_of_unknown = SeenKeys(REMEMBERED_REASONS)
        self.rejected: Counter[str] = Counter()

    def __iter__(self) -> Iterator[Peer]:
        return iter(self._peers.values())

    def __len__(self) -> int:
        """The number of peers that are known, present or not."""
        return len(self._peers)

    @property
    def present(self) -> tuple[str, ...]:
        """The ids of the peers that have announced themselves, sorted."""
        return tuple(sorted(peer.id for peer in self._peers.values() if peer.present))

    def find(self, id: str) -> Peer | None:  # noqa: A002
        """The peer of an id, known or new; None if it is new and there are too many."""
        peer = self._peers.get(id)
        if peer is None:
            if len(self._peers) >= MAX_PEERS:
                self.reject(id, "too many peers", ValueError(f"more than {MAX_PEERS} peers on one link"))
                return None
            peer = self._peers[id] = Peer(id)
        return peer

    def get(self, id: str) -> Peer | None:  # noqa: A002
        """The peer of an id, if it is known."""
        return self._peers.get(id)

    def join(self, id: str) -> tuple[Peer | None, Peer | None]:  # noqa: A002
        """Note that a peer is there.

        Returns
        -------
        peer : Peer or None
            None if it was present before, or there is no place.
        evicted : Peer or None
            A peer that has never announced itself, and had to make room.
        """
        evicted = None
        if id not in self._peers and len(self._peers) >= MAX_PEERS:
            evicted = next((peer for peer in self._peers.values() if not peer.present), None)
            if evicted is not None:
                del self._peers[evicted.id]
        peer = self.find(id)
        if peer is None or peer.present:
            return None, evicted
        peer.present = True
        return peer, evicted

    def forget(self, id: str) -> Peer | None:  # noqa: A002
        """Remove a peer that has gone; returns it if it was known."""
        return self._peers.pop(id, None)

    def forget_all(self) -> list[Peer]:
        """Remove all peers, and return them."""
        peers = list(self._peers.values())
        self._peers.clear()
        return peers

    def reject(self, id: str, reason: str, error: Exception, count: int = 1) -> None:  # noqa: A002
        """Count what was refused of a peer, and report the first refusal for each reason."""
        self.rejected[reason] += count
        peer = self._peers.get(id)
        reported = self._reported_of_unknown if peer is None else peer.reported
        if reported.add(reason):
            self._report(id, reason, error)

    def admit_authorities(self, peer: Peer, authorities: Collection[str], samples: int) -> bool:
        """Note the authorities that a batch names; returns False, and refuses the batch, if they are too many."""
        for authority in authorities:
            if authority not in peer.authorities:
                text = peer.authority_text + len(authority)
                if len(peer.authorities) >= MAX_AUTHORITIES or text > MOST_AUTHORITY_TEXT:
                    error = ValueError(
                        f"the peer has spoken for more than {MAX_AUTHORITIES} authorities, or for very long ones"
                    )
                    self.reject(peer.id, "too many authorities", error, samples)
                    return False
                peer.authorities.add(authority)
                peer.authority_text = text
        return True


class HearsTime(Protocol):
    """A follower of the time of another program."""

    def hear(self, stamp: int) -> None:
        """Take the time of the other program, a stamp in ns."""


class Host(Protocol):
    """The event loop and the link, as an end needs them."""

    def receive(self, item: Received) -> None:
        """Have an item handled on the event loop; for any thread."""

    def send_soon(self, pending: int) -> None:
        """Have `Endpoint.send` called at the end of the turn of the event loop; so many samples wait."""

    def is_behind(self) -> bool:
        """Whether items wait to be handled."""

    def stir(self) -> None:
        """Have `Endpoint.work` called before the time that it has returned."""


class Endpoint:
    """The bus's end of a link.

    Parameters
    ----------
    bus : Bus
    name : str
        How events and log lines call the link.
    frames : iterable of str or None
        The children that go out and come in; None for all.
    drop_lost : bool
        Whether the frames of a lost peer leave the bus.
    max_frames : int
        How many frames one bus, or one peer of another world, may have.

    Attributes
    ----------
    id : str
        The name of this end for its peers.
    host : Host
        Set by the link before anything is called.
    follower : HearsTime or None
        Hears the time of the first peer that tells one, until that peer is lost.
    outbox : Outbox
    peers : Peers
    report : SendReport
    messages, samples : int
        How many messages were accepted, and how many samples were published.
    lost : int
        How many live messages never came, by their numbers.
    duplicates : int
        How many samples were no news.
    """

    id: str
    host: Host
    outbox: Outbox

    def __init__(self, bus: Bus, name: str, frames: Iterable[str] | None, drop_lost: bool, max_frames: int) -> None:
        if isinstance(frames, str):
            raise TypeError(f"frames must be several names, not {frames!r}")
        self.bus = bus
        self.name = name
        self.frames = None if frames is None else frozenset(frames)
        self.drop_lost = drop_lost
        self.max_frames = max_frames
        self.follower: HearsTime | None = None
        self._followed: str | None = None
        self._log = OnceLogger(logging.getLogger("tfbus"))
        self.relay = relay_of(bus)
        self.peers = Peers(self._tell_rejection)
        self.report = SendReport(self._warn_not_sent)
        self.messages = 0
        self.samples = 0
        self.lost = 0
        self.duplicates = 0

    # For the link

    async def open(self) -> None:
        """Connect to the network; raises `OSError` if it cannot."""
        raise NotImplementedError

    async def run(self) -> None:
        """Do what takes time, until cancelled."""
        raise NotImplementedError

    async def close(self) -> None:
        """Disconnect."""
        raise NotImplementedError

    def attach(self) -> None:
        """Join the bus: from now on, all that is latched or published gathers in the outbox.

        Raises
        ------
        BusClosedError
        """
        self.relay.attach(self.outbox, foreign=True)

    def detach(self) -> None:
        """Leave the bus; its peers are forgotten, and their frames stay."""
        self.peers.forget_all()
        self.relay.detach(self.outbox)

    def clock_jumped_back(self) -> None:
        """Take samples with the stamps of earlier ones for news."""
        self.relay.clock_jumped_back()

    def tell_time(self, stamp: int) -> None:
        """Tell peers the time of this bus's clock, in ns, with all that is published from now on."""
        if self.outbox.time is not None and stamp < self.outbox.time:
            # Samples that were published before the jump are of the time before it.
            self.send()
        self.outbox.tell_time(stamp)

    def send(self) -> None:
        """Hand to the network all that has gathered in the outbox, if there is anything."""
        turn = self.outbox.flush()
        if turn.entries or turn.statics or turn.time is not None:
            self._send(turn)

    def work(self) -> float:
        """Do what is due; returns the time of the next call, in s of the monotonic clock."""
        return inf

    def split(self, item: Received) -> Iterator[Any]:
        """The content of an item in parts, None where other tasks may have their turn.

        Raises
        ------
        MalformedMessageError
            If the rest of the item cannot be used.
        """
        return iter((item.content,))

    def handle(self, sender: str, content: Any) -> None:
        """Handle a part of an item; nothing in it makes this raise."""
        try:
            if content is Presence.JOINED:
                self._join(sender)
            elif content is Presence.LEFT:
                self._leave(sender)
            elif isinstance(content, MalformedMessageError):
                self.peers.reject(sender, content.reason, content)
            else:
                self._take(sender, content)
        except MalformedMessageError as error:
            self.peers.reject(sender, error.reason, error)
        except Exception as error:  # noqa: BLE001 - no peer, and no subscriber, may end the event loop
            self.peers.reject(sender, "not published", error)

    # For the two kinds of ends

    def _send(self, turn: Turn) -> None:
        raise NotImplementedError

    def _take(self, sender: str, content: Any) -> None:
        """Handle a message."""
        raise NotImplementedError

    def _lose(self, peer: Peer) -> tuple[str, ...]:
        """Forget what a lost peer has brought; returns its frames, sorted."""
        raise NotImplementedError

    def _join(self, sender: str, robot: str = "") -> Peer | None:
        """Note that a peer is there; returns it if that is new."""
        peer, evicted = self.peers.join(sender)
        if evicted is not None:
            self._lose(evicted)
        if peer is not None:
            peer.robot = robot
            if self.outbox.time is not None:
                self.outbox.tell_time(self.outbox.time)
            self.bus._announce(PeerJoined(self.bus.clock.now(), self.name, sender))
        return peer

    def _leave(self, sender: str) -> None:
        if sender == self._followed:
            self._followed = None
        peer = self.peers.forget(sender)
        if peer is not None:
            frames = self._lose(peer)
            authorities = tuple(sorted(peer.authorities))
            self.bus._announce(PeerLost(self.bus.clock.now(), self.name, sender, authorities, frames))

    def _hear_time(self, sender: str, stamp: int) -> None:
        if self.follower is None or self.peers.find(sender) is None:
            return
        if self._followed is None:
            self._followed = sender
        if sender == self._followed:
            self.follower.hear(stamp)
        else:
            error = ValueError(f"this bus follows the clock of peer {self._followed}")
            self.peers.reject(sender, "second clock", error)

    def _count(self, sender: str, offered: int, published: int, refused: int) -> None:
        self.samples += published
        self.duplicates += offered - published - refused
        if refused:
            error = ValueError(f"the peer has announced more than {self.max_frames} frames")
            self.peers.reject(sender, "too many frames", error, refused)

    def _warn_not_sent(self, error: Exception) -> None:
        self._log.warning(str(error), "not sent over the link %s: %s", self.name, error)

    def _tell_rejection(self, sender: str, reason: str, error: Exception) -> None:
        self._log.warning((sender, reason), "refused what peer %s sent over the link %s: %s", sender, self.name, error)
        # A copy has no traceback that would keep the message in memory.
        self.bus._announce(PeerRejected(self.bus.clock.now(), self.name, sender, reason, copy(error)))

    def _notify(self) -> None:
        self.host.send_soon(self.outbox.pending)


class LatchingOutbox(Outbox):
    """The outbox of a link to a world that keeps messages with static frames for late joiners, as ROS does.

    Of frames that this link has sent before, an echo replaces what is kept, for now another link brings them.
    """

    def __init__(self, frames: Collection[str] | None, notify: Callable[[], object]) -> None:
        super().__init__(frames, notify)
        self._kept: set[str] = set()
        self._changes: dict[str, TransformStamped | None] = {}

    def _follow(self, batch: OutgoingBatch, echo: bool) -> bool:
        changed = False
        for sample in batch.samples:
            _, child, _, _, _, static = sample._fields
            if static and (not echo or child in self._kept):
                self._kept.add(child)
                self._changes[child] = sample
                changed = True
            elif not static and child in self._kept:
                self._kept.remove(child)
                self._changes[child] = None
                changed = True
        return changed

    def _follow_removal(self, frame: str, rank: Rank | None) -> bool:
        del rank
        if frame not in self._kept:
            return False
        self._kept.remove(frame)
        self._changes[frame] = None
        return True

    def _take_statics(self) -> dict[str, TransformStamped | None]:
        changes, self._changes = self._changes, {}
        return changes


class ForeignEnd(Endpoint):
    """The end of a link to a world whose messages have neither origins nor numbers.

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
        super().__init__(bus, name, frames, drop_lost, max_frames)
        self.id = carrier.id
        self._carrier = carrier
        self._splits = carrier if isinstance(carrier, SplittingCarrier) else None
        self.outbox = LatchingOutbox(self.frames, self._notify)

    async def open(self) -> None:
        await self._carrier.open(self.host.receive, self.report)

    async def run(self) -> None:
        await self._carrier.run()

    async def close(self) -> None:
        await self._carrier.close()

    def detach(self) -> None:
        for peer in self.peers.forget_all():
            self.relay.lose_foreign(peer, self.outbox, drop=False)
        self.relay.detach(self.outbox)

    def split(self, item: Received) -> Iterator[Any]:
        return super().split(item) if self._splits is None else self._splits.split(item.content)

    def _send(self, turn: Turn) -> None:
        self._carrier.send(turn)

    def _lose(self, peer: Peer) -> tuple[str, ...]:
        return self.relay.lose_foreign(peer, self.outbox, self.drop_lost)

    def _take(self, sender: str, content: Any) -> None:
        message = self._carrier.read(content)
        if message.time is not None:
            self._hear_time(sender, message.time)
        peer = self.peers.find(sender)
        if peer is None or self.bus.closed:
            return
        if not message.continues:
            self.messages += 1
        for error in message.errors:
            self.peers.reject(sender, error.reason, error)
        for batch in message.batches:
            if self.bus.closed or not self.peers.admit_authorities(peer, batch.authorities, len(batch.samples)):
                continue
            samples = batch.samples
            if self.frames is not None:
                samples = [sample for sample in samples if sample.child in self.frames]
            published, refused = self.relay.publish_foreign(self.outbox, peer, samples, self.max_frames)
            self._count(sender, len(samples), published, refused)
