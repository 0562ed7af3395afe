"""Where stamps and sleeping come from.

`SystemClock` is the machine's time. `SimulatedClock` stands still until somebody advances it, and then gives the same
order of timed tasks on every event loop: that is what makes a test or a simulation repeatable.
"""

import math
import time
from bisect import bisect_left, insort
from collections.abc import Awaitable, Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from itertools import count
from typing import Protocol

import anyio
import anyio.lowlevel

from tfbus.errors import ClockResetError
from tfbus.registration import Registration
from tfbus.stamps import SECOND, STAMP_MAX, as_duration, as_stamp, from_seconds, is_real

JumpCallback = Callable[[int, int], object]
"""Called with the stamps just before and just after a jump."""

_SETTLING_CHECKPOINTS = 5


class Ticks:
    """The numbers 0, 1, 2, ... each at its time: tick k is due at start + k / hz, so the beat does not drift.

    Iterate it with ``async for``; the start is the first iteration, where tick 0 is due. A tick that is a whole period
    late is counted in `skipped` and left out: after a hold-up the newest due tick comes at once and the others never,
    so there is no burst.

    Parameters
    ----------
    hz : float
        Ticks per second; greater than zero.
    elapsed : callable
        A clock in ns that never goes back.
    sleep_until : callable
        Sleeps until that clock has reached a time.

    Attributes
    ----------
    skipped : int
        How many ticks have been left out.
    """

    def __init__(self, hz: float, elapsed: Callable[[], int], sleep_until: Callable[[int], Awaitable[None]]) -> None:
        if not is_real(hz):
            raise TypeError(f"a rate must be a number in Hz, not {hz!r}")
        if not (math.isfinite(hz) and hz > 0):
            raise ValueError(f"a rate must be greater than zero and finite, got {hz!r} Hz")
        self.hz = float(hz)
        self.skipped = 0
        self._elapsed = elapsed
        self._sleep_until = sleep_until
        self._start: int | None = None
        self._next = 0

    def __aiter__(self) -> "Ticks":
        return self

    async def __anext__(self) -> int:
        if self._start is None:
            self._start = self._elapsed()
        newest_due = math.floor((self._elapsed() - self._start) * self.hz / SECOND)
        tick = max(self._next, newest_due)
        self.skipped += tick - self._next
        self._next = tick + 1
        await self._sleep_until(self._start + round(tick * SECOND / self.hz))
        return tick


class Clock(Protocol):
    """What the rest of tfbus needs of a clock."""

    def now(self) -> int:
        """The present stamp, in ns."""

    async def sleep(self, seconds: float) -> None:
        """Sleep for a duration; jumps do not change it."""

    async def sleep_until(self, stamp: int) -> None:
        """Sleep until `now` has reached a stamp; a jump back raises `ClockResetError`."""

    def ticks(self, hz: float) -> Ticks:
        """A beat of `hz` ticks per second, counted in durations."""

    def move_on_after(self, seconds: float) -> AbstractContextManager[anyio.CancelScope]:
        """A ``with`` that cancels its body after a duration and goes on behind it; see `anyio.move_on_after`."""

    def on_jump(self, callback: JumpCallback) -> Registration:
        """Call `callback` with the stamps before and after each jump, until the registration is closed."""


class SystemClock:
    """The machine's time: stamps are ``time.time_ns()``, sleeping is monotonic. It never announces a jump."""

    def now(self) -> int:
        """Nanoseconds since 1970."""
        return time.time_ns()

    async def sleep(self, seconds: float) -> None:
        """Sleep for a duration, at least one checkpoint long."""
        await anyio.sleep(as_duration(seconds, "seconds"))

    async def sleep_until(self, stamp: int) -> None:
        """Sleep until a stamp, as far as it is away now."""
        await anyio.sleep(max(0, as_stamp(stamp) - self.now()) / SECOND)

    def ticks(self, hz: float) -> Ticks:
        """A beat on the monotonic clock.

        Raises
        ------
        ValueError
            If `hz` is not greater than zero and finite.
        """
        return Ticks(hz, self._elapsed, self._sleep_until_elapsed)

    def move_on_after(self, seconds: float) -> AbstractContextManager[anyio.CancelScope]:
        """`anyio.move_on_after`."""
        return anyio.move_on_after(as_duration(seconds, "seconds"))

    def on_jump(self, callback: JumpCallback) -> Registration:  # noqa: ARG002 - the protocol's signature
        """Never calls `callback`."""
        return Registration(lambda: None)

    def _elapsed(self) -> int:
        return round(anyio.current_time() * SECOND)

    async def _sleep_until_elapsed(self, elapsed: int) -> None:
        await anyio.sleep_until(elapsed / SECOND)


