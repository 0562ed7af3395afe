"""The domain is one replicated map, and each link holds a copy of it.

The map
-------
Frame -> the *entry* of the highest rank: a sample, static or the newest moving one, or a removal. A rank is the number
and the origin of the batch or removal (see `tfbus.links.relay`). So of two entries all links keep the same one, in any
order of arrival: a last-writer-wins map (Shapiro, Preguica, Baquero and Zawirski, "Conflict-free replicated data
types", 2011). Every link that holds an entry can pass it on, not only its author. The copy also holds entries that its
bus refuses.

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

Each copy numbers its own changes: its *sequence* (as Syncthing does). An entry is *settled* once it has not changed for
`SETTLING`; a static sample, a removal, and what an answer has told are settled at once. The digest is over settled
entries, so a frame that moves many times a second does not make copies differ.

1. A sign with the digest of one's own copy needs nothing: what that copy holds up to its sequence is here.
   A copy of some frames only is compared over these, once its link has asked for them.
2. If the digests differ, and the sequence in the sign is beyond the last one seen of that copy, the link asks the peer
   a little later, if they differ still. If a number is missing among its live messages, the link asks the peer soon.
3. A link with unread messages puts its questions off, because the missing entries may be among them. Otherwise busy
   links would make each other busier.
4. A link asks one question at a time. Answers are bounded, and the next question begins where the last answer ended.
   After an answer without news, the next question to that peer waits twice as long.
5. A link that starts asks the first one that it meets for all at once.

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

import heapq
from bisect import bisect_right
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from math import inf
from random import uniform
from typing import NamedTuple

try:
    # hashlib has it too, but loads OpenSSL for others, which takes 0.6 MB of each process with a link.
    from _blake2 import blake2b
except ImportError:  # A Python that has it elsewhere.
    from hashlib import blake2b

from tfbus.geometry.stamped import TransformStamped
from tfbus.links.relay import Entry, OutgoingBatch, Rank, RemovedFrame

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


@dataclass(eq=False, slots=True)
class Known:
    """The newest statement on one frame: a sample or a removal.

    Attributes
    ----------
    frame : str
    number, origin
        The rank.
    sample : TransformStamped or None
        None if the frame was removed.
    ours : bool
        Whether this link brings it to the domain: it came from the bus, and not by this link.
    sequence : int
        The number of the change; 0 while it has none.
    digest : int
        Its part of the digest; 0 until it has settled.
    """

    frame: str
    number: int
    origin: bytes
    sample: TransformStamped | None
    ours: bool
    sequence: int = 0
    digest: int = 0

    @property
    def told(self) -> Entry:
        """As it goes into a message."""
        if self.sample is None:
            return RemovedFrame(self.origin, self.number, self.frame)
        return OutgoingBatch(self.origin, self.number, (self.sample,))


class Claim(NamedTuple):
    """The state of the sender's copy, in a sign or an answer.

    Attributes
    ----------
    since, sequence : int
        An answer tells all changes behind `since` up to `sequence`.
    digest : int
        The digest of the copy at `sequence`; 0 if `final` is not set.
    final : bool
        Whether `sequence` is the newest.
    partial : bool
        Whether the sender's copy has only some frames.
    """

    since: int
    sequence: int
    digest: int
    final: bool = True
    partial: bool = False


class TooManyEntriesError(ValueError):
    """A bus, or all together, has more frames than a copy holds."""


@dataclass(eq=False, slots=True)
class Places:
    """The room that all copies of one link have together.

    Attributes
    ----------
    max_frames : int
        How many frames one origin may have.
    held : Counter
        How many frames each origin has, except the own one.
    taken, removals : int
        How many frames and removals there are.
    """

    max_frames: int
    held: Counter[bytes] = field(default_factory=Counter)
    taken: int = 0
    removals: int = 0


class Replica:
    """One copy of the map.

    Parameters
    ----------
    max_frames : int
        How many frames one origin may have, but for the own one.
    own : bytes
        The own origin.
    places : Places, optional
        Shared by the copies of one link.

    Attributes
    ----------
    entries : dict of str to Known
    """

    def __init__(self, max_frames: int, own: bytes, places: Places | None = None) -> None:
        self._places = Places(max_frames) if places is None else places
        self._own = own
        self.entries: dict[str, Known] = {}
        # A heap of the removals, the lowest ranks first; a removal stays in it for a while after a newer entry.
        self._removals: list[tuple[Rank, str]] = []
        self._removed = 0
        # Frames whose entries have changed since the last claim and are to settle first.
        self._fresh: dict[str, None] = {}
        self._unsettled: dict[str, float] = {}
        # The changes in their order; a frame that has changed again since has a higher sequence.
        self._log: list[tuple[int, Known]] = []
        self._digest = 0
        self._sequence = 0

    def note(
        self, frame: str, rank: Rank, sample: TransformStamped | None, *, ours: bool = False, settles: bool = False
    ) -> bool:
        """Take in an entry, if it is of a higher rank than the known one; returns whether it was.

        Parameters
        ----------
        frame : str
        rank : (int, bytes)
        sample : TransformStamped or None
            None for a removal.
        ours : bool
        settles : bool
            Whether the entry may change again in a moment: it is a live sample of a moving frame.

        Raises
        ------
        TooManyEntriesError
            If its bus, or all together, has too many frames.
        """
        number, origin = rank
        known = self.entries.get(frame)
        if known is not None and number <= known.number and not self._replaces(rank, sample, known):
            return False
        was_removed = known is not None and known.sample is None
        if known is None or known.origin != origin or was_removed is not (sample is None):
            self._count(origin, known, sample)
            self._forgive(was_removed - (sample is None))
        if known is None:
            known = self.entries[frame] = Known(frame, number, origin, sample, ours)
        else:
            known.number, known.origin, known.sample, known.ours = number, origin, sample, ours
        if settles:
            self._fresh[frame] = None
        else:
            # Numbered at once, because a hundred thousand entries at the next claim would take a turn of seconds.
            self._fresh.pop(frame, None)
            self._unsettled.pop(frame, None)
            self._number(known, settled=True)
        if sample is None:
            heapq.heappush(self._removals, (rank, frame))
            if self._too_many_removals or len(self._removals) > 2 * MOST_REMOVALS:
                self._forget_removals()
        return True

    def claim(self, now: float, frames: Collection[str] | None = None) -> Claim:
        """The sequence and the digest of the copy, or of the part of it that is about some frames."""
        self._settle(now)
        digest = self._digest
        if frames is not None:
            digest = 0
            for known in filter(None, map(self.entries.get, frames)):
                digest ^= known.digest
        return Claim(self._sequence, self._sequence, digest)

    def changes(
        self, since: int, now: float, frames: Collection[str] | None = None, limit: int = CHUNK
    ) -> tuple[list[Entry], Claim]:
        """The oldest changes behind a sequence, and the claim that goes with them.

        A sequence that the copy has not reached gives the beginning of all that it holds: a claim since 0. Entries that
        have not settled are among the changes.
        """
        self._settle(now)
        for frame in self._unsettled:
            # Numbered now for the order of this answer, and again when it settles, for the links without this answer.
            if not self.entries[frame].sequence:
                self._number(self.entries[frame])
        if since > self._sequence:
            since = 0
        log: Iterable[tuple[int, Known]]
        if frames is None:
            log = islice(self._log, bisect_right(self._log, since, key=_first), None)
        else:
            log = sorted(((known.sequence, known) for known in map(self.entries.get, frames) if known), key=_first)
        found: list[Entry] = []
        for sequence, known in log:
            if sequence > since and known.sequence == sequence:
                found.append(known.told)
                if len(found) == limit and sequence < self._sequence:
                    return found, Claim(since, sequence, 0, final=False)
        return found, self.claim(now, frames)._replace(since=since)

    def ours(self, limit: int) -> list[Entry] | None:
        """All that this link brings to the domain; None if that is more than a limit."""
        ours = (known.told for known in self.entries.values() if known.ours and known.sample is not None)
        found = list(islice(ours, limit + 1))
        return None if len(found) > limit else found

    def told(self) -> Iterator[Entry]:
        """All entries."""
        return (known.told for known in self.entries.values())

    def moving(self) -> list[str]:
        """The moving frames that this link brings to the domain, sorted."""
        found = (known for known in self.entries.values() if known.ours and known.sample is not None)
        return sorted(known.frame for known in found if known.sample is not None and not known.sample.static)

    def _replaces(self, rank: Rank, sample: TransformStamped | None, known: Known) -> bool:
        if rank != (known.number, known.origin):
            return rank > (known.number, known.origin)
        # Two samples of one batch.
        return sample is not None and known.sample is not None and sample.stamp > known.sample.stamp

    def _count(self, origin: bytes, known: Known | None, sample: TransformStamped | None) -> None:
        if sample is not None and origin != self._own:
            held, most = self._places.held, self._places.max_frames
            if held.get(origin, 0) >= most or self._places.taken >= MANY_ORIGINS * most:
                raise TooManyEntriesError(f"the peer has announced more than {most} frames")
            held[origin] += 1
            self._places.taken += 1
        if known is not None and known.sample is not None:
            self._release(known.origin)

    def _release(self, origin: bytes) -> None:
        if origin != self._own:
            held = self._places.held
            held[origin] -= 1
            self._places.taken -= 1
            if not held[origin]:
                del held[origin]

    def forget(self) -> None:
        """Give all places to the other copies."""
        for entry in self.entries.values():
            if entry.sample is not None:
                self._release(entry.origin)
        self._forgive(self._removed)
        self.entries.clear()

    def _forgive(self, removals: int) -> None:
        """Count so many removals less."""
        self._removed -= removals
        self._places.removals -= removals

    @property
    def _too_many_removals(self) -> bool:
        return self._removed > MOST_REMOVALS or self._places.removals > MANY_ORIGINS * MOST_REMOVALS

    def _settle(self, now: float) -> None:
        """Number the settled changes, and take the unsettled ones out of the digest."""
        for frame in self._fresh:
            known = self.entries[frame]
            self._digest ^= known.digest
            known.digest = known.sequence = 0
            self._unsettled.pop(frame, None)
            self._unsettled[frame] = now
        self._fresh.clear()
        while self._unsettled:
            frame = next(iter(self._unsettled))
            if now - self._unsettled[frame] < SETTLING:
                break
            del self._unsettled[frame]
            self._number(self.entries[frame], settled=True)

    def _number(self, known: Known, settled: bool = False) -> None:
        self._sequence += 1
        known.sequence = self._sequence
        self._log.append((self._sequence, known))
        if len(self._log) > 2 * len(self.entries) + _SPARE:
            self._log = [(number, known) for number, known in self._log if known.sequence == number]
        if settled:
            rank = b"%b%d %d " % (known.origin, known.number, known.sample is None)
            digest = int.from_bytes(hash_bytes(rank + known.frame.encode("utf-8", "surrogatepass"), 8), "little")
            self._digest ^= digest ^ known.digest
            known.digest = digest

    def _forget_removals(self) -> None:
        """Forget the removals of the lowest ranks beyond the bound, so that all copies forget the same ones."""
        while self._removed and self._too_many_removals:
            rank, frame = heapq.heappop(self._removals)
            if self._is_removed(frame, rank):
                self._forgive(1)
                known = self.entries.pop(frame)
                self._digest ^= known.digest
                known.sequence = 0
                self._fresh.pop(frame, None)
                self._unsettled.pop(frame, None)
        if len(self._removals) > 2 * MOST_REMOVALS:
            self._removals = [(rank, frame) for rank, frame in self._removals if self._is_removed(frame, rank)]
            heapq.heapify(self._removals)

    def _is_removed(self, frame: str, rank: Rank) -> bool:
        entry = self.entries.get(frame)
        return entry is not None and entry.sample is None and (entry.number, entry.origin) == rank


def hash_bytes(data: bytes, size: int) -> bytes:
    """The BLAKE2b hash (RFC 7693) of some bytes, the same in every process; `size` is its own, from 1 to 64 bytes."""
    return blake2b(data, digest_size=size).digest()


def _first(logged: tuple[int, Known]) -> int:
    return logged[0]


@dataclass(eq=False, slots=True)
class _Copy:
    """The copy of one peer, as far as it is known.

    Attributes
    ----------
    replica : Replica
        The own copy that is to agree with it.
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
    fruitless, silences : int
        Answers without news, and questions without an answer, one after the other.
    """

    replica: Replica
    seen: int
    must_ask: bool
    frames: Collection[str] | None = None
    claim: Claim | None = None
    due: float = inf
    again: float = inf
    urgent: bool = False
    missed: bool = False
    fruitless: int = 0
    silences: int = 0


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
        self._remembered: dict[str, tuple[Replica, int]] = {}
        self._asked: Question | None = None
        self._patience = _NEVER
        # The time at which one of the questions that were put off is asked.
        self._latest = inf
        self._is_new = True

    def joined(self, peer: str, replica: Replica, now: float, must_ask: bool = False) -> None:
        """Begin to follow the copy of a peer; it has to be asked if this is the first one, or if the caller says so."""
        remembered, seen = self._remembered.pop(peer, (replica, 0))
        self._copies[peer] = copy = _Copy(replica, seen if remembered is replica else 0, must_ask)
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
            self._remembered[peer] = copy.replica, copy.seen
            if len(self._remembered) > MOST_REMEMBERED:
                del self._remembered[next(iter(self._remembered))]
        if self._asked is not None and self._asked.peer == peer:
            self._asked = None
            self._is_new = self._is_new or not any(other.seen for other in self._copies.values())

    def told(self, peer: str, claim: Claim, now: float, soon: bool = False) -> None:
        """Take the claim in a sign of a peer; with `soon`, ask for missing entries at once."""
        copy = self._copies.get(peer)
        if copy is None or (claim.partial and copy.frames is None):
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
            copy.seen, copy.due, copy.fruitless = claim.sequence, inf, 0
        elif claim.sequence > copy.seen:
            pause = 0.0 if soon else min(uniform(0.3, 0.7) * 2**copy.fruitless, _LONGEST_PAUSE)
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
        copy.seen = claim.sequence
        copy.due, copy.urgent = now, True
        copy.again = now + _ASK_AGAIN if copy.must_ask else inf
        if claim.final:
            copy.due, copy.urgent, copy.missed, copy.claim, copy.silences = inf, False, False, claim, 0
            copy.fruitless = 0 if news or self._agrees(copy, now) else min(copy.fruitless + 1, 10)

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
        return copy.claim is not None and copy.claim.digest == copy.replica.claim(now, copy.frames).digest

    def _fail(self, copy: _Copy, now: float) -> None:
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
