"""Lookups that wait: parked under the frames that they lack, and woken by new samples.

`Lookups.lookup` is the whole wait. It passes a checkpoint, asks the tree, and if the answer may still come it parks a
`Waiter` in the live tree (`tfbus.waiting.live_tree` says under which frame) and awaits its wake-up. The insertion that
unblocks the lookup hands over the answer. The task gives that answer if the tree has not changed until it runs, one
turn of the event loop later; otherwise it asks again, and may park again on the same deadline.

An alarm ends a wait at its timeout. A cancel scope for each wait would set and remove a timer of the event loop each
time; the alarms of a buffer share one timer. The timer is set for the first alarm. When that alarm is cancelled, the
timer stays, because the next alarm is nearly always later. A lookup that has waited for 5 s is logged, together with
all others that have.
"""

import logging
import math
import sys
from collections.abc import Awaitable, Callable, Generator, Hashable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from heapq import heapify, heappop, heappush
from itertools import count, islice
from typing import Any, Protocol, cast

import anyio
import anyio.lowlevel
import anyio.to_thread

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
from tfbus.tree.history import Edge
from tfbus.tree.lookup import Bounds, Question, answer
from tfbus.waiting.live_tree import PendingLookup, Share, Waiter, blocking_frames, without_traceback


def running_loop() -> Any:
    """The running event loop: the loop object of asyncio, or the token of trio."""
    # anyio has no public timer; only the loops' own functions set one without a task of the caller.
    return cast(Any, anyio.lowlevel.current_token().native_token)


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
    """

    def __init__(self, loop: Any, callback: Callable[[], object]) -> None:
        self.loop = loop
        self.due = math.inf
        self._callback = callback
        self._trio = None if hasattr(loop, "call_at") else cast(Any, sys.modules["trio"])
        self._handle: Any = None

    def now(self) -> float:
        """The time of the loop, in s, while the loop runs."""
        return float(self.loop.time() if self._trio is None else self._trio.current_time())

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
            self._trio.lowlevel.spawn_system_task(self._sleep, self._handle)

    def _fire(self) -> None:
        self._handle = None
        self.due = math.inf
        try:
            self._callback()
        except Exception:
            # No task would receive the error, and it would end the whole run of trio.
            logging.getLogger("tfbus").exception("a timer raised")

    async def _sleep(self, scope: Any) -> None:
        with scope:
            await cast(Any, self._trio).sleep_forever()
        self._fire()


def wake_up() -> tuple[Awaitable[None], Callable[[], object]]:
    """A wait of one task on the loop that runs now, to be awaited once, and the function that ends it.

    If it was ended before the task awaits it, there is no checkpoint. The function may raise an `Exception` if the wait
    has ended, or the event loop is closed.
    """
    loop = running_loop()
    if hasattr(loop, "create_future"):
        # No function of Python is then on the way from a publish to the event loop.
        future = loop.create_future()
        return future, partial(future.set_result, None)
    woken = _TrioWakeUp()
    return woken, woken.end


class _TrioWakeUp:
    """A wait of one task on trio."""

    __slots__ = ("_ended", "_task")

    def __init__(self) -> None:
        self._task: Any = None
        self._ended = False

    def end(self) -> None:
        """End the wait, if it has not ended."""
        if not self._ended:
            self._ended = True
            task, self._task = self._task, None
            if task is not None:
                cast(Any, sys.modules["trio"]).lowlevel.reschedule(task)

    def __await__(self) -> Generator[Any, None, None]:
        if self._ended:
            return _nothing()
        lowlevel = cast(Any, sys.modules["trio"]).lowlevel
        self._task = lowlevel.current_task()
        return cast(Generator[Any, None, None], lowlevel.wait_task_rescheduled(self._abort).__await__())

    def _abort(self, _raise_cancel: object) -> Any:
        """End the wait, because trio has cancelled it."""
        self._task = None
        self._ended = True
        return cast(Any, sys.modules["trio"]).lowlevel.Abort.SUCCEEDED


def _nothing() -> Generator[Any, None, None]:
    yield from ()


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
        return replace(
            asked, target=self._prefix.on_bus(asked.target), source=self._prefix.on_bus(asked.source), fixed=fixed
        )

    def answer(self, found: TransformStamped) -> TransformStamped:
        """An answer with local names."""
        return renamed(found, self._prefix.local(found.parent), self._prefix.local(found.child))

    def pending(self, found: PendingLookup) -> PendingLookup:
        """A waiting lookup with the local names of its question; its error keeps the names of the bus."""
        asked = found.question
        fixed = None if asked.fixed is None else self._prefix.local(asked.fixed)
        asked = replace(
            asked, target=self._prefix.local(asked.target), source=self._prefix.local(asked.source), fixed=fixed
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


class Alarms(Protocol):
    """Calls functions after a duration on some clock."""

    def call_after(self, seconds: float, callback: Callable[[], object]) -> Cancel:
        """Call a function on the event loop after a duration in s, unless it is cancelled; it must not raise."""


def alarms_of(clock: Clock) -> Alarms | None:
    """Alarms by the clock of a bus; None for a clock that is not a class of tfbus."""
    # Not isinstance: a class derived from a clock may tell the time in another way.
    if type(clock) is SystemClock:
        return LoopAlarms()
    return SimulatedAlarms(clock) if type(clock) is SimulatedClock else None


class SimulatedAlarms:
    """Alarms by a simulated clock, which keeps them with its other timers."""

    def __init__(self, clock: SimulatedClock) -> None:
        self._clock = clock

    def call_after(self, seconds: float, callback: Callable[[], object]) -> Cancel:
        """Call a function after a simulated duration in s, unless it is cancelled; it must not raise."""
        return self._clock.call_after(seconds, callback).close


class LoopAlarms:
    """Alarms by the time of the event loop that runs, which may be another one later."""

    def __init__(self) -> None:
        self._heap: AlarmHeap | None = None

    def call_after(self, seconds: float, callback: Callable[[], object]) -> Cancel:
        """Call a function on the event loop after a duration in s, unless it is cancelled; it must not raise."""
        loop = running_loop()
        heap = self._heap
        if heap is None or heap.timer.loop is not loop:
            # The heap of another loop still wakes the lookups that wait there.
            heap = self._heap = AlarmHeap(loop)
        return heap.add(seconds, callback)


class AlarmHeap:
    """The alarms on one event loop by their times, with one timer for the first."""

    def __init__(self, loop: Any) -> None:
        self.timer = LoopTimer(loop, self._ring)
        self._alarms: list[tuple[float, int]] = []
        # The callbacks that are neither made nor cancelled, by number.
        self._callbacks: dict[int, Callable[[], object]] = {}
        self._numbers = count()

    def __len__(self) -> int:
        return len(self._alarms)

    def add(self, seconds: float, callback: Callable[[], object]) -> Cancel:
        due = self.timer.now() + seconds
        number = next(self._numbers)
        callbacks = self._callbacks
        callbacks[number] = callback
        if len(self._alarms) > 2 * len(callbacks) + _CANCELLED_KEPT:
            self._alarms = [alarm for alarm in self._alarms if alarm[1] in callbacks]
            heapify(self._alarms)
        heappush(self._alarms, (due, number))
        if due < self.timer.due:
            self.timer.set(due)
        # No function of Python, because nearly every wait cancels its alarms before it gives its answer.
        return partial(callbacks.pop, number, None)

    def _ring(self) -> None:
        """Make the calls that are due, and set the timer for the next."""
        now = self.timer.now()
        try:
            while self._alarms and (self._alarms[0][0] <= now or self._alarms[0][1] not in self._callbacks):
                callback = self._callbacks.pop(heappop(self._alarms)[1], None)
                if callback is not None:
                    callback()
        finally:
            if self._alarms and self._alarms[0][0] < self.timer.due:
                self.timer.set(self._alarms[0][0])


REPORT_AFTER = 5.0
"""A lookup that has waited for this long, in s, is logged."""

NAMED = 3
"""The number of lookups that a line names; naming one searches all frames for similar names."""

_LOOKED_AT = 10_000


class HangingReport:
    """Logs the lookups of one buffer that have waited for `REPORT_AFTER`, each cause once.

    Parameters
    ----------
    share : Share
    clock : Clock
    """

    def __init__(self, share: Share, clock: Clock) -> None:
        self._share = share
        self._clock = clock
        self._told = SeenKeys(_LOOKED_AT)
        self._last: int | None = None

    def tell(self, question: Question, since: int, blocker: TransformLookupError) -> float:
        """Log a lookup that has waited for `REPORT_AFTER`, and all others that have, unless a line was logged just now.

        Returns
        -------
        float
            The time, in s, until the next call of this method; infinity if the cause has been logged.
        """
        if _cause(blocker) in self._told:
            return math.inf
        now = self._clock.now()
        if self._last is not None and 0 <= now - self._last < from_seconds(REPORT_AFTER):
            return REPORT_AFTER - to_seconds(now - self._last)
        self._last = now
        self._told.add(_cause(blocker))
        named = [PendingLookup(question, since, blocker)]
        untold = 0
        long = (each for each in self._share.pending() if each.since <= now - from_seconds(REPORT_AFTER))
        for pending in islice(long, _LOOKED_AT):
            if self._told.add(_cause(pending.blocked_by)):
                if len(named) < NAMED:
                    named.append(pending)
                else:
                    untold += 1
        log = logging.getLogger("tfbus")
        if len(named) == 1:
            log.warning(
                "a lookup of %r in %r has waited for more than %g s: %s",
                question.source,
                question.target,
                REPORT_AFTER,
                blocker,
            )
        else:
            lookups = "; ".join(map(str, named))
            more = f"; and {untold} more, see Buffer.pending()" if untold else ""
            log.warning(
                "%d lookups have waited for more than %g s: %s%s", len(named) + untold, REPORT_AFTER, lookups, more
            )
        return math.inf


def _cause(blocker: TransformLookupError) -> Hashable:
    return type(blocker), blocking_frames(blocker)


class _Wait:
    """A lookup that waits, from its first error to its end."""

    __slots__ = (
        "blocker",
        "cancel_end",
        "cancel_reminder",
        "expired",
        "is_long",
        "last_reset",
        "others",
        "question",
        "since",
        "wake",
        "woken",
    )
    woken: Awaitable[None]
    wake: Callable[[], object]

    def __init__(
        self,
        question: Question,
        since: int,
        last_reset: ClockResetError | None,
        blocker: TransformLookupError,
        others: tuple[Question, ...],
    ) -> None:
        self.question = question
        self.since = since
        self.last_reset = last_reset
        self.blocker = blocker
        self.others = others
        self.cancel_end: Cancel | None = None
        self.cancel_reminder: Cancel | None = None
        self.expired = False
        self.is_long = False

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
    """

    def __init__(
        self,
        share: Share,
        bus: Bus,
        local_names: LocalNames | None = None,
    ) -> None:
        self.share = share
        self.forest = share.live.forest
        self.bus = bus
        self._clock = bus.clock
        self._local_names = local_names
        self._report = HangingReport(share, bus.clock)
        self._alarms = alarms_of(bus.clock)

    def bounds(self, max_age: float, at: int | Latest, source_at: int | Latest | None) -> Bounds | None:
        """The stamps that count as `LATEST` now; None for any."""
        if at is not LATEST and source_at is not LATEST:
            raise TypeError("max_age goes with LATEST: an answer at a given stamp never gets newer")
        if as_duration(max_age, "max_age") == math.inf:
            return None
        now, age = self._clock.now(), from_seconds(max_age)
        return Bounds(max(now - age, STAMP_MIN), min(now + age, STAMP_MAX))

    def note_ahead(self, error: ExtrapolationError) -> None:
        """Write into an error by how much the newest stamp of its edge is ahead of the clock."""
        # The clock alone nearly always tells that it is not; how far ahead a stamp may be is asked only then.
        if error.newest is not None and self._clock.now() < error.newest > self.bus._newest_plausible():
            error.ahead = error.newest - self._clock.now()

    def lookup_nowait(self, question: Question) -> TransformStamped:
        """The answer, or an error at once."""
        bounds = None
        if question.is_plain:
            plain = self.forest.paths.answer(question.target, question.source, question.at)
            if plain is not None:
                return plain if self._local_names is None else self._local_names.answer(plain)
        if question.max_age is not None:
            bounds = self.bounds(question.max_age, question.at, question.source_at)
        try:
            found = answer(
                self.forest,
                question.target,
                question.source,
                question.at,
                question.source_at,
                question.fixed,
                bounds,
                question.policy,
            )
        except ExtrapolationError as error:
            self.note_ahead(error)
            raise
        return found if self._local_names is None else self._local_names.answer(found)

    async def lookup(
        self, question: Question, timeout: float | None, others: tuple[Question, ...] = ()
    ) -> TransformStamped:
        """The answer as soon as there is one, after a checkpoint; the errors are as in `Buffer.lookup`.

        `others` are further questions that need an answer: if waiting cannot help one of them, its error is raised.
        """
        limit = math.inf if timeout is None else as_duration(timeout, "timeout")
        last_reset = self.share.live.last_reset
        await anyio.lowlevel.checkpoint()
        try:
            return self._lookup_since(last_reset, question)
        except MAY_COME as error:
            if isinstance(error, UnknownFrameError):
                self._check_names(question)
            blocker = without_traceback(error)
        self.bus._check_thread()
        wait = _Wait(question, self._clock.now(), last_reset, blocker, others)
        alarms = self._alarms
        if alarms is None:
            found = await self._wait_in_scopes(wait, limit)
            if found is not None:
                return found
            raise _timed_out(wait, limit) from wait.blocker
        # Inline, because every further coroutine would be resumed one by one.
        self._set_alarms(wait, limit, alarms)
        waiting, paths = self.share.live.waiting, self.forest.paths
        try:
            while True:
                waiter = self._park(wait)
                try:
                    # Timeouts of zero give the others a turn as well.
                    await (anyio.lowlevel.checkpoint() if wait.expired else wait.woken)
                except BaseException:
                    waiting.remove(waiter)
                    raise
                found = waiter.answer
                if found is not None and waiter.version == paths.version:
                    # Nothing has changed since the insertion woke and removed the waiter.
                    return found if self._local_names is None else self._local_names.answer(found)
                waiting.remove(waiter)
                found = self._ask_again(wait)
                if found is not None:
                    return found
                if wait.expired:
                    raise _timed_out(wait, limit) from wait.blocker
                if wait.is_long:
                    self._remind(wait, alarms)
        finally:
            if wait.cancel_end is not None:
                wait.cancel_end()
            if wait.cancel_reminder is not None:
                wait.cancel_reminder()

    def report(self, question: Question, since: int, blocker: TransformLookupError) -> float:
        """Log a lookup that has waited for long; return the time, in s, after which to call this again."""
        return self._report.tell(question, since, blocker)

    def _set_alarms(self, wait: "_Wait", limit: float, alarms: Alarms) -> None:
        """Set the alarms for the end of a wait, after some time (s), and for the log line before it."""
        if limit == 0.0:
            wait.expired = True
        elif limit < math.inf:
            wait.cancel_end = alarms.call_after(limit, wait.expire)
        if limit > REPORT_AFTER:
            wait.cancel_reminder = alarms.call_after(REPORT_AFTER, partial(self._remind, wait, alarms))

    def _park(self, wait: "_Wait") -> Waiter:
        """Park a lookup under the frames that block it, with a new wake-up."""
        share = self.share
        if share.end_reason is not None:
            raise BusClosedError(share.end_reason) from wait.blocker
        wait.woken, wait.wake = wake_up()
        waiter = Waiter(wait.question, wait.since, wait.wake, wait.others)
        share.park(waiter, wait.blocker)
        return waiter

    def _ask_again(self, wait: "_Wait") -> TransformStamped | None:
        """The answer; or None, after noting the error that blocks it."""
        try:
            # The data may have come in the turn of the loop in which the time ran out.
            return self._lookup_since(wait.last_reset, wait.question)
        except MAY_COME as error:
            wait.blocker = without_traceback(error)
        for other in wait.others:
            with suppress(*MAY_COME):
                self.lookup_nowait(other)
        return None

    def _remind(self, wait: "_Wait", alarms: Alarms) -> None:
        """Log a lookup that has waited for long, now or when the next line may be logged."""
        wait.is_long = True
        pause = self.report(wait.question, wait.since, wait.blocker)
        if pause < math.inf:
            if wait.cancel_reminder is not None:
                wait.cancel_reminder()
            wait.cancel_reminder = alarms.call_after(pause, partial(self._remind, wait, alarms))

    async def _wait_in_scopes(self, wait: "_Wait", limit: float) -> TransformStamped | None:
        """Wait for the answer for some time (s) by a clock that knows no alarms; None if there was none."""
        pause = REPORT_AFTER
        found = None
        with self._clock.move_on_after(limit):
            while found is None:
                with self._clock.move_on_after(pause):
                    while found is None:
                        waiter = self._park(wait)
                        try:
                            await wait.woken
                        finally:
                            self.share.live.waiting.remove(waiter)
                        found = self._ask_again(wait)
                if found is None:
                    pause = min(self.report(wait.question, wait.since, wait.blocker), REPORT_AFTER)
                    found = self._ask_again(wait)
        return self._ask_again(wait) if found is None else found

    def _lookup_since(self, last_reset: ClockResetError | None, question: Question) -> TransformStamped:
        """The answer, or `ClockResetError` if the clock has jumped back after `last_reset`."""
        latest = self.share.live.last_reset
        if latest is not None and latest is not last_reset:
            raise ClockResetError(before=latest.before, after=latest.after)
        return self.lookup_nowait(question)

    def _check_names(self, question: Question) -> None:
        """Raise `UnknownFrameError` for a name that can never be the name of a frame."""
        for name in (question.target, question.source, question.fixed):
            if name is not None and not is_frame(name):
                raise UnknownFrameError(frame=name, known=self.forest.some_frames()) from None


def _timed_out(wait: _Wait, limit: float) -> LookupTimeoutError:
    """The error of a wait that had no answer for some time (s)."""
    question = wait.question
    return LookupTimeoutError(target=question.target, source=question.source, timeout=limit, missing=wait.blocker)
