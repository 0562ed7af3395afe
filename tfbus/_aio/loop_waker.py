"""How other threads wake the event loop."""

from collections.abc import Callable
from typing import Any, cast

import anyio.lowlevel


class LoopWaker:
    """Has the event loop call a function soon, once for all the rings since it was last called.

    Parameters
    ----------
    answer : callable
        Called on the loop. It must not raise, and take care of all that has gathered.

    Notes
    -----
    A ring is for something that was queued before. The bell is armed again before `answer` is called, so what comes
    right behind it rings once more; it can be one ring too many, and never one too few.
    """

    def __init__(self, answer: Callable[[], object]) -> None:
        self._answer = answer
        self._soon: Callable[[Callable[[], object]], object] | None = None
        self._has_ended: Callable[[], bool] = bool
        self._armed = True

    @property
    def connected(self) -> bool:
        """Whether `connect` was called."""
        return self._soon is not None

    def connect(self) -> None:
        """Wake the event loop that runs now, from now on."""
        # anyio has no public call for this; both loops' own one is the only thing that wakes them from a thread.
        native = cast(Any, anyio.lowlevel.current_token().native_token)
        self._soon = getattr(native, "run_sync_soon", None) or native.call_soon_threadsafe
        # trio answers each ring that it has taken; asyncio's loops may end with some.
        self._has_ended = getattr(native, "is_closed", bool)
        # An earlier loop may have ended with a ring that it never answered.
        self._armed = True

    def ring(self) -> None:
        """Have it answered; for any thread.

        Raises
        ------
        RuntimeError
            If the event loop has ended, or there was none.
        """
        if self._soon is None:
            raise RuntimeError("connect the doorbell on the event loop first")
        if self._armed:
            self._armed = False
            try:
                self._soon(self._open)
            except BaseException:
                self._armed = True
                raise
        elif self._has_ended():
            raise RuntimeError("the event loop has ended before it answered an earlier ring")

    def _open(self) -> None:
        self._armed = True
        self._answer()
