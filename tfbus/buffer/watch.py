"""A transform that is followed: its newest value, each time that it has changed."""

import math
from collections.abc import Callable
from types import TracebackType

import anyio
import anyio.lowlevel

from tfbus.buffer._waiting_lookup import REPORT_AFTER, Lookups
from tfbus.clock import Clock
from tfbus.errors import MAY_COME, ClockResetError, TransformLookupError, UnknownFrameError
from tfbus.frames import is_frame
from tfbus.geometry.stamped import TransformStamped
from tfbus.stamps import SECOND, STAMP_MAX, is_real, to_seconds
from tfbus.tree.question import Question
from tfbus.waiting.live_tree import LiveTree
from tfbus.waiting.waiting_index import Waiter, without_traceback
from tfbus.waiting.watch_index import Watched


class Watch:
    """What `Buffer.watch` gives: ``async for transform in watch``, for one reader.

    It holds no queue: each answer is worked out when it is read, so a slow reader skips and never lags. The iteration
    ends when the watch, the buffer or the bus is closed and what had changed before has been read.

    Attributes
    ----------
    skipped : int
        Batches that touched the watched path, while there was an answer, and that no evaluation saw, because a later
        one had come by then.
    """

    def __init__(
        self,
        question: Question,
        min_translation: float,
        min_rotation: float,
        max_rate: float | None,
        feed: LiveTree,
        room: Lookups,
        clock: Clock,
        check_thread: Callable[[], object],
    ) -> None:
        for name in (question.target, question.source):
            if not is_frame(name):
                raise UnknownFrameError(frame=name, known=feed.tree.frames())
        if question.max_age is not None:
            room.not_before(question.max_age, question.at, question.source_at)
        self.skipped = 0
        self._question = question
        self._min_translation = _threshold(min_translation, "min_translation", "m", math.inf)
        self._min_rotation = _threshold(min_rotation, "min_rotation", "rad", math.pi)
        self._period = _period(max_rate)
        self._feed = feed
        self._room = room
        self._clock = clock
        self._check_thread = check_thread
        self._reading = anyio.ResourceGuard("reading from")
        self._reader: anyio.Event | None = None
        self._last: TransformStamped | None = None
        self._rests_since: int | None = None
        self._state = Watched(question.target, question.source, self._wake)
        if feed.ended:
            self._state.ended = True
            return
        feed.watching.add(self._state)
        try:
            self._look()
        except MAY_COME:
            return
        # Nobody has seen that one; it was looked up to count from here on.
        self._state.flagged = True

    def close(self) -> None:
        """End the iteration; a second call does nothing."""
        if self._state.waiting:
            self._check_thread()
        self._feed.watching.remove(self._state)
        self._state.ended = True
        self._wake()

    def __enter__(self) -> "Watch":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def __aiter__(self) -> "Watch":
        return self

    async def __anext__(self) -> TransformStamped:
        self._check_thread()
        with self._reading:
            await anyio.lowlevel.checkpoint()
            return await self._next_change()

    async def _next_change(self) -> TransformStamped:
        state = self._state
        since: int | None = None
        while True:
            if state.reset is not None:
                raise self._start_over(state.reset)
            if not state.flagged:
                if state.ended:
                    raise StopAsyncIteration
                await self._wait()
                continue
            if not state.ended and (rest := self._rest()) > 0.0:
                if not await self._wait(rest):
                    self._rests_since = None
                continue
            try:
                answer = self._look()
            except MAY_COME as error:
                blocker = without_traceback(error)
            else:
                if self._is_change(answer):
                    self._last = answer
                    self._rests_since = self._clock.now()
                    return answer
                continue
            if state.ended:
                raise StopAsyncIteration
            since = self._clock.now() if since is None else since
            await self._park(blocker, since)

    def _look(self) -> TransformStamped:
        """The answer now; from here on, what it is made of flags the watch."""
        state = self._state
        self.skipped += max(0, state.updates - 1)
        state.updates = 0
        try:
            answer = self._room.ask(self._question)
        except MAY_COME:
            self._feed.watching.forget(state)
            raise
        self._feed.watching.follow(state, self._feed.tree.forest, answer.stamp)
        state.flagged = False
        return answer

    def _is_change(self, answer: TransformStamped) -> bool:
        """Whether an answer differs enough from the last one that was yielded."""
        last = self._last
        if last is None:
            return True
        if not (self._min_translation or self._min_rotation):
            return answer != last
        before, now = last.transform, answer.transform
        if self._min_translation and math.dist(before.translation, now.translation) >= self._min_translation:
            return True
        return bool(self._min_rotation) and (before.inverse() @ now).as_axis_angle()[1] >= self._min_rotation

    def _start_over(self, reset: ClockResetError) -> ClockResetError:
        """Forget what was before a jump back of the clock; the error that says so."""
        state = self._state
        self.skipped += state.updates
        state.updates = 0
        state.reset = None
        self._last = None
        self._rests_since = None
        return ClockResetError(before=reset.before, after=reset.after)

    def _rest(self) -> float:
        """How long `max_rate` still holds the next answer back, in s."""
        if self._rests_since is None:
            return 0.0
        left = self._period - (self._clock.now() - self._rests_since)
        # The machine's time may have been set back.
        return min(left, self._period) / SECOND

    async def _park(self, blocker: TransformLookupError, since: int) -> None:
        """Wait until something comes that can have removed what blocks the answer."""
        waiter = Waiter(self._question, since, self._wake)
        self._feed.waiting.park(waiter, blocker)
        try:
            quiet = REPORT_AFTER - to_seconds(self._clock.now() - since)
            if quiet <= 0.0 or not await self._wait(quiet):
                self._room.report(self._question, blocker)
                await self._wait()
        finally:
            self._feed.waiting.remove(waiter)

    async def _wait(self, seconds: float = math.inf) -> bool:
        """Wait until something happens, but no longer than this; whether something has happened."""
        self._reader = woken = anyio.Event()
        self._state.waiting = True
        try:
            with self._clock.move_on_after(seconds):
                await woken.wait()
        finally:
            self._reader = None
            self._state.waiting = False
        return woken.is_set()

    def _wake(self) -> None:
        if self._reader is not None:
            self._reader.set()


def _threshold(value: float, name: str, unit: str, greatest: float) -> float:
    if not is_real(value):
        raise TypeError(f"{name} must be a number in {unit}, not {value!r}")
    if not 0.0 <= value <= greatest:
        raise ValueError(f"{name} must be from 0 to {greatest:.4g} {unit}, got {value!r}")
    return float(value)


def _period(max_rate: float | None) -> int:
    """The shortest time between two answers, in ns."""
    if max_rate is None:
        return 0
    if not is_real(max_rate):
        raise TypeError(f"max_rate must be a number in Hz, not {max_rate!r}")
    if not 0.0 < max_rate < math.inf:
        raise ValueError(f"max_rate must be greater than zero and finite, got {max_rate!r} Hz")
    return math.ceil(min(SECOND / float(max_rate), STAMP_MAX))
