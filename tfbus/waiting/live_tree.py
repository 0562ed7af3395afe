"""A forest that a bus fills, with the lookups that wait for it and the watches that follow it.

It knows no event loop: to wake a waiter is to call the function that the waiter brought along.
"""

import logging
from collections.abc import Callable, Iterable

from tfbus.errors import ClockResetError, FutureExtrapolationError, TransformLookupError, UnknownFrameError
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.registration import Registration
from tfbus.statistics import BufferStatistics
from tfbus.tree.forest import Forest, LoopingSample
from tfbus.waiting._feed import Feed
from tfbus.waiting._limits import limits_of
from tfbus.waiting.waiting_index import Waiter, WaitingIndex
from tfbus.waiting.watch_index import WatchIndex, WatchState


class LiveTree:
    """The part of a buffer that its bus calls.

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
    end_reason : str or None
        The reason why no more samples will come; None while they may.
    last_reset : ClockResetError or None
        The last jump back of the clock; a new object for each.
    tell_expired : callable
        Called with a sample that has expired, the newest stamp of its frame, in ns, and the authority of that. Returns
        whether that stamp is ahead of the clock. The bus sets it.
    expired_ahead, superseded : int
        As in `BufferStatistics`; the bus counts the superseded ones.
    feed : Feed
        Does what `insert` does with a batch, if all of it is plain.
    """

    def __init__(self, forest: Forest, on_loop: Callable[[LoopingSample], object] | None = None) -> None:
        self.forest = forest
        self._on_loop = on_loop
        self.waiting = WaitingIndex()
        self.watching = WatchIndex()
        self.end_reason: str | None = None
        self.last_reset: ClockResetError | None = None
        self.tell_expired: Callable[[TransformStamped, int, str], bool] = lambda _sample, _newest, _authority: False
        self.expired_ahead = 0
        self.superseded = 0
        self._waiters = self.waiting.by_frame
        self._watches = self.watching.by_frame
        self._end_callbacks: dict[Registration, Callable[[], object]] = {}
        waiting = self.waiting
        self.feed = Feed(
            forest.paths,
            forest.frames,
            forest.readers,
            waiting.by_frame,
            waiting.parked,
            waiting.limits,
            self.watching.by_frame,
            waiting.forget,
        )

    def insert(self, batch: Batch) -> None:
        """Insert a batch that the bus has judged, and wake the lookups and watches that it concerns."""
        if not self.feed.insert(batch):
            self.insert_closely(batch)

    def insert_closely(self, batch: Batch) -> None:
        """As `insert`, for a batch that the feed has left alone because it is not plain."""
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
        self.waiting.park(waiter, error, self._limits(waiter, error))

    def remove_frame(self, frame: str) -> None:
        """Forget a frame, if it is known, and wake the lookups and watches that it concerns."""
        forest = self.forest
        parents = forest.frames[frame].named_parents if frame in forest.frames else ()
        try:
            forest.remove(frame)
        except UnknownFrameError:
            return
        if self._waiters:
            gone = {name for name in parents if name not in forest.names}
            _wake(self.waiting.pop_asking_for(forest.names_below(self.waiting.names, {frame, *gone})))
        _wake(self.watching.mark((frame,)))

    def reset(self, before: int, after: int) -> None:
        """Drop moving samples after the clock has jumped back; waiting lookups and watches get a `ClockResetError`."""
        self.forest.clear()
        self.last_reset = ClockResetError(before=before, after=after)
        _wake(self.waiting.pop_all())
        _wake(self.watching.reset(self.last_reset))

    def end(self, reason: str) -> None:
        """Wake all waiting lookups and watches for the last time; only the first reason counts."""
        if self.end_reason is None:
            self.end_reason = reason
        _wake(self.waiting.pop_all())
        _wake(self.watching.end())

    def call_end_callbacks(self) -> None:
        """Call each function that `on_end` registered, once. An `Exception` of one is logged."""
        while self._end_callbacks:
            registration = next(iter(self._end_callbacks))
            callback = self._end_callbacks.pop(registration)
            try:
                callback()
            except Exception as error:
                logging.getLogger("tfbus").warning("what was to be called at the end raised", exc_info=error)

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
        return len(self.waiting) > 0 or self.watching.has_waiters or bool(self._end_callbacks)

    def statistics(self, offered: int) -> BufferStatistics:
        """The counters, with the number of samples that the bus has offered."""
        forest = self.forest
        return BufferStatistics(
            offered,
            forest.inserted,
            forest.replaced,
            forest.expired + self.superseded,
            len(self.waiting),
            self.expired_ahead,
            self.superseded,
            forest.looped,
        )

    def _wake_with_answers(self, waiters: Iterable[Waiter]) -> None:
        """Wake waiters, each with its answer if the kernel has one; it counts as long as the forest stays as it is."""
        paths = self.forest.paths
        for waiter in waiters:
            if waiter.plain is not None:
                waiter.answer = paths.answer(*waiter.plain)
                waiter.version = paths.version
        _wake(waiters)

    def _limits(self, waiter: Waiter, error: TransformLookupError | None) -> list[tuple[str, int]]:
        """The limits of a waiter, but for that of the edge that blocks it, whose next samples wake it anyway."""
        blocking = error.child if isinstance(error, FutureExtrapolationError) else None
        limits = limits_of(self.forest, waiter.question, blocking)
        for other in waiter.others:
            limits += limits_of(self.forest, other, None)
        return limits

    def _wake_hopeless(self, stamp: int) -> None:
        """Wake the waiters that samples up to a stamp (ns) have made hopeless."""
        for waiter in self.waiting.pop_limited(stamp):
            limits = self._limits(waiter, waiter.blocked_by)
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
            concerned = forest.names_below(asked, forest.changed)
            _wake(self.waiting.pop_asking_for(concerned))
            _wake(self.watching.mark_asking_for(concerned))
        if self._on_loop is not None:
            for found in forest.looping:
                self._on_loop(found)
        forest.forget_changes()


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
