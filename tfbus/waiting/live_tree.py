"""A forest that a bus fills, with the lookups that wait for it and the watches that follow it.

Buffers of one bus that would hold the same samples share one `LiveTree`, each by a `Share`, so a sample is stored and
looked up among the waiting once for all of them::

    Bus ──batch──> LiveTree ── forest, waiting, watching
                      │
                      ├── Share of buffer 1 ── its waiters and watches, its end
                      └── Share of buffer 2 ── ...

A buffer that is closed keeps what it has. While others go on sharing the tree, the next change first gives the closed
ones that still exist a copy of the forest, one for all that were closed since the last change.

A lookup that cannot be answered is parked under the frame that blocks it, and an insertion looks only there:

* under an edge whose newest stamp is too old, in the order of the stamps that the lookups need. The batch that brings
  an edge to 12.5 s takes all lookups up to 12.5 s off the end of that list, and sees no other;
* under an unknown frame, or under the roots of two trees: any sample of these frames wakes the lookup.

A lookup also ends when the window of another edge on its path moves past the stamp. So each edge has a limit: a sample
newer than the limit drops the stamp. One list for all frames holds the first limit of each waiter, so an insertion
costs one comparison while no limit is passed. Once a frame has passed the first limit of a waiter, that waiter is kept
under each edge whose limit is not yet passed, such as an edge that has stopped.

`LiveTree.insert` pops the waiters that may have an answer now and wakes them, each with its answer if that is plain. To
wake a waiter is to call the function that it brought along: nothing here knows an event loop, and nothing waits.
"""

import logging
from bisect import bisect_left, insort
from collections.abc import Callable, Container, Hashable, Iterable, KeysView, Sequence
from dataclasses import astuple, dataclass
from itertools import count, takewhile
from operator import sub
from typing import Any, Protocol
from weakref import ref

from tfbus.errors import (
    MAY_COME,
    AheadError,
    ClockResetError,
    DisconnectedError,
    ExtrapolationError,
    FutureExtrapolationError,
    GapError,
    TransformLookupError,
    UnknownFrameError,
)
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.registration import Registration
from tfbus.stamps import STAMP_MAX, STAMP_MIN, Latest, Place
from tfbus.statistics import BufferStatistics
from tfbus.tree.cycles import names_below
from tfbus.tree.forest import Forest, LoopingSample
from tfbus.tree.history import FrameHistory
from tfbus.tree.lookup import Policy, Question, read_stamp
from tfbus.waiting.watch_index import WatchIndex, WatchState
from tfbus.which_kernel import Feed, Line, Parked

Limits = list[tuple[str, int]]


def limits_of(forest: Forest, question: Question, blocking: Container[str]) -> Limits:
    """The moving edges of a question, each with a limit in ns: a sample newer than it may make an answer impossible.

    An edge that keeps all samples has no limit. Neither has a lookup at `LATEST`, because its stamp is never too old.
    Only the thread that fills the forest may call this.

    Parameters
    ----------
    forest : Forest
    question : Question
    blocking : container of str
        The edges to leave out, because each of their samples is noticed anyway.
    """
    target, source, fixed = question.target, question.source, question.fixed
    if fixed is None:
        return _limits_at(forest, target, source, question.at, question.policy, blocking)
    return [
        *_limits_at(forest, target, fixed, question.at, question.policy, blocking),
        *_limits_at(forest, fixed, source, question.source_at, question.policy, blocking),
    ]


