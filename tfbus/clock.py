"""Clocks: the stamps and the timers of a bus.

`SystemClock` is the time of the machine. `SimulatedClock` stands still until a task advances it, and then runs timed
tasks in the same order on every event loop, which makes tests and simulations repeatable.
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

from tfbus._aio.loops import settling
from tfbus.errors import ClockResetError
from tfbus.registration import Registration
from tfbus.stamps import SECOND, STAMP_MAX, as_duration, as_stamp, format_stamp, from_seconds, is_real

JumpCallback = Callable[[int, int], object]
"""A function that is called with the stamps just before and just after a jump, in ns."""


class Ticks:
    """An async iterator over the numbers 0, 1, 2, ...: tick k is due at start + k / hz, so the ticks do not drift.

    The first iteration is the start, where tick 0 is due. A tick that is late by a whole period is skipped and counted
    in `skipped`: after a delay the newest due tick is given at once, and the older ones are never given.

    Parameters
    ----------
    hz : float
        Ticks per second; greater than zero.
    elapsed : callable
        Returns a monotonic time in ns.
    sleep_until : async callable
        Sleeps until that time has reached its argument.

    Attributes
    ----------
    skipped : int
        Number of skipped ticks.

    Examples
    --------
    >>> clock = SimulatedClock()
    >>> ticks = clock.ticks(hz=10.0)
    >>> ticks.hz
    10.0
    """

    def __init__(self, hz: float, elapsed: Callable[[], int], sleep_until: Callable[[int], Awaitable[None]]) -> None:
        if not is_real(hz):
            raise TypeError(f"a rate must be a number in Hz, not {hz!r}")
        if not (math.isfinite(hz) and hz > 0):
            raise ValueError(f"a rate must be greater than zero and finite, got {hz!r} Hz")
        self.hz: float = float(hz)
        self.skipped: int = 0
        self._elapsed = elapsed
        self._sleep_until = sleep_until
        self._start: int | None = None
        self._next = 0

    def __aiter__(self) -> "Ticks":
        return self

    async def __anext__(self) -> int:
        now = self._elapsed()
        if self._start is None:
            self._start = now
        newest_due = math.floor((now - self._start) * self.hz / SECOND)
        tick = max(self._next, newest_due)
        self.skipped += tick - self._next
        self._next = tick + 1
        await self._sleep_until(self._start + round(tick * SECOND / self.hz))
        return tick


class Clock(Protocol):
    """The protocol of clocks: now, sleeping, ticks, timeouts and jumps.

    On a `SystemClock`, a buffer sets one timer of the event loop for all its waiting lookups; on a `SimulatedClock`, it
    uses the method ``call_after``. On any other clock, also of a class derived from these two, a task in a
    `move_on_after` of its own ends each wait.

    A clock without a time at first may have a property ``is_set``. Until it is true, a bus compares no stamp with it.

    Examples
    --------
    >>> clock: Clock = SimulatedClock(start=10)
    >>> Bus(clock).clock.now()
    10
    """

    def now(self) -> int:
        """The current stamp, in ns.

        Examples
        --------
        >>> clock: Clock = SimulatedClock(start=from_seconds(5.0))
        >>> clock.now()
        5000000000
        """

    async def sleep(self, seconds: float) -> None:
        """Sleep for a duration in s; jumps do not change it.

        Examples
        --------
        >>> clock = SimulatedClock()
        >>> async with anyio.create_task_group() as tasks:
        ...     _ = tasks.start_soon(clock.advance, 10.0)
        ...     await clock.sleep(2.5)
        ...     print(clock.now())
        2500000000
        """

    async def sleep_until(self, stamp: int) -> None:
        """Sleep until `now` has reached a stamp in ns; a jump back raises `ClockResetError`.

        Examples
        --------
        >>> clock = SimulatedClock()
        >>> async with anyio.create_task_group() as tasks:
        ...     _ = tasks.start_soon(clock.advance, 10.0)
        ...     await clock.sleep_until(from_seconds(4.0))
        ...     print(clock.now())
        4000000000
        """

    def ticks(self, hz: float) -> Ticks:
        """Ticks at `hz` per second; jumps do not change their times.

        Examples
        --------
        >>> clock = SimulatedClock()
        >>> async with anyio.create_task_group() as tasks:
        ...     _ = tasks.start_soon(clock.advance, 10.0)
        ...     async for tick in clock.ticks(2.0):
        ...         if tick == 3:
        ...             break
        >>> clock.now() >= from_seconds(1.5)
        True
        """

    def move_on_after(self, seconds: float) -> AbstractContextManager[anyio.CancelScope]:
        """A ``with`` that cancels its body after a duration in s, as `anyio.move_on_after`.

        Examples
        --------
        >>> clock = SimulatedClock()
        >>> async with anyio.create_task_group() as tasks:
        ...     _ = tasks.start_soon(clock.advance, 10.0)
        ...     with clock.move_on_after(1.0) as scope:
        ...         await anyio.sleep_forever()
        >>> scope.cancelled_caught
        True
        """

    def on_jump(self, callback: JumpCallback) -> Registration:
        """Call `callback` with the stamps before and after each jump, until the registration is closed.

        Examples
        --------
        >>> clock = SimulatedClock(start=from_seconds(5.0))
        >>> jumps = []
        >>> _ = clock.on_jump(lambda before, after: jumps.append((before, after)))
        >>> clock.set(0)
        >>> jumps
        [(5000000000, 0)]
        """


class SystemClock:
    """The time of the machine: stamps are ``time.time_ns()``, sleeps are monotonic. It never announces a jump.

    Examples
    --------
    >>> bus = Bus(SystemClock())
    >>> bus.clock.now() > from_seconds(1.7e9)
    True
    """

    def now(self) -> int:
        """Nanoseconds since 1970.

        Examples
        --------
        >>> SystemClock().now() > from_seconds(1.7e9)
        True
        """
        return time.time_ns()

    async def sleep(self, seconds: float) -> None:
        """Sleep for a duration in s; zero passes a checkpoint.

        Examples
        --------
        >>> await SystemClock().sleep(0.001)
        """
        await anyio.sleep(as_duration(seconds, "seconds"))

    async def sleep_until(self, stamp: int) -> None:
        """Sleep until a stamp in ns, by its distance from now; later changes of the machine's clock have no effect.

        Examples
        --------
        >>> clock = SystemClock()
        >>> await clock.sleep_until(clock.now() + 1_000_000)
        """
        await anyio.sleep(max(0, as_stamp(stamp) - self.now()) / SECOND)

    def ticks(self, hz: float) -> Ticks:
        """Ticks at `hz` per second on the monotonic clock.

        Raises
        ------
        ValueError
            If `hz` is not greater than zero and finite.

        Examples
        --------
        >>> async for stamp in SystemClock().ticks(hz=1000.0):
        ...     print(type(stamp).__name__)
        ...     break
        int
        """
        return Ticks(hz, self._elapsed, self._sleep_until_elapsed)

    def move_on_after(self, seconds: float) -> AbstractContextManager[anyio.CancelScope]:
        """A ``with`` that cancels its body after a duration in s; see `anyio.move_on_after`.

        Examples
        --------
        >>> with SystemClock().move_on_after(0.001) as scope:
        ...     await SystemClock().sleep(60.0)
        >>> scope.cancelled_caught
        True
        """
        return anyio.move_on_after(as_duration(seconds, "seconds"))

    def on_jump(self, callback: JumpCallback) -> Registration:  # noqa: ARG002 - the protocol's signature
        """Return a registration that never calls `callback`.

        Examples
        --------
        >>> with SystemClock().on_jump(print):
        ...     pass  # The system's clock never says that it jumped.
        """
        return Registration(lambda: None)

    def _elapsed(self) -> int:
        return round(anyio.current_time() * SECOND)

    async def _sleep_until_elapsed(self, elapsed: int) -> None:
        await anyio.sleep_until(elapsed / SECOND)


class SimulatedClock:
    """A clock that stands still until `advance` or `set` moves it.

    Between two due timers `advance` lets all tasks run until they are blocked. On every event loop, timed tasks
    therefore run in the order of their times and, at equal times, in the order of registration. Tasks that are started
    together, or woken by one publish or one `set`, run in the order of the event loop, which trio shuffles on purpose.
    A task that waits for a worker thread or a socket counts as blocked: simulated time is for one process.

    The cost of a timer does not depend on the number of tasks. On an asyncio loop, `advance` finds out that all tasks
    are blocked by counting the calls of the loop's method ``call_soon``, which it replaces by its counter meanwhile.

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

    >>> clock = SimulatedClock()
    >>> await clock.advance(1.5)
    >>> clock.now()
    1500000000
    """

    def __init__(self, start: int = 0) -> None:
        self._now = as_stamp(start)
        self._is_set = self._now != 0
        self._elapsed = 0
        self._timers: list[_Timer] = []
        self._stamp_sleepers: dict[_StampSleeper, None] = {}
        self._order = count()
        self._callbacks: dict[int, JumpCallback] = {}
        self._listeners: dict[int, Callable[[int], object]] = {}
        self._advancing = False

    def __repr__(self) -> str:
        timers = len(self._timers)
        return f"<SimulatedClock at {format_stamp(self._now)}, {timers:,} timer{'' if timers == 1 else 's'}>"

    def now(self) -> int:
        """The current simulated stamp, in ns.

        Examples
        --------
        >>> SimulatedClock(start=from_seconds(2.0)).now()
        2000000000
        """
        return self._now

    @property
    def is_set(self) -> bool:
        """Whether the clock has a time: it was made with a stamp other than 0, was set, or has advanced."""
        return self._is_set

    async def sleep(self, seconds: float) -> None:
        """Sleep for a simulated duration in s; zero passes a checkpoint.

        Examples
        --------
        >>> import anyio
        >>> async def nap(clock: SimulatedClock) -> None:
        ...     async with anyio.create_task_group() as tasks:
        ...         tasks.start_soon(clock.sleep, 60.0)
        ...         await clock.advance(60.0)
        >>> await nap(SimulatedClock())
        """
        duration = as_duration(seconds, "seconds")
        if duration * SECOND >= STAMP_MAX:
            await anyio.sleep_forever()
        await self._sleep_until_elapsed(self._elapsed + from_seconds(duration))

    async def sleep_until(self, stamp: int) -> None:
        """Sleep until `advance` or `set` has brought the clock to a stamp, in ns.

        Raises
        ------
        ClockResetError
            If the clock jumps back before that.

        Examples
        --------
        >>> await SimulatedClock(start=10).sleep_until(5)
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
        """Ticks at `hz` per second of simulated time.

        Raises
        ------
        ValueError
            If `hz` is not greater than zero and finite.

        Examples
        --------
        >>> clock = SimulatedClock()
        >>> async for stamp in clock.ticks(hz=10.0):
        ...     print(stamp)
        ...     break
        0
        """
        return Ticks(hz, lambda: self._elapsed, self._sleep_until_elapsed)

    @contextmanager
    def move_on_after(self, seconds: float) -> Iterator[anyio.CancelScope]:
        """A ``with`` that cancels its body after a simulated duration in s; see `anyio.move_on_after`.

        Examples
        --------
        >>> clock = SimulatedClock()
        >>> with clock.move_on_after(5.0) as scope:
        ...     await clock.advance(1.0)
        >>> scope.cancelled_caught
        False
        """
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

    def call_after(self, seconds: float, callback: Callable[[], object]) -> Registration:
        """Call `callback` once, after a simulated duration in s, unless the registration is closed before.

        The timeouts of waiting lookups are such calls. `advance` makes the call between two runs of the tasks; it
        raises the errors of the call.

        Examples
        --------
        >>> clock = SimulatedClock()
        >>> with clock.call_after(5.0, lambda: print("five seconds later")):
        ...     await clock.advance(5.0)
        five seconds later
        """
        duration = as_duration(seconds, "seconds")
        if duration * SECOND >= STAMP_MAX:
            return Registration(lambda: None)
        timer = self._start_timer(self._elapsed + from_seconds(duration), callback)
        return Registration(lambda: self._stop_timer(timer))

    def on_jump(self, callback: JumpCallback) -> Registration:
        """Call `callback` with the stamps before and after each `set`.

        Examples
        --------
        >>> clock = SimulatedClock(start=10)
        >>> with clock.on_jump(print):
        ...     clock.set(0)
        10 0
        """
        key = next(self._order)
        self._callbacks[key] = callback
        return Registration(lambda: self._callbacks.pop(key, None))

    def on_move(self, callback: Callable[[int], object]) -> Registration:
        """Call `callback` with each new stamp, after every step of `advance` and after `set`.

        Examples
        --------
        >>> clock = SimulatedClock()
        >>> with clock.on_move(print):
        ...     await clock.advance(1.0)
        1000000000
        """
        key = next(self._order)
        self._listeners[key] = callback
        return Registration(lambda: self._listeners.pop(key, None))

    async def advance(self, seconds: float) -> None:
        """Move the clock forward by a duration in s, and run the timed tasks that become due.

        All tasks run until they are blocked. Then the clock moves to the next due timer, fires it, and all tasks run
        again, and so on. A task that never blocks keeps `advance` from returning. At the greatest stamp that 64 bits
        hold, the clock stays; sleeps of a duration go on.

        Raises
        ------
        ValueError
            If `seconds` is negative.
        RuntimeError
            If another task is advancing the clock.

        Examples
        --------
        >>> clock = SimulatedClock()
        >>> await clock.advance(0.5)
        >>> clock.now()
        500000000
        """
        duration = from_seconds(as_duration(seconds, "seconds"))
        if self._advancing:
            raise RuntimeError("another task is advancing this clock: let one task drive it")
        self._advancing = True
        try:
            end = self._elapsed + duration
            with settling() as settle:
                await settle()
                while self._timers and self._timers[0].due <= end:
                    timer = self._timers.pop(0)
                    self._move_to(timer.due)
                    timer.fire()
                    await settle()
            self._move_to(end)
        finally:
            self._advancing = False

    def set(self, stamp: int) -> None:
        """Jump to a stamp, in ns.

        Sleeps of a duration are not changed. `sleep_until` ends if the stamp is reached, and raises `ClockResetError`
        after a jump back.

        Examples
        --------
        >>> clock = SimulatedClock()
        >>> clock.set(100)
        >>> clock.now()
        100
        """
        before, after = self._now, as_stamp(stamp)
        self._now, self._is_set = after, True
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
        self._tell_move()

    def _move_to(self, elapsed: int) -> None:
        if elapsed > self._elapsed:
            self._is_set = True
            self._now = min(self._now + elapsed - self._elapsed, STAMP_MAX)
            self._elapsed = elapsed
            if self._listeners:
                self._tell_move()

    def _tell_move(self) -> None:
        for listener in tuple(self._listeners.values()):
            listener(self._now)

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
    """A function to call at a time; timers are ordered by time, then by registration."""

    __slots__ = ("due", "fire", "order")

    def __init__(self, due: int, order: int, fire: Callable[[], object]) -> None:
        self.due = due
        self.order = order
        self.fire = fire

    def __lt__(self, other: "_Timer") -> bool:
        return (self.due, self.order) < (other.due, other.order)


class _StampSleeper:
    """A task that sleeps until a stamp; `reset` is the error of a jump back."""

    __slots__ = ("event", "reset", "stamp", "timer")

    def __init__(self, stamp: int, event: anyio.Event) -> None:
        self.stamp = stamp
        self.event = event
        self.timer: _Timer
        self.reset: ClockResetError | None = None
