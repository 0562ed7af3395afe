"""Lookups that wait: parked under the frames that they lack, and woken by new samples.

Each lookup passes a checkpoint, asks the tree, and if the answer may still come it is parked in the live tree
(`tfbus.waiting.live_tree` says under which frame) and sleeps. The insertion that unblocks the lookup hands over the
answer. The task gives that answer if the tree has not changed until it runs, one turn of the event loop later;
otherwise it asks again, and may park again on the same deadline.

The kernel does all this for a plain lookup that lacks nothing but newer samples, and parks it at once: the sleep is its
checkpoint. It calls `Lookups.begin` for the first sleep on an event loop, makes the later ones itself, and gives None
where something is not plain. `Lookups.go_on` is the whole wait in Python. It goes on from there, and it is the only way
without the compiled kernel, with a prefix, and with options.

An alarm ends a wait at its timeout. A cancel scope for each wait would set and remove a timer of the event loop each
time; the alarms of a buffer share one timer. The timer is set for the first alarm. When that alarm is cancelled, the
timer stays, because the next alarm is nearly always later. One further alarm, set while lookups wait, looks for all
that have waited for 5 s and logs them. The error that blocks a lookup is worded only then, or when somebody asks.
"""

import logging
import math
import sys
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from functools import partial
from heapq import heapify, heappop, heappush
from itertools import count
from time import time_ns
from typing import Any, Protocol, cast

import anyio

from tfbus._aio.loops import asleep, checkpoint, here, running_loop, spawn, wake_up
from tfbus.bus.bus import Bus
from tfbus.bus.subscribers import SeenKeys
from tfbus.clock import Clock, SimulatedClock, SystemClock
from tfbus.errors import (
    MAY_COME,
    BusClosedError,
    ClockResetError,
    ExtrapolationError,
    LookupTimeoutError,
    TransformLookupError,
    UnknownFrameError,
)
from tfbus.frames import Prefix, is_frame
from tfbus.geometry.stamped import TransformStamped, renamed
from tfbus.stamps import LATEST, STAMP_MAX, STAMP_MIN, Latest, as_duration, from_seconds, to_seconds
from tfbus.tree.explanation import Explanation
from tfbus.tree.forest import Forest
from tfbus.tree.history import Edge
from tfbus.tree.lookup import Bounds, Question, answer
from tfbus.waiting.live_tree import PendingLookup, Share, Waiter, without_traceback


class LoopTimer:
    """Calls a function on an event loop at a time by the loop's own clock.

    Parameters
    ----------
    loop
        As `running_loop` gives it.
    callback : callable
        Called on the loop; an `Exception` is logged.

    Attributes
    ----------
    due : float
        The time of the next call, in s; infinity if none is set.
    now : callable
        Gives the time of the loop, in s, while the loop runs.
    """

    def __init__(self, loop: Any, callback: Callable[[], object]) -> None:
        self.loop = loop
        self.due: float = math.inf
        self._callback = callback
        self._trio = None if hasattr(loop, "call_at") else cast(Any, sys.modules["trio"])
        self._handle: Any = None
        clock = None if self._trio is None else self._trio.lowlevel.current_clock()
        self.now: Callable[[], float] = loop.time if clock is None else clock.current_time

    def set(self, due: float) -> None:
        """Call the function at a time, in s; a time that was set before no longer counts."""
        self.due = due
        if self._trio is None:
            if self._handle is not None:
                self._handle.cancel()
            self._handle = self.loop.call_at(due, self._fire)
        elif self._handle is not None:
            self._handle.deadline = due
        else:
            self._handle = self._trio.CancelScope(deadline=due)
            spawn(self.loop, partial(self._sleep, self._handle))

    def _fire(self) -> None:
        self._handle = None
        self.due = math.inf
        call_back(self._callback)

    async def _sleep(self, scope: Any) -> None:
        with scope:
            await cast(Any, self._trio).sleep_forever()
        self._fire()