def _limits_at(
    forest: Forest, target: str, source: str, at: int | Latest | None, policy: Policy | None, blocking: Container[str]
) -> Limits:
    if at is None or isinstance(at, Latest):
        return []
    path = forest.paths.find(target, source)
    edges = _edges(forest, target, source, at) if path is None or path.root in forest.frames else path.moving
    window = STAMP_MAX if forest.window is None else forest.window
    limits = []
    asked = at
    if policy is not None:
        at = min(at + policy.tolerance, STAMP_MAX)
    for edge in edges:
        if edge.child in blocking:
            continue
        before, after = edge.around(at)
        if before is None:
            # The first sample decides.
            limit = at
        elif after is not None:
            # Until the sample before the stamp leaves the window.
            limit = before + window
            if policy is not None and policy.max_gap is not None and _is_in_gap(edge, asked, policy):
                limit = at
        else:
            # Until a sample after the stamp comes, and the one before it has left the window or is too far away.
            near = window if policy is None or policy.max_gap is None else min(window, policy.max_gap)
            limit = max(before + near, at)
        if limit < STAMP_MAX:
            limits.append((edge.child, limit))
    return limits


def _is_in_gap(edge: FrameHistory, at: int, policy: Policy) -> bool:
    try:
        read_stamp(edge, at, policy)
    except GapError:
        return True
    except ExtrapolationError:
        pass
    return False


def _edges(forest: Forest, target: str, source: str, at: int) -> tuple[FrameHistory, ...]:
    """The moving edges that decide whether there will be an answer."""
    with forest.lock:
        try:
            path = forest.find_path(target, source, at)
        except UnknownFrameError:
            return ()
        except DisconnectedError as error:
            # A loop ends when one of its edges loses the stamp.
            loop = [forest.frames[child] for child in dict.fromkeys(error.loop)]
            return tuple(edge for edge in loop if not edge.static)
    return path.moving if path.rival is None else (*path.moving, *path.rival.moving)


_NEVER = 2**64


@dataclass(frozen=True, slots=True)
class PendingLookup:
    """A waiting lookup: its question, when it began to wait (ns on the bus's clock), and the error that blocks it.

    Examples
    --------
    >>> import anyio
    >>> with Bus() as bus, Buffer(bus) as buffer:
    ...     async with anyio.create_task_group() as tasks:
    ...         _ = tasks.start_soon(buffer.lookup, "map", "cart")
    ...         await anyio.wait_all_tasks_blocked()
    ...         print(*buffer.pending())
    ...         tasks.cancel_scope.cancel()
    'cart' in 'map': frame 'map' is not known
    """

    question: Question
    since: int
    blocked_by: TransformLookupError

    def __str__(self) -> str:
        return f"{self.question.source!r} in {self.question.target!r}: {self.blocked_by}"


class Waiter(Parked):
    """A parked lookup.

    Attributes
    ----------
    others : sequence of Question
        Further questions that need an answer: the waiter is woken when one of them can no longer have an answer.
    blocked_by : TransformLookupError or None
        The error with which it was parked; None if the kernel has parked it, because newer samples are all it lacks.
    limits : list of (str, Place)
        Its places under the edges that have a limit for it, once its first limit is passed.
    indexed : bool
        Whether the index has noted the names of its questions.
    """

    others: Sequence[Question] = ()
    blocked_by: TransformLookupError | None = None
    limits: list[tuple[str, Place]] | None = None
    indexed = False

    @property
    def question(self) -> Question:
        """The question that it asks."""
        return Question(*self.asked)

    @property
    def cause(self) -> Hashable:
        """Equal for waiters that wait for the same."""
        return FutureExtrapolationError if self.blocked_by is None else type(self.blocked_by), self.names

    def frames(self) -> set[str]:
        """The frames that the questions name."""
        names = {self.question.target, self.question.source}
        if self.question.fixed is not None:
            names.add(self.question.fixed)
        for other in self.others:
            names.update((other.target, other.source))
        return names


def blocking_frames(error: TransformLookupError) -> tuple[str, ...]:
    """The frames whose next sample may remove the cause of `error`.

    Raises
    ------
    TypeError
        If `error` is of a kind that waiting cannot help.
    """
    if isinstance(error, FutureExtrapolationError):
        return (error.child, *error.others)
    if isinstance(error, AheadError):
        return (error.child,)
    if isinstance(error, UnknownFrameError):
        return (error.frame,)
    if isinstance(error, DisconnectedError):
        return error.roots
    raise TypeError(f"waiting cannot help against {error!r}")


