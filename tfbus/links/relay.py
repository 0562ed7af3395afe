"""The relay of a bus, which all its links share: it passes samples on between them, and no sample goes round.

Every batch is numbered by the bus on which it was published first, its *origin*. The same batch may arrive on several
ways, for a bus with two links passes samples on between them. So a sample is news only if its number is
higher than that of the newest sample of the same origin and child; then no ring of buses has an echo. For each child,
the numbers of `MOST_ORIGINS` origins are remembered, and the highest number of all others.

The number of a batch is the machine's time in microseconds, or one more than the highest number that the bus has seen
of any origin, whichever is higher (a hybrid logical clock: Kulkarni, Demirbas, Madappa, Avva and Leone, "Logical
physical clocks", 2014). So of two statements on one frame, such as a static sample and a removal, the later one has the
higher number and holds on every bus, in whatever order they arrive: also if the two buses were parted, as far as the
clocks of their machines agree, and if a program was started again. Somebody who makes up a sample of this bus with a
higher number is heard like anybody else, and this bus numbers on above it.

Batches of a world that has no origins, such as ROS, get this bus as their origin. Such a world gives samples back that
it was sent, by another link of this bus or by another bus, without a mark. So while a link to such a world is attached,
or two links of any kind, the relay remembers the newest samples of each child, and takes the same one for news only
once: it knows a sample by its child, parent, stamp and kind, and a static one by its value as well, for many are
stamped zero.

Outgoing samples gather in the outbox of each link until the turn of the event loop ends.

The relay also counts the ways to each bus, its *reach*: a link with `drop_lost` withdraws the frames of a bus that is
not reached any more. They are not removed: see `tfbus.links.replica`.
"""

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import groupby
from math import inf
from time import time_ns

from tfbus.bus.bus import Bus
from tfbus.bus.subscribers import SeenKeys
from tfbus.errors import UnknownFrameError
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.links.clocks import OwnClock
from tfbus.links.message import can_hold, sendable
from tfbus.links.replica import Entry, FromLink, Known, OutgoingBatch, Provenance, RemovedFrame, Replica, View
from tfbus.links.seams import Host
from tfbus.registration import Registration
from tfbus.rows import Row
from tfbus.stamps import format_duration, format_stamp

LARGEST_JUMP = 2**52
"""A number may be so far ahead of this machine's time: 142 years in us, for some machines begin in 1970."""
MOST_ORIGINS = 8
"""The most origins whose numbers are remembered for each frame."""
MOST_PASSED = 256
"""The most samples of a frame that are remembered beside a world without origins."""
_PASSED_OF_GONE = 32
REMEMBERED_REASONS = 100


class Outbox:
    """The sending half of a link, in which batches and removals gather until the turn of the event loop ends.

    Parameters
    ----------
    frames : iterable of str or None
        The children that go out and come in; None for all.

    Attributes
    ----------
    host : Host
        Set by the link before anything is called.
    frames : frozenset of str or None
    pending : int
        How many samples and removals wait to go out.
    views : dict of str to View
        The frames that the links of each robot bring by this link.
    own : View or None
        The view of them that this link tells; None if it tells no entries, because its world has no origins.
    max_offset : float
        Clocks that differ by so many ns at most are near enough.
    """

    host: Host
    own: View | None = None
    max_offset: float = inf

    def __init__(self, frames: Iterable[str] | None) -> None:
        self.frames: frozenset[str] | None = None if frames is None else frozenset(frames)
        self.pending: int = 0
        self.views: dict[str, View] = {}
        self._entries: list[Entry] = []

    def add(self, published: Entry, echo: bool) -> None:
        """Add what was published or removed on the bus; an echo came in by this very link, and does not go out."""
        entry = None if echo else self.outgoing(published)
        if entry is not None:
            self._entries.append(entry)
            self.pending += entry.size
            self.host.send_soon(self.pending)

    def outgoing(self, entry: Entry) -> Entry | None:
        """The part of an entry that this link may send; None if it may send nothing of it."""
        return entry.within(self.frames)

    def ways(self) -> Iterable[tuple[bytes, tuple[bytes, ...]]]:
        """The buses that the peers of this link lead to, each with the buses on the way there."""
        return ()

    def reach_changed(self) -> None:
        """The buses that this one reaches by other links have changed."""


