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
the relay remembers the newest samples of each child, and takes the same one for news only once.

Outgoing samples gather in the outbox of each link until the turn of the event loop ends.

The relay also counts the ways to each bus, its *reach*: a link with `drop_lost` withdraws the frames of a bus that is
not reached any more. They are not removed: see `tfbus.links.replica`.
"""

import os
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from math import inf
from time import time_ns
from typing import Any, ClassVar

from tfbus.bus.bus import Bus
from tfbus.bus.subscribers import SeenKeys
from tfbus.errors import UnknownFrameError
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.registration import Registration
from tfbus.rows import Row

LARGEST_JUMP = 2**52
"""A number may be so far ahead of this machine's time: 142 years in us, for some machines begin in 1970."""
MANY_PEERS = 20
"""The frames of all peers together may be so many times the frames of one."""
MOST_ORIGINS = 8
"""The most origins whose numbers are remembered for each frame."""
_REMEMBERED = 10_000
_PER_CHILD = 256
_GONE_CHILDREN = 1_000
REMEMBERED_REASONS = 100

Rank = tuple[int, bytes]
"""Number and origin. Of two things that are said of one frame, the one of the higher rank holds."""
LOWEST: Rank = (-1, b"")


@dataclass(eq=False, slots=True)
class OutgoingBatch:
    """Samples of one batch and one origin, as they go out.

    Attributes
    ----------
    origin : bytes
        The bus on which the batch was published first, 16 bytes.
    sequence : int
        The batch's number on that bus.
    samples : sequence of TransformStamped
    """

    origin: bytes
    sequence: int
    samples: Sequence[TransformStamped]

    @property
    def size(self) -> int:
        """The number of its samples."""
        return len(self.samples)

    def within(self, frames: Collection[str] | None) -> "OutgoingBatch | None":
        """The part of it that is about some frames; None if it has none."""
        if frames is None:
            return self
        samples = tuple(sample for sample in self.samples if sample._fields[1] in frames)
        return OutgoingBatch(self.origin, self.sequence, samples) if samples else None


@dataclass(frozen=True, slots=True)
class RemovedFrame:
    """A frame was removed, by the batch number `sequence` of the bus `origin`."""

    origin: bytes
    sequence: int
    frame: str
    size: ClassVar[int] = 1

    def within(self, frames: Collection[str] | None) -> "RemovedFrame | None":
        """The removal itself if it is of one of some frames; None if not."""
        return self if frames is None or self.frame in frames else None


Entry = OutgoingBatch | RemovedFrame


@dataclass(slots=True)
class Turn:
    """All that one turn of the event loop has published and removed.

    Attributes
    ----------
    entries : list of OutgoingBatch or RemovedFrame
        In the order in which it happened.
    statics : dict of str to TransformStamped or None
        The static frames whose state for late joiners has changed, for networks that keep messages for these: the
        newest sample of each, or None if the frame is not to be kept any more.
    time : int or None
        The time of the clock that the link tells, in ns, if it has to be told. A turn may have nothing else.
    """

    entries: list[Entry]
    statics: dict[str, TransformStamped | None]
    time: int | None = None


class Outbox:
    """The sending half of a link, in which batches and removals gather until the turn of the event loop ends.

    Parameters
    ----------
    frames : iterable of str or None
        The children that go out and come in; None for all.

    Attributes
    ----------
    frames : frozenset of str or None
    pending : int
        How many samples and removals wait to go out.
    """

    keeps_withdrawn = False
    """Whether the other ends see for themselves that the owner of a frame was lost."""

    def __init__(self, frames: Iterable[str] | None) -> None:
        self.frames: frozenset[str] | None = None if frames is None else frozenset(frames)
        self.pending: int = 0
        self._entries: list[Entry] = []

    def add(self, published: Entry, echo: bool = False, withdrawn: bool = False) -> None:
        """Add what was published or removed on the bus.

        Parameters
        ----------
        published : OutgoingBatch or RemovedFrame
        echo : bool
            Whether it came in by this very link, and does not go out.
        withdrawn : bool
            Whether a frame left this bus only because its owner was lost.
        """
        goes_out = not echo and not (withdrawn and self.keeps_withdrawn)
        entry = self.outgoing(published) if goes_out else published.within(self.frames)
        if entry is None:
            return
        if goes_out:
            self._entries.append(entry)
            self.pending += entry.size
        if self._follow(entry, goes_out) or goes_out:
            self._notify()

    def outgoing(self, entry: Entry) -> Entry | None:
        """The part of an entry that this link may send; None if it may send nothing of it."""
        return entry.within(self.frames)

    def keep(self, entry: Entry) -> None:
        """Note an entry that another link knows and this bus does not show, for peers that show it."""

    def kept(self) -> Iterable[Entry]:
        """The entries that this link knows, for another link that begins later."""
        return ()

    def ways(self) -> Iterable[tuple[bytes, tuple[bytes, ...]]]:
        """The buses that the peers of this link lead to, each with the buses on the way there."""
        return ()

    def reach_changed(self) -> None:
        """The buses that this one reaches by other links have changed."""

    def _notify(self) -> None:
        """Note that the outbox has something to send."""
        raise NotImplementedError

    def _follow(self, entry: Entry, goes_out: bool) -> bool:
        """Note for late joiners what was published or removed; returns whether anything changes for these.

        It does not go out if the other ends know it: it came from them, or they see that an owner was lost.
        """
        raise NotImplementedError


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
    rate: float = inf
    thinned: float = -inf
    number: int = 0
    news: bool = False
    authorities: set[str] = field(default_factory=set)
    authority_text: int = 0
    frames: set[str] = field(default_factory=set)
    paths: dict[bytes, tuple[bytes, ...]] = field(default_factory=dict)
    reported: SeenKeys = field(default_factory=lambda: SeenKeys(REMEMBERED_REASONS))


