"""A timer of the event loop that belongs to no task."""

import logging
import math
import sys
from collections.abc import Callable
from typing import Any, cast

import anyio.lowlevel


def running_loop() -> Any:
    """The event loop that runs here: that of asyncio, or the token of trio."""
    # anyio has no public timer; only the loops' own functions set one without a task of the caller.
    return cast(Any, anyio.lowlevel.current_token().native_token)


class LoopTimer:
    """Calls a function on an event loop at a time by the loop's own clock.

    Parameters
    ----------
    loop
        As `running_loop` gives it.
    callback : callable
        Called on the loop; an `Exception` is logged.

    Attributes
    ----------
    due : float
        The time of the next call, in s; infinity if none is set.
    """

    def __init__(self, loop: Any, callback: Callable[[], object]) -> None:
        self.loop = loop
        self.due = math.inf
        self._callback = callback
        self._trio = None if hasattr(loop, "call_at") else cast(Any, sys.modules["trio"])
        self._handle: Any = None

    def now(self) -> float:
        """The time of the loop, in s. Only the loop that runs has one."""
        return float(self.loop.time() if self._trio is None else self._trio.current_time())

    def set(self, due: float) -> None:
        """Call the function at a time, in s, and not at the one that was set before."""
        self.due = due
        if self._trio is None:
            if self._handle is not None:
                self._handle.cancel()
            self._handle = self.loop.call_at(due, self._fire)
        elif self._handle is not None:
            self._handle.deadline = due
        else:
            self._handle = self._trio.CancelScope(deadline=due)
            self._trio.lowlevel.spawn_system_task(self._sleep, self._handle)

    def _fire(self) -> None:
        self._handle = None
        self.due = math.inf
        try:
            self._callback()
        except Exception:
            # No task would hear of it, and it would end the whole run of trio.
            logging.getLogger("tfbus").exception("a timer raised")

    async def _sleep(self, scope: Any) -> None:
        with scope:
            await cast(Any, self._trio).sleep_forever()
        self._fire()
