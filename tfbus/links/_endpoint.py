"""One end of a link without its event loop: the relay, inbox, outbox, peers and events of a link, put together."""

import logging
from collections.abc import Callable, Collection
from copy import copy

from tfbus._log import OnceLogger, SeenKeys
from tfbus.bus.bus import Bus
from tfbus.events import PeerJoined, PeerLost, PeerRejected
from tfbus.links._carrier import Carrier
from tfbus.links._inbox import Inbox
from tfbus.links._outbox import Outbox
from tfbus.links._peers import MAX_PEERS, Peers
from tfbus.links._receive_queue import Presence, Received
from tfbus.links._relay import relay_of
from tfbus.tf_message import MalformedMessageError


class Endpoint:
    """The bus's end of a link, between its relay and its carrier.

    Parameters
    ----------
    bus : Bus
    name : str
        How events and log lines call the link.
    carrier : Carrier
    notify : callable
        Called when there is something to send, for `send` to send it soon.
    frames : collection of str or None
        The children that go out and come in; None for all.
    drop_lost : bool
        Whether the frames of a lost peer leave the bus.
    max_frames : int
        How many frames one peer may have.

    Attributes
    ----------
    outbox : Outbox
    inbox : Inbox
    peers : Peers
    """

    def __init__(
        self,
        bus: Bus,
        name: str,
        carrier: Carrier,
        notify: Callable[[], object],
        *,
        frames: Collection[str] | None = None,
        drop_lost: bool = False,
        max_frames: int = 10_000,
    ) -> None:
        self._bus = bus
        self._name = name
        self._carrier = carrier
        self._drop_lost = drop_lost
        self._log = OnceLogger(logging.getLogger("tfbus"))
        self._relay = relay_of(bus)
        self._joined_before = SeenKeys(MAX_PEERS)
        self.peers = Peers(self._report)
        self.outbox = Outbox(frames, notify)
        self.inbox = Inbox(bus, self._relay, self.outbox, frames, max_frames, self.peers)

    def attach(self) -> None:
        """Join the bus: from now on, all that is latched or published gathers in the outbox.

        Raises
        ------
        BusClosedError
        """
        self._relay.attach(self.outbox)

    def detach(self) -> None:
        """Leave the bus; its peers are forgotten, and their frames stay."""
        for peer in self.peers.forget_all():
            self._relay.lose(peer, self.outbox, drop=False)
        self._relay.detach(self.outbox)

    def send(self) -> None:
        """Hand to the carrier all that has gathered in the outbox, if there is anything."""
        turn = self.outbox.flush()
        if turn.entries or turn.statics:
            self._carrier.send(turn)

    def handle(self, item: Received) -> None:
        """Handle one item that the carrier has received; nothing in it makes this raise."""
        content = item.content
        try:
            if content is Presence.JOINED:
                self._peer_joined(item.sender)
            elif content is Presence.LEFT:
                self._peer_left(item.sender)
            elif isinstance(content, MalformedMessageError):
                self.peers.reject(item.sender, content.reason, content)
            else:
                self.inbox.receive(item.sender, self._carrier.read(content))
        except MalformedMessageError as error:
            self.peers.reject(item.sender, error.reason, error)
        except Exception as error:  # noqa: BLE001 - no peer, and no subscriber, may end the event loop
            self.peers.reject(item.sender, "not published", error)

    def _peer_joined(self, sender: str) -> None:
        evicted = self.peers.make_room(sender)
        if evicted is not None:
            self._relay.lose(evicted, self.outbox, drop=False)
        peer = self.peers.find(sender)
        if peer is not None and not peer.present:
            peer.present = True
            self._carrier.peer_joined(sender, again=not self._joined_before.add(sender))
            self._bus._announce(PeerJoined(self._bus.clock.now(), self._name, sender))

    def _peer_left(self, sender: str) -> None:
        peer = self.peers.forget(sender)
        if peer is not None:
            frames = self._relay.lose(peer, self.outbox, self._drop_lost)
            authorities = tuple(sorted(peer.authorities))
            self._bus._announce(PeerLost(self._bus.clock.now(), self._name, sender, authorities, frames))

    def _report(self, sender: str, reason: str, error: Exception) -> None:
        self._log.warning((sender, reason), "refused what peer %s sent over the link %s: %s", sender, self._name, error)
        # A copy has no traceback that would keep the message in memory.
        self._bus._announce(PeerRejected(self._bus.clock.now(), self._name, sender, reason, copy(error)))
