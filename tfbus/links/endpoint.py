"""One end of a link without its event loop: it publishes what peers have sent, within limits, and tells of them.

`tfbus.links.domain.DomainEnd` is the end of a link of tfbus, `tfbus.links.ros.foreign_end.ForeignEnd` that of a link to
another world. Nothing that a peer sends makes either of them raise.
"""

import logging
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from copy import copy
from math import inf
from typing import Any, Protocol

from tfbus.bus.bus import Bus
from tfbus.bus.subscribers import OnceLogger, SeenKeys
from tfbus.events import PeerJoined, PeerLost, PeerRejected
from tfbus.geometry.stamped import TransformStamped
from tfbus.links.relay import REMEMBERED_REASONS, Outbox, Peer, Relay, relay_of
from tfbus.links.replica import Entry
from tfbus.links.seams import Joined, Left, Network, Received, SendReport
from tfbus.statistics import PeerClock
from tfbus.tf_message import MalformedMessageError

MAX_PEERS = 1_000
MAX_AUTHORITIES = 1_000
MOST_AUTHORITY_TEXT = 2**20
"""Letters of all authorities of one peer together."""


def check_options(options: Iterable[str], known: Any) -> None:
    """Raise `TypeError` for an option that a typed dictionary does not have, as Python does for an argument."""
    names = known.__required_keys__ | known.__optional_keys__
    for name in sorted(set(options) - names):
        from difflib import get_close_matches

        near = get_close_matches(name, names)
        hint = f", did you mean {' or '.join(map(repr, near))}?" if near else f"; there are {', '.join(sorted(names))}"
        raise TypeError(f"a link has no option {name!r}{hint}")


class HearsTime(Protocol):
    """A follower of the time of another program."""

    def hear(self, stamp: int) -> None:
        """Take the time of the other program, a stamp in ns."""


