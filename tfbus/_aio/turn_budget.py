"""`TurnBudget`, which bounds the time for which one piece of work keeps the event loop."""

from collections.abc import Callable
from time import monotonic
from typing import Final

import anyio.lowlevel

TURN: Final = 0.001
"""In s: two such pieces of work, each late by one message, stay within 5 ms."""


class TurnBudget:
    """Tells long work, such as reading messages of a network, when other tasks have to get their turn.

    Parameters
    ----------
    seconds : float
        How long the work may go on.
    now : callable
        Returns a monotonic time in s.
    """

    def __init__(self, seconds: float = TURN, now: Callable[[], float] = monotonic) -> None:
        self._seconds = seconds
        self._now = now
        self._end = now() + seconds

    @property
    def spent(self) -> bool:
        """Whether the turn has to end."""
        return self._now() >= self._end

    def begin(self) -> None:
        """Begin a turn: other tasks had theirs."""
        self._end = self._now() + self._seconds

    async def give_way(self) -> None:
        """Pass a checkpoint if the turn has to end, and begin the next."""
        if self.spent:
            await anyio.lowlevel.checkpoint()
            self.begin()
