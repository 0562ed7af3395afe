"""Alarms for the waiting lookups of one buffer: calls after a duration, most of which are cancelled before.

A cancel scope for each wait would set and remove a timer of the event loop each time. Here all of a buffer share one:
it is set for the first alarm, and stays as it is when that is cancelled, because the next one is nearly always later.
"""

from collections.abc import Callable
from heapq import heapify, heappop, heappush
from itertools import count
from typing import Any, Protocol

from tfbus._aio.loop_timer import LoopTimer, running_loop
from tfbus.clock import Clock, SimulatedClock, SystemClock

_CANCELLED_KEPT = 64


class Alarm(Protocol):
    """A call that may be cancelled."""

    def close(self) -> None:
        """Cancel the call, if it has not been made."""


class Alarms(Protocol):
    """Calls functions after a duration on some clock."""

    def call_after(self, seconds: float, callback: Callable[[], object]) -> Alarm:
        """Call a function on the event loop after a duration in s; it must not raise."""


def alarms_of(clock: Clock) -> Alarms | None:
    """Alarms by the clock of a bus; None for a clock of which only the protocol is known."""
    # Not isinstance: a class derived from a clock may tell the time in another way.
    if type(clock) is SystemClock:
        return LoopAlarms()
    return clock if type(clock) is SimulatedClock else None


class LoopAlarms:
    """Alarms by the time of the event loop that runs, which may be another one later."""

    def __init__(self) -> None:
        self._heap: _AlarmHeap | None = None

    def call_after(self, seconds: float, callback: Callable[[], object]) -> Alarm:
        """Call a function on the event loop after a duration in s; it must not raise."""
        loop = running_loop()
        heap = self._heap
        if heap is None or heap.timer.loop is not loop:
            # What waits on another loop is still woken by the heap of that one.
            heap = self._heap = _AlarmHeap(loop)
        return heap.add(seconds, callback)


class _AlarmHeap:
    """The alarms on one event loop by their times, with one timer for the first.

    Attributes
    ----------
    cancelled : int
        The number of alarms that were cancelled and are still here.
    """

    def __init__(self, loop: Any) -> None:
        self.timer = LoopTimer(loop, self._ring)
        self._alarms: list[tuple[float, int, _LoopAlarm]] = []
        self.cancelled = 0
        self._order = count()

    def add(self, seconds: float, callback: Callable[[], object]) -> "_LoopAlarm":
        due = self.timer.now() + seconds
        alarm = _LoopAlarm(self, callback)
        heappush(self._alarms, (due, next(self._order), alarm))
        if due < self.timer.due:
            self.timer.set(due)
        return alarm

    def remove_cancelled(self) -> None:
        """Remove the alarms that were cancelled, if they are most of all."""
        if 2 * self.cancelled > len(self._alarms):
            self._alarms = [each for each in self._alarms if each[2].callback is not None]
            heapify(self._alarms)
            self.cancelled = 0

    def _ring(self) -> None:
        """Make the calls that are due, and set the timer for the next."""
        now = self.timer.now()
        try:
            while self._alarms and (self._alarms[0][2].callback is None or self._alarms[0][0] <= now):
                _, _, alarm = heappop(self._alarms)
                callback, alarm.callback = alarm.callback, None
                if callback is None:
                    self.cancelled -= 1
                else:
                    callback()
        finally:
            if self._alarms and self._alarms[0][0] < self.timer.due:
                self.timer.set(self._alarms[0][0])


class _LoopAlarm:
    """A call at a time; no callback is left once it was made or cancelled."""

    __slots__ = ("_heap", "callback")

    def __init__(self, heap: _AlarmHeap, callback: Callable[[], object]) -> None:
        self._heap = heap
        self.callback: Callable[[], object] | None = callback

    def close(self) -> None:
        """Cancel the call, if it has not been made."""
        if self.callback is not None:
            self.callback = None
            heap = self._heap
            heap.cancelled += 1
            if heap.cancelled > _CANCELLED_KEPT:
                heap.remove_cancelled()
