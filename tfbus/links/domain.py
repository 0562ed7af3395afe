"""The end of a link of tfbus, between the relay of its bus and a wire; `tfbus.links.replica` tells the protocol."""

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from math import inf
from time import monotonic
from typing import Any, TypedDict, Unpack

from tfbus.bus.bus import Bus
from tfbus.clock import SimulatedClock
from tfbus.events import ClockOffset, PeerClockStepped
from tfbus.links.channels import ALL, QUIET, SLOW, Channels, filter_name
from tfbus.links.clocks import Clocks
from tfbus.links.endpoint import MAX_PEERS, Endpoint, HearsTime, check_options
from tfbus.links.history import LONGEST_HISTORY, HistoryAsker, chunk_of_past
from tfbus.links.lookups import RemoteLookups
from tfbus.links.message import (
    END_OF_STAMPS,
    FIRST_STAMP,
    LONGEST_WAY,
    ChangesQuestion,
    Heard,
    Kind,
    Outgoing,
    PastQuestion,
    Text,
    Way,
    kind_of,
    read_message,
    read_question,
    sendable,
    split_clocks,
    write_body,
    write_message,
    write_question,
)
from tfbus.links.relay import Peer
from tfbus.links.replica import (
    CHUNK,
    Agreement,
    Claim,
    Entry,
    FromLink,
    Known,
    Provenance,
    ReceivedBatch,
    RemovedFrame,
    TooManyEntriesError,
    View,
    as_told,
)
from tfbus.links.seams import Hearing, Joined, Left, Received, Wire, WireItem
from tfbus.stamps import SECOND, as_duration, to_seconds
from tfbus.statistics import PeerClock
from tfbus.tf_message import MalformedMessageError

SIGN_PERIOD = 1.0
SIGN_PERIOD_EACH = 0.05
LONGEST_SIGN_PERIOD_EACH = 0.15
"""s; a link signs `SIGN_PERIOD` after it has sent something or met a peer, and then after twice that time each time, up
to the `rest` of its wire. A sign goes to all peers, so with many peers the first and the longest period are at least
`SIGN_PERIOD_EACH` and `LONGEST_SIGN_PERIOD_EACH` for each peer."""
SOONEST_SIGN = 0.05
"""s; the shortest time between two signs."""
MOST_QUESTIONS = 1_000
"""The most questions, for changes or the past, that wait for an answer: one of each kind from each link."""
MOST_ROBOTS = 100
"""The most robots without a link whose copies are kept."""
MOST_WAITING = 10_000
"""The most links that wait until a peer leaves."""
_LONGEST_NAME = 200
_LARGEST_GAP = 2**32
_URGENT = frozenset(Kind) - {Kind.LIVE, Kind.SIGN}
_FOLLOWS = frozenset({Kind.MEETING, Kind.ANSWER, Kind.PAST})


class DomainOptions(TypedDict, total=False):
    """The parameters that all links of tfbus have in common; `tfbus.links.DomainLink` explains them."""

    robot: str | None
    robots: Iterable[str] | Mapping[str, float] | None
    slow_rate: float
    frames: Iterable[str] | None
    drop_lost: bool
    max_frames: int
    history: float | None
    max_offset: float
    correct_clocks: bool
    capacity: int
    clock: SimulatedClock | HearsTime | None
    tell_clock: bool


