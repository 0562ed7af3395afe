"""The domain is one replicated map, and each bus holds a copy of it, which its links share.

The map
-------
Frame -> the *entry* of the highest rank: a sample, static or the newest moving one, or a removal. A rank is the number
and the origin of the batch or removal (see `tfbus.links.relay`). So of two entries all buses keep the same one, in any
order of arrival: a last-writer-wins map (Shapiro, Preguica, Baquero and Zawirski, "Conflict-free replicated data
types", 2011). Every bus that holds an entry can pass it on, not only its author. The copy also holds entries that its
bus refuses, or hides because their bus is lost.

A link sees the map by *views*. One is of the frames that the links of its own robot bring, with all that comes from
its bus; it is told to others. One more is of the frames that the links of each other robot bring. Every view has a
digest of its entries. A frame stays in a view whatever link brings it later.

The *newest* moving sample is the one that was published last. A buffer orders samples by their stamps instead, which
is the same unless a program publishes an older stamp later. Then the map holds the older stamp: so a recording that is
played again, and a simulation that starts again, reach the buses that join later.

Messages
--------
Live messages carry samples and removals as they happen. They are numbered, and never repeated. The other messages below
find and fetch missing entries; kinds and layout are in `tfbus.links.message`.

========  =========  ==========================================================================================
message   to         content
========  =========  ==========================================================================================
live      a channel  batches and removals, with the number of the message
sign      a channel  a sign of life: the number of the newest live message, the sequence and digest of the copy,
                     and which buses are reached by other links
meeting   one link   a sign, and the frames that the sender itself brings to the domain, unless they are many
question  one link   a request for the changes of a copy since a sequence (and the frames that the asker wants)
answer    one link   entries, the sequence up to which they are complete, and whether that is the newest
========  =========  ==========================================================================================

Each bus numbers the changes of its copy: its *sequence* (as Syncthing does). An entry is *settled* once it has not
changed for `SETTLING`; a static sample, a removal, and what an answer has told are settled at once. The digest is over
settled entries, so a frame that moves many times a second does not make copies differ.

1. A sign with the digest of one's own copy needs nothing: what that copy holds up to its sequence is here. Nor does a
   sign whose digest differs as after the last full answer: that copy has older entries, and nobody tells it the newer
   ones, as where two robots do not hear each other and use one frame name.
   A copy of some frames only is compared over these, once its link has asked for them.
2. If the digests differ, and the sequence in the sign is beyond the last one seen of that copy, the link asks the peer
   a little later, if they differ still. If a number is missing among its live messages, the link asks the peer soon.
3. A link with unread messages puts its questions off, because the missing entries may be among them. Otherwise busy
   links would make each other busier.
4. A link asks one question at a time. Answers are bounded, and the next question begins where the last answer ended.
   After an answer without news, the next question to that peer waits twice as long.
5. A link that starts asks the first one that it meets for all at once. Its signs say so until it has all answers, and
   others ask it meanwhile only if that takes long: most of what it has by then came from them.

So all copies agree some seconds after any trouble, without one digest for each peer and without a leader.

Present, stale, lost
--------------------
A link is *present* if the wire has announced it. Its frames are *stale* if no new samples of them come, which their
ages show; a stopped or busy process is only stale. A link is *lost* if the wire says so: on one machine by the end of
its socket, over a router by the end of its token. No entry leaves the map then, because others may hear the process, or
it may come back. A link with ``drop_lost`` removes the frames of a bus from its own bus while no route leads there, and
restores them from its copy when one does. So both settings agree on the map: without ``drop_lost`` a bus shows the
newest entry of every frame, for late joiners too; with it, only the frames of reachable buses.

A route may lead over a bus with two links. The signs of such a bus list the buses that it reaches by its other links,
each with the buses on the route, so that no link takes a route that leads back through itself (a path vector, as in
BGP, RFC 4271).
"""

import os
from bisect import bisect_left, bisect_right, insort
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from itertools import groupby
from math import inf
from operator import attrgetter
from random import uniform
from typing import Any, ClassVar, NamedTuple, Self

from tfbus.geometry.stamped import TransformStamped, shifted
from tfbus.geometry.uncertain import UncertainSample, with_belief
from tfbus.rows import Row

