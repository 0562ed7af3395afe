"""Where a lookup waits for what it lacks: it is parked under that, woken when it may have come, and asked again."""

import logging
import math
from collections.abc import Callable

import anyio
import anyio.lowlevel

from tfbus._log import OnceLogger
from tfbus.buffer._local_names import LocalNames
from tfbus.clock import Clock
from tfbus.errors import (
    MAY_COME,
    BusClosedError,
    ClockResetError,
    LookupTimeoutError,
    TransformLookupError,
    UnknownFrameError,
)
from tfbus.frames import is_frame
from tfbus.geometry.stamped import TransformStamped
from tfbus.stamps import LATEST, Latest, as_duration, from_seconds
from tfbus.tree.question import Question
from tfbus.waiting.live_tree import LiveTree
from tfbus.waiting.waiting_index import Waiter, blocking_frames, without_traceback

REPORT_AFTER = 5.0
"""A wait that is longer than this, in s, is logged."""


class Lookups:
    """Asks a feed's tree, at once or as soon as there is an answer.

    Parameters
    ----------
    feed : Feed
    clock : Clock
        Timeouts and ages are counted on it.
    check_thread : callable
        Raises unless the caller may wait here.
    prefix : LocalNames, optional
        Answers have its local names. Questions have those of the bus, as errors and the log.
    """

    def __init__(
        self, feed: LiveTree, clock: Clock, check_thread: Callable[[], object], prefix: LocalNames | None = None
    ) -> None:
        self._feed = feed
        self._clock = clock
        self._check_thread = check_thread
        self._prefix = prefix
        self._log = OnceLogger(logging.getLogger("tfbus"))

    def not_before(self, max_age: float, at: int | Latest, source_at: int | Latest | None) -> int | None:
        """The oldest stamp that counts for `LATEST`, now; None for any."""
        if at is not LATEST and source_at is not LATEST:
            raise TypeError("max_age goes with LATEST: an answer at a given stamp never gets newer")
        if as_duration(max_age, "max_age") == math.inf:
            return None
        return self._clock.now() - from_seconds(max_age)

    def ask(self, question: Question) -> TransformStamped:
        """The answer, or an error at once."""
        not_before = None
        if question.max_age is not None:
            not_before = self.not_before(question.max_age, question.at, question.source_at)
        answer = self._feed.tree.answer(
            question.target,
            question.source,
            question.at,
            question.source_at,
            question.fixed,
            not_before,
            question.policy,
        )
        return answer if self._prefix is None else self._prefix.answer(answer)

    async def wait(self, question: Question, timeout: float | None) -> TransformStamped:
        """The answer as soon as there is one, but not before a checkpoint; the errors are those of `Buffer.lookup`."""
        limit = math.inf if timeout is None else as_duration(timeout, "timeout")
        reset = self._feed.last_reset
        await anyio.lowlevel.checkpoint()
        try:
            return self._read(question, reset)
        except MAY_COME as error:
            for name in (question.target, question.source, question.fixed):
                if name is not None and not is_frame(name):
                    raise UnknownFrameError(frame=name, known=self._feed.tree.frames()) from None
            blocker = without_traceback(error)
        self._check_thread()
        since = self._clock.now()
        quiet = min(limit, REPORT_AFTER)
        for late, seconds in ((False, quiet), (True, limit - quiet)):
            with self._clock.move_on_after(seconds):
                while True:
                    if late:
                        self.report(question, blocker)
                    await self.park(question, since, blocker)
                    try:
                        return self._read(question, reset)
                    except MAY_COME as error:
                        blocker = without_traceback(error)
            try:
                # The data may have come in the very turn of the loop in which the time was up.
                return self._read(question, reset)
            except MAY_COME as error:
                blocker = without_traceback(error)
            if seconds >= limit:
                break
        raise LookupTimeoutError(
            target=question.target, source=question.source, timeout=limit, missing=blocker
        ) from blocker

    async def park(self, question: Question, since: int, blocker: TransformLookupError) -> None:
        """Wait until something comes that can have removed what blocks a lookup.

        Raises
        ------
        BusClosedError
            If nothing more will come.
        """
        if self._feed.ended:
            raise BusClosedError(self._feed.ended) from blocker
        woken = anyio.Event()
        waiter = Waiter(question, since, woken.set)
        self._feed.waiting.park(waiter, blocker)
        try:
            await woken.wait()
        except BaseException:
            # Cancelled; whoever wakes a waiter has taken it out already.
            self._feed.waiting.remove(waiter)
            raise

    def _read(self, question: Question, reset: ClockResetError | None) -> TransformStamped:
        """As `ask`, for a lookup that began when the clock's last jump back was `reset`."""
        latest = self._feed.last_reset
        if latest is not None and latest is not reset:
            raise ClockResetError(before=latest.before, after=latest.after)
        return self.ask(question)

    def report(self, question: Question, blocker: TransformLookupError) -> None:
        """Log what blocks a lookup that has waited for long."""
        self._log.warning(
            (type(blocker), blocking_frames(blocker)),
            "a lookup of %r in %r has waited for more than %g s: %s",
            question.source,
            question.target,
            REPORT_AFTER,
            blocker,
        )