def without_traceback(error: TransformLookupError) -> TransformLookupError:
    """The error without its traceback, to be kept while a lookup waits.

    A traceback refers to the waiting stack frame, which refers to the error: every wait would leave a reference cycle,
    and the garbage collector then stops the loop for 100 ms now and then.
    """
    here: BaseException | None = error
    while here is not None:
        here.__traceback__ = None
        here = here.__cause__
    return error


class WaitingIndex:
    """The parked lookups of all buffers that share a tree.

    Attributes
    ----------
    by_frame : dict of str to Line
        The waiters under each frame that blocks a lookup, or that may make one hopeless by its next sample.
    parked : dict of Waiter to None
        All waiters in the order in which they came.
    limits : list of (-stamp, -order, Waiter)
        The first limit of each waiter that has one, if no frame has passed it, sorted.
    passed : int
        The newest stamp that has passed a limit, in ns.
    orders : iterator of int
        Numbers the places.
    """

    def __init__(self) -> None:
        self.by_frame: dict[str, Line] = {}
        self.parked: dict[Waiter, None] = {}
        # Updated only when it is read, because most waiters are woken by the blocking edge before. `indexed` marks a
        # waiter that is in it.
        self._by_name: dict[str, dict[Waiter, None]] = {}
        self.limits: list[Place] = []
        self.passed: int = STAMP_MIN
        self.orders: count[int] = count()

    def __len__(self) -> int:
        return len(self.parked)

    @property
    def names(self) -> KeysView[str]:
        """The frames that the questions of the waiters name."""
        return self._index().keys()

    @property
    def limit(self) -> int:
        """The first limit of all waiters, in ns: a newer sample of any frame may have made a waiter hopeless."""
        return -self.limits[-1][0] if self.limits else _NEVER

    def park(self, waiter: Waiter, error: TransformLookupError, limits: Iterable[tuple[str, int]] = ()) -> None:
        """Put a waiter under the frames that `error` says it lacks.

        Parameters
        ----------
        waiter : Waiter
        error : TransformLookupError
        limits : iterable of (str, int)
            Other edges on its path, each with the newest stamp (ns) that it may reach before it loses the waiter's.

        Raises
        ------
        TypeError
            If `error` is of a kind that waiting cannot help.
        """
        names = blocking_frames(error)
        cause = error.__cause__
        if isinstance(cause, (*MAY_COME, GapError)):
            # At the newest common stamp another sample is missing as well; late data may bring it.
            also = (cause.child,) if isinstance(cause, GapError) else blocking_frames(cause)
            names = tuple(dict.fromkeys((*names, *also)))
        waiter.names = names
        waiter.blocked_by = error
        self.parked[waiter] = None
        try:
            if isinstance(error, FutureExtrapolationError) and len(names) == 1:
                needed = STAMP_MIN if isinstance(error.stamp, Latest) else error.stamp - error.slack
                waiter.place = (-needed, -next(self.orders), waiter)
                insort(self._under(error.child).places, waiter.place)
            else:
                waiter.place = None
                for name in names:
                    self._under(name).for_any[waiter] = None
            self.set_limits(waiter, limits)
        except BaseException:
            # Out of memory.
            self.remove(waiter)
            raise

    def set_limits(self, waiter: Waiter, limits: Iterable[tuple[str, int]]) -> None:
        """Note the limits of a parked waiter that has none."""
        first = _NEVER
        for frame, limit in limits:
            if limit < self.passed:
                place = (-limit, -next(self.orders), waiter)
                waiter.elsewhere = True
                waiter.limits = [*(waiter.limits or ()), (frame, place)]
                insort(self._under(frame).limits, place)
            elif limit < first:
                first = limit
        if first < _NEVER:
            waiter.limit = (-first, -next(self.orders), waiter)
            insort(self.limits, waiter.limit)

    def remove(self, waiter: Waiter) -> None:
        """Remove one waiter, if it is still parked."""
        if waiter not in self.parked:
            return
        self.forget(waiter)
        for name in waiter.names or ():
            blocked = self.by_frame.get(name)
            if blocked is not None:
                if waiter.place is not None:
                    _discard(blocked.places, waiter.place)
                blocked.for_any.pop(waiter, None)
                self._drop_if_empty(name, blocked)
        waiter.place = None

    def pop_unblocked(self, frame: str, stamp: int | None) -> list[Waiter]:
        """Remove and return the waiters that a sample of `frame` at `stamp` may have unblocked or made hopeless.

        These waiters need any sample, or this stamp or an older one, or have an older limit for this frame. No waiter
        needs a stamp older than the newest sample, so a late sample unblocks no others.
        """
        blocked = self.by_frame.get(frame)
        if blocked is None:
            return []
        ready = list(blocked.for_any)
        for waiter in ready:
            self.remove(waiter)
        if stamp is not None:
            limits, places = blocked.limits, blocked.places
            while limits and -limits[-1][0] < stamp:
                waiter = limits[-1][2]
                self.remove(waiter)
                ready.append(waiter)
            while places and -places[-1][0] <= stamp:
                waiter = places.pop()[2]
                # The place refers to the waiter: without this line they form a reference cycle.
                waiter.place = None
                self.forget(waiter)
                ready.append(waiter)
        self._drop_if_empty(frame, blocked)
        return ready

    def pop_limited(self, stamp: int) -> list[Waiter]:
        """Take the first limit from each waiter whose limit is older than `stamp`; return these, which stay parked."""
        self.passed = max(self.passed, stamp)
        limits = self.limits
        found = []
        while limits and -limits[-1][0] < stamp:
            waiter = limits.pop()[2]
            waiter.limit = None
            self._forget_limits(waiter)
            if waiter in self.parked:
                found.append(waiter)
        return found

    def pop_asking_for(self, frames: Iterable[str]) -> list[Waiter]:
        """Remove and return the waiters whose question names one of the frames."""
        by_name = self._index()
        ready = dict.fromkeys(waiter for name in frames for waiter in by_name.get(name, ()))
        for waiter in ready:
            self.remove(waiter)
        return list(ready)

    def pop_all(self) -> list[Waiter]:
        """Remove and return all waiters."""
        ready = list(self.parked)
        for waiter in ready:
            waiter.place = waiter.limit = waiter.limits = None
            waiter.indexed = False
        self.parked.clear()
        self._by_name.clear()
        self.by_frame.clear()
        self.limits.clear()
        self.passed = STAMP_MIN
        return ready

    def forget(self, waiter: Waiter) -> None:
        """Forget a waiter, except under the frames that block it."""
        try:
            if waiter.limit is not None:
                _discard(self.limits, waiter.limit)
                waiter.limit = None
            if waiter.limits:
                self._forget_limits(waiter)
            if waiter.indexed:
                for name in waiter.frames():
                    waiters = self._by_name.get(name)
                    if waiters is not None:
                        waiters.pop(waiter, None)
                        if not waiters:
                            del self._by_name[name]
                waiter.indexed = False
        finally:
            # First, because memory may run out below; the rest is then forgotten when its turn comes.
            self.parked.pop(waiter, None)

    def _index(self) -> dict[str, dict[Waiter, None]]:
        """The waiters by the frames that their questions name."""
        fresh = list(takewhile(lambda waiter: not waiter.indexed, reversed(self.parked)))
        for waiter in reversed(fresh):
            waiter.indexed = waiter.elsewhere = True
            for name in waiter.frames():
                self._by_name.setdefault(name, {})[waiter] = None
        return self._by_name

    def _forget_limits(self, waiter: Waiter) -> None:
        """Remove a waiter from under each edge that has a limit for it."""
        for frame, place in waiter.limits or ():
            blocked = self.by_frame.get(frame)
            if blocked is not None:
                _discard(blocked.limits, place)
                self._drop_if_empty(frame, blocked)
        waiter.limits = None

    def _under(self, frame: str) -> Line:
        blocked = self.by_frame.get(frame)
        if blocked is None:
            blocked = self.by_frame[frame] = Line()
        return blocked

    def _drop_if_empty(self, frame: str, blocked: Line) -> None:
        if not (blocked.places or blocked.for_any or blocked.limits):
            self.by_frame.pop(frame, None)

    def of(self, share: "Share") -> list[Waiter]:
        """The waiters of one buffer; for any thread."""
        # Copied first, because another thread may call this while the loop parks and wakes.
        return [waiter for waiter in list(self.parked) if waiter.share is share]