SETTLING = 1.5
"""s; a frame that moves less often than that is in the digests between its samples."""
CHUNK = 500
"""The most entries in one answer."""
MOST_REMOVALS = 10_000
"""The most removals that are remembered, those of the highest ranks."""
MANY_ORIGINS = 20
"""All buses together may have this many times the frames of one bus."""
MOST_REMEMBERED = 1_000
"""The most lost peers whose last known sequences are remembered."""
PATIENCE = 3.0
"""s; the longest wait for an answer."""
LONGEST_DELAY = 10.0
"""s after which a link with unread messages asks one of the questions that it has put off."""
_LONGEST_PAUSE = 60.0
_PAUSE_OF_UNKNOWN = 4.0
"""s; the longest pause before a filtered link asks a peer again that has not signed yet, for each such peer."""
_ASK_AGAIN = 30.0
_SPARE = 1_000
_NEVER = -inf

Rank = tuple[int, bytes]
"""Number and origin. Of two things that are said of one frame, the one of the higher rank holds."""
LOWEST: Rank = (-1, b"")


# Statements


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
    clock : int or None
        The base of the clock that stamped them, against this machine's steady clock, in ns: see `tfbus.links.clocks`.
    shift : int
        The ns by which the stamps of its moving samples were corrected.
    """

    origin: bytes
    sequence: int
    samples: Sequence[TransformStamped]
    clock: int | None = None
    shift: int = 0

    @property
    def size(self) -> int:
        """The number of its samples."""
        return len(self.samples)

    def within(self, frames: Collection[str] | None) -> "OutgoingBatch | None":
        """The part of it that is about some frames; None if it has none."""
        if frames is None:
            return self
        samples = tuple(sample for sample in self.samples if sample.child in frames)
        return OutgoingBatch(self.origin, self.sequence, samples, self.clock, self.shift) if samples else None

    def uncorrected(self) -> Sequence[TransformStamped]:
        """Its samples with the stamps that their sender gave them."""
        return [shifted(sample, -self.shift) for sample in self.samples] if self.shift else self.samples


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


@dataclass(eq=False, slots=True)
class Provenance:
    """The source of a batch or removal.

    Attributes
    ----------
    origin : bytes
        The bus on which it was published first, 16 bytes.
    sequence : int
        Its number on that bus; later ones have higher numbers.
    outbox : Outbox or None
        The link that brought it, which does not send it back. None for this bus's own.
    peer : Peer or None
        The other end of that link; None for this bus's own.
    told : int or None
        The base of the clock that stamped its samples, as the peer has told it.
    clock : int or None
        The same, as in `OutgoingBatch`; None if it is not known.
    shift : int
        The ns by which the stamps of its moving samples were corrected.
    """

    origin: bytes
    sequence: int
    outbox: object | None = None
    peer: object | None = None
    told: int | None = None
    clock: int | None = None
    shift: int = 0

    @property
    def rank(self) -> Rank:
        """Of two things that were said of a frame, the one of the higher rank holds."""
        return self.sequence, self.origin


class FromLink(TransformStamped):
    """A sample that came over a link; equal to one that did not."""

    __slots__ = ()
    _provenance: Provenance

    def again(self, source: Provenance) -> Self:
        """The same from its source once more, so that its fields may change."""
        again = type(self).__new__(type(self))
        again._fields, again._provenance = self._fields, source  # type: ignore[misc]
        again._take(self)
        return again


class ReceivedTransform(FromLink):
    """A sample without a covariance."""

    __slots__ = ("_provenance",)

    def __reduce__(self) -> tuple[Any, ...]:
        # A copy in another process has not come over this link.
        return TransformStamped, (self.parent, self.child, self.stamp, self.transform, self.authority, self.static)


class ReceivedUncertain(FromLink, UncertainSample):
    """A sample with a covariance."""

    __slots__ = ("_provenance",)

    def __reduce__(self) -> tuple[Any, ...]:
        return with_belief, (TransformStamped.replace(self), self.belief)


def received(sample: TransformStamped) -> FromLink:
    """A sample as one that came over a link."""
    kind = ReceivedTransform if sample._is_plain else ReceivedUncertain
    found = kind.__new__(kind)
    found._fields = sample._fields
    found._take(sample)
    return found


class ReceivedBatch(OutgoingBatch):
    """A batch as it came in; the provenance of its samples is not set yet."""

    __slots__ = ()
    samples: list[FromLink]


# The map


@dataclass(eq=False, slots=True)
class Known:
    """The newest statement on one frame, a sample or a removal, and what the bus has heard of the frame.

    Attributes
    ----------
    frame : str
    source : Provenance
        Its rank is that of the entry.
    sample : TransformStamped or None
        None if the frame was removed.
    views : tuple of View
        The views that have it; they only grow, so that all buses agree on them.
    route : tuple of View
        The views to which the last statement was added.
    shown : Provenance or None
        The source of the newest sample on the bus; None while the bus does not show the frame.
    floor : Rank
        The rank of the newest static sample or removal: no sample before it is news.
    numbers : dict of bytes to int
        The newest number that each origin has given a sample which was published here, and under b"" the highest of the
        forgotten origins.
    passed : dict or None
        The newest samples that went over the bus, beside a world without origins.
    sequence : int
        The number of the change; 0 while it has none.
    digest : int
        Its part of the digests; 0 until it has settled.
    """

    frame: str
    source: Provenance
    sample: TransformStamped | None
    views: "tuple[View, ...]" = ()
    route: "tuple[View, ...]" = ()
    shown: Provenance | None = None
    floor: Rank = LOWEST
    numbers: dict[bytes, int] = field(default_factory=dict)
    passed: dict[tuple[str, int, Row | None], None] | None = None
    sequence: int = 0
    digest: int = 0


def as_told(entries: Iterable[Known]) -> list[Entry]:
    """Some entries as they go into a message, in their order: a batch for each run of samples of one source."""
    told: list[Entry] = []
    for source, run in groupby(entries, attrgetter("source")):
        samples = []
        for known in run:
            if known.sample is None:
                told.append(RemovedFrame(source.origin, source.sequence, known.frame))
            else:
                samples.append(known.sample)
        if samples:
            told.append(OutgoingBatch(source.origin, source.sequence, samples, source.clock, source.shift))
    return told


class Claim(NamedTuple):
    """The state of the sender's copy, in a sign or an answer.

    Attributes
    ----------
    since, sequence : int
        An answer tells all changes behind `since` up to `sequence`.
    digest : int
        The digest of the copy at `sequence`; 0 in an answer if `final` is not set.
    final : bool
        Whether `sequence` is the newest; in a sign, whether the sender has fetched all answers.
    """

    since: int
    sequence: int
    digest: int
    final: bool = True


class TooManyEntriesError(ValueError):
    """A bus, or all together, has more frames than a copy holds."""


class Replica:
    """The copy of the map that a bus holds, for all its links.

    Attributes
    ----------
    origin : bytes
        The name of the bus for others: 16 random bytes.
    entries : dict of str to Known
    sequence : int
        The number of the newest change.
    """

    def __init__(self) -> None:
        self.origin = os.urandom(16)
        self.entries: dict[str, Known] = {}
        self.sequence = 0
        # How many frames each origin has, this bus too: a stranger may speak in its name.
        self._held: Counter[bytes] = Counter()
        # Their sum, because a peer may tell of as many origins as frames.
        self._taken = 0
        # The removals in the order of their ranks.
        self._removals: list[tuple[Rank, str]] = []
        # Frames whose entries have changed since the last claim and are to settle first.
        self._fresh: dict[str, None] = {}
        self._unsettled: dict[str, float] = {}
        # The changes in their order, and their sequences; a frame that has changed again since has a higher one. A list
        # of pairs would give the garbage collector one more object for each frame.
        self._log: list[Known] = []
        self._sequences: list[int] = []

    def note(
        self,
        frame: str,
        source: Provenance,
        sample: TransformStamped | None,
        route: "tuple[View, ...]" = (),
        *,
        max_frames: float = inf,
        settles: bool = False,
    ) -> bool:
        """Take in an entry, if it is of a higher rank than the known one; returns whether it was.

        Parameters
        ----------
        frame : str
        source : Provenance
        sample : TransformStamped or None
            None for a removal.
        route : tuple of View
            The views to which this brings the frame.
        max_frames : float
            How many frames one origin may have.
        settles : bool
            Whether the entry may change again in a moment: it is a live sample of a moving frame.

        Raises
        ------
        TooManyEntriesError
            If its bus, or all together, has too many frames.
        """
        known = self.entries.get(frame)
        is_new = known is None or source.sequence > known.source.sequence or self._replaces(source, sample, known)
        if is_new:
            is_same = known is not None and known.source.origin == source.origin and known.sample is not None
            if not is_same or sample is None:
                self._admit(source.origin, known, sample, max_frames)
            if known is None:
                known = self.entries[frame] = Known(frame, source, sample)
            else:
                known.source, known.sample = source, sample
        assert known is not None
        if route is not known.route and (is_new or source.rank == known.source.rank):
            known.route = route
            self.widen(known, route)
        if not is_new:
            return False
        if settles:
            self._fresh[frame] = None
            return True
        # Numbered at once, because a hundred thousand entries at the next claim would take a turn of seconds.
        self._fresh.pop(frame, None)
        self._unsettled.pop(frame, None)
        self._number(known, settled=True)
        if sample is None or sample.static:
            known.floor = source.rank
        if sample is None:
            insort(self._removals, (source.rank, frame))
            if len(self._removals) > MOST_REMOVALS:
                # The removal of the lowest rank goes, so that all copies forget the same ones.
                self.discard(self.entries[self._removals[0][1]])
        return True

    def go_on(self, source: Provenance, samples: "Sequence[FromLink]", route: "tuple[View, ...]") -> int:
        """Take in the first samples of a live batch, as far as they only continue moving frames of the batch's origin.

        Most samples do. This has the effect of `note`, and the samples are news for the bus. The view has their frames
        already, because its route has brought the known samples.

        Returns
        -------
        int
            How many were taken in.
        """
        entries, fresh = self.entries, self._fresh
        origin, sequence = source.origin, source.sequence
        for count, sample in enumerate(samples):
            child = sample.child
            known = entries.get(child)
            if sample.static or known is None or known.sample is None or known.passed or known.route is not route:
                return count
            last = known.source
            if last.origin != origin or last.sequence >= sequence:
                return count
            known.source, known.sample = source, sample
            fresh[child] = None
        return len(samples)

    def widen(self, known: Known, views: "Iterable[View]") -> None:
        """Let an entry be in some views too."""
        new = (*[view for view in views if view not in known.views and view.holds(known.frame)],)
        if new:
            # Most entries share the tuple of their route, for the garbage collector looks at each.
            is_route = not known.views and new == known.route
            known.views = known.route if is_route else known.views + new
            for view in new:
                view.digest ^= known.digest
            if known.sequence:
                self._number(known)

    def narrow(self, views: "Collection[View]", keep_removals: bool) -> None:
        """Forget some views, and the entries that neither a view has nor the bus shows."""
        for known in list(self.entries.values()):
            known.views, known.route = tuple(view for view in known.views if view not in views), ()
            if not (known.views or known.shown or (keep_removals and known.sample is None)):
                self.discard(known)

    def discard(self, known: Known) -> None:
        """Forget an entry."""
        self._release(known)
        self._weigh(known, 0)
        del self.entries[known.frame]
        known.sequence = 0
        self._fresh.pop(known.frame, None)
        self._unsettled.pop(known.frame, None)

    def changes(self, since: int, now: float) -> Iterator[Known]:
        """The entries that have changed behind a sequence, the oldest changes first, settled or not."""
        self.settle(now)
        for frame in self._unsettled:
            # Numbered now for the order of this answer, and again when it settles, for the links without this answer.
            if not self.entries[frame].sequence:
                self._number(self.entries[frame])
        log, sequences = self._log, self._sequences
        places = range(bisect_right(sequences, since), len(log))
        return (log[place] for place in places if log[place].sequence == sequences[place])

    def settle(self, now: float) -> None:
        """Number the settled changes, and take the unsettled ones out of the digests."""
        for frame in self._fresh:
            known = self.entries[frame]
            self._weigh(known, 0)
            known.sequence = 0
            self._unsettled.pop(frame, None)
            self._unsettled[frame] = now
        self._fresh.clear()
        while self._unsettled:
            frame = next(iter(self._unsettled))
            if now - self._unsettled[frame] < SETTLING:
                break
            del self._unsettled[frame]
            self._number(self.entries[frame], settled=True)

    @staticmethod
    def _replaces(source: Provenance, sample: TransformStamped | None, known: Known) -> bool:
        if source.sequence != known.source.sequence or source.origin != known.source.origin:
            return source.rank > known.source.rank
        before = known.sample
        if sample is None or before is None:
            return False
        if not (sample.static or before.static):
            # Two moving samples of one batch, by the stamps that its sender gave them.
            newer = (sample.stamp - source.shift) - (before.stamp - known.source.shift)
            if newer:
                return newer > 0
        # Otherwise the last one of the batch holds, as on its own bus; the same one again is not new.
        return (sample.parent, sample._row, sample.static) != (before.parent, before._row, before.static)

    def _admit(self, origin: bytes, known: Known | None, sample: TransformStamped | None, max_frames: float) -> None:
        """Count a new entry in place of a known one."""
        if sample is not None:
            taken = self._taken - self._held[self.origin]
            if self._held[origin] >= max_frames or taken >= MANY_ORIGINS * max_frames:
                raise TooManyEntriesError(f"the peer has announced more than {max_frames} frames")
            self._held[origin] += 1
            self._taken += 1
        if known is not None:
            self._release(known)

    def _release(self, known: Known) -> None:
        """Count an entry no more."""
        origin = known.source.origin
        if known.sample is None:
            del self._removals[bisect_left(self._removals, (known.source.rank, known.frame))]
        else:
            self._held[origin] -= 1
            self._taken -= 1
            if not self._held[origin]:
                del self._held[origin]

    def _number(self, known: Known, settled: bool = False) -> None:
        self.sequence += 1
        known.sequence = self.sequence
        self._log.append(known)
        self._sequences.append(self.sequence)
        if len(self._log) > 2 * len(self.entries) + _SPARE:
            log = zip(self._log, self._sequences, strict=True)
            self._log = [known for known, sequence in log if known.sequence == sequence]
            self._sequences = [known.sequence for known in self._log]
        if settled:
            rank = b"%b%d %d " % (known.source.origin, known.source.sequence, known.sample is None)
            digest = hash_bytes(rank + known.frame.encode("utf-8", "surrogatepass"), 8)
            self._weigh(known, int.from_bytes(digest, "little"))

    def _weigh(self, known: Known, digest: int) -> None:
        change, known.digest = known.digest ^ digest, digest
        for view in known.views:
            view.digest ^= change


class View:
    """The part of the map that a link tells to others, or that the links of a robot bring by it.

    Parameters
    ----------
    replica : Replica
    frames : frozenset of str or None
        Other frames are not in it; None for all.

    Attributes
    ----------
    digest : int
        The digest of its settled entries.
    route : tuple of View
        The views that get the samples of this one: itself, and the views that the other links tell.
    """

    def __init__(self, replica: Replica, frames: frozenset[str] | None = None) -> None:
        self._replica = replica
        self._frames = frames
        self.digest = 0
        self.route: tuple[View, ...] = (self,)

    def holds(self, frame: str) -> bool:
        """Whether a frame may be in it."""
        return self._frames is None or frame in self._frames

    def claim(self, now: float, frames: Collection[str] | None = None) -> Claim:
        """The sequence and the digest of the view, or of the part of it that is about some frames."""
        self._replica.settle(now)
        digest = self.digest
        if frames is not None:
            digest = 0
            for known in filter(None, map(self._replica.entries.get, frames)):
                if self in known.views:
                    digest ^= known.digest
        return Claim(self._replica.sequence, self._replica.sequence, digest)

    def changes(
        self, since: int, now: float, frames: Collection[str] | None = None, limit: int = CHUNK
    ) -> tuple[list[Entry], Claim]:
        """The oldest changes behind a sequence, and the claim that goes with them.

        A sequence that the copy has not reached gives the beginning of all that it holds: a claim since 0. Entries that
        have not settled are among the changes.
        """
        if since > self._replica.sequence:
            since = 0
        found: list[Known] = []
        for known in self._replica.changes(since, now):
            if self in known.views and (frames is None or known.frame in frames):
                found.append(known)
                if len(found) == limit and known.sequence < self._replica.sequence:
                    return as_told(found), Claim(since, known.sequence, 0, final=False)
        return as_told(found), self.claim(now, frames)._replace(since=since)

    def brought(self, outbox: object) -> Iterator[Known]:
        """The frames of it that a link itself brings to the domain: they came from the bus, and not by this link."""
        for known in self._replica.entries.values():
            if known.sample is not None and known.source.outbox is not outbox and self in known.views:
                yield known


def hash_bytes(data: bytes, size: int) -> bytes:
    """The BLAKE2b hash (RFC 7693) of some bytes, the same in every process; `size` is its own, from 1 to 64 bytes."""
    return blake2b(data, digest_size=size).digest()


# The questions


@dataclass(eq=False, slots=True)
class _Copy:
    """The copy of one peer, as far as it is known.

    Attributes
    ----------
    view : View
        The own view that is to agree with it.
    seen : int
        All changes up to this sequence are here.
    must_ask : bool
    frames : collection of str or None
        The frames of the copy, if it has only some.
    claim : Claim or None
    due : float
        The time of the next question.
    again : float
        The time of the next question if no sign comes before: the peer may not serve the filter.
    urgent : bool
        Whether the question is not put off.
    missed : bool
        Whether live messages are missing.
    fetches : bool
        Whether the last answer was not the whole one.
    fruitless, silences : int
        Answers without news, and questions without an answer, one after the other.
    differs : int
        The difference of the digests after an answer with all that the peer had: entries that are older than the own
        ones, and that nobody tells the peer, as where it is a robot that does not hear another one with its frames.
    """

    view: View
    seen: int
    must_ask: bool
    frames: Collection[str] | None = None
    claim: Claim | None = None
    due: float = inf
    again: float = inf
    urgent: bool = False
    missed: bool = False
    fetches: bool = False
    fruitless: int = 0
    silences: int = 0
    differs: int = 0


class Question(NamedTuple):
    """A question that is due: the changes in the copy of a peer since a sequence."""

    peer: str
    since: int


class Agreement:
    """Decides which peer a link asks next, so that its copies come to agree with the copies of its peers; see above.

    Nothing here knows an event loop: the caller hands in each time, in s of a monotonic clock.
    """

    def __init__(self) -> None:
        self._copies: dict[str, _Copy] = {}
        self._remembered: dict[str, tuple[View, int]] = {}
        self._asked: Question | None = None
        self._patience = _NEVER
        # The time at which one of the questions that were put off is asked.
        self._latest = inf
        self._is_new = True

    @property
    def fetches(self) -> bool:
        """Whether a peer tells its copy in several answers, and the last one has not come yet."""
        return any(copy.fetches for copy in self._copies.values())

    def joined(self, peer: str, view: View, now: float, must_ask: bool = False) -> None:
        """Begin to follow the copy of a peer; it has to be asked if this is the first one, or if the caller says so."""
        remembered, seen = self._remembered.pop(peer, (view, 0))
        self._copies[peer] = copy = _Copy(view, seen if remembered is view else 0, must_ask)
        if self._is_new or must_ask:
            self._is_new = False
            copy.due, copy.missed, copy.urgent = now, True, True

    def filters(self, peer: str, frames: Collection[str]) -> None:
        """Note that the copy of a peer has only these frames, which the own copy has too."""
        copy = self._copies.get(peer)
        if copy is not None:
            copy.frames = frames

    def left(self, peer: str) -> None:
        """Follow the copy of a peer no more."""
        copy = self._copies.pop(peer, None)
        if copy is not None and copy.seen:
            self._remembered[peer] = copy.view, copy.seen
            if len(self._remembered) > MOST_REMEMBERED:
                del self._remembered[next(iter(self._remembered))]
        if self._asked is not None and self._asked.peer == peer:
            self._asked = None
            self._is_new = self._is_new or not any(other.seen for other in self._copies.values())

    def told(self, peer: str, claim: Claim, now: float, soon: bool = False) -> None:
        """Take the claim in a sign of a peer; with `soon`, ask for missing entries at once."""
        copy = self._copies.get(peer)
        if copy is None:
            return
        if copy.claim is not None and claim.sequence < copy.claim.sequence:
            return
        copy.claim = claim
        copy.again = now + _ASK_AGAIN if copy.must_ask else inf
        if copy.silences:
            # The peer was stopped or cut off, and speaks again.
            copy.silences = 0
            copy.due = min(copy.due, now + uniform(0.05, 0.2))
        if not copy.missed and self._agrees(copy, now):
            copy.seen, copy.due, copy.fruitless, copy.fetches = claim.sequence, inf, 0, False
        elif claim.sequence > copy.seen:
            if not claim.final:
                # Most of what the peer still fetches is here. Its next sign comes soon, unless the fetching never ends.
                pause, soon = LONGEST_DELAY, False
            elif soon:
                pause = 0.0
            else:
                pause = min(uniform(0.3, 0.7) * 2**copy.fruitless, _LONGEST_PAUSE)
            copy.due, copy.urgent = min(copy.due, now + pause), copy.urgent or soon

    def missed(self, peer: str, now: float) -> None:
        """Note that live messages of a peer are missing."""
        copy = self._copies.get(peer)
        if copy is not None:
            copy.missed = True
            copy.due = min(copy.due, now + uniform(0.05, 0.2))

    def answered(self, peer: str, claim: Claim, news: bool, now: float) -> None:
        """Take the claim of an answer, after its entries were noted."""
        copy, asked = self._copies.get(peer), self._asked
        if copy is None or asked is None or asked.peer != peer or claim.since not in (0, asked.since):
            return
        self._asked = None
        if not claim.final and claim.sequence <= (copy.seen if claim.since else 0):
            # An answer that leads nowhere.
            self._fail(copy, now)
            return
        copy.fetches = not claim.final
        copy.seen = claim.sequence
        copy.due, copy.urgent = now, True
        copy.again = now + _ASK_AGAIN if copy.must_ask else inf
        if claim.final:
            copy.due, copy.urgent, copy.missed, copy.claim, copy.silences = inf, False, False, claim, 0
            copy.differs = self._difference(copy, claim, now)
            copy.fruitless = min(copy.fruitless + 1, 10) if copy.differs and not news else 0

    def unanswered(self, peer: str, now: float) -> None:
        """Note that a peer has not answered."""
        copy = self._copies.get(peer)
        if self._asked is not None and self._asked.peer == peer:
            self._asked = None
            if copy is not None:
                self._fail(copy, now)

    def question(self, now: float, is_behind: bool = False) -> Question | None:
        """The question to ask now; None if there is none, or an answer is awaited.

        Parameters
        ----------
        now : float
        is_behind : bool
            Whether the link has unread messages.
        """
        if self._asked is not None:
            if now < self._patience:
                return None
            self.unanswered(self._asked.peer, now)
        if is_behind and now < self._latest:
            self._latest = min(self._latest, now + LONGEST_DELAY)
            for copy in self._copies.values():
                if copy.due <= now and not copy.urgent:
                    copy.due = now + uniform(0.1, 0.2)
        while True:
            peer = min(self._copies, key=self._due_of, default=None)
            if peer is None or self._due_of(peer) > now:
                return None
            copy = self._copies[peer]
            again = copy.again <= now
            copy.due = copy.again = inf
            if not copy.urgent:
                self._latest = inf
            copy.urgent = False
            if again or copy.missed or not self._agrees(copy, now):
                self._asked, self._patience = Question(peer, copy.seen), now + PATIENCE
                return self._asked
            copy.seen = max(copy.seen, 0 if copy.claim is None else copy.claim.sequence)
            copy.fetches = False

    def rests(self, peer: str, now: float) -> bool:
        """Whether the copies agree and no question to a peer is open, so that the same sign again needs no work."""
        copy = self._copies.get(peer)
        return (
            copy is not None
            and copy.due == copy.again == inf
            and not (copy.missed or copy.silences)
            and (self._asked is None or self._asked.peer != peer)
            and self._agrees(copy, now)
        )

    def next_due(self) -> float:
        """The time at which `question` has to be called next."""
        if self._asked is not None:
            return self._patience
        return min(map(self._due_of, self._copies), default=inf)

    def _agrees(self, copy: _Copy, now: float) -> bool:
        return copy.claim is not None and self._difference(copy, copy.claim, now) in (0, copy.differs)

    @staticmethod
    def _difference(copy: _Copy, claim: Claim, now: float) -> int:
        return claim.digest ^ copy.view.claim(now, copy.frames).digest

    def _fail(self, copy: _Copy, now: float) -> None:
        copy.fetches = False
        copy.silences = min(copy.silences + 1, 10)
        copy.missed = True
        longest = _LONGEST_PAUSE
        if copy.must_ask and copy.claim is None:
            # The peer may not know the filter; then it signs on no channel that this link hears.
            longest = min(longest, _PAUSE_OF_UNKNOWN * sum(each.claim is None for each in self._copies.values()))
        copy.due = now + min(uniform(0.3, 0.7) * 2**copy.silences, longest)

    def _due_of(self, peer: str) -> float:
        copy = self._copies[peer]
        return min(copy.due, copy.again)
