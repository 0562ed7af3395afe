"""Lookups that wait: parked under the frames that they lack, and woken by new samples.

Whoever inserts the samples hands over the answer. It is given if the tree has not changed until the task runs, one turn
of the event loop later; otherwise the lookup asks again, and may park again.
"""

import math
from collections.abc import Awaitable, Callable
from contextlib import suppress
from functools import partial

import anyio
import anyio.lowlevel

from tfbus._aio.wake_up import wake_up
from tfbus.buffer._alarms import Alarms, Cancel, alarms_of
from tfbus.buffer._hanging_report import REPORT_AFTER, HangingReport
from tfbus.buffer._local_names import LocalNames
from tfbus.clock import Clock
from tfbus.errors import (
    MAY_COME,
    BusClosedError,
    ClockResetError,
    ExtrapolationError,
    LookupTimeoutError,
    TransformLookupError,
    UnknownFrameError,
)
from tfbus.frames import is_frame
from tfbus.geometry.stamped import TransformStamped
from tfbus.stamps import LATEST, STAMP_MAX, STAMP_MIN, Latest, as_duration, from_seconds
from tfbus.tree.lookup import Bounds, answer
from tfbus.tree.question import Question
from tfbus.waiting.live_tree import LiveTree
from tfbus.waiting.waiting_index import Waiter, without_traceback


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
    live : LiveTree
    clock : Clock
        The clock of timeouts and ages.
    check_thread : callable
        Raises unless the calling thread may wait here.
    newest_plausible : callable
        Gives the greatest stamp, in ns, that is not ahead of the clock now.
    local_names : LocalNames, optional
        Translates the answers. Questions, errors and log lines have the names of the bus.
    """

    def __init__(
        self,
        live: LiveTree,
        clock: Clock,
        check_thread: Callable[[], object],
        newest_plausible: Callable[[], int],
        local_names: LocalNames | None = None,
    ) -> None:
        self._live = live
        self._clock = clock
        self._check_thread = check_thread
        self._newest_plausible = newest_plausible
        self._local_names = local_names
        self._report = HangingReport(live.waiting, clock)
        self._alarms = alarms_of(clock)

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
        if error.newest is not None and error.newest > self._newest_plausible():
            error.ahead = error.newest - self._clock.now()

    def lookup_nowait(self, question: Question) -> TransformStamped:
        """The answer, or an error at once."""
        bounds = None
        if question.is_plain:
            plain = self._live.forest.paths.answer(question.target, question.source, question.at)
            if plain is not None:
                return plain if self._local_names is None else self._local_names.answer(plain)
        if question.max_age is not None:
            bounds = self.bounds(question.max_age, question.at, question.source_at)
        try:
            found = answer(
                self._live.forest,
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
        """The answer as soon as there is one, after a checkpoint; the errors are those of `Buffer.lookup`.

        `others` are questions whose answers are needed as well: an error of one that waiting cannot help is raised.
        """
        limit = math.inf if timeout is None else as_duration(timeout, "timeout")
        last_reset = self._live.last_reset
        await anyio.lowlevel.checkpoint()
        try:
            return self._lookup_since(last_reset, question)
        except MAY_COME as error:
            self._check_names(question)
            blocker = without_traceback(error)
        self._check_thread()
        wait = _Wait(question, self._clock.now(), last_reset, blocker, others)
        alarms = self._alarms
        if alarms is None:
            found = await self._wait_in_scopes(wait, limit)
            if found is not None:
                return found
            raise _timed_out(wait, limit) from wait.blocker
        # Here and not in a coroutine of its own, because each would be resumed one by one.
        self._set_alarms(wait, limit, alarms)
        waiting, paths = self._live.waiting, self._live.forest.paths
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
                    # As it was when the waiter was woken, and removed.
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
        """Park a lookup under what it lacks, with a new wake-up."""
        live = self._live
        if live.end_reason is not None:
            raise BusClosedError(live.end_reason) from wait.blocker
        wait.woken, wait.wake = wake_up()
        waiter = Waiter(wait.question, wait.since, wait.wake, wait.others)
        live.park(waiter, wait.blocker)
        return waiter

    def _ask_again(self, wait: "_Wait") -> TransformStamped | None:
        """The answer, or None; then the error that blocks it is noted."""
        try:
            # The data may have come in the same turn of the loop in which the time was up.
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
                            self._live.waiting.remove(waiter)
                        found = self._ask_again(wait)
                if found is None:
                    pause = min(self.report(wait.question, wait.since, wait.blocker), REPORT_AFTER)
                    found = self._ask_again(wait)
        return self._ask_again(wait) if found is None else found

    def _lookup_since(self, last_reset: ClockResetError | None, question: Question) -> TransformStamped:
        """The answer, or `ClockResetError` if the clock has jumped back after `last_reset`."""
        latest = self._live.last_reset
        if latest is not None and latest is not last_reset:
            raise ClockResetError(before=latest.before, after=latest.after)
        return self.lookup_nowait(question)

    def _check_names(self, question: Question) -> None:
        """Raise `UnknownFrameError` for a name that can never be that of a frame."""
        for name in (question.target, question.source, question.fixed):
            if name is not None and not is_frame(name):
                raise UnknownFrameError(frame=name, known=self._live.forest.some_frames()) from None


def _timed_out(wait: _Wait, limit: float) -> LookupTimeoutError:
    """The error of a wait that had no answer for some time (s)."""
    question = wait.question
    return LookupTimeoutError(target=question.target, source=question.source, timeout=limit, missing=wait.blocker)