@dataclass(eq=False, slots=True)
class Peer:
    """The other end of a link, as far as this end knows it.

    Attributes
    ----------
    id : str
    present : bool
        Whether it has announced that it is there.
    robot : str
        The robot whose link it is; empty without one.
    is_placed : bool
        Whether its clock has been measured, or cannot be.
    rate : float
        How often newest samples are wanted of it, in Hz; infinite for everything, 0 for nothing.
    thinned : float
        The time of the newest samples that it has sent by such a rate, in s.
    number : int
        The number of its newest live message; 0 before the first.
    news : bool
        Whether a message of it that is being handled has brought news.
    authorities : set of str
        The authorities whose samples it has sent.
    authority_text : int
        The letters of these.
    frames : set of str
        The frames that it was the first to bring from a world without origins; their number is limited.
    paths : dict of bytes to tuple of bytes
        The buses that are reached through it, its own among them, each with the buses on the way there.
    reported : SeenKeys
        The reasons of refusals that were reported.
    """

    id: str
    present: bool = False
    robot: str = ""
    is_placed: bool = False
    rate: float = inf
    thinned: float = -inf
    number: int = 0
    news: bool = False
    authorities: set[str] = field(default_factory=set)
    authority_text: int = 0
    frames: set[str] = field(default_factory=set)
    paths: dict[bytes, tuple[bytes, ...]] = field(default_factory=dict)
    reported: SeenKeys = field(default_factory=lambda: SeenKeys(REMEMBERED_REASONS))


