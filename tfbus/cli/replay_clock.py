"""The clock of a command that shows times: it follows a replay."""

import time
from typing import Final

import anyio
import anyio.lowlevel

from tfbus.clock import JumpCallback, SystemClock
from tfbus.errors import ClockResetError
from tfbus.registration import Registration
from tfbus.stamps import SECOND, as_stamp

_PATIENCE: Final = 5.0
"""The time in s to wait for a simulated clock: transforms often arrive before it, and would seem decades old."""


class ReplayClock(SystemClock):
    """The machine's time until the first stamp of a replay arrives, and then the newest stamp that has arrived.

    So ages are counted in the time of the replay. Durations, rates and timeouts use the machine's time: a command goes
    on while the replay is paused.
    """

    def __init__(self) -> None:
        self._replayed: int | None = None
        self._patient_until = time.monotonic() + _PATIENCE
        self._arrival = anyio.Event()
        self._callbacks: dict[object, JumpCallback] = {}

    @property
    def is_set(self) -> bool:
        """Whether a stamp has arrived, or none has for so long that the machine's time counts."""
        return self._replayed is not None or time.monotonic() >= self._patient_until

    def now(self) -> int:
        """The newest stamp that has arrived, or the machine's time; in ns."""
        return super().now() if self._replayed is None else self._replayed

    def hear(self, stamp: int) -> None:
        """Take the time of the replay, in ns; an earlier one is a jump back.

        The first stamp is of another clock than the time before, so it is neither earlier nor later. It is announced as
        a jump to itself, and samples that arrived before it stay.
        """
        before = stamp if self._replayed is None else self._replayed
        first, self._replayed = self._replayed is None, stamp
        arrival, self._arrival = self._arrival, anyio.Event()
        arrival.set()
        if first or stamp < before:
            for callback in tuple(self._callbacks.values()):
                callback(before, stamp)

    async def sleep_until(self, stamp: int) -> None:
        """Sleep until a stamp in ns; `ClockResetError` after a jump back."""
        wanted, before = as_stamp(stamp), self.now()
        await anyio.lowlevel.checkpoint()
        while (now := self.now()) < wanted:
            if now < before:
                raise ClockResetError(before=before, after=now)
            before = now
            with anyio.move_on_after((wanted - now) / SECOND if self._replayed is None else None):
                await self._arrival.wait()

    def on_jump(self, callback: JumpCallback) -> Registration:
        """Call `callback` with the stamps before and after each jump."""
        key = object()
        self._callbacks[key] = callback
        return Registration(lambda: self._callbacks.pop(key, None))