@dataclass(eq=False, slots=True)
class Provenance:
    """The source of a received batch or removal.

    Attributes
    ----------
    origin : bytes
        The bus on which it was published first, 16 bytes.
    sequence : int
        Its number on that bus; later ones have higher numbers.
    outbox : Outbox or None
        The outbox of the link that brought it, which does not send it back. None for this bus's own.
    peer : Peer or None
        The other end of that link; None for this bus's own.
    """

    origin: bytes
    sequence: int
    outbox: Outbox | None = None
    peer: Peer | None = None

    @property
    def rank(self) -> Rank:
        """Of two things that were said of a frame, the one of the higher rank holds."""
        return self.sequence, self.origin


class ReceivedTransform(TransformStamped):
    """A sample that came over a link; equal to one that did not."""

    __slots__ = ("_provenance",)
    _provenance: Provenance

    def __reduce__(self) -> tuple[Any, ...]:
        # A copy in another process has not come over this link.
        return TransformStamped, (self.parent, self.child, self.stamp, self.transform, self.authority, self.static)


@dataclass(eq=False, slots=True)
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

    samples: list[ReceivedTransform]
    authorities: Collection[str]
    origin: bytes | None = None
    sequence: int = 0


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
    origin : bytes
        The name of this bus for others: 16 random bytes.
    """

    def __init__(self, bus: Bus) -> None:
        self.origin: bytes = os.urandom(16)
        self._number = 0
        self._bus = bus
        self._registration: Registration | None = None
        self._outboxes: list[Outbox] = []
        # The newest number that each origin has given a frame, and under b"" the highest of the forgotten origins.
        self._newest: dict[str, dict[bytes, int]] = {}
        self._latest: dict[str, Provenance] = {}
        self._settled: dict[str, Rank] = {}
        self._removed: dict[str, Rank] = {}
        self._removing: tuple[str, Provenance | None] | None = None
        self._ways: Counter[bytes] = Counter()
        self._passed: PassedSamples | None = None

    def attach(self, outbox: Outbox, foreign: bool = False) -> None:
        """Give a link the latched samples, the entries of the other links, and all samples from now on.

        Parameters
        ----------
        outbox : Outbox
        foreign : bool
            Whether it is a link to a world whose samples have no origin.

        Raises
        ------
        BusClosedError
        """
        if (foreign or self._outboxes) and self._passed is None:
            # A bus with two links may hear a sample that has gone through a world without origins by either.
            self._passed = PassedSamples()
        if self._registration is None:
            self._registration = self._bus.subscribe(self._on_batch, self._on_removal)
        for other in self._outboxes:
            for entry in other.kept():
                outbox.keep(entry)
        self._bus.subscribe(lambda batch: self._send_latched(batch, outbox)).close()
        self._outboxes.append(outbox)

    def detach(self, outbox: Outbox) -> None:
        """Give a link nothing any more."""
        self._outboxes.remove(outbox)
        for latest in self._latest.values():
            if latest.outbox is outbox:
                # Otherwise the frame would keep the link in memory.
                latest.outbox = latest.peer = None
        if not self._outboxes:
            self._removed.clear()
            self._passed = None

    def clock_jumped_back(self) -> None:
        """Take samples with the stamps of earlier ones for news."""
        if self._passed is not None:
            self._passed.forget_moving()

    def is_plausible(self, number: int) -> bool:
        """Whether a number may be one that a bus has given by now.

        The time bounds it, not the newest number: else some thousand jumps would lead to the end of all numbers.
        """
        return number - time_ns() // 1_000 <= LARGEST_JUMP

    # Samples and removals of peers

    def publish(
        self, received: Iterable[tuple[Provenance, Iterable[ReceivedTransform]]], max_frames: int
    ) -> tuple[int, int]:
        """Publish those samples of some received batches that are news, as one batch.

        Parameters
        ----------
        received : iterable of (Provenance, iterable of ReceivedTransform)
            All of one peer.
        max_frames : int
            How many frames one peer may have; all together may have `MANY_PEERS` times as many.

        Returns
        -------
        published, refused : int
            The numbers of samples that were published, and that were refused because they would add too many frames.
            All other samples were no news.
        """
        news: list[ReceivedTransform] = []
        refused = 0
        for provenance, samples in received:
            refused += self._find_news(provenance, samples, MANY_PEERS * max_frames, news)
        if news:
            self._bus.publish(news, invalid="drop")
        return len(news), refused

    def publish_foreign(
        self, outbox: Outbox, peer: Peer, samples: Iterable[ReceivedTransform], max_frames: int
    ) -> tuple[int, int]:
        """Publish a batch of a world that has neither origins nor numbers; what went over this bus before is no news.

        The batch gets this bus as its origin and the next number of this bus. It goes out by all links but the one that
        brought it, whose outbox is `outbox`. Parameters and results are those of `publish`, but for `max_frames`, which
        bounds the frames of the peer.
        """
        provenance = Provenance(self.origin, self._next_number(), outbox, peer)
        assert self._passed is not None
        admitted: list[ReceivedTransform] = []
        refused = 0
        for sample in samples:
            if sample in self._passed:
                continue
            if sample.child in peer.frames or len(peer.frames) < max_frames:
                peer.frames.add(sample.child)
                admitted.append(sample)
            else:
                refused += 1
        published, beyond = self.publish([(provenance, admitted)], max_frames)
        return published, refused + beyond

    def remove(self, provenance: Provenance, frame: str) -> None:
        """Remove a frame from the bus, unless something newer was said of it."""
        self._number = max(self._number, provenance.sequence)
        latest = self._latest.get(frame)
        newest = self._newest.get(frame, {}).get(provenance.origin, -1)
        if (
            newest < provenance.sequence
            and provenance.rank > self._removed.get(frame, LOWEST)
            and (latest is None or provenance.rank > latest.rank)
        ):
            self._remove_from_bus(frame, provenance)

    def lose_foreign(self, peer: Peer, outbox: Outbox, drop: bool) -> tuple[str, ...]:
        """Forget a peer of a world without origins; returns the frames that it was the last to bring, sorted.

        With `drop`, this bus removes these frames, for it has answered for them.
        """
        frames = tuple(sorted(frame for frame, latest in self._latest.items() if latest.peer is peer))
        if drop:
            for frame in frames:
                latest = self._latest.get(frame)
                # A subscriber that hears of one removal may have removed or published others, or closed the bus.
                if not self._bus.closed and latest is not None and latest.peer is peer:
                    self._remove_from_bus(frame, Provenance(self.origin, self._next_number(), outbox, peer))
                    if self._passed is not None:
                        # The next peer may bring the frame unchanged.
                        self._passed.forget(frame)
        return frames

    # Reach

    def reaches(self, origin: bytes) -> bool:
        """Whether a bus is reached on any way; this one always is."""
        return origin == self.origin or self._ways[origin] > 0

    def way_opened(self, origin: bytes) -> None:
        """Count one more way to a bus."""
        self._ways[origin] += 1

    def way_closed(self, origin: bytes) -> bool:
        """Count one way less to a bus; returns whether that was the last one."""
        self._ways[origin] -= 1
        if self._ways[origin] > 0:
            return False
        del self._ways[origin]
        return True

    def reach_besides(self, outbox: Outbox) -> dict[bytes, tuple[bytes, ...]]:
        """The buses that other links than this one lead to, each with the buses on the shortest way there."""
        found: dict[bytes, tuple[bytes, ...]] = {}
        for other in self._outboxes:
            if other is not outbox:
                for origin, path in other.ways():
                    if origin not in found or len(path) < len(found[origin]):
                        found[origin] = path
        return found

    def reach_changed(self, outbox: Outbox) -> None:
        """Let the other links than this one know that they have to tell a new reach."""
        for other in self._outboxes:
            if other is not outbox:
                other.reach_changed()

    def frames_of(self, origins: Collection[bytes]) -> list[str]:
        """The frames on the bus whose newest sample is of one of some buses, sorted."""
        return sorted(frame for frame, latest in self._latest.items() if latest.origin in origins)

    def mask(self, provenance: Provenance, samples: Sequence[TransformStamped]) -> None:
        """Withdraw frames whose newest samples are of a lost bus, until it or another bus brings them again."""
        self._number = max(self._number, provenance.sequence)
        for outbox in self._outboxes:
            if outbox is not provenance.outbox:
                outbox.keep(OutgoingBatch(provenance.origin, provenance.sequence, samples))
        frames = sorted({sample.child for sample in samples})
        for frame in frames:
            latest = self._latest.get(frame)
            if not self._bus.closed and latest is not None and latest.rank < provenance.rank:
                self._remove_from_bus(frame, None)

    def withdraw(self, frames: Iterable[str], origins: Collection[bytes]) -> None:
        """Take frames off this bus whose newest samples are of some buses; other buses are not told."""
        for frame in frames:
            latest = self._latest.get(frame)
            # A subscriber may have changed things meanwhile.
            if not self._bus.closed and latest is not None and latest.origin in origins:
                self._remove_from_bus(frame, None)

    # Inside

    def _find_news(
        self,
        provenance: Provenance,
        samples: Iterable[ReceivedTransform],
        most_frames: int,
        news: list[ReceivedTransform],
    ) -> int:
        """Append the news of one batch to `news`; returns how many samples would add too many frames."""
        refused, before = 0, len(news)
        sequence, origin = provenance.sequence, provenance.origin
        self._number = max(self._number, sequence)
        rank = provenance.rank
        passed, settled, removed, is_own = self._passed, self._settled, self._removed, origin == self.origin
        for sample in samples:
            child, static = sample.child, sample.static
            # A static one has to be ranked, so that all buses agree in the end.
            if passed is not None and not static and sample in passed:
                continue
            if (child in settled or child in removed or static or is_own) and self._is_outranked(sample, rank):
                continue
            numbers = self._newest.get(child)
            if numbers is None:
                if len(self._newest) >= most_frames:
                    refused += 1
                    continue
                numbers = self._newest[child] = {}
            known = numbers.get(origin)
            if (numbers.get(b"", -1) if known is None else known) >= sequence:
                continue
            sample._provenance = provenance
            news.append(sample)
        # Other samples of the batch may be of the same child.
        for sample in news[before:] if before else news:
            numbers = self._newest[sample.child]
            numbers[origin] = sequence
            if len(numbers) > MOST_ORIGINS:
                oldest = min(filter(None, numbers), key=numbers.__getitem__)
                numbers[b""] = max(numbers.pop(oldest), numbers.get(b"", -1))
        return refused

    def _remove_from_bus(self, frame: str, provenance: Provenance | None) -> None:
        self._removing = frame, provenance
        try:
            self._bus.remove_frame(frame)
        except UnknownFrameError:
            # The frame was never on this bus, or was forgotten when its clock jumped back; the other buses have it.
            self._on_removal(frame)
        finally:
            self._removing = None

    def _on_batch(self, batch: Batch) -> None:
        self._pass_on(batch, _provenance_of, self._outboxes)

    def _send_latched(self, batch: Batch, outbox: Outbox) -> None:
        def known(sample: TransformStamped) -> Provenance | None:
            return _provenance_of(sample) or self._latest.get(sample.child)

        self._pass_on(batch, known, [outbox])

    def _pass_on(
        self, batch: Batch, known: Callable[[TransformStamped], Provenance | None], outboxes: Iterable[Outbox]
    ) -> None:
        """Note the samples of a batch, and give them to some links."""
        for provenance, group in groupby(batch, known):
            if provenance is None:
                provenance = Provenance(self.origin, self._next_number())
            samples = tuple(group)
            for sample in samples:
                child = sample.child
                if self._passed is not None:
                    self._passed.add(sample)
                latest = self._latest.get(child)
                # A sample of another bus that is late does not make the frame its own.
                if latest is None or latest.sequence < provenance.sequence or latest.rank < provenance.rank:
                    self._latest[child] = provenance
                if sample.static:
                    self._settled[child] = provenance.rank
            outgoing = OutgoingBatch(provenance.origin, provenance.sequence, samples)
            for outbox in outboxes:
                outbox.add(outgoing, echo=outbox is provenance.outbox)

    def _on_removal(self, frame: str) -> None:
        if self._removing is not None and self._removing[0] == frame:
            provenance = self._removing[1]
        else:
            provenance = Provenance(self.origin, self._next_number()) if self._outboxes else None
        latest = self._latest.pop(frame, None)
        self._settled.pop(frame, None)
        self._newest.pop(frame, None)
        if self._passed is not None:
            # A withdrawn sample may come again unchanged.
            (self._passed.forget if provenance is None else self._passed.retire)(frame)
        if provenance is not None:
            self._removed.pop(frame, None)
            self._removed[frame] = provenance.rank
            if len(self._removed) > _REMEMBERED:
                del self._removed[next(iter(self._removed))]
            removal = RemovedFrame(provenance.origin, provenance.sequence, frame)
            for outbox in self._outboxes:
                if latest is not None or outbox.keeps_withdrawn:
                    outbox.add(removal, echo=outbox is provenance.outbox)
        elif latest is not None:
            withdrawal = RemovedFrame(latest.origin, latest.sequence, frame)
            for outbox in self._outboxes:
                outbox.add(withdrawal, echo=outbox is latest.outbox, withdrawn=True)

    def _is_outranked(self, sample: ReceivedTransform, rank: Rank) -> bool:
        """Whether a higher rank holds: of a removal or a static sample; for a static or own sample, of any."""
        _, child, _, _, _, static = sample._fields
        if rank < self._settled.get(child, LOWEST) or rank < self._removed.get(child, LOWEST):
            return True
        latest = self._latest.get(child)
        return (static or rank[1] == self.origin) and latest is not None and rank <= latest.rank

    def _next_number(self) -> int:
        self._number = max(self._number + 1, time_ns() // 1_000)
        return self._number


def relay_of(bus: Bus) -> Relay:
    """The relay of a bus, which its links share; the bus itself holds it."""
    if not isinstance(bus._relay, Relay):
        bus._relay = Relay(bus)
    return bus._relay


def _provenance_of(sample: TransformStamped) -> Provenance | None:
    return sample._provenance if type(sample) is ReceivedTransform else None


_Key = tuple[str, int, Row | None]


class PassedSamples:
    """Remembers the newest samples of each child that went over a bus, whichever way.

    A sample is known by its child, parent, stamp and kind; a static one by its value as well, for many are stamped
    zero. A moving one with another value is the same sample, as it is for tf2.

    Parameters
    ----------
    per_child : int
        How many samples of a child are remembered; then the oldest are forgotten.
    gone_children : int
        How many children that have left the bus are remembered.
    """

    def __init__(self, per_child: int = _PER_CHILD, gone_children: int = _GONE_CHILDREN) -> None:
        self._per_child = per_child
        self._gone_children = gone_children
        self._keys: dict[str, dict[_Key, None]] = {}
        self._gone: dict[str, None] = {}

    def __contains__(self, sample: TransformStamped) -> bool:
        parent, child, stamp, row, _, static = sample._fields
        known = self._keys.get(child)
        return known is not None and (parent, stamp, row if static else None) in known

    def add(self, sample: TransformStamped) -> None:
        """Remember a sample."""
        parent, child, stamp, row, _, static = sample._fields
        known = self._keys.get(child)
        if known is None:
            known = self._keys[child] = {}
        elif child in self._gone:
            del self._gone[child]
        key = parent, stamp, row if static else None
        # A sample that passes again is as new as any.
        known.pop(key, None)
        known[key] = None
        if len(known) > self._per_child:
            del known[next(iter(known))]

    def forget(self, child: str) -> None:
        """Forget all samples of a child."""
        self._keys.pop(child, None)
        self._gone.pop(child, None)

    def retire(self, child: str) -> None:
        """Keep the samples of a child that has left the bus, until many more have left: copies may come late."""
        if child not in self._keys:
            return
        self._gone.pop(child, None)
        self._gone[child] = None
        if len(self._gone) > self._gone_children:
            self.forget(next(iter(self._gone)))

    def forget_moving(self) -> None:
        """Forget all moving samples, because the clock has jumped back and their stamps may come once more."""
        for child, known in list(self._keys.items()):
            kept = {key: None for key in known if key[2] is not None}
            if kept:
                self._keys[child] = kept
            else:
                self.forget(child)
