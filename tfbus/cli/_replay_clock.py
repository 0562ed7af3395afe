"""`ReplayClock`, the clock of commands that show a domain: the machine's, until a replay there tells its time."""

import time
from typing import Final

import anyio
import anyio.lowlevel

from tfbus.clock import JumpCallback, SystemClock
from tfbus.errors import ClockResetError
from tfbus.registration import Registration
from tfbus.stamps import SECOND, as_stamp

_PATIENCE: Final = 5.0
"""s. The transforms of a simulation often arrive before its clock, which would show them as decades old."""


class ReplayClock(SystemClock):
    """The time of the machine until the first stamp is heard, and then the newest stamp that was heard.

    So the ages of transforms are ages of then. Durations, rates and timeouts stay those of the machine: a command goes
    on while the replay is paused.
    """

    def __init__(self) -> None:
        self._told: int | None = None
        self._patient_until = time.monotonic() + _PATIENCE
        self._heard = anyio.Event()
        self._callbacks: dict[object, JumpCallback] = {}

    @property
    def is_set(self) -> bool:
        """Whether a stamp was heard, or none has come for so long that the time is the machine's."""
        return self._told is not None or time.monotonic() >= self._patient_until

    def now(self) -> int:
        """The newest stamp that was heard, or the machine's time; in ns."""
        return super().now() if self._told is None else self._told

    def hear(self, stamp: int) -> None:
        """Take the time of the replay, in ns; an earlier one is a jump back.

        The first one is another clock's, so that it is no earlier or later time: it is told as a jump to itself, and
        what has arrived before it stays.
        """
        before = stamp if self._told is None else self._told
        first, self._told = self._told is None, stamp
        heard, self._heard = self._heard, anyio.Event()
        heard.set()
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
            with anyio.move_on_after((wanted - now) / SECOND if self._told is None else None):
                await self._heard.wait()

    def on_jump(self, callback: JumpCallback) -> Registration:
        """Call `callback` with the stamps before and after each jump."""
        key = object()
        self._callbacks[key] = callback
        return Registration(lambda: self._callbacks.pop(key, None))
