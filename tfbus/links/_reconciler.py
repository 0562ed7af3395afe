"""Brings a link to agree with its peers: it asks those whose state it does not hold, until it does."""

from collections.abc import Callable

from tfbus.links._asker import Asker
from tfbus.links._inbox import Inbox, ReceivedMessage
from tfbus.links._mirror import Mirror
from tfbus.links._peers import Peer, Peers


class Reconciler:
    """Decides whom to ask for what, by the mirrors of all peers that are present.

    Parameters
    ----------
    inbox : Inbox
    peers : Peers
    ask : callable
        Asks a peer for the changes of its state behind a number; `answered` or `unanswered` is called some time later.
    asker : Asker
        Decides when.
    wake : callable
        Called when `run` has to be called earlier than `next_due` said before.
    max_frames : int
        How many frames one peer may have.
    """

    def __init__(
        self,
        inbox: Inbox,
        peers: Peers,
        ask: Callable[[str, int], object],
        asker: Asker,
        wake: Callable[[], object],
        max_frames: int,
    ) -> None:
        self._inbox = inbox
        self._peers = peers
        self._ask = ask
        self._asker = asker
        self._wake = wake
        self._max_frames = max_frames

    def joined(self, peer: Peer) -> None:
        """Begin to follow a peer's state."""
        peer.mirror = Mirror(self._max_frames)
        self._asker.want(peer.id, at_once=True)
        self._wake()

    def left(self, peer: Peer) -> None:
        """Follow a peer's state no more."""
        peer.mirror = None
        self._asker.satisfied(peer.id)

    def heard(self, sender: str) -> None:
        """Ask a peer soon, if its newest message shows that something is missing."""
        peer = self._peers.get(sender)
        if peer is None or peer.mirror is None:
            return
        if peer.mirror.agrees or peer.mirror.overfull:
            self._asker.satisfied(sender)
        elif self._asker.want(sender):
            self._wake()

    def answered(self, sender: str, message: ReceivedMessage) -> None:
        """Take in the answer of a peer, and ask for more if there is more."""
        progress = self._inbox.receive_answer(sender, message)
        peer = self._peers.get(sender)
        if peer is None or peer.mirror is None:
            return
        if peer.mirror.agrees or peer.mirror.overfull:
            self._asker.satisfied(sender)
        elif progress:
            self._asker.progressed(sender)
        else:
            self._asker.failed(sender)
        self._wake()

    def unanswered(self, sender: str) -> None:
        """Ask a peer again after a while."""
        self._asker.failed(sender)
        self._wake()

    def next_due(self) -> float | None:
        """The time of the next call of `run`, on the asker's clock; None if there is nothing to do."""
        return self._asker.next_due()

    def run(self) -> None:
        """Ask whoever is to be asked by now."""
        for id in self._asker.take_due():  # noqa: A001 - the wire calls it so
            peer = self._peers.get(id)
            if peer is None or peer.mirror is None:
                self._asker.satisfied(id)
            else:
                self._ask(id, peer.mirror.asks())