class SimulatedClock:
    """Time that stands still until `advance` moves it.

    Between two timed tasks that are due, `advance` lets everything run until all tasks are blocked, so timed tasks run
    in order of their time, and of registration where that is equal, on every event loop. The order of several tasks
    that one publish or one `set` wakes, or that are started together, is the loop's own; trio shuffles it on purpose.
    Worker threads and sockets count as blocked: simulated time is for one process.

    Parameters
    ----------
    start : int
        The first stamp, in ns.

    Examples
    --------
    ::

        clock = SimulatedClock()
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(robot, Bus(clock))
            await clock.advance(10.0)
            tasks.cancel_scope.cancel()
    """

    def __init__(self, start: int = 0) -> None:
        self._now = as_stamp(start)
        self._elapsed = 0
        self._timers: list[_Timer] = []
        self._stamp_sleepers: dict[_StampSleeper, None] = {}
        self._order = count()
        self._callbacks: dict[int, JumpCallback] = {}
        self._advancing = False

    def now(self) -> int:
        """The simulated stamp, in ns."""
        return self._now

    async def sleep(self, seconds: float) -> None:
        """Sleep for a simulated duration; zero is one checkpoint."""
        duration = as_duration(seconds, "seconds")
        if duration * SECOND >= STAMP_MAX:
            await anyio.sleep_forever()
        await self._sleep_until_elapsed(self._elapsed + from_seconds(duration))

    async def sleep_until(self, stamp: int) -> None:
        """Sleep until the clock has reached a stamp, by advancing or by a jump.

        Raises
        ------
        ClockResetError
            If the clock jumps back meanwhile.
        """
        sleeper = _StampSleeper(as_stamp(stamp), anyio.Event())
        if sleeper.stamp <= self._now:
            await anyio.lowlevel.checkpoint()
            return
        self._stamp_sleepers[sleeper] = None
        timer = self._start_timer(self._elapsed + sleeper.stamp - self._now, sleeper.event.set)
        sleeper.timer = timer
        try:
            await sleeper.event.wait()
        finally:
            del self._stamp_sleepers[sleeper]
            self._stop_timer(sleeper.timer)
        if sleeper.reset is not None:
            raise sleeper.reset

    def ticks(self, hz: float) -> Ticks:
        """A beat in simulated time.

        Raises
        ------
        ValueError
            If `hz` is not greater than zero and finite.
        """
        return Ticks(hz, lambda: self._elapsed, self._sleep_until_elapsed)

    @contextmanager
    def move_on_after(self, seconds: float) -> Iterator[anyio.CancelScope]:
        """As `anyio.move_on_after`, in simulated time."""
        duration = as_duration(seconds, "seconds")
        with anyio.CancelScope() as scope:
            if duration * SECOND >= STAMP_MAX:
                yield scope
                return
            if duration == 0:
                scope.cancel()
            timer = self._start_timer(self._elapsed + from_seconds(duration), scope.cancel)
            try:
                yield scope
            finally:
                self._stop_timer(timer)

    def on_jump(self, callback: JumpCallback) -> Registration:
        """Call `callback` with the stamps before and after each `set`."""
        key = next(self._order)
        self._callbacks[key] = callback
        return Registration(lambda: self._callbacks.pop(key, None))

    async def advance(self, seconds: float) -> None:
        """Let simulated time pass.

        First everything that can run runs; then time goes from one timed task to the next that is due, and everything
        that can run runs again. A task that never blocks stalls this for ever.

        Raises
        ------
        ValueError
            If `seconds` is negative.
        RuntimeError
            If another task is advancing the clock.
        """
        duration = from_seconds(as_duration(seconds, "seconds"))
        if self._advancing:
            raise RuntimeError("another task is advancing this clock: let one task drive it")
        self._advancing = True
        try:
            end = self._elapsed + duration
            await self._settle()
            while self._timers and self._timers[0].due <= end:
                timer = self._timers.pop(0)
                self._move_to(timer.due)
                timer.fire()
                await self._settle()
            self._move_to(end)
        finally:
            self._advancing = False

    def set(self, stamp: int) -> None:
        """Jump to a stamp. Durations go on undisturbed; sleepers on a stamp wake, or learn of a jump back."""
        before, after = self._now, as_stamp(stamp)
        self._now = after
        error = ClockResetError(before=before, after=after) if after < before else None
        for sleeper in self._stamp_sleepers:
            if sleeper.event.is_set():
                continue
            self._stop_timer(sleeper.timer)
            if error is not None or sleeper.stamp <= after:
                sleeper.reset = error
                sleeper.event.set()
            else:
                sleeper.timer = self._start_timer(self._elapsed + sleeper.stamp - after, sleeper.event.set)
        for callback in tuple(self._callbacks.values()):
            callback(before, after)

    async def _settle(self) -> None:
        # On asyncio, waiting for blocked tasks sleeps 0.1 s when it finds one that can run; few are left by then.
        for _ in range(_SETTLING_CHECKPOINTS):
            await anyio.lowlevel.checkpoint()
        await anyio.wait_all_tasks_blocked()

    def _move_to(self, elapsed: int) -> None:
        if elapsed > self._elapsed:
            self._now += elapsed - self._elapsed
            self._elapsed = elapsed

    async def _sleep_until_elapsed(self, elapsed: int) -> None:
        if elapsed <= self._elapsed:
            await anyio.lowlevel.checkpoint()
            return
        woken = anyio.Event()
        timer = self._start_timer(elapsed, woken.set)
        try:
            await woken.wait()
        finally:
            self._stop_timer(timer)

    def _start_timer(self, due: int, fire: Callable[[], object]) -> "_Timer":
        timer = _Timer(due, next(self._order), fire)
        insort(self._timers, timer)
        return timer

    def _stop_timer(self, timer: "_Timer") -> None:
        at = bisect_left(self._timers, timer)
        if at < len(self._timers) and self._timers[at] is timer:
            del self._timers[at]


class _Timer:
    """Something to do at a time; ordered by that, then by registration."""

    __slots__ = ("due", "fire", "order")

    def __init__(self, due: int, order: int, fire: Callable[[], object]) -> None:
        self.due = due
        self.order = order
        self.fire = fire

    def __lt__(self, other: "_Timer") -> bool:
        return (self.due, self.order) < (other.due, other.order)


class _StampSleeper:
    """A task that sleeps until a stamp."""

    __slots__ = ("event", "reset", "stamp", "timer")

    def __init__(self, stamp: int, event: anyio.Event) -> None:
        self.stamp = stamp
        self.event = event
        self.timer: _Timer
        self.reset: ClockResetError | None = None