def call_back(callback: Callable[[], object]) -> None:
    """Call a function, and log its `Exception`."""
    try:
        callback()
    except Exception:
        # No task would receive the error, and it would end the whole run of trio.
        logging.getLogger("tfbus").exception("a timer raised")


class LocalNames:
    """Translates questions into the names of the bus, and answers into local names.

    Parameters
    ----------
    prefix : Prefix
    """

    def __init__(self, prefix: Prefix) -> None:
        self._prefix = prefix

    def on_bus(self, name: str) -> str:
        """The name of a frame on the bus."""
        return self._prefix.on_bus(name)

    def question(self, asked: Question) -> Question:
        """A question with the names of the bus."""
        fixed = None if asked.fixed is None else self._prefix.on_bus(asked.fixed)
        return asked._replace(
            target=self._prefix.on_bus(asked.target), source=self._prefix.on_bus(asked.source), fixed=fixed
        )

    def answer(self, found: TransformStamped) -> TransformStamped:
        """An answer with local names."""
        return renamed(found, self._prefix.local(found.parent), self._prefix.local(found.child))

    def pending(self, found: PendingLookup) -> PendingLookup:
        """A waiting lookup with the local names of its question; its error keeps the names of the bus."""
        asked = found.question
        fixed = None if asked.fixed is None else self._prefix.local(asked.fixed)
        asked = asked._replace(
            target=self._prefix.local(asked.target), source=self._prefix.local(asked.source), fixed=fixed
        )
        return replace(found, question=asked)

    def edge(self, found: Edge) -> Edge:
        """An edge with local names."""
        return replace(found, parent=self._prefix.local(found.parent), child=self._prefix.local(found.child))

    def explanation(self, found: Explanation, target: str, source: str) -> Explanation:
        """An explanation with local names, target and source as asked; its errors keep the names of the bus."""
        return replace(
            found,
            target=target,
            source=source,
            chain=tuple(map(self._prefix.local, found.chain)),
            half_chains=tuple(tuple(map(self._prefix.local, half)) for half in found.half_chains),
            edges=tuple(
                replace(edge, parent=self._prefix.local(edge.parent), child=self._prefix.local(edge.child))
                for edge in found.edges
            ),
        )


_CANCELLED_KEPT = 64


Cancel = Callable[[], object]
"""Cancels a call, if it has not been made."""

CallAfter = Callable[[float, Callable[[], object]], Cancel]
"""Calls a function on an event loop after a duration in s, unless it is cancelled; the function must not raise."""


def _nothing() -> None:
    """Cancel nothing."""


class Alarms(Protocol):
    """Calls functions after a duration on some clock."""

    def on(self, loop: Any) -> CallAfter:
        """The alarms on the running event loop, as `running_loop` gives it."""


def alarms_of(clock: Clock) -> Alarms:
    """Alarms by the clock of a bus."""
    # Not isinstance: a class derived from a clock may tell the time in another way.
    if type(clock) is SystemClock:
        return LoopAlarms()
    return SimulatedAlarms(clock) if type(clock) is SimulatedClock else ClockAlarms(clock)