class Relay:
    """Passes samples and removals between one bus and its links.

    There is one relay a bus, from `relay_of`. It begins with the first link, and goes on after the last one: a later
    link publishes nothing that an earlier one has published, and sends the frames of the bus with the numbers that they
    have. Only removals are forgotten, because the later link may be to another domain.

    Parameters
    ----------
    bus : Bus

    Attributes
    ----------
    replica : Replica
    clock : OwnClock
    """

    def __init__(self, bus: Bus) -> None:
        self.replica: Replica = Replica()
        self.clock: OwnClock = OwnClock(bus.clock)
        self._number = 0
        self._bus = bus
        self._registration: Registration | None = None
        self._outboxes: list[Outbox] = []
        # The views to which all that this bus says itself is added.
        self._route: tuple[View, ...] = ()
        self._removing: tuple[str, Provenance | None] | None = None
        self._reached: set[bytes] = set()
        self._remembers = False
        self._process = os.getpid()

    def attach(self, outbox: Outbox) -> None:
        """Give a link the latched samples, the entries of the other links, and all samples from now on.

        Raises
        ------
        BusClosedError
        RuntimeError
            In a child made by `fork`: its copy and that of the parent have one origin, and each would take what the
            other says for its own.
        """
        if self._process != os.getpid():
            raise RuntimeError(
                "this process was forked since a link of the bus was made: make the bus and its links in the child"
            )
        # A bus with two links may hear a sample that has gone through a world without origins by either.
        self._remembers = self._remembers or outbox.own is None or bool(self._outboxes)
        if self._registration is None:
            self._registration = self._bus.subscribe(self._on_batch, self._on_removal)
        self._outboxes.append(outbox)
        self.route()
        if outbox.own is not None:
            for known in self.replica.entries.values():
                if known.views or (known.sample is not None and can_hold(known.sample)):
                    self.replica.widen(known, [outbox.own])
        self._bus.subscribe(lambda batch: self._send_latched(batch, outbox)).close()

    def detach(self, outbox: Outbox) -> None:
        """Give a link nothing any more."""
        self._outboxes.remove(outbox)
        self.route()
        self.replica.narrow(outbox.views.values(), keep_removals=bool(self._outboxes))
        self._remembers = self._remembers and bool(self._outboxes)
        for known in self.replica.entries.values():
            if not self._remembers:
                known.passed = None
            for source in (known.source, known.shown):
                if source is not None and source.outbox is outbox:
                    # Otherwise the frame would keep the link in memory.
                    source.outbox = source.peer = None

    def route(self) -> None:
        """Route the samples of each view to other views anew, because links or views have come or gone."""
        own = [(outbox, outbox.own) for outbox in self._outboxes if outbox.own is not None]
        self._route = tuple(view for _, view in own)
        for outbox in self._outboxes:
            others = [view for other, view in own if other is not outbox]
            for view in outbox.views.values():
                view.route = view, *others

    def clock_jumped_back(self) -> None:
        """Take samples with the stamps of earlier ones for news."""
        for known in self.replica.entries.values():
            known.passed = {key: None for key in known.passed or () if key[2] is not None} or None

    def is_plausible(self, number: int) -> bool:
        """Whether a number may be one that a bus has given by now.

        The time bounds it, not the newest number: else some thousand jumps would lead to the end of all numbers.
        """
        return number - time_ns() // 1_000 <= LARGEST_JUMP

    def next_number(self) -> int:
        """A number for what this bus says itself."""
        self._number = max(self._number + 1, time_ns() // 1_000)
        return self._number

    def heard(self, number: int) -> None:
        """Give higher numbers than this from now on."""
        self._number = max(self._number, number)

    # Samples and removals of peers

    def is_news(self, known: Known, sample: TransformStamped, source: Provenance) -> bool:
        """Whether the bus has not heard a sample before, and shows nothing newer that rules it out."""
        static, rank, shown = sample.static, source.rank, known.shown
        # A static one has to be ranked, so that all buses agree in the end.
        if rank < known.floor or (known.passed and not static and _key(sample) in known.passed):
            return False
        if shown is not None and (static or source.origin == self.replica.origin) and rank <= shown.rank:
            return False
        number = known.numbers.get(source.origin)
        return (known.numbers.get(b"", -1) if number is None else number) < source.sequence

    def admit(self, news: Iterable[FromLink], source: Provenance) -> None:
        """Take the news of one batch for heard, which are to be published next."""
        for sample in news:
            sample._provenance = source  # type: ignore[misc]
            numbers = self.replica.entries[sample.child].numbers
            numbers[source.origin] = source.sequence
            if len(numbers) > MOST_ORIGINS:
                oldest = min(filter(None, numbers), key=numbers.__getitem__)
                numbers[b""] = max(numbers.pop(oldest), numbers.get(b"", -1))

    def has_passed(self, sample: TransformStamped) -> bool:
        """Whether a sample of a world without origins went over this bus before."""
        known = self.replica.entries.get(sample.child)
        return known is not None and known.passed is not None and _key(sample) in known.passed

    def remove(self, frame: str, source: Provenance | None) -> None:
        """Remove a frame from the bus for a peer, or with None withdraw it: other buses are not told of that."""
        self._removing = frame, source
        try:
            self._bus.remove_frame(frame)
        except UnknownFrameError:
            # The frame was never on this bus, or was forgotten when its clock jumped back; the other buses have it.
            self._on_removal(frame)
        finally:
            self._removing = None

    # Reach

    def reaches(self, origin: bytes) -> bool:
        """Whether a bus is reached on any way; this one always is."""
        return origin == self.replica.origin or origin in self._reached

    def reach_changed(self, outbox: Outbox) -> tuple[set[bytes], set[bytes]]:
        """The buses that the changed ways of a link reach newly, and the buses that are no longer reached."""
        before = self._reached
        self._reached = {origin for one in self._outboxes for origin, _ in one.ways()}
        for other in self._outboxes:
            if other is not outbox:
                # It tells them to its peers.
                other.reach_changed()
        return self._reached - before, before - self._reached

    def reach_besides(self, outbox: Outbox) -> dict[bytes, tuple[bytes, ...]]:
        """The buses that other links than this one lead to, each with the buses on the shortest way there."""
        ways = (way for other in self._outboxes if other is not outbox for way in other.ways())
        return dict(sorted(ways, key=lambda way: len(way[1]), reverse=True))

    def frames_of(self, owns: Callable[[Provenance], bool]) -> tuple[str, ...]:
        """The frames on the bus whose newest sample has such a source, sorted."""
        entries = self.replica.entries.values()
        return tuple(sorted(known.frame for known in entries if known.shown is not None and owns(known.shown)))

    def take_off(
        self,
        owns: Callable[[Provenance], bool],
        removal: Callable[[], Provenance | None] = lambda: None,
        *,
        moving: bool = False,
    ) -> tuple[str, ...]:
        """Withdraw or remove the frames whose newest samples have such a source; returns them, sorted.

        Parameters
        ----------
        owns : callable
        removal : callable
            Returns the source of each removal; by default None, to withdraw the frames.
        moving : bool
            Whether static frames stay.
        """
        gone = []
        for frame in self.frames_of(owns):
            known = self.replica.entries.get(frame)
            # A subscriber may have changed things meanwhile.
            is_there = not self._bus.closed and known is not None and known.shown is not None and owns(known.shown)
            if known is not None and is_there and not (moving and known.sample is not None and known.sample.static):
                self.remove(frame, removal())
                # It may come again unchanged.
                known.passed = None
                gone.append(frame)
        return tuple(gone)

    def clock_of(self, frame: str) -> str:
        """The clock that stamps a frame beside this bus's, in words; empty if they agree, or that is not known."""
        known = self.replica.entries.get(frame)
        source = None if known is None else known.shown
        own = self.clock.base()
        if known is None or known.sample is None or source is None or source.clock is None or own is None:
            return ""
        ahead = source.clock - own
        if not isinstance(source.outbox, Outbox) or abs(ahead) <= source.outbox.max_offset:
            return ""
        clock = f"its clock runs {format_duration(abs(ahead))} {'ahead of' if ahead > 0 else 'behind'} this one"
        return f"{clock}, and stamped {format_stamp(known.sample.stamp - source.shift)}" if source.shift else clock

    # Inside

    def _on_batch(self, batch: Batch) -> None:
        self._pass_on(batch, _source_of, self._outboxes)

    def _send_latched(self, batch: Batch, outbox: Outbox) -> None:
        def source_of(sample: TransformStamped) -> Provenance | None:
            known = self.replica.entries.get(sample.child)
            return _source_of(sample) or (None if known is None else known.shown)

        self._pass_on(batch, source_of, [outbox])

    def _pass_on(
        self, batch: Batch, source_of: Callable[[TransformStamped], Provenance | None], outboxes: Iterable[Outbox]
    ) -> None:
        """Note the samples of a batch, and give them to some links."""
        entries = self.replica.entries
        for source, group in groupby(batch, source_of):
            if source is None:
                source = Provenance(self.replica.origin, self.next_number(), clock=self.clock.base())
            samples = tuple(group)
            for sample in samples:
                child = sample.child
                known = entries.get(child)
                # A link has noted what it brings.
                if known is None or known.source is not source or source.outbox is None:
                    fits = can_hold(sample)
                    # Other buses keep the last sample that a message can hold, and this copy keeps it for them.
                    if known is None or fits or not known.views:
                        route = self._route if fits else ()
                        self.replica.note(child, source, sample, route, settles=not sample.static)
                        known = entries[child]
                if self._remembers:
                    _remember(known, sample)
                # A sample of another bus that is late does not make the frame its own.
                shown = known.shown
                if shown is None or shown.sequence < source.sequence or shown.rank < source.rank:
                    known.shown = source
            outgoing = OutgoingBatch(source.origin, source.sequence, samples, source.clock, source.shift)
            for outbox in outboxes:
                outbox.add(outgoing, echo=outbox is source.outbox)

    def _on_removal(self, frame: str) -> None:
        known = self.replica.entries.get(frame)
        shown = None
        if known is not None:
            shown, known.shown = known.shown, None
            known.numbers.clear()
        if not self._outboxes:
            if known is not None:
                self.replica.discard(known)
            return
        if self._removing is None or self._removing[0] != frame:
            source: Provenance | None = Provenance(self.replica.origin, self.next_number())
        else:
            source = self._removing[1]
        if source is None:
            if known is not None and shown is not None:
                # A withdrawn sample may come again unchanged.
                known.passed = None
                for outbox in self._outboxes:
                    # The other ends of a link of tfbus see for themselves that the owner was lost.
                    if outbox.own is None:
                        outbox.add(RemovedFrame(shown.origin, shown.sequence, frame), outbox is shown.outbox)
            return
        removal = RemovedFrame(source.origin, source.sequence, frame)
        if known is None or known.source is not source:
            # The outboxes report one that cannot be sent.
            self.replica.note(frame, source, None, self._route if sendable(removal, lambda *_: None) else ())
        if known is not None and known.passed:
            # Copies of the last samples may come late.
            known.passed = dict.fromkeys(list(known.passed)[-_PASSED_OF_GONE:])
        for outbox in self._outboxes:
            if shown is not None or outbox.own is not None:
                outbox.add(removal, echo=outbox is source.outbox)


def relay_of(bus: Bus) -> Relay:
    """The relay of a bus, which its links share; the bus itself holds it."""
    if not isinstance(bus._relay, Relay):
        relay = bus._relay = Relay(bus)
        bus._clock_namers.append(relay.clock_of)
    return bus._relay


def _source_of(sample: TransformStamped) -> Provenance | None:
    return sample._provenance if isinstance(sample, FromLink) else None


def _key(sample: TransformStamped) -> tuple[str, int, Row | None]:
    return sample.parent, sample.stamp, sample._row if sample.static else None


def _remember(known: Known, sample: TransformStamped) -> None:
    """Remember that a sample has passed; one that passes again is as new as any."""
    key = _key(sample)
    passed = known.passed = known.passed or {}
    passed.pop(key, None)
    passed[key] = None
    if len(passed) > MOST_PASSED:
        del passed[next(iter(passed))]
