"""One end of a link without its event loop: the relay, inbox, outbox, peers and events of a link, put together."""

import logging
from collections.abc import Callable, Collection
from copy import copy
from math import inf
from time import monotonic

from tfbus.bus.bus import Bus
from tfbus.bus.subscribers import OnceLogger
from tfbus.events import PeerJoined, PeerLost, PeerRejected
from tfbus.links._asker import Asker
from tfbus.links._carrier import AskableCarrier, Carrier, HistoryCarrier
from tfbus.links._clock_follower import HearsTime
from tfbus.links._history import HistoryAsker, HistoryTeller
from tfbus.links._inbox import Inbox, ReceivedMessage
from tfbus.links._outbox import Outbox
from tfbus.links._peers import Peers
from tfbus.links._receive_queue import Answer, HistoryAnswer, HistoryQuestion, Presence, Question, Received
from tfbus.links._reconciler import Reconciler
from tfbus.links._relay import relay_of
from tfbus.links._state_teller import StateTeller
from tfbus.tf_message import MalformedMessageError

CLAIM_PERIOD = 1.0
CLAIM_PERIOD_EACH = 0.2
LONGEST_CLAIM_PERIOD = 120.0
"""s; a link claims its state so long after it has sent something or met a peer, and then after twice that time, up to
the longest.

A claim goes to all peers, so a link with many of them claims less often: the first time is `CLAIM_PERIOD_EACH` for each
peer, if that is more than `CLAIM_PERIOD`.
"""


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
    now : callable
        Returns a monotonic time in s.
    wake : callable
        Called when `reconcile` has to be called earlier than it said before.
    history : float or None
        How many seconds of the past each new peer is asked for.
    follower : HearsTime, optional
        Hears the time of the first peer that tells one, until that peer is lost.

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
        now: Callable[[], float] = monotonic,
        wake: Callable[[], object] = lambda: None,
        history: float | None = None,
        follower: HearsTime | None = None,
    ) -> None:
        self._bus = bus
        self._name = name
        self._carrier = carrier
        self._drop_lost = drop_lost
        self._log = OnceLogger(logging.getLogger("tfbus"))
        self._relay = relay_of(bus)
        self._askable = carrier if isinstance(carrier, AskableCarrier) else None
        self._follower = follower
        self._followed: str | None = None
        self._now = now
        self._claimed_at = -CLAIM_PERIOD
        self._claim_period = CLAIM_PERIOD
        self.peers = Peers(self._report)
        self.outbox = Outbox(frames, notify, None if self._askable is None else self._askable.can_hold)
        self.inbox = Inbox(bus, self._relay, self.outbox, frames, max_frames, self.peers)
        self._reconciler = (
            None
            if self._askable is None
            else Reconciler(self.inbox, self.peers, self._askable.ask, Asker(now), wake, max_frames)
        )
        self._state_teller = (
            None if self._askable is None else StateTeller(self.outbox.state, self._askable.write_answer)
        )
        self._history_teller = HistoryTeller(bus, self._relay, self.outbox)
        self._history: HistoryAsker | None = None
        if history is not None and isinstance(carrier, HistoryCarrier):
            self._history = HistoryAsker(history, carrier.ask_history, now)

    def attach(self) -> None:
        """Join the bus: from now on, all that is latched or published gathers in the outbox.

        Raises
        ------
        BusClosedError
        """
        # Peers that cannot be asked are of a world that knows no buses.
        self._relay.attach(self.outbox, foreign=self._askable is None, brings=self.peers.brings)

    def detach(self) -> None:
        """Leave the bus; its peers are forgotten, and their frames stay."""
        for peer in self.peers.forget_all():
            self._relay.lose(peer, self.outbox, drop=False)
        self._relay.detach(self.outbox)

    def clock_jumped_back(self) -> None:
        """Take samples with the stamps of earlier ones for news."""
        self._relay.clock_jumped_back()

    def send(self) -> None:
        """Hand to the carrier all that has gathered in the outbox, if there is anything."""
        turn = self.outbox.flush()
        if turn.entries or turn.statics or turn.time is not None:
            self._carrier.send(turn)
            self._claimed_at = self._now()
            self._claim_soon()

    def tell_time(self, stamp: int) -> None:
        """Tell peers the time of this bus's clock, in ns, with all that is published from now on."""
        if self.outbox.time is not None and stamp < self.outbox.time:
            # Samples that were published before the jump are of the time before it.
            self.send()
        self.outbox.tell_time(stamp)

    def next_question(self) -> float | None:
        """The time at which the next peer is to be asked; None while nothing is missing."""
        return None if self._reconciler is None else self._reconciler.next_due()

    def reconcile(self) -> float:
        """Ask whoever is to be asked, and claim the state if it is time; returns when to call this again."""
        if self._reconciler is None or self._askable is None:
            return inf
        self._reconciler.run()
        due = self._claimed_at + self._claim_period
        if self._now() >= due:
            self._claimed_at = self._now()
            self._claim_period = min(2 * self._claim_period, LONGEST_CLAIM_PERIOD)
            due = self._claimed_at + self._claim_period
            # Peers that this link does not hear may hear it.
            if not self.outbox.pending:
                self._askable.claim(self.outbox.step())
        asking = self.next_question()
        history = None
        if self._history is not None:
            for peer in self._history.overdue():
                self._end_history(peer)
            history = self._history.next_due()
        return min(when for when in (due, asking, history) if when is not None)

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
            elif isinstance(content, Question):
                # An answer must not overtake a batch whose changes it tells.
                self.send()
                self._answer(content)
            elif isinstance(content, Answer):
                self._take_answer(item.sender, content)
            elif isinstance(content, HistoryQuestion):
                self._tell_history(content)
            elif isinstance(content, HistoryAnswer):
                self._take_history(item.sender, content)
            else:
                message = self._carrier.read(content)
                if message.time is not None:
                    self._hear_time(item.sender, message.time)
                if self._history is None or not self._history.holds(item.sender, message):
                    self._end_history(item.sender)
                    self._take_live(item.sender, message)
        except MalformedMessageError as error:
            self.peers.reject(item.sender, error.reason, error)
        except Exception as error:  # noqa: BLE001 - no peer, and no subscriber, may end the event loop
            self.peers.reject(item.sender, "not published", error)

    def _take_live(self, sender: str, message: ReceivedMessage) -> None:
        self.inbox.receive(sender, message)
        if self._reconciler is not None and not message.goes_on:
            self._reconciler.heard(sender)

    def _tell_history(self, question: HistoryQuestion) -> None:
        if self._askable is not None:
            told = self._history_teller.chunk(question.seconds, question.after)
            self._askable.answer(question, self._askable.write_answer(*told))

    def _take_history(self, sender: str, answer: HistoryAnswer) -> None:
        if self._history is None or not self._history.is_open(sender):
            return
        goes_on = False
        try:
            message = None if answer.message is None else self._carrier.read(answer.message)
            if message is not None:
                self.inbox.receive_history(sender, message)
            goes_on = self._history.goes_on(sender, message)
        finally:
            if not goes_on:
                self._end_history(sender)

    def _end_history(self, sender: str) -> None:
        """Publish what waited for the past of a peer, with it or without it."""
        if self._history is not None:
            for message in self._history.end(sender):
                self._take_live(sender, message)

    def _hear_time(self, sender: str, stamp: int) -> None:
        if self._follower is None or self.peers.find(sender) is None:
            return
        if self._followed is None:
            self._followed = sender
        if sender == self._followed:
            self._follower.hear(stamp)
        else:
            error = ValueError(f"this bus follows the clock of peer {self._followed}")
            self.peers.reject(sender, "second clock", error)

    def _answer(self, question: Question) -> None:
        message = None if self._state_teller is None else self._state_teller.answer(question.since)
        if self._askable is not None and message is not None:
            self._askable.answer(question, message)

    def _take_answer(self, sender: str, answer: Answer) -> None:
        if self._reconciler is None:
            return
        try:
            message = None if answer.message is None else self._carrier.read(answer.message)
        except MalformedMessageError:
            self._reconciler.unanswered(sender)
            raise
        if message is None:
            self._reconciler.unanswered(sender)
        else:
            self._reconciler.answered(sender, message)

    def _claim_soon(self) -> None:
        self._claim_period = min(max(CLAIM_PERIOD, CLAIM_PERIOD_EACH * len(self.peers)), LONGEST_CLAIM_PERIOD)

    def _peer_joined(self, sender: str) -> None:
        evicted = self.peers.make_room(sender)
        if evicted is not None:
            self._relay.lose(evicted, self.outbox, drop=False)
        peer = self.peers.find(sender)
        if peer is not None and not peer.present:
            peer.present = True
            # A peer that has never lost this link asks for nothing now, and may have missed something all the same.
            self._claim_soon()
            if self._reconciler is not None:
                self._reconciler.joined(peer)
            if self.outbox.time is not None:
                self.outbox.tell_time(self.outbox.time)
            if self._history is not None:
                self._history.joined(sender)
            self._bus._announce(PeerJoined(self._bus.clock.now(), self._name, sender))

    def _peer_left(self, sender: str) -> None:
        self._end_history(sender)
        if sender == self._followed:
            self._followed = None
        peer = self.peers.forget(sender)
        if peer is not None:
            if self._reconciler is not None:
                self._reconciler.left(peer)
            frames = self._relay.lose(peer, self.outbox, self._drop_lost)
            authorities = tuple(sorted(peer.authorities))
            self._bus._announce(PeerLost(self._bus.clock.now(), self._name, sender, authorities, frames))

    def _report(self, sender: str, reason: str, error: Exception) -> None:
        self._log.warning((sender, reason), "refused what peer %s sent over the link %s: %s", sender, self._name, error)
        # A copy has no traceback that would keep the message in memory.
        self._bus._announce(PeerRejected(self._bus.clock.now(), self._name, sender, reason, copy(error)))
