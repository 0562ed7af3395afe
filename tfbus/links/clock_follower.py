"""`ClockFollower`, which drives a simulated clock by a time that comes from elsewhere, such as a replay or ROS."""

from typing import Final, Protocol

import anyio

from tfbus.clock import SimulatedClock
from tfbus.stamps import from_seconds, to_seconds

FAR: Final = 10.0
"""s; a time that is further ahead is a jump, because to run all timers up to it would take long."""


class HearsTime(Protocol):
    """A follower of the time of another program."""

    def hear(self, stamp: int) -> None:
        """Take the time of the other program, a stamp in ns."""


class ClockFollower:
    """Drives a `SimulatedClock` by the stamps that are heard; nothing is polled.

    The clock jumps to the first stamp, to one before the last, and to one that is more than `FAR` ahead. To all others
    it advances, so that timed tasks run in their order. Nobody else may advance the clock.

    Parameters
    ----------
    clock : SimulatedClock
    """

    def __init__(self, clock: SimulatedClock) -> None:
        self.clock = clock
        self._newest: int | None = None
        self._heard: anyio.Event | None = None
        self._advancing: anyio.CancelScope | None = None

    def hear(self, stamp: int) -> None:
        """Take the time of the other program, a stamp in ns; a jump is done when this returns."""
        before, self._newest = self._newest, stamp
        if before is None or stamp < before or stamp - before > from_seconds(FAR):
            if self._advancing is not None:
                self._advancing.cancel()
            if stamp != self.clock.now():
                self.clock.set(stamp)
        elif self._heard is not None:
            self._heard.set()

    async def run(self) -> None:
        """Advance the clock to what is heard, until cancelled.

        Raises
        ------
        RuntimeError
            If another task advances the clock.
        """
        while True:
            ahead = 0 if self._newest is None else self._newest - self.clock.now()
            if ahead > 0:
                with anyio.CancelScope() as self._advancing:
                    await self.clock.advance(to_seconds(ahead))
                self._advancing = None
            else:
                self._heard = anyio.Event()
                await self._heard.wait()
