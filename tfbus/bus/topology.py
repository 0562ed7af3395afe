"""The newest edges of a bus, and the judgement of each batch before it is committed.

The newest edges must form a forest. The bus judges a batch by them before any buffer gets it, so that the sender learns
of a bad edge at once.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from copy import copy
from itertools import repeat
from operator import attrgetter
from typing import Literal, get_args

from tfbus.bus.ownership import Ownership
from tfbus.bus.subscribers import Announcer, OnceLogger
from tfbus.clock import Clock, SimulatedClock
from tfbus.errors import InvalidTransformError, TooManyFramesError
from tfbus.events import (
    AuthorityConflict,
    FrameAdded,
    FrameRemoved,
    KindChanged,
    Reparented,
    SampleRejected,
    StampAhead,
    StampBehind,
    how_far_behind,
)
from tfbus.geometry.stamped import Batch, TransformStamped, as_max_translation, is_within, not_physical
from tfbus.registration import Registration
from tfbus.stamps import (
    SECOND,
    STAMP_MAX,
    STAMP_MIN,
    as_duration,
    format_duration,
    format_stamp,
    from_seconds,
    likely_cause,
)
from tfbus.tree.cycles import NewestEdge, admit, changed_parents
from tfbus.tree.forest import KnownFrames, StaticFrames
from tfbus.which_kernel import Edge, Judge


class Plausibility:
    """Judges translations and stamps.

    Parameters
    ----------
    clock : Clock
    max_translation : float
        The greatest length of a translation, in m.
    max_ahead : float or None
        How far a stamp may be ahead of the clock, in s; None for any distance.
    reject_ahead : bool
        Whether samples that are further ahead are refused.
    max_behind : float or None
        How far the stamp of a moving sample may be behind the clock, in s; None for any distance.

    Raises
    ------
    TypeError, ValueError
        If `max_translation` is not greater than zero and at most 1e100, `max_ahead` or `max_behind` is not a duration,
        or `reject_ahead` comes without a `max_ahead`.

    Attributes
    ----------
    max_translation : float
    rejects_ahead : bool
    lasting : int
        In ns: for how long the plausible stamps are used before the clock is read again. A simulated clock reports its
        moves.
    """

    def __init__(
        self,
        clock: Clock,
        max_translation: float,
        max_ahead: float | None,
        reject_ahead: bool,
        max_behind: float | None = None,
    ) -> None:
        self.max_translation: float = as_max_translation(max_translation)
        self._max_ahead = _as_bound(max_ahead, "max_ahead")
        self._max_behind = _as_bound(max_behind, "max_behind")
        if reject_ahead and self._max_ahead is None:
            raise ValueError("reject_ahead needs a max_ahead: without one, no stamp is ahead of the clock")
        self.rejects_ahead = reject_ahead
        self._clock = clock
        self.lasting = STAMP_MAX if isinstance(clock, SimulatedClock) else SECOND // 10
        self._recorded = 0
        self._kept = 0

    def newest_plausible(self) -> int:
        """The greatest stamp, in ns, that is not ahead of the clock now; `STAMP_MAX` if none is."""
        if self._max_ahead is None or not self._compares:
            return STAMP_MAX
        return min(self._clock.now() + self._max_ahead, STAMP_MAX)

    def oldest_plausible(self) -> int:
        """The least stamp, in ns, that is not behind the clock now; `STAMP_MIN` if none is."""
        if self._max_behind is None or self._kept or not self._compares:
            return STAMP_MIN
        return max(self._clock.now() - self._max_behind, STAMP_MIN)

    @property
    def _compares(self) -> bool:
        """Whether stamps are of the clock, and it has a time."""
        return not self._recorded and bool(getattr(self._clock, "is_set", True))

    @contextmanager
    def recorded_time(self) -> Iterator[None]:
        """A ``with`` for samples whose stamps are of another clock; none of them is ahead or behind."""
        self._recorded += 1
        try:
            yield
        finally:
            self._recorded -= 1

    @contextmanager
    def kept_samples(self) -> Iterator[None]:
        """A ``with`` for samples that were kept for late joiners; none of them is behind."""
        self._kept += 1
        try:
            yield
        finally:
            self._kept -= 1

    def split(self, batch: Batch) -> tuple[Batch, list[InvalidTransformError], Batch, Batch]:
        """The samples of a batch that may go on, the errors of the others, and the samples that are ahead, and behind.

        All are in order. A static sample is never ahead or behind, because it holds at every stamp.
        """
        newest, oldest = self.newest_plausible(), self.oldest_plausible()
        allowed: list[TransformStamped] = []
        refused: list[InvalidTransformError] = []
        ahead: list[TransformStamped] = []
        behind: list[TransformStamped] = []
        for sample in batch:
            _, _, stamp, _, _, static = sample._fields
            if not is_within(sample, self.max_translation):
                refused.append(not_physical(sample, self.max_translation))
                continue
            if stamp > newest and not static:
                ahead.append(sample)
                if self.rejects_ahead:
                    refused.append(self._too_far_ahead(sample))
                    continue
            elif stamp < oldest and not static:
                behind.append(sample)
            allowed.append(sample)
        return tuple(allowed), refused, tuple(ahead), tuple(behind)

    def _too_far_ahead(self, sample: TransformStamped) -> InvalidTransformError:
        parent, child, stamp, _, authority, _ = sample._fields
        assert self._max_ahead is not None
        now = self._clock.now()
        ahead, bound, cause = format_duration(stamp - now), format_duration(self._max_ahead), likely_cause(stamp, now)
        return InvalidTransformError(
            f"frame {child!r}: the stamp {format_stamp(stamp)} from {authority!r} is {ahead} ahead of the clock "
            f"(at most {bound}){cause and f': {cause}'}",
            reason="ahead",
            parent=parent,
            child=child,
            authority=authority,
        )


def _as_bound(seconds: float | None, name: str) -> int | None:
    """A bound in ns; None for any distance."""
    duration = math.inf if seconds is None else as_duration(seconds, name)
    return None if duration == math.inf else from_seconds(duration)


Invalid = Literal["raise", "drop"]


def as_invalid(invalid: Invalid) -> Invalid:
    """The argument `invalid`; `ValueError` if it is neither."""
    if invalid not in get_args(Invalid):
        raise ValueError(f"invalid must be 'raise' or 'drop', not {invalid!r}")
    return invalid


def as_max_frames(value: int | None) -> int | None:
    """The argument `max_frames`; `TypeError` or `ValueError` if it is neither a number of frames nor None."""
    if isinstance(value, bool) or not isinstance(value, int | None):
        raise TypeError(f"max_frames must be an int or None, not {value!r}")
    if value is not None and value < 2:
        raise ValueError(f"max_frames must be at least 2, a parent and a child, got {value}")
    return value


class _Edge(Edge):
    """The newest edge of one child, and the authority of its newest sample.

    `last` is the authority of its last sample, which may have been a late one.
    `since` numbers the parents of all frames in the order in which they were published.
    """

    __slots__ = ("authority", "last", "since", "static")

    def __init__(self, parent: str, static: bool, authority: str, since: int) -> None:
        self.parent = parent
        self.static = static
        self.newest = None
        self.authority = authority
        self.last = authority
        self.trusted = None
        self.late = False
        self.since = since


class Topology:
    """Each child's newest parent, kind and authority, and the static samples that late joiners need.

    Parameters
    ----------
    log : OnceLogger
    ownership : Ownership
        Says who may publish which child.
    plausibility : Plausibility
        Judges translations and stamps.
    announcer : Announcer
        Announces changes and refusals.
    evict : callable
        Removes a frame from the bus and all buffers.
    max_frames : int or None
        The greatest number of frames that the newest edges may name; None for any number.

    Attributes
    ----------
    names : KnownFrames
        The frames that the newest edges name.
    latched : StaticFrames
        The static sample of each static child.
    rejected : Counter
        Samples that were refused, by reason.
    reparented, kind_changes, conflicts : int
        Number of samples that gave a child another newest parent, another kind, or another authority than before.
    ahead : int
        Accepted samples that were ahead of the clock.
    judge : Judge
        Records the samples of a batch if all continue known edges; otherwise `accept` judges them. It counts the
        accepted samples that were behind the clock.
    """

    def __init__(
        self,
        log: OnceLogger,
        ownership: Ownership,
        plausibility: Plausibility,
        announcer: Announcer,
        evict: Callable[[str], object],
        max_frames: int | None = None,
    ) -> None:
        self._log = log
        self._ownership = ownership
        self._plausibility = plausibility
        self._announcer = announcer
        self._evict = evict
        self.max_frames = max_frames
        self._parents = 0
        self._newest: dict[str, _Edge] = {}
        self.names: KnownFrames = KnownFrames()
        # The judge compares stamps with a reading of the clock that is at most a tenth of a second old; a simulated
        # clock is read after each of its moves.
        self.judge: Judge = Judge(self._newest, plausibility.max_translation**2)
        self.latched: StaticFrames = StaticFrames()
        self.rejected: Counter[str] = Counter()
        self.reparented: int = 0
        self.kind_changes: int = 0
        self.conflicts: int = 0
        self.ahead: int = 0

    def __len__(self) -> int:
        return len(self._newest)

    def __contains__(self, child: object) -> bool:
        return child in self._newest or (isinstance(child, str) and self._ownership.remembers(child))

    def newest(self, child: str) -> NewestEdge | None:
        """The newest edge of a child, if it has one."""
        return self._newest.get(child)

    def moving(self) -> dict[str, tuple[str, int]]:
        """The newest parent and stamp (ns) of each moving child."""
        edges = self._newest.items()
        return {child: (known.parent, newest) for child, known in edges if (newest := known.newest) is not None}

    def known(self) -> Iterator[tuple[int, str, str, str, bool]]:
        """The fields of a `FrameAdded` for each child that has a parent, as if it were new.

        Made without a step in Python for each, because a stream that opens asks for all of them in one turn. Read
        it before the next change.
        """
        edges = self._newest.values()
        fields = (map(attrgetter(name), edges) for name in ("parent", "authority", "static"))
        return zip(repeat(self._announcer.now()), self._newest, *fields, strict=False)

    def known_ahead(self) -> list[StampAhead]:
        """An event for each child whose newest sample is ahead of the clock."""
        now, newest = self._announcer.now(), self._plausibility.newest_plausible()
        if newest == STAMP_MAX:
            return []
        return [
            StampAhead(now, child, known.newest, known.authority)
            for child, known in self._newest.items()
            if known.newest is not None and known.newest > newest
        ]

    def known_behind(self) -> list[StampBehind]:
        """An event for each child that was reported as behind the clock, and whose newest sample still is."""
        if not self.judge.behind:
            return []
        now, oldest = self._announcer.now(), self._plausibility.oldest_plausible()
        return [
            StampBehind(now, child, known.newest, None, known.authority)
            for child, known in self._newest.items()
            if known.late and known.newest is not None and known.newest < oldest
        ]

    def expired(self, sample: TransformStamped, newest: int, authority: str) -> bool:
        """Report a sample that has expired in a buffer; `newest` (ns) and `authority` are of its child's newest sample.

        Returns whether `newest` is ahead of the clock, so that correct samples expire.
        """
        if newest > self._plausibility.newest_plausible():
            self._tell_ahead(sample.child, newest, authority)
            return True
        if self._plausibility.oldest_plausible() != STAMP_MIN:
            self._tell_behind(sample, newest)
        return False

    def accept(self, batch: Batch, invalid: Invalid, judged: bool = False) -> Batch:
        """Judge a batch, record the samples that may be committed, and return them.

        `judged` says that the judge has already been asked and has handed the batch back.

        Raises
        ------
        InvalidTransformError
            If `invalid` is ``"raise"`` and a sample closes a loop, or its authority may not publish the child. Nothing
            is recorded.
        """
        # The usual case: all samples continue known edges, and only the stamps are new.
        if (not judged and self.judge.accepts(batch)) or self._accepts_now(batch):
            return batch
        return self._judge(batch, invalid)

    def reserve(self, child: str, authority: str) -> Registration:
        """Let only one authority publish a child; see `Ownership.reserve`."""
        registration = self._ownership.reserve(child, authority)
        known = self._newest.get(child)
        if known is not None and known.authority != authority:
            known.trusted = None
        return registration

    def remove(self, child: str) -> None:
        """Forget a child and its first authority."""
        self.latched.remove(child)
        self._ownership.forget(child)
        if self._newest.pop(child, None) is None:
            return
        self.names.remove(child)
        if self._announcer.has_listeners:
            self._announcer.announce(FrameRemoved(self._announcer.now(), child))

    def clear_moving(self) -> None:
        """Forget every moving child, but keep the right of its first authority."""
        self._ownership.remember(self._newest)
        static = {child: known for child, known in self._newest.items() if known.static}
        self._newest.clear()
        self._newest.update(static)
        self.names = self.latched.names.copy()

    def reject(self, reason: str, error: Exception) -> None:
        """Count and announce a sample that was refused."""
        self.rejected[reason] += 1
        if not self._announcer.has_listeners:
            return
        child = parent = authority = None
        if isinstance(error, InvalidTransformError):
            child, parent, authority = error.child, error.parent, error.authority
        # A copy, because the traceback of the original keeps the sender's variables alive.
        self._announcer.announce(SampleRejected(self._announcer.now(), reason, child, parent, authority, copy(error)))

    def drop(self, error: InvalidTransformError) -> None:
        """Count, announce and log a sample that was left out."""
        self.reject(error.reason, error)
        # Strangers may try any number of names.
        cause = () if isinstance(error, TooManyFramesError) else (error.child, error.authority)
        self._log.warning((error.reason, *cause), "dropped a sample: %s", error)

    @contextmanager
    def recorded_time(self) -> Iterator[None]:
        """A ``with`` for samples whose stamps are of another clock; none of them is ahead or behind."""
        with self._at_the_clock(self._plausibility.recorded_time()):
            yield

    @contextmanager
    def kept_samples(self) -> Iterator[None]:
        """A ``with`` for samples that were kept for late joiners; none of them is behind."""
        with self._at_the_clock(self._plausibility.kept_samples()):
            yield

    @contextmanager
    def _at_the_clock(self, other_rules: AbstractContextManager[None]) -> Iterator[None]:
        """A ``with`` in which the judge follows other rules."""
        try:
            with other_rules:
                self._look_at_clock()
                yield
        finally:
            self._look_at_clock()

    def clock_moved(self, _stamp: int) -> None:
        """Note that a clock that is not the machine's has moved."""
        self._look_at_clock()

    def _look_at_clock(self) -> None:
        """Give the judge a new reading of the clock."""
        plausibility = self._plausibility
        self.judge.allow(plausibility.oldest_plausible(), plausibility.newest_plausible(), plausibility.lasting)

    def _accepts_now(self, batch: Batch) -> bool:
        """Whether the judge accepts a batch after a new reading of the clock."""
        self._look_at_clock()
        return self.judge.accepts(batch)

    def _judge(self, batch: Batch, invalid: Invalid) -> Batch:
        batch, refused, ahead, behind = self._plausibility.split(batch)
        if self._ownership.restricts:
            batch, unowned = self._ownership.split(batch, self._newest)
            refused += unowned
        accepted, looped = admit(self._newest, batch, self.names.parents)
        if self.max_frames is not None and not self._fits(accepted, self.max_frames):
            batch, homeless = self._find_places(batch, self.max_frames)
            refused += homeless
            accepted, looped = admit(self._newest, batch, self.names.parents)
        if looped and self._ownership.reserves and not (refused and invalid == "raise"):
            accepted, looped = self._defend(batch, refused, invalid)
        refused += looped
        rejects_ahead = self._plausibility.rejects_ahead
        if rejects_ahead:
            for sample in ahead:
                self._tell_ahead(sample.child, sample.stamp, sample.authority)
        if refused and invalid == "raise":
            for error in refused:
                self.reject(error.reason, error)
            raise refused[0]
        for error in refused:
            self.drop(error)
        for sample in accepted:
            self._record(sample)
        if behind or (ahead and not rejects_ahead):
            stored = set(map(id, accepted))
            for sample in () if rejects_ahead else ahead:
                if id(sample) in stored:
                    self.ahead += 1
                    self._tell_ahead(sample.child, sample.stamp, sample.authority)
            for sample in behind:
                if id(sample) in stored:
                    self.judge.behind += 1
                    self._tell_behind(sample)
                    self._newest[sample.child].late = True
        return accepted

    def _fits(self, batch: Batch, max_frames: int) -> bool:
        """Whether the bus has places for the frames of a batch, which may free some and take others."""
        # No sample names more than two new frames.
        if len(self.names) + 2 * len(batch) <= max_frames:
            return True
        if self._ownership.reserves:
            # A sample that is refused later frees no place.
            return False
        return self.names.count_after(changed_parents(self._newest, batch)) <= max_frames

    def _find_places(self, batch: Batch, max_frames: int) -> tuple[Batch, list[InvalidTransformError]]:
        """The samples of a batch whose frames fit into the free places, and the errors of the others."""
        before = len(self.names)
        allowed: list[TransformStamped] = []
        refused: list[InvalidTransformError] = []
        taken: set[str] = set()
        for sample in batch:
            new = {frame for frame in (sample.parent, sample.child) if frame not in taken and frame not in self.names}
            if new and before + len(taken) + len(new) > max_frames:
                refused.append(
                    TooManyFramesError(
                        frames=before,
                        max_frames=max_frames,
                        parent=sample.parent,
                        child=sample.child,
                        authority=sample.authority,
                    )
                )
            else:
                taken |= new
                allowed.append(sample)
        return tuple(allowed), refused

    def _defend(
        self,
        batch: Batch,
        refused: list[InvalidTransformError],
        invalid: Invalid,
    ) -> tuple[Batch, list[InvalidTransformError]]:
        """Let the owners of reserved frames win against the edges of others that close a loop with theirs.

        Such an edge is refused (`refused` gets its error) if it is in the same batch, else it is removed from the bus.

        Returns
        -------
        accepted, looped
            As `admit` gives them.
        """
        edges = dict(self._newest)
        removed: list[InvalidTransformError] = []
        _, looped = admit(edges, batch, self.names.parents)
        while intruder := next(filter(None, (self._ownership.intruder(error, edges, batch) for error in looped)), None):
            rest = tuple(sample for sample in batch if not _is_edge(sample, intruder))
            if len(rest) < len(batch):
                # An error for each sample, so that all are counted.
                refused += [intruder] * (len(batch) - len(rest))
                batch = rest
            else:
                del edges[_child(intruder)]
                removed.append(intruder)
            _, looped = admit(edges, batch, self.names.parents)
        if invalid == "drop" or not (looped or refused):
            for error in removed:
                # Its samples were accepted, so they are not counted as refused.
                self.reject("displaced", error)
                self._log.warning(("intruder", error.child, error.authority), "removed a frame: %s", error)
                self._evict(_child(error))
        # A subscriber that was told of a removal may have published.
        return admit(self._newest, batch, self.names.parents)

    def _record(self, sample: TransformStamped) -> None:
        parent, child, stamp, _, authority, static = sample._fields
        announcer = self._announcer
        known = self._newest.get(child)
        if known is None:
            self._parents += 1
            known = self._newest[child] = _Edge(parent, static, authority, self._parents)
            self.names.update(child, (parent,))
            if announcer.has_listeners:
                announcer.announce(FrameAdded(announcer.now(), child, parent, authority, static))
        if known.last != authority:
            if self._ownership.reserved_for(child) is None:
                self._conflict(child, authority, known.last)
            known.last = authority
            known.late = False
        if known.static != static:
            self.kind_changes += 1
            kind = "static" if static else "moving"
            self._log.warning(("kind", child, authority), "frame %r is now %s, from %r", child, kind, authority)
            known.static = static
            if announcer.has_listeners:
                announcer.announce(KindChanged(announcer.now(), child, static, authority))
        if static or known.newest is None or stamp >= known.newest:
            known.newest = None if static else stamp
            known.authority = authority
            if known.parent != parent:
                self._reparent(child, parent, known.parent, authority)
                self.names.update(child, (parent,))
                self._parents += 1
                known.parent, known.since = parent, self._parents
        known.trusted = None if static or known.authority != authority else authority
        if static:
            self.latched.put(sample)
        else:
            self.latched.remove(child)

    def _tell_ahead(self, child: str, newest: int, authority: str) -> None:
        now = self._announcer.now()
        cause = likely_cause(newest, now)
        self._log.warning(
            ("ahead", child, authority),
            "frame %r has a sample from %r that is %s ahead of the clock: right samples are older, and expire%s",
            child,
            authority,
            format_duration(newest - now),
            cause and f"; {cause}",
        )
        if self._announcer.has_listeners:
            self._announcer.announce(StampAhead(now, child, newest, authority))

    def _tell_behind(self, sample: TransformStamped, newest: int | None = None) -> None:
        """Tell of a sample that is behind the clock, or has expired by the newest stamp (ns) of its child."""
        _, child, stamp, _, authority, _ = sample._fields
        now = self._announcer.now()
        self._log.warning(
            ("behind", child, authority),
            "frame %r has a sample from %r that is %s: %s",
            child,
            authority,
            how_far_behind(stamp, now, newest),
            likely_cause(stamp, now) or "it is late, or the clock of its sender is behind or stands still",
        )
        if self._announcer.has_listeners:
            self._announcer.announce(StampBehind(now, child, stamp, newest, authority))

    def _conflict(self, child: str, authority: str, other: str) -> None:
        self.conflicts += 1
        first, second = sorted((other, authority))
        key = ("authority", child, first, second)
        self._log.warning(key, "frame %r comes from two authorities, %r and %r", child, first, second)
        if self._announcer.has_listeners:
            self._announcer.announce(AuthorityConflict(self._announcer.now(), child, authority, other))

    def _reparent(self, child: str, parent: str, old_parent: str, authority: str) -> None:
        self.reparented += 1
        key = ("parent", child, authority)
        self._log.info(key, "frame %r moves from %r to %r, says %r", child, old_parent, parent, authority)
        if self._announcer.has_listeners:
            self._announcer.announce(Reparented(self._announcer.now(), child, parent, old_parent, authority))


def _is_edge(sample: TransformStamped, error: InvalidTransformError) -> bool:
    return (sample.child, sample.parent, sample.authority) == (error.child, error.parent, error.authority)


def _child(error: InvalidTransformError) -> str:
    assert error.child is not None
    return error.child