class ClockAlarms:
    """Alarms by a clock that is not a class of tfbus: each is a task in a scope of that clock."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock

    def on(self, loop: Any) -> CallAfter:
        """The alarms on the running event loop, as `running_loop` gives it."""

        def call_after(seconds: float, callback: Callable[[], object]) -> Cancel:
            alarm = anyio.CancelScope()
            spawn(loop, partial(self._ring, alarm, self._clock.move_on_after(seconds), callback))
            return alarm.cancel

        return call_after

    async def _ring(
        self, alarm: anyio.CancelScope, time: AbstractContextManager[anyio.CancelScope], callback: Callable[[], object]
    ) -> None:
        with alarm:
            with time:
                await anyio.sleep_forever()
            call_back(callback)


class SimulatedAlarms:
    """Alarms by a simulated clock, which keeps them with its other timers."""

    def __init__(self, clock: SimulatedClock) -> None:
        self._clock = clock

    def on(self, loop: Any) -> CallAfter:  # noqa: ARG002 - simulated time is the same on every loop
        """Alarms after simulated durations."""
        return lambda seconds, callback: self._clock.call_after(seconds, callback).close


class LoopAlarms:
    """Alarms by the time of the event loop that runs, which may be another one later."""

    def __init__(self) -> None:
        self._heap: AlarmHeap | None = None

    def on(self, loop: Any) -> CallAfter:
        """The alarms on the running event loop, as `running_loop` gives it."""
        if self._heap is None or self._heap.timer.loop is not loop:
            # The heap of another loop still wakes the lookups that wait there.
            self._heap = AlarmHeap(loop)
        return self._heap.add


class AlarmHeap:
    """The alarms on one event loop by their times, with one timer for the first."""

    def __init__(self, loop: Any) -> None:
        self.timer: LoopTimer = LoopTimer(loop, self._ring)
        self._now = self.timer.now
        # With a list of the callback, which is empty once the call is made or cancelled.
        self._alarms: list[tuple[float, int, list[Callable[[], object]]]] = []
        self._most = _CANCELLED_KEPT
        self._numbers = count()

    def __len__(self) -> int:
        return len(self._alarms)

    def add(self, seconds: float, callback: Callable[[], object]) -> Cancel:
        due = self._now() + seconds
        alarms = self._alarms
        if len(alarms) > self._most:
            alarms[:] = [alarm for alarm in alarms if alarm[2]]
            heapify(alarms)
            self._most = 2 * len(alarms) + _CANCELLED_KEPT
        made = [callback]
        heappush(alarms, (due, next(self._numbers), made))
        if due < self.timer.due:
            self.timer.set(due)
        # No function of Python, because nearly every wait cancels its alarms before it gives its answer.
        return made.clear

    def _ring(self) -> None:
        """Make the calls that are due, and set the timer for the next."""
        now = self.timer.now()
        try:
            while self._alarms and (self._alarms[0][0] <= now or not self._alarms[0][2]):
                made = heappop(self._alarms)[2]
                if made:
                    made.pop()()
        finally:
            if self._alarms and self._alarms[0][0] < self.timer.due:
                self.timer.set(self._alarms[0][0])


REPORT_AFTER = 5.0
"""A lookup that has waited for this long, in s, is logged."""

NAMED = 3
"""The number of lookups that a line names; naming one searches all frames for similar names."""

_NO_TIMEOUT = 1e7
"""A timeout of this many s, a third of a year, is never meant; but 10 ms in nanoseconds is this number."""

_LOOKED_AT = 10_000
_LEAST_PAUSE = 0.1


class HangingReport:
    """Logs the lookups of one buffer that have waited for `REPORT_AFTER`, each cause once.

    Parameters
    ----------
    share : Share
    clock : Clock
    blocker : callable
        Gives the error that blocks a waiter; None if it has found its answer.
    """

    def __init__(self, share: Share, clock: Clock, blocker: Callable[[Waiter], TransformLookupError | None]) -> None:
        self._share = share
        self._clock = clock
        self._blocker = blocker
        self._told = SeenKeys(_LOOKED_AT)
        self._last: int | None = None

    def tell(self) -> float:
        """Log the lookups that have waited for `REPORT_AFTER`, unless a line was logged just now.

        Returns
        -------
        float
            The time, in s, until the next call of this method; infinity if no lookup waits whose cause is untold.
        """
        now = self._clock.now()
        if self._last is not None and 0 <= now - self._last < from_seconds(REPORT_AFTER):
            return REPORT_AFTER - to_seconds(now - self._last)
        named: list[PendingLookup] = []
        unnamed = 0
        first = math.inf
        doubt = ""
        for waiter in self._share.waiters[:_LOOKED_AT]:
            pause = REPORT_AFTER - to_seconds(now - waiter.since)
            if waiter.patience <= REPORT_AFTER or waiter.cause in self._told:
                continue
            if pause > 0.0:
                first = min(first, pause)
            elif len(named) == NAMED:
                unnamed += self._told.add(waiter.cause)
            elif (blocker := self._blocker(waiter)) is not None:
                self._told.add(waiter.cause)
                if _NO_TIMEOUT <= waiter.patience < math.inf:
                    doubt = f"; a timeout of {waiter.patience:,.0f} s, nanoseconds passed as seconds?"
                named.append(PendingLookup(waiter.question, waiter.since, blocker))
        if not named:
            return max(first, _LEAST_PAUSE)
        self._last = now
        log = logging.getLogger("tfbus")
        if len(named) == 1:
            question = named[0].question
            log.warning(
                "a lookup of %r in %r has waited for more than %g s: %s%s",
                question.source,
                question.target,
                REPORT_AFTER,
                named[0].blocked_by,
                doubt,
            )
        else:
            lookups = "; ".join(map(str, named)) + doubt
            more = f"; and {unnamed} more, see Buffer.pending()" if unnamed else ""
            log.warning(
                "%d lookups have waited for more than %g s: %s%s", len(named) + unnamed, REPORT_AFTER, lookups, more
            )
        return max(first, REPORT_AFTER)


class Wait(Waiter):
    """A lookup that waits, from its first error to its end."""

    sleep: Generator[Any, None, None]
    expired: bool = False

    def expire(self) -> None:
        """End the wait."""
        self.expired = True
        # Woken or cancelled already.
        with suppress(Exception):
            self.wake()


class Lookups:
    """Answers questions from a live tree, at once or as soon as there is an answer.

    Parameters
    ----------
    share : Share
        The buffer's share of the live tree.
    bus : Bus
        Its clock measures timeouts and ages; it says which thread may wait here.
    local_names : LocalNames, optional
        Translates the answers. Questions, errors and log lines have the names of the bus.

    Attributes
    ----------
    forest : Forest
        The forest that answers.
    now : callable
        The bus's clock, in ns.
    feed : Feed or None
        Asks for this buffer, and parks its lookups; only the compiled kernel has one.
    """

    def __init__(
        self,
        share: Share,
        bus: Bus,
        local_names: LocalNames | None = None,
    ) -> None:
        self.share = share
        self.forest: Forest = share.live.forest
        self.bus = bus
        self._clock = bus.clock
        # One call less, as each wait notes when it began.
        self.now: Callable[[], int] = time_ns if type(bus.clock) is SystemClock else bus.clock.now
        self._is_here = bus._is_here
        self._local_names = local_names
        self._alarms = alarms_of(bus.clock)
        self._report = HangingReport(share, bus.clock, self.blocker)
        # The loop on which the next look at the lookups that hang is due, if one is, and the function that cancels it.
        self._looking_on: Any = None
        self._cancel_look: Cancel = _nothing
        self.feed: Any = share.feed
        if self.feed is not None:
            self.feed.kind, self.feed.here, self.feed.begin = Wait, here, self.begin

    def bounds(self, max_age: float, at: int | Latest, source_at: int | Latest | None) -> Bounds | None:
        """The stamps that count as `LATEST` now; None for any."""
        if at is not LATEST and source_at is not LATEST:
            raise TypeError("max_age goes with LATEST: an answer at a given stamp never gets newer")
        if as_duration(max_age, "max_age") == math.inf:
            return None
        now, age = self._clock.now(), from_seconds(max_age)
        return Bounds(max(now - age, STAMP_MIN), min(now + age, STAMP_MAX))

    def complete(self, error: TransformLookupError, max_age: float | None, bounds: Bounds | None) -> None:
        """Write into an error of the tree what only the bus and its clock know."""
        if type(error) is UnknownFrameError:
            error.missed = self.share.end_reason is None and error.frame in self.bus._topology.names.frames
            return
        if not isinstance(error, ExtrapolationError):
            return
        if max_age is not None and bounds is not None and error.newest is not None and error.stamp in bounds:
            error.max_age = from_seconds(max_age)
        # The clock alone nearly always tells that it is not; how far ahead a stamp may be is asked only then.
        if error.newest is not None and self._clock.now() < error.newest > self.bus._newest_plausible():
            error.ahead = error.newest - self._clock.now()
        error._clock_namers = self.bus._clock_namers

    def lookup_nowait(self, question: Question, ask: Callable[..., TransformStamped] = answer) -> TransformStamped:
        """The answer, or an error at once. `ask` may be another function with the arguments of `answer`."""
        bounds = None
        if question.is_plain and ask is answer:
            plain = self.forest.paths.answer(question.target, question.source, question.at)
            if plain is not None:
                return plain if self._local_names is None else self._local_names.answer(plain)
        if question.max_age is not None:
            bounds = self.bounds(question.max_age, question.at, question.source_at)
        try:
            found = ask(
                self.forest,
                question.target,
                question.source,
                question.at,
                question.source_at,
                question.fixed,
                bounds,
                question.policy,
            )
        except TransformLookupError as error:
            self.complete(error, question.max_age, bounds)
            raise
        return found if self._local_names is None else self._local_names.answer(found)

    async def lookup(self, question: Question, timeout: float | None) -> TransformStamped:
        """The answer as soon as there is one, after a checkpoint; the errors are as in `Buffer.lookup`."""
        patience = math.inf if timeout is None else as_duration(timeout, "timeout")
        last_reset = self.share.live.last_reset
        await checkpoint()
        wait = Wait(question, self.now(), _nothing)
        wait.patience = patience
        return await self.go_on(wait, last_reset)

    async def go_on(self, wait: Wait, last_reset: ClockResetError | None) -> TransformStamped:
        """As `lookup`, for a task that has passed the checkpoint, and may have been woken.

        Every jump back of the clock after `last_reset` ends it.
        """
        waiting = self.share.live.waiting
        try:
            while True:
                waiting.remove(wait)
                if wait.expired:
                    return self._last_answer(wait, last_reset)
                found = self._ask(wait, last_reset)
                if found is not None:
                    return found
                # Timeouts of zero give the others a turn as well.
                await (checkpoint() if wait.expired else asleep(wait.sleep))
                found = self.given(wait)
                if found is not None:
                    return found
        finally:
            self.end(wait)

    def begin(self, wait: Wait) -> bool:
        """Whether the kernel may park a lookup on the event loop that runs now. Called by the kernel.

        The kernel does not ask again on that loop.
        """
        loop = running_loop()
        is_here = self._looking_on is loop or self._is_here()
        if not is_here or self.share.end_reason is not None or wait.patience == 0.0:
            return False
        self._look_on(loop, REPORT_AFTER)
        self.feed.loop, self.feed.call_after = loop, self._alarms.on(loop)
        return True

    def given(self, wait: Wait) -> TransformStamped | None:
        """The answer that came with the wake-up, if nothing has changed since."""
        found: TransformStamped | None = wait.answer
        if found is None or wait.version != self.forest.paths.version:
            return None
        return found if self._local_names is None else self._local_names.answer(found)

    def park(self, wait: Wait, error: TransformLookupError | None = None) -> bool:
        """Let a lookup wait: its `wake` is called inside the insertion that may unblock it, and by its alarm.

        Parameters
        ----------
        wait : Wait
            A lookup that has no answer now.
        error : TransformLookupError, optional
            The error that blocks the lookup. Without it, only the kernel may park the lookup: one question that lacks
            nothing but newer samples.

        Returns
        -------
        bool
            Whether the lookup waits.

        Raises
        ------
        BusClosedError
            If there is an error, and no more samples will come.
        """
        ended = self.share.end_reason
        if error is None and (self.feed is None or ended is not None or wait.others):
            return False
        if ended is not None:
            raise BusClosedError(ended) from error
        wait.share = self.share
        try:
            if error is not None:
                self.share.live.waiting.remove(wait)
                self.share.park(wait, error)
            elif not self.feed.park(wait):
                return False
            loop = running_loop()
            self._look_on(loop, REPORT_AFTER - to_seconds(self.now() - wait.since))
            if wait.patience == 0.0:
                wait.expired = True
            elif wait.patience < math.inf and wait.cancel_end is None:
                wait.cancel_end = self._alarms.on(loop)(wait.patience, wait.expire)
        except BaseException:
            self.end(wait)
            raise
        return True

    def end(self, wait: Wait) -> None:
        """Leave nothing of a wait behind."""
        self.share.live.waiting.remove(wait)
        if wait.cancel_end is not None:
            wait.cancel_end()

    def close(self) -> None:
        """Look no more at the lookups that hang."""
        self._look_after(math.inf)

    def pending(self, most: int | None = None) -> Iterator[PendingLookup]:
        """All waiting lookups, or the first few, with the errors that block them. For any thread."""
        for waiter in self.share.waiters[:most]:
            if (blocker := self.blocker(waiter)) is not None:
                yield PendingLookup(waiter.question, waiter.since, blocker)

    def blocker(self, waiter: Waiter) -> TransformLookupError | None:
        """The error that blocks a parked waiter now; None if it has found its answer. For any thread."""
        try:
            self.lookup_nowait(waiter.question)
        except TransformLookupError as error:
            return without_traceback(error)
        return waiter.blocked_by

    def report(self) -> float:
        """Log the lookups that have waited for long; return the time, in s, after which to call this again."""
        return self._report.tell()

    def _ask(self, wait: Wait, last_reset: ClockResetError | None) -> TransformStamped | None:
        """The answer; or None, after parking the lookup under the frames that block it, with a new wake-up."""
        found = self._look(wait, last_reset)
        if found is None and wait.blocked_by is not None:
            self.bus._check_waiter()
            wait.sleep, wait.wake = wake_up(running_loop())
            self.park(wait, wait.blocked_by)
        return found

    def _look(self, wait: Wait, last_reset: ClockResetError | None) -> TransformStamped | None:
        """The answer; or None, after noting the error that blocks it."""
        latest = self.share.live.last_reset
        if latest is not None and latest is not last_reset:
            raise ClockResetError(before=latest.before, after=latest.after)
        try:
            return self.lookup_nowait(wait.question)
        except MAY_COME as error:
            if isinstance(error, UnknownFrameError):
                self._check_names(wait.question)
            wait.blocked_by = without_traceback(error)
        return None

    def _last_answer(self, wait: Wait, last_reset: ClockResetError | None) -> TransformStamped:
        """The answer of a wait whose time is up: the data may have come in the same turn of the loop."""
        found = self._look(wait, last_reset)
        if found is not None:
            return found
        target, source, *_ = wait.question
        missing = cast(TransformLookupError, wait.blocked_by)
        raise LookupTimeoutError(target=target, source=source, timeout=wait.patience, missing=missing) from missing

    def _look_on(self, loop: Any, pause: float) -> None:
        """Look at the lookups that hang after some time (s), unless a look on this loop is due."""
        if self._looking_on is not loop:
            self._look_after(max(pause, 0.0))

    def _look_after(self, pause: float) -> None:
        """Look at the lookups that hang after some time (s), unless that is infinite."""
        self._cancel_look()
        if self.feed is not None:
            self.feed.loop = None
        if pause < math.inf:
            self._looking_on = loop = running_loop()
            self._cancel_look = self._alarms.on(loop)(pause, lambda: self._look_after(self.report()))
        else:
            self._looking_on, self._cancel_look = None, _nothing

    def _check_names(self, question: Question) -> None:
        """Raise `UnknownFrameError` for a name that can never be the name of a frame."""
        for name in (question.target, question.source, question.fixed):
            if name is not None and not is_frame(name):
                raise UnknownFrameError(frame=name, known=self.forest.some_frames()) from None
