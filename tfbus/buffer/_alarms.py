"""Alarms for the waiting lookups of one buffer: calls after a duration, most of which are cancelled before.

A cancel scope for each wait would set and remove a timer of the event loop each time. Here all of a buffer share one:
it is set for the first alarm, and stays as it is when that is cancelled, because the next one is nearly always later.
"""

from collections.abc import Callable
from functools import partial
from heapq import heapify, heappop, heappush
from itertools import count
from typing import Any, Protocol

from tfbus._aio.loop_timer import LoopTimer, running_loop
from tfbus.clock import Clock, SimulatedClock, SystemClock

_CANCELLED_KEPT = 64


Cancel = Callable[[], object]
"""Cancels a call, if it has not been made."""


class Alarms(Protocol):
    """Calls functions after a duration on some clock."""

    def call_after(self, seconds: float, callback: Callable[[], object]) -> Cancel:
        """Call a function on the event loop after a duration in s, unless it is cancelled; it must not raise."""


def alarms_of(clock: Clock) -> Alarms | None:
    """Alarms by the clock of a bus; None for a clock of which only the protocol is known."""
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
        self._heap: _AlarmHeap | None = None

    def call_after(self, seconds: float, callback: Callable[[], object]) -> Cancel:
        """Call a function on the event loop after a duration in s, unless it is cancelled; it must not raise."""
        loop = running_loop()
        heap = self._heap
        if heap is None or heap.timer.loop is not loop:
            # What waits on another loop is still woken by the heap of that one.
            heap = self._heap = _AlarmHeap(loop)
        return heap.add(seconds, callback)


class _AlarmHeap:
    """The alarms on one event loop by their times, with one timer for the first."""

    def __init__(self, loop: Any) -> None:
        self.timer = LoopTimer(loop, self._ring)
        self._alarms: list[tuple[float, int]] = []
        # The callbacks of those that were neither made nor cancelled, by number.
        self._callbacks: dict[int, Callable[[], object]] = {}
        self._numbers = count()

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
