"""A timed task's beat."""

import math
from collections.abc import Awaitable, Callable

from tfbus.stamps import SECOND, is_real


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