def _discard(places: list[Place], place: Place) -> None:
    """Remove a place from a sorted list, if it is in it."""
    i = bisect_left(places, place)
    if i < len(places) and places[i] is place:
        del places[i]


class LiveTree:
    """The part of one or several buffers that their bus calls.

    Parameters
    ----------
    forest : Forest
        Only the bus may change it from now on: another change would wake no waiting lookup.
    on_loop : callable, optional
        Called with each sample that forms a loop of parents at a past stamp.

    Attributes
    ----------
    forest : Forest
    waiting : WaitingIndex
    watching : WatchIndex
    last_reset : ClockResetError or None
        The last jump back of the clock; a new object for each.
    tell_expired : callable
        The bus sets it. Called with a sample that has expired, and with the stamp (ns) and the authority of its frame's
        newest sample; returns whether that stamp is ahead of the clock.
    expired_ahead, superseded : int
        As in `BufferStatistics`; the bus counts the superseded ones.
    feed : Feed or None
        Does what `insert` does with a batch, if all of it is plain; only the compiled kernel has one.
    """

    def __init__(self, forest: Forest, on_loop: Callable[[LoopingSample], object] | None = None) -> None:
        self.forest = forest
        self._on_loop = on_loop
        self.waiting: WaitingIndex = WaitingIndex()
        self.watching: WatchIndex = WatchIndex()
        self.last_reset: ClockResetError | None = None
        self.tell_expired: Callable[[TransformStamped, int, str], bool] = lambda _sample, _newest, _authority: False
        self.expired_ahead: int = 0
        self.superseded = 0
        self._waiters = self.waiting.by_frame
        self._watches = self.watching.by_frame
        # The readers of the forest for buffers that were closed since the last change.
        self._closed: list[ref[ReadsForest]] = []
        self.feed: Any = self.make_feed()

    def make_feed(self) -> Any:
        """A `Feed` of this tree; None without the compiled kernel."""
        if Feed is None:
            return None
        forest, waiting = self.forest, self.waiting
        return Feed(
            forest.paths,
            forest.frames,
            forest.readers,
            waiting.by_frame,
            waiting.parked,
            waiting.limits,
            self.watching.by_frame,
            waiting,
        )

    def insert(self, batch: Batch) -> None:
        """Insert a batch that the bus has judged, and wake the lookups and watches that it concerns."""
        if self.feed is None or not self.feed.insert(batch):
            self.insert_closely(batch)

    def insert_closely(self, batch: Batch) -> None:
        """As `insert`, for a batch that the feed has handed back because it is not plain."""
        self._part()
        waiters = self._waiters
        plain = self.forest.commit(batch)
        if waiters or self.waiting.limits:
            limit = self.waiting.limit
            passed = None
            for sample in batch:
                child, stamp = sample.child, sample.stamp
                if child in waiters:
                    self._wake_with_answers(self.waiting.pop_unblocked(child, stamp))
                if stamp > limit:
                    passed = limit = stamp
            if passed is not None:
                self._wake_hopeless(passed)
        if self._watches:
            _wake(self.watching.mark([sample.child for sample in batch]))
        if not plain:
            for sample in self.forest.expired_samples:
                history = self.forest.frames.get(sample.child)
                if history is not None and history.newest is not None:
                    self.expired_ahead += self.tell_expired(sample, history.newest, history.authority)
            self._wake_for_new_topology()

    def park(self, waiter: Waiter, error: TransformLookupError) -> None:
        """Let a waiter wait until a sample may have removed the cause of `error`, or has made an answer impossible.

        Raises
        ------
        TypeError
            If `error` is of a kind that waiting cannot help.
        """
        blocking = (error.child,) if isinstance(error, FutureExtrapolationError) else ()
        self.waiting.park(waiter, error, self._limits(waiter, blocking))

    def remove_frame(self, frame: str) -> None:
        """Forget a frame, if it is known, and wake the lookups and watches that it concerns."""
        self._part()
        forest = self.forest
        parents = forest.frames[frame].named_parents if frame in forest.frames else ()
        try:
            forest.remove(frame)
        except UnknownFrameError:
            return
        if self._waiters:
            gone = {name for name in parents if name not in forest.names}
            _wake(self.waiting.pop_asking_for(names_below(forest.frames, self.waiting.names, {frame, *gone})))
        _wake(self.watching.mark((frame,)))

    def reset(self, before: int, after: int) -> None:
        """Drop moving samples after the clock has jumped back; waiting lookups and watches get a `ClockResetError`."""
        self._part()
        self.forest.clear()
        self.last_reset = ClockResetError(before=before, after=after)
        _wake(self.waiting.pop_all())
        _wake(self.watching.reset(self.last_reset))

    def statistics(self, samples: int, waiting: int = 0) -> BufferStatistics:
        """All counters, given the number of samples that the bus has published and of lookups that wait."""
        forest, ahead, superseded = self.forest, self.expired_ahead, self.superseded
        expired = forest.expired + superseded
        return BufferStatistics(
            samples, forest.paths.inserted, forest.replaced, expired, waiting, ahead, superseded, forest.looped
        )

    def keep_for(self, *readers: "ReadsForest") -> None:
        """Let what a closed buffer reads stay as it is now, while other buffers share this tree."""
        self._closed += map(ref, readers)
        # As for any reader, the kernel then hands the next batch back.
        self.forest.readers[id(self)] = set()

    def _part(self) -> None:
        """Before a change, give the buffers that were closed a forest of their own."""
        if not self._closed:
            return
        self.forest.readers.pop(id(self), None)
        readers = [reader for known in self._closed if (reader := known()) is not None]
        self._closed.clear()
        if readers:
            forest, before = self.forest.copy(), self.forest
            forest.paths.inserted, forest.replaced = before.paths.inserted, before.replaced
            forest.expired, forest.looped = before.expired, before.looped
            for reader in readers:
                reader._stand_on(forest)

    def _wake_with_answers(self, waiters: Iterable[Waiter]) -> None:
        """Wake waiters, each with its answer if the kernel has one; it counts as long as the forest stays as it is."""
        paths = self.forest.paths
        for waiter in waiters:
            if waiter.question.is_plain:
                waiter.answer = paths.answer(*waiter.question[:3])
                waiter.version = paths.version
        _wake(waiters)

    def _limits(self, waiter: Waiter, blocking: Container[str]) -> list[tuple[str, int]]:
        """The limits of all edges except the blocking ones, whose next sample wakes the waiter in any case."""
        limits = limits_of(self.forest, waiter.question, blocking)
        for other in waiter.others:
            limits += limits_of(self.forest, other, ())
        return limits

    def _wake_hopeless(self, stamp: int) -> None:
        """Wake the waiters that samples up to a stamp (ns) have made hopeless."""
        for waiter in self.waiting.pop_limited(stamp):
            limits = self._limits(waiter, waiter.names or ())
            if any(
                (newest := self.forest.frames[frame].newest) is not None and newest > limit for frame, limit in limits
            ):
                self.waiting.remove(waiter)
                _wake((waiter,))
            else:
                self.waiting.set_limits(waiter, limits)

    def _wake_for_new_topology(self) -> None:
        """Wake the lookups that a new edge, another parent or kind, or a longer past may have unblocked."""
        forest = self.forest
        if self._waiters:
            for name in forest.new_parents:
                _wake(self.waiting.pop_unblocked(name, None))
        if forest.changed and (self._waiters or self._watches):
            asked = {*self.waiting.names, *self.watching.changing_names}
            concerned = names_below(forest.frames, asked, forest.changed)
            _wake(self.waiting.pop_asking_for(concerned))
            _wake(self.watching.mark_asking_for(concerned))
        if self._on_loop is not None:
            for found in forest.looping:
                self._on_loop(found)
        forest.forget_changes()


