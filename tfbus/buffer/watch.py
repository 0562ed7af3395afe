"""Watches: the newest value of a transform, each time that it has changed."""

import math
from types import TracebackType

import anyio.lowlevel

from tfbus._aio.task_groups import OneReader
from tfbus.buffer.lookups import REPORT_AFTER, Lookups
from tfbus.errors import MAY_COME, AheadError, ClockResetError, TransformLookupError, UnknownFrameError
from tfbus.frames import is_frame
from tfbus.geometry.stamped import TransformStamped
from tfbus.stamps import SECOND, STAMP_MAX, is_real, to_seconds
from tfbus.tree.lookup import Question
from tfbus.waiting.live_tree import Waiter, without_traceback
from tfbus.waiting.watch_index import WatchState

_NO_ANSWER = (*MAY_COME, AheadError)
"""The errors that a later sample, or the same one later, may resolve."""


class Watch:
    """The result of `Buffer.watch`: ``async for transform in watch``, for one reader.

    It has no queue: each answer is computed when it is read, so a slow reader skips answers and never lags. The
    iteration ends when the watch, the buffer or the bus is closed and a pending change has been read.

    Attributes
    ----------
    skipped : int
        Number of batches that touched the watched path but appear in no answer, because a later batch had come.

    Examples
    --------
    >>> bus = Bus(SimulatedClock())
    >>> with Buffer(bus) as buffer, buffer.watch("map", "cart") as changes:
    ...     TransformBroadcaster(bus).send("map", "cart", Transform((1.0, 0.0, 0.0)), at=10)
    ...     async for transform in changes:
    ...         print(transform.stamp)
    ...         changes.close()
    10
    """

    def __init__(
        self,
        question: Question,
        min_translation: float,
        min_rotation: float,
        max_rate: float | None,
        lookups: Lookups,
    ) -> None:
        share = lookups.share
        live = share.live
        for name in (question.target, question.source):
            if not is_frame(name):
                raise UnknownFrameError(frame=name, known=lookups.forest.some_frames())
        if question.max_age is not None:
            lookups.bounds(question.max_age, question.at, question.source_at)
        self.skipped: int = 0
        self._question = question
        self._min_translation = _threshold(min_translation, "min_translation", "m", math.inf)
        self._min_rotation = _threshold(min_rotation, "min_rotation", "rad", math.pi)
        self._period = _period(max_rate)
        self._watching = live.watching
        self._lookups = lookups
        self._clock = lookups.bus.clock
        self._check_thread = lookups.bus._check_waiter
        self._reader = OneReader()
        self._last: TransformStamped | None = None
        self._last_given_at: int | None = None
        self._state = WatchState(question.target, question.source, self._reader.wake)
        if share.end_reason is not None:
            self._state.ended = True
            return
        share.watch(self._state)
        try:
            self._update()
        except _NO_ANSWER:
            return
        # The reader has not seen this answer. It was looked up to count the updates from here on.
        self._state.outdated = True

    def close(self) -> None:
        """End the iteration; a second call does nothing.

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> with Buffer(bus) as buffer, buffer.watch("map", "cart") as changes:
        ...     changes.close()
        ...     print([transform async for transform in changes])
        []
        """
        if self._state.waiting:
            self._check_thread()
        self._watching.remove(self._state)
        self._state.ended = True
        self._reader.wake()

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
        with self._reader:
            await anyio.lowlevel.checkpoint()
            return await self._next_change()

    async def _next_change(self) -> TransformStamped:
        state = self._state
        since: int | None = None
        while True:
            if state.reset is not None:
                raise self._start_over(state.reset)
            if not state.outdated:
                if state.ended:
                    raise StopAsyncIteration
                await self._wait()
                continue
            if not state.ended and (pause := self._remaining_pause()) > 0.0:
                if not await self._wait(pause):
                    self._last_given_at = None
                continue
            try:
                answer = self._update()
            except _NO_ANSWER as error:
                blocker = without_traceback(error)
            else:
                if self._is_change(answer):
                    self._last = answer
                    self._last_given_at = self._clock.now()
                    return answer
                continue
            if state.ended:
                raise StopAsyncIteration
            since = self._clock.now() if since is None else since
            await self._park(blocker, since)

    def _update(self) -> TransformStamped:
        """The answer now; a later change on its path makes the watch outdated."""
        state = self._state
        self.skipped += max(0, state.updates - 1)
        state.updates = 0
        try:
            answer = self._lookups.lookup_nowait(self._question)
        except _NO_ANSWER:
            self._watching.set_no_answer(state)
            raise
        self._watching.set_answer(state, self._lookups.forest, answer.stamp)
        state.outdated = False
        return answer

    def _is_change(self, answer: TransformStamped) -> bool:
        """Whether an answer differs enough from the last one."""
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
        """Forget everything from before a jump back of the clock; return the error that announces it."""
        state = self._state
        self.skipped += state.updates
        state.updates = 0
        state.reset = None
        self._last = None
        self._last_given_at = None
        return ClockResetError(before=reset.before, after=reset.after)

    def _remaining_pause(self) -> float:
        """The time until `max_rate` allows the next answer, in s."""
        if self._last_given_at is None:
            return 0.0
        left = self._period - (self._clock.now() - self._last_given_at)
        # The machine's time may have been set back.
        return min(left, self._period) / SECOND

    async def _park(self, blocker: TransformLookupError, since: int) -> None:
        """Wait for a sample that may have removed the cause of `blocker`."""
        waiter = Waiter(self._question, since, self._reader.wake)
        self._lookups.share.park(waiter, blocker)
        try:
            pause = REPORT_AFTER - to_seconds(self._clock.now() - since)
            while pause <= 0.0 or not await self._wait(pause):
                pause = self._lookups.report()
        finally:
            self._lookups.share.live.waiting.remove(waiter)

    async def _wait(self, seconds: float = math.inf) -> bool:
        """Wait until the watch is woken, at most for some time; return whether it was woken."""
        self._state.waiting = True
        try:
            with self._clock.move_on_after(seconds):
                await self._reader.wait()
        finally:
            self._state.waiting = False
        return self._reader.was_woken


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