class Endpoint(Outbox, ABC):
    """The bus's end of a link.

    Parameters
    ----------
    bus : Bus
    name : str
        How events and log lines call the link.
    network : Network
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
    network : Network
    follower : HearsTime or None
        Hears the time of the first peer that tells one, until that peer is lost.
    peers : dict of str to Peer
        All that are known, present or not, by their ids.
    rejected : Counter
        How many messages and samples were refused, by reason.
    time : int or None
        The time of the clock that was told last, in ns.
    report : SendReport
    messages, samples : int
        How many messages were accepted, and how many samples were published.
    lost : int
        How many live messages never came, by their numbers.
    duplicates : int
        How many samples were no news.
    """

    def __init__(
        self,
        bus: Bus,
        name: str,
        network: Network,
        frames: Iterable[str] | None,
        drop_lost: bool,
        max_frames: int,
    ) -> None:
        if isinstance(frames, str):
            raise TypeError(f"frames must be several names, not {frames!r}")
        super().__init__(frames)
        self.bus = bus
        self.name = name
        self.id: str = network.id
        self.network: Network = network
        self.drop_lost = drop_lost
        self.max_frames = max_frames
        self.follower: HearsTime | None = None
        self._followed: str | None = None
        self._log = OnceLogger(logging.getLogger("tfbus"))
        self.relay: Relay = relay_of(bus)
        self.peers: dict[str, Peer] = {}
        self.rejected: Counter[str] = Counter()
        self._reported_of_unknown = SeenKeys(REMEMBERED_REASONS)
        self.time: int | None = None
        self._time_waits = False
        self.report: SendReport = SendReport(self._warn_not_sent)
        self.messages = 0
        self.samples: int = 0
        self.lost = 0
        self.duplicates: int = 0

    # For the link

    @abstractmethod
    async def open(self) -> None:
        """Connect to the network; raises `OSError` if it cannot."""

    @abstractmethod
    def detach(self) -> None:
        """Leave the bus; its peers are forgotten, and their frames stay."""

    def clock_statistics(self) -> tuple[PeerClock, ...]:
        """The clocks of the peers, as far as they tell their times."""
        return ()

    def tell_time(self, stamp: int) -> None:
        """Tell peers the time of this bus's clock, in ns, with the samples that are published from now on."""
        if self.time is not None and stamp < self.time:
            # Samples that were published before the jump are of the time before it.
            self.send()
        self.time, self._time_waits = stamp, True
        self.host.send_soon(self.pending)

    def send(self) -> None:
        """Hand the gathered entries to the network, if there are any."""
        entries, time = self._entries, self.time if self._time_waits else None
        self._entries, self._time_waits = [], False
        self.pending: int = 0
        self._send(entries, time)

    def work(self) -> float:
        """Do the work that is due; returns the time of the next call, in s of the monotonic clock."""
        return inf

    @abstractmethod
    def split(self, item: Received) -> Iterator[Any]:
        """The content of an item in parts, None where other tasks may have their turn.

        Raises
        ------
        MalformedMessageError
            If the rest of the item cannot be used.
        """

    def handle(self, sender: str, content: Any) -> None:
        """Handle a part of an item; nothing in it makes this raise."""
        if isinstance(content, Joined):
            self.guarded(self._join, sender, content.robot)
        elif isinstance(content, Left):
            self.guarded(self._leave, sender)
        elif isinstance(content, MalformedMessageError):
            self.reject(sender, content.reason, content)
        else:
            self.guarded(self._take, sender, content)

    def guarded(self, work: Callable[..., object], sender: str, *told: Any) -> None:
        """Do some work with what a peer has sent; its errors are counted and told."""
        try:
            work(sender, *told)
        except MalformedMessageError as error:
            self.reject(sender, error.reason, error)
        except Exception as error:  # noqa: BLE001 - no peer, and no subscriber, may end the event loop
            self.reject(sender, "not published", error)

    @property
    def present(self) -> tuple[str, ...]:
        """The ids of the peers that have announced themselves, sorted."""
        return tuple(sorted(peer.id for peer in self.peers.values() if peer.present))

    def reject(self, sender: str, reason: str, error: Exception, count: int = 1) -> None:
        """Count refused samples or messages of a peer; the first refusal for each reason is logged and announced."""
        self.rejected[reason] += count
        peer = self.peers.get(sender)
        if (self._reported_of_unknown if peer is None else peer.reported).add(reason):
            self._log.warning(
                (sender, reason), "refused what peer %s sent over the link %s: %s", sender, self.name, error
            )
            # A copy has no traceback that would keep the message in memory.
            self.bus._announce(PeerRejected(self.bus.clock.now(), self.name, sender, reason, copy(error)))

    # For the two kinds of ends

    @abstractmethod
    def _send(self, entries: Sequence[Entry], time: int | None) -> None:
        """Send what one turn of the event loop has published and removed, and the time if it has to be told."""

    @abstractmethod
    def _take(self, sender: str, content: Any) -> None:
        """Handle a message."""

    @abstractmethod
    def _lose(self, peer: Peer) -> tuple[str, ...]:
        """Forget the frames of a lost peer; returns them, sorted."""

    def _join(self, sender: str, robot: str) -> Peer | None:
        """Note that a peer is there; returns it if that is new, and there is a place."""
        if sender not in self.peers and len(self.peers) >= MAX_PEERS:
            # A peer that has never announced itself has to make room.
            unannounced = next((peer for peer in self.peers.values() if not peer.present), None)
            if unannounced is not None:
                self._lose(self.peers.pop(unannounced.id))
        peer = self._find(sender)
        if peer is None or peer.present:
            return None
        peer.present, peer.robot = True, robot
        if self.time is not None:
            self.tell_time(self.time)
        self.bus._announce(PeerJoined(self.bus.clock.now(), self.name, sender))
        return peer

    def _find(self, sender: str) -> Peer | None:
        """The peer of an id, known or new; None if it is new and there are too many."""
        if sender not in self.peers:
            if len(self.peers) >= MAX_PEERS:
                self.reject(sender, "too many peers", ValueError(f"more than {MAX_PEERS} peers on one link"))
                return None
            self.peers[sender] = Peer(sender)
        return self.peers[sender]

    def _leave(self, sender: str) -> None:
        if sender == self._followed:
            self._followed = None
        peer = self.peers.pop(sender, None)
        if peer is not None:
            frames = self._lose(peer)
            authorities = tuple(sorted(peer.authorities))
            self.bus._announce(PeerLost(self.bus.clock.now(), self.name, sender, authorities, frames))

    def _hear_time(self, sender: str, stamp: int) -> None:
        if self.follower is None or self._find(sender) is None:
            return
        if self._followed is None:
            self._followed = sender
        if sender == self._followed:
            self.follower.hear(stamp)
        else:
            error = ValueError(f"this bus follows the clock of peer {self._followed}")
            self.reject(sender, "second clock", error)

    def _warn_not_sent(self, error: Exception) -> None:
        self._log.warning(str(error), "not sent over the link %s: %s", self.name, error)

    def _admit_authorities(self, peer: Peer, samples: Collection[TransformStamped]) -> bool:
        """Note the authorities of a batch; returns False, and refuses the batch, if they are too many."""
        for authority in {sample.authority for sample in samples} - peer.authorities:
            text = peer.authority_text + len(authority)
            if len(peer.authorities) >= MAX_AUTHORITIES or text > MOST_AUTHORITY_TEXT:
                why = f"the peer has spoken for more than {MAX_AUTHORITIES} authorities, or for very long ones"
                self.reject(peer.id, "too many authorities", ValueError(why), len(samples))
                return False
            peer.authorities.add(authority)
            peer.authority_text = text
        return True