class ReadsForest(Protocol):
    """A reader of a forest, such as a buffer."""

    def _stand_on(self, forest: Forest) -> None:
        """Read this forest from now on."""


class Share:
    """The part of a live tree that belongs to one buffer: the lookups and watches of this buffer, and its end.

    Parameters
    ----------
    live : LiveTree
    before : BufferStatistics
        The counters of the bus and of the tree before the buffer joined; its own go on from there.

    Attributes
    ----------
    live : LiveTree
    end_reason : str or None
        The reason why no more samples will come; None while they may.
    feed : Feed or None
        Asks for this buffer, and parks its lookups; only the compiled kernel has one.
    """

    def __init__(self, live: LiveTree, before: BufferStatistics) -> None:
        self.live = live
        self.end_reason: str | None = None
        self.feed: Any = live.make_feed()
        if self.feed is not None:
            self.feed.share = self
        self._end_callbacks: dict[Registration, Callable[[], object]] = {}
        self._before = before

    def park(self, waiter: Waiter, error: TransformLookupError) -> None:
        """See `LiveTree.park`."""
        waiter.share = self
        self.live.park(waiter, error)

    def watch(self, state: WatchState) -> None:
        """Add a watch without an answer."""
        state.share = self
        self.live.watching.add(state)

    @property
    def waiters(self) -> list[Waiter]:
        """The waiting lookups; for any thread."""
        return self.live.waiting.of(self)

    def end(self, reason: str) -> None:
        """Wake the waiting lookups and watches for the last time; only the first reason counts."""
        if self.end_reason is None:
            self.end_reason = reason
        if self.feed is not None:
            self.feed.loop = None
        waiters = self.waiters
        for waiter in waiters:
            self.live.waiting.remove(waiter)
        _wake(waiters)
        _wake(self.live.watching.end(self))

    def call_end_callbacks(self) -> None:
        """Call each function that `on_end` registered, once. An `Exception` of one is logged."""
        while self._end_callbacks:
            registration = next(iter(self._end_callbacks))
            callback = self._end_callbacks.pop(registration)
            try:
                callback()
            except Exception as error:
                logging.getLogger("tfbus").warning("a callback at the end of a buffer raised", exc_info=error)

    def on_end(self, callback: Callable[[], object]) -> Registration:
        """Register a function for `call_end_callbacks`, or call it now if the end has come."""
        registration = Registration(lambda: self._end_callbacks.pop(registration, None))
        if self.end_reason is not None:
            callback()
        else:
            self._end_callbacks[registration] = callback
        return registration

    @property
    def has_waiters(self) -> bool:
        """Whether a task or a callback has to be told of the end, which only the thread of the event loop may do."""
        return bool(self._end_callbacks) or bool(self.waiters) or self.live.watching.has_waiters(self)

    def statistics(self, samples: int) -> BufferStatistics:
        """The counters since the buffer joined, given the number of samples that its bus has published by now."""
        now = self.live.statistics(samples, len(self.waiters))
        return BufferStatistics(*map(sub, astuple(now), astuple(self._before)))


def _wake(waiters: Iterable[Waiter | WatchState]) -> None:
    interrupt: BaseException | None = None
    for waiter in waiters:
        # The others must be woken all the same.
        try:
            waiter.wake()
        except (KeyboardInterrupt, SystemExit) as error:
            interrupt = interrupt or error
        except Exception:  # noqa: BLE001 - its wait was cancelled, or its event loop is gone
            pass
    if interrupt is not None:
        raise interrupt
