"""Lookups that wait: parked under the frames that they lack, woken by new samples, and tried again."""

import math
from collections.abc import Callable
from contextlib import nullcontext, suppress

import anyio
import anyio.lowlevel

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
        since = self._clock.now()
        silent = min(limit, REPORT_AFTER)
        found = await self._lookup_within(silent, question, since, last_reset, blocker, others, report=False)
        if isinstance(found, TransformLookupError) and silent < limit:
            found = await self._lookup_within(limit - silent, question, since, last_reset, found, others, report=True)
        if isinstance(found, TransformLookupError):
            raise LookupTimeoutError(
                target=question.target, source=question.source, timeout=limit, missing=found
            ) from found
        return found

    async def park(
        self, question: Question, since: int, blocker: TransformLookupError, others: tuple[Question, ...] = ()
    ) -> None:
        """Wait for a sample that may have removed the cause of `blocker`.

        Raises
        ------
        BusClosedError
            If no more samples will come.
        """
        if self._live.end_reason is not None:
            raise BusClosedError(self._live.end_reason) from blocker
        woken = anyio.Event()
        waiter = Waiter(question, since, woken.set, others)
        self._live.park(waiter, blocker)
        try:
            await woken.wait()
        except BaseException:
            # Cancelled. A waiter that is woken has been removed before.
            self._live.waiting.remove(waiter)
            raise

    def report(self, question: Question, since: int, blocker: TransformLookupError) -> float:
        """Log a lookup that has waited for long; return the time, in s, after which to call this again."""
        return self._report.tell(question, since, blocker)

    async def _lookup_within(
        self,
        seconds: float,
        question: Question,
        since: int,
        last_reset: ClockResetError | None,
        blocker: TransformLookupError,
        others: tuple[Question, ...],
        *,
        report: bool,
    ) -> TransformStamped | TransformLookupError:
        """Wait for the answer for some time; return it, or the error that still blocks it."""
        pause = math.inf
        with self._clock.move_on_after(seconds):
            while True:
                if report:
                    pause = self.report(question, since, blocker)
                with nullcontext() if pause == math.inf else self._clock.move_on_after(pause):
                    await self.park(question, since, blocker, others)
                try:
                    return self._lookup_since(last_reset, question)
                except MAY_COME as error:
                    blocker = without_traceback(error)
                for other in others:
                    with suppress(*MAY_COME):
                        self.lookup_nowait(other)
        try:
            # The data may have come in the same turn of the loop in which the time was up.
            return self._lookup_since(last_reset, question)
        except MAY_COME as error:
            return without_traceback(error)

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
                raise UnknownFrameError(frame=name, known=self._live.forest.known_frames()) from None