class DomainEnd(Endpoint):
    """The end of a link of tfbus.

    Parameters
    ----------
    bus : Bus
    name : str
        The domain.
    wire : Wire
    now : callable
        Returns a monotonic time in s.
    **options
        See `tfbus.links.DomainLink`, which also lists the errors; some are for the link alone.

    Attributes
    ----------
    own : View
        The frames that the links of this robot bring.
    lookups : RemoteLookups
    clocks : Clocks
    """

    own: View

    def __init__(
        self,
        bus: Bus,
        name: str,
        wire: Wire,
        now: Callable[[], float] = monotonic,
        **options: Unpack[DomainOptions],
    ) -> None:
        check_options(options, DomainOptions)
        robot, robots = options.get("robot"), options.get("robots")
        slow_rate, history = options.get("slow_rate", 1.0), options.get("history")
        if isinstance(robots, str):
            raise TypeError(f"robots must be several names, not {robots!r}")
        if robot is not None:
            check_name("a robot's name", robot, r"[\w.-]+", "letters, digits, '-', '_' and '.'")
        rates = robots if isinstance(robots, Mapping) else dict.fromkeys(("*",) if robots is None else robots, inf)
        for pattern in rates:
            check_name("the name of a robot", pattern, r"[\w.*-]+", "letters, digits, '-', '_' and '.', or '*' for any")
        # Not a number is not greater either.
        if not 0 < slow_rate < inf or any(not rate >= 0 for rate in rates.values()):
            raise ValueError(f"a rate must be greater than zero, got {rates!r} and {slow_rate!r} Hz")
        if history is not None and not 0 < as_duration(history, "history") <= LONGEST_HISTORY:
            raise ValueError(f"history must be a time that passes, {LONGEST_HISTORY:g} s at most, got {history}")
        frames, drop_lost = options.get("frames"), options.get("drop_lost", False)
        super().__init__(bus, name, wire, frames, drop_lost, options.get("max_frames", 10_000))
        self._now = now
        self._wire = wire
        self._robot = robot or ""
        channel = ALL if self.frames is None else filter_name(self.frames)
        # Whether peers are to send the wanted frames only.
        self._filters = channel != ALL
        channels = {inf: channel, 0.0: QUIET}
        self._rates = {Hearing(pattern, channels.get(rate, SLOW)): rate for pattern, rate in rates.items()}
        self._bus = self.relay.replica.origin
        self._channels = Channels(wire, self._bus, slow_rate, self.report)
        self.own: View = self._view_of(self._robot)
        self._agreement = Agreement()
        max_offset, corrects = as_duration(options.get("max_offset", 0.02), "max_offset"), options.get("correct_clocks")
        if corrects and not self.relay.clock.runs:
            raise TypeError(
                f"to correct the stamps of others, the bus needs a clock that runs by itself, not {bus.clock!r}"
            )
        self.max_offset: float = max_offset * SECOND
        self.clocks: Clocks = Clocks(self.relay.clock, self.id, max_offset, corrects=bool(corrects))
        self._history = HistoryAsker(history or 0.0, wire.send, now)
        self.lookups: RemoteLookups = RemoteLookups(wire.send, name)
        # The last sign of each peer that agrees with this link: the same sign once more need not wake the event loop.
        self._resting: dict[str, bytes] = {}
        # Answering takes half of the event loop's time at most.
        self._questions: dict[tuple[str, Kind], bytes] = {}
        self._answers_due = -inf
        self._waiting: dict[str, str] = {}
        self._signed_at = self._sign_due = -inf
        self._sign_period = SIGN_PERIOD

    # For the link

    async def open(self) -> None:
        await self._wire.open(list(self._rates), self.take, self._warn_of_wire)

    def detach(self) -> None:
        self.lookups.close()
        while self.peers:
            self._forget(self.peers.popitem()[1])
        self.relay.detach(self)

    def work(self) -> float:
        now = self._now()
        if self._questions and now >= self._answers_due:
            sender, kind = next(iter(self._questions))
            # An answer must not overtake a batch in the outbox.
            self.send()
            answer = self._answer if kind is Kind.QUESTION else self._tell_past
            self.guarded(answer, sender, self._questions.pop((sender, kind)))
            after = self._now()
            now, self._answers_due = after, 2 * after - now
        for late in self._history.overdue():
            self._end_history(self.peers[late])
        due = self._agreement.next_due()
        if now >= due:
            self._ask(now)
            due = self._agreement.next_due()
        if now >= self._sign_due:
            peers = len(self.present)
            self._sign_period = min(2 * self._sign_period, max(self._wire.rest, LONGEST_SIGN_PERIOD_EACH * peers))
            self._sign(now)
        due = min(due, self._sign_due, self._history.next_due(), self._answers_due if self._questions else inf)
        return min(due, self._channels.send_slowly(now))

    def _ask(self, now: float) -> None:
        """Ask the question that is due, unless it is put off."""
        question = self._agreement.question(now, self.host.is_behind() or self._wire.is_behind())
        if question is not None:
            frames = tuple(sorted(self.frames)) if self.frames is not None and self._filters else None
            body = write_question(ChangesQuestion(question.since, frames))
            if not self._wire.send(question.peer, write_body(Kind.QUESTION, body)):
                self._agreement.unanswered(question.peer, now)

    def split(self, item: Received) -> Iterator[Any]:
        if not isinstance(item.content, bytes):
            yield item.content
            return
        for part in read_message(item.content):
            # A message that comes before its time is left out as a whole, however long its parts take.
            if isinstance(part, Heard) and not part.continues and self._is_thinned(item.sender, part):
                return
            yield part
            # Only a sign without a time may rest, because a clock may be followed later.
            is_plain = isinstance(part, Heard) and part.kind is Kind.SIGN and part.time is None
            if is_plain and self._agreement.rests(item.sender, self._now()):
                self._resting[item.sender] = item.content

    def _warn_of_wire(self, error: Exception) -> None:
        self._log.warning(str(error), "the link %s: %s", self.name, error)

    # For its parts

    def sign_soon(self, seconds: float = SOONEST_SIGN) -> None:
        """Sign so many seconds after the last sign, or in the next turn of the event loop, if no sign is due before."""
        self._sign_due = min(self._sign_due, self._signed_at + seconds)
        self.host.stir()

    def clock_statistics(self) -> tuple[PeerClock, ...]:
        return self.clocks.statistics((link, self.peers[link].authorities) for link in self.present)

    # For the relay

    def ways(self) -> Iterator[Way]:
        for peer in self.peers.values():
            yield from peer.paths.items()

    def reach_changed(self) -> None:
        self.sign_soon()

    def outgoing(self, entry: Entry) -> Entry | None:
        wanted = super().outgoing(entry)
        return None if wanted is None else sendable(wanted, self.report.refused)

    # Going out

    def _send(self, entries: Sequence[Entry], time: int | None) -> None:
        if entries or time is not None:
            self._channels.send(entries, time, self._now())
            self._sign_sooner()

    def _sign_sooner(self) -> None:
        period = max(SIGN_PERIOD, SIGN_PERIOD_EACH * len(self.peers))
        if period < self._sign_period:
            self._sign_period = period
            self.sign_soon(period)

    def _sign(self, now: float) -> None:
        self._signed_at, self._sign_due = now, now + self._sign_period
        self.send()
        serves = self.lookups.server is not None
        is_whole = not self._agreement.fetches
        self._channels.sign(self.own, is_whole, now, self._reach(), serves, self.clocks.section(answers=True))
        self._tell_offsets()

    def _reach(self) -> list[Way]:
        besides = self.relay.reach_besides(self)
        return [(origin, path) for origin, path in besides.items() if len(path) < LONGEST_WAY][:255]

    def _meet(self, peer: Peer) -> None:
        """Send a new peer the entries that this link brings, or an empty meeting if they are too many."""
        self.send()
        claim = self.own.claim(self._now())._replace(final=not self._agreement.fetches)
        clocks = self.clocks.section(answers=False)
        serves = self.lookups.server is not None
        out = Outgoing(Kind.MEETING, self._bus, 0, claim, self.time, self._reach(), serves, clocks)
        brought = [*islice(self.own.brought(self), CHUNK + 1)]
        try:
            message = write_message(out, as_told(brought) if len(brought) <= CHUNK else ())
        except ValueError:
            message = write_message(out)
        self._wire.send(peer.id, message)

    # Coming in

    def take(self, link: str, item: WireItem) -> None:
        """Take an item of the wire, from any thread."""
        if isinstance(item, bytes):
            kind = kind_of(item)
            if kind in (Kind.SIGN, Kind.MEETING):
                item, section = split_clocks(item)
                if section:
                    self.clocks.arrive(link, section)
            if kind is Kind.SIGN and self._resting.get(link) == item:
                return
            urgent = kind in _URGENT
            received = Received(link, item, len(item), kind is Kind.LIVE, urgent, kind in _FOLLOWS)
        else:
            received = Received(link, item, urgent=isinstance(item, (Joined, Left)))
        self.host.receive(received)

    def _join(self, sender: str, robot: str) -> Peer | None:
        peer = super()._join(sender, robot)
        if peer is not None:
            self.clocks.joined(sender)
            peer.rate = next((rate for one, rate in self._rates.items() if one.matches(peer.robot)), inf)
            self._meet(peer)
            self._sign_sooner()
            # A robot of rate 0 only answers lookups.
            if peer.rate:
                # A peer hears of a filter by the first question.
                self._agreement.joined(sender, self._view_of(peer.robot), self._now(), must_ask=self._filters)
                if not self.clocks.corrects:
                    self._history.joined(sender)
            self.host.stir()
        elif sender not in self.peers and len(self._waiting) < MOST_WAITING:
            self._waiting[sender] = robot
        return peer

    def _take(self, sender: str, content: Any) -> None:
        if isinstance(content, Text):
            self._take_text(sender, content)
        else:
            self._take_message(sender, content)

    def _take_text(self, sender: str, text: Text) -> None:
        if text.kind is Kind.LOOKUP:
            self.lookups.asked(sender, text.data)
        elif text.kind is Kind.LOOKUP_ANSWER:
            self.lookups.answered(sender, text.data)
        else:
            key = sender, text.kind
            if key not in self._questions and len(self._questions) >= MOST_QUESTIONS:
                raise MalformedMessageError("too many questions", f"{MOST_QUESTIONS} wait for an answer")
            self._questions[key] = text.data
            self.host.stir()

    def _take_message(self, sender: str, heard: Heard) -> None:
        peer = self.peers.get(sender)
        if peer is None or not peer.present or self.bus.closed:
            return
        if heard.time is not None:
            self._hear_time(sender, heard.time)
        if not heard.continues:
            self._update_ways(peer, heard)
            if heard.kind in (Kind.SIGN, Kind.MEETING):
                self.lookups.note_server(sender, peer.robot, heard.serves)
                self._settle_clocks(peer)
                if not peer.rate:
                    return
            if heard.kind is not Kind.SIGN:
                self.messages += 1
        if heard.kind is Kind.LIVE and sender in self._history.open:
            if self._history.holds(sender, heard):
                return
            # The held messages come before this one, or they would be no news.
            self._end_history(peer)
        self._take_held(peer, heard)

    def _take_held(self, peer: Peer, heard: Heard) -> None:
        now, kind = self._now(), heard.kind
        live = kind is Kind.LIVE
        numbered = not heard.continues and kind in (Kind.LIVE, Kind.SIGN)
        is_gap = numbered and self._count_gap(peer, heard.number, live)
        if is_gap:
            self._agreement.missed(peer.id, now)
        if is_gap or not live:
            self._resting.pop(peer.id, None)
            self.host.stir()
        if kind is Kind.PAST and peer.id not in self._history.open:
            return
        peer.news = self._take_entries(peer, heard) or (heard.continues and peer.news)
        if live or heard.goes_on:
            return
        if kind is Kind.PAST:
            if not self._history.goes_on(peer.id, heard):
                self._end_history(peer)
        elif kind is Kind.ANSWER:
            self._agreement.answered(peer.id, heard.claim, peer.news, now)
        else:
            is_much = kind is Kind.MEETING and not heard.continues and not heard.entries
            self._agreement.told(peer.id, heard.claim, now, soon=is_much)

    def _take_entries(self, peer: Peer, heard: Heard) -> bool:
        """Note and publish the entries of a message; returns whether any of them was news."""
        for error in heard.errors:
            self.reject(peer.id, error.reason, error)
        view, news = self._view_of(peer.robot), False
        together: list[FromLink] = []
        for entry in heard.entries:
            if not self.relay.is_plausible(entry.sequence):
                # It would make all later numbers of its origin old.
                why = f"a batch with the number {entry.sequence}, which is too far ahead of all others"
                self.reject(peer.id, "number", ValueError(why), entry.size)
                continue
            self.relay.heard(entry.sequence)
            source = Provenance(entry.origin, entry.sequence, self, peer)
            if isinstance(entry, ReceivedBatch):
                if self._place(peer, source, entry, heard):
                    # The samples before the step are published before those behind it.
                    self._publish(together, heard.kind)
                    self._begin_anew(peer, source)
                # The authorities of a bus beyond the peer do not count as the peer's.
                if entry.origin in peer.paths and not self._admit_authorities(peer, entry.samples):
                    continue
                is_new, admitted = self._judge(peer, view, source, entry.samples, heard.kind)
                news = news or is_new
                together += admitted
                # The batches of an answer were never one batch, but nothing is between them.
                if heard.kind is not Kind.LIVE:
                    continue
            self._publish(together, heard.kind)
            if self.bus.closed:
                # A subscriber may have closed it since the last entry.
                return news
            if isinstance(entry, RemovedFrame):
                news = self._remove(view, source, entry.frame) or news
        self._publish(together, heard.kind)
        return news

    def _place(self, peer: Peer, source: Provenance, entry: ReceivedBatch, heard: Heard) -> bool:
        """Note the clock of a batch, and correct its stamps; returns whether they do not go on from those before."""
        source.told = entry.clock
        source.clock = self.clocks.goes_on(peer.id, entry.origin, entry.clock)
        if source.clock is not None:
            return False
        moving = [sample for sample in entry.samples if not sample.static]
        self._correct(peer, source, moving)
        is_live = heard.kind is Kind.LIVE and bool(moving)
        return is_live and self.clocks.jumps(peer.id, entry.origin, entry.clock, source.clock, source.shift)

    def _correct(self, peer: Peer, source: Provenance, moving: Sequence[FromLink]) -> None:
        """Find the clock of a source, and if stamps are to be corrected, move those of its samples, which are new."""
        source.clock, shift = self.clocks.place(peer.id, source.told)
        if shift and all(FIRST_STAMP <= sample.stamp + shift < END_OF_STAMPS for sample in moving):
            source.shift = shift
            for sample in moving:
                parent, child, stamp, row, authority, static = sample._fields
                sample._fields = parent, child, stamp + shift, row, authority, static

    def _settle_clocks(self, peer: Peer) -> None:
        """Read what signs have told of clocks; once that of a peer is known, correct what it told before."""
        self.clocks.settle()
        self._tell_offsets()
        if peer.is_placed or not self.clocks.is_measured(peer.id):
            return
        peer.is_placed = True
        self._correct_kept(peer)
        # All frames whose clocks the peer has told have begun anew.
        self.clocks.forget_origins(peer.id)
        if self.clocks.corrects and peer.rate:
            self._history.joined(peer.id)
        if self.clocks.corrects and not self._history.open:
            self._show()

    def _correct_kept(self, peer: Peer) -> None:
        """Correct the entries that a peer told before their clocks were known, and take them off the bus."""
        waiting: dict[Provenance, list[tuple[Known, FromLink]]] = {}
        for known in self.relay.replica.entries.values():
            source, sample = known.source, known.sample
            if source.peer is peer and source.clock is None and isinstance(sample, FromLink):
                waiting.setdefault(source, []).append((known, sample))
        moved: list[Known] = []
        for source, together in waiting.items():
            # Others may hold the samples as they came. They have no source yet if the bus had them from elsewhere.
            moving = [(known, sample.again(source)) for known, sample in together if not sample.static]
            self._correct(peer, source, [sample for _, sample in moving])
            for known, sample in moving if source.shift else ():
                known.sample = sample
                moved.append(known)
        for known in moved:
            if known.shown is not None and not self.bus.closed:
                self.relay.remove(known.frame, None)

    def _begin_anew(self, peer: Peer, source: Provenance) -> None:
        """Forget the older samples of a bus whose stamps have jumped, because the newer ones do not go on from them."""
        frames = self.relay.take_off(lambda shown: shown.origin == source.origin, moving=True)
        step = self.clocks.step_of(source.origin)
        if step:
            self.bus._announce(PeerClockStepped(self.bus.clock.now(), self.name, peer.id, to_seconds(step), frames))
            return
        entries = self.relay.replica.entries.values()
        sources = [known.source for known in entries if known.source.origin == source.origin]
        untold = [one for one in sources if one.peer is peer and one.told is None]
        if untold:
            # The clock of the bus is told for the first time: what rests is corrected, and stays.
            for one in untold:
                one.told = source.told
            self._correct_kept(peer)
            if not self._history.open:
                self._show()

    def _tell_offsets(self) -> None:
        """Announce the clocks that have begun to differ from this one, or no longer do."""
        for link, offset, bound, over in self.clocks.news():
            peer = self.peers.get(link)
            if peer is None:
                continue
            authorities = tuple(sorted(peer.authorities))
            event = ClockOffset(self.bus.clock.now(), self.name, link, authorities, offset, bound, over)
            self.bus._announce(event)
            self._log.warning(("clock", link, over), "%s", event)

    def _remove(self, view: View, source: Provenance, frame: str) -> bool:
        """Note a removal; returns whether it was news for the map."""
        replica = self.relay.replica
        was_known = frame in replica.entries
        is_news = view.holds(frame) and replica.note(frame, source, None, view.route)
        # One that is forgotten at once is news only where the frame is, or it would go round in a ring of buses.
        is_news = is_news and (was_known or frame in replica.entries)
        if is_news:
            self.relay.remove(frame, source)
        return is_news

    def _judge(
        self, peer: Peer, view: View, source: Provenance, samples: list[FromLink], kind: Kind
    ) -> tuple[bool, list[FromLink]]:
        """Note the samples of a batch; returns whether any was news for the map, and those to publish."""
        replica, live = self.relay.replica, kind is Kind.LIVE
        hides = self.drop_lost and not self.relay.reaches(source.origin)
        # The newest sample of a moving frame would make its past no news.
        waits = bool(self._history.open) and kind not in (Kind.LIVE, Kind.PAST)
        # The usual case: the samples only continue moving frames.
        count = replica.go_on(source, samples, view.route) if live and not hides else 0
        admitted, news = samples[:count], count > 0
        for sample in samples[count:]:
            child, static = sample.child, sample.static
            if not view.holds(child):
                continue
            moves = live and not static
            try:
                is_new = replica.note(child, source, sample, view.route, max_frames=self.max_frames, settles=moves)
            except TooManyEntriesError as error:
                self.reject(peer.id, "too many frames", error)
                continue
            known = replica.entries[child]
            # A late live sample of a moving frame belongs to its history, as the past does.
            is_late = moves and known.shown is not None and known.sample is not None and not known.sample.static
            if not (is_new or is_late or kind is Kind.PAST):
                continue
            news = True
            if hides:
                if known.shown is not None and known.shown.rank < source.rank:
                    self.relay.remove(child, None)
            elif not (waits and not static):
                if self.relay.is_news(known, sample, source):
                    admitted.append(sample)
                else:
                    self.duplicates += 1
        self.relay.admit(admitted, source)
        return news, admitted

    def _publish(self, samples: list[FromLink], kind: Kind) -> None:
        """Publish some samples, and empty their list."""
        if samples and not self.bus.closed:
            if kind is Kind.LIVE:
                self.bus.publish(samples, invalid="drop")
            else:
                with self.bus._kept_samples():
                    self.bus.publish(samples, invalid="drop")
            self.samples += len(samples)
        samples.clear()

    def _count_gap(self, peer: Peer, number: int, live: bool) -> bool:
        """Count the live messages that are missing before this number; returns whether there are any."""
        if not number:
            return False
        missing = number - peer.number - live
        # No link sends so many messages: a larger gap means that one of the two numbers is forged.
        if abs(missing) > _LARGEST_GAP:
            peer.number = number
            return True
        if number <= peer.number:
            return False
        known = peer.number > 0
        peer.number = number
        if known:
            self.lost += missing
        return known and missing > 0

    def _is_thinned(self, sender: str, heard: Heard) -> bool:
        """Whether a message with newest samples comes before its time."""
        if heard.number or heard.kind is not Kind.LIVE:
            return False
        peer = self.peers.get(sender)
        if peer is None or peer.rate == inf:
            return False
        now = self._now()
        since = now - peer.thinned
        # Samples that belong together come in several messages at once.
        if since > 0.02:
            if since * peer.rate < 0.9:
                return True
            peer.thinned = now
        return False

    # Presence

    def _leave(self, sender: str) -> None:
        self._waiting.pop(sender, None)
        for kind in (Kind.QUESTION, Kind.PAST_QUESTION):
            self._questions.pop((sender, kind), None)
        super()._leave(sender)
        if self._waiting and len(self.peers) < MAX_PEERS:
            link = next(iter(self._waiting))
            self._join(link, self._waiting.pop(link))

    def _lose(self, peer: Peer) -> tuple[str, ...]:
        lost = self._forget(peer)
        frames = self.relay.frames_of(lambda shown: shown.origin in lost)
        self._withdraw(lost)
        return frames

    def _withdraw(self, lost: Collection[bytes]) -> None:
        if self.drop_lost and lost:
            self.relay.take_off(lambda shown: shown.origin in lost)

    def _forget(self, peer: Peer) -> set[bytes]:
        """Forget a peer; returns the buses that are no longer reached."""
        self._end_history(peer)
        self._agreement.left(peer.id)
        self.lookups.left(peer.id)
        self.clocks.left(peer.id)
        self._resting.pop(peer.id, None)
        self._forget_robots(peer.robot)
        _, lost = self.relay.reach_changed(self) if peer.paths else ((), set[bytes]())
        return lost

    def _update_ways(self, peer: Peer, heard: Heard) -> None:
        """Note the buses that a peer leads to: its own bus, and those in its sign."""
        own = self._bus
        if heard.kind in (Kind.SIGN, Kind.MEETING):
            told = {bus: (heard.bus, *path) for bus, path in heard.reach if bus != own and own not in path}
            paths = {heard.bus: (), **{bus: path for bus, path in told.items() if bus != heard.bus}}
        elif peer.paths:
            return
        else:
            paths = {heard.bus: ()}
        paths.pop(own, None)
        if paths == peer.paths:
            return
        peer.paths = paths
        opened, lost = self.relay.reach_changed(self)
        self._withdraw(lost)
        if self.drop_lost and opened:
            self._show()

    def _show(self) -> None:
        """Publish the entries that were kept from the bus, as far as their buses are reached now."""
        found: list[FromLink] = []
        for known in self.relay.replica.entries.values():
            sample, source = known.sample, known.source
            is_here = not self.drop_lost or self.relay.reaches(source.origin)
            if is_here and isinstance(sample, FromLink) and self.relay.is_news(known, sample, source):
                self.relay.admit([sample], source)
                found.append(sample)
        self._publish(found, Kind.ANSWER)

    # Answers

    def _answer(self, sender: str, body: bytes) -> None:
        question = read_question(ChangesQuestion, body)
        frames = None if question.frames is None else frozenset(question.frames)
        if frames is not None:
            if self.frames is None or frames <= self.frames:
                self._agreement.filters(sender, frames)
            self._channels.serve(frames, self._now())
        limit = CHUNK
        while limit:
            entries, claim = self.own.changes(question.since, self._now(), frames, limit)
            out = Outgoing(Kind.ANSWER, self._bus, 0, claim, None, self._reach())
            try:
                message = write_message(out, entries)
            except ValueError:
                limit //= 2
            else:
                self._wire.send(sender, message)
                return

    def _tell_past(self, sender: str, body: bytes) -> None:
        question = read_question(PastQuestion, body)
        entries, final = chunk_of_past(self.bus, self.own.brought(self), question.seconds, question.after)
        out = Outgoing(Kind.PAST, self._bus, 0, Claim(0, 0, 0, final))
        self._wire.send(sender, write_message(out, entries))

    def _end_history(self, peer: Peer) -> None:
        """Stop waiting for the past of a peer, and publish its live messages that were held back."""
        if peer.id in self._history.open:
            held = self._history.end(peer.id)
            if not self._history.open:
                # The newest samples of frames without a past were not published yet.
                self._show()
            for heard in held:
                self._take_held(peer, heard)

    # Robots

    def _view_of(self, robot: str) -> View:
        view = self.views.get(robot)
        if view is None:
            view = self.views[robot] = View(self.relay.replica, self.frames)
            self.relay.route()
        return view

    def _forget_robots(self, gone: str) -> None:
        """Forget what the robots brought that have gone first, if many have gone."""
        if gone not in self.views or len(self.views) <= MOST_ROBOTS:
            return
        # Robots that have come or gone last are the last.
        self.views[gone] = self.views.pop(gone)
        here = {peer.robot for peer in self.peers.values()} | {self._robot}
        absent = [robot for robot in self.views if robot not in here]
        forgotten = [self.views.pop(robot) for robot in absent[: max(len(absent) - MOST_ROBOTS, 0)]]
        if forgotten:
            self.relay.replica.narrow(forgotten, keep_removals=True)


def check_name(what: str, name: str, pattern: str, letters: str) -> str:
    """Return a name; raises `ValueError` if it does not match a pattern, which the error tells as `letters`."""
    if len(name) > _LONGEST_NAME or not re.fullmatch(pattern, name, re.ASCII):
        raise ValueError(f"{what} is made of {letters}, {_LONGEST_NAME} at most, not {name!r}")
    return name
