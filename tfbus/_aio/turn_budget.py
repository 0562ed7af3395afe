"""`TurnBudget`, which bounds the time for which one piece of work keeps the event loop."""

import time
from collections.abc import Callable
from typing import Final

import anyio.lowlevel

TURN: Final = 0.001
"""In s: two such pieces of work, each late by one message, stay within 5 ms."""

# A coarse clock, as on Windows, would let a turn go on for many times as long.
_HAS_FINE_CLOCK = time.get_clock_info("thread_time").resolution <= TURN / 10
_busy: Final = time.thread_time if _HAS_FINE_CLOCK else time.monotonic


class TurnBudget:
    """Tells long work, such as reading messages of a network, when other tasks have to get their turn.

    The time in which the thread waits for a processor does not count: on a crowded machine each turn would end after
    its first message, and the work would never be done.

    Parameters
    ----------
    seconds : float
        How long the work may go on.
    now : callable
        Returns a monotonic time in s.
    busy : callable
        Returns the time in s for which this thread has run; it takes longer to ask.
    """

    def __init__(
        self,
        seconds: float = TURN,
        now: Callable[[], float] = time.monotonic,
        busy: Callable[[], float] = _busy,
    ) -> None:
        self._seconds = seconds
        self._now = now
        self._busy = busy
        self.begin()

    @property
    def spent(self) -> bool:
        """Whether the turn has to end."""
        if self._now() < self._end:
            return False
        left = self._busy_end - self._busy()
        self._end = self._now() + left
        return left <= 0.0

    def begin(self) -> None:
        """Begin a turn: other tasks had theirs."""
        self._end = self._now() + self._seconds
        self._busy_end = self._busy() + self._seconds

    async def give_way(self) -> None:
        """Pass a checkpoint if the turn has to end, and begin the next."""
        if self.spent:
            await anyio.lowlevel.checkpoint()
            self.begin()
