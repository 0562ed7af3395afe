"""Wake-ups of the event loop from other threads."""

import logging
from collections.abc import Callable
from typing import Any, cast

import anyio.lowlevel


class LoopWaker:
    """Calls a function on the event loop soon after any thread has asked for it.

    Requests that come before the call share one call.

    Parameters
    ----------
    callback : callable
        Called on the loop. It must process everything that has been queued, or wake again. An `Exception` is logged.

    Notes
    -----
    Queue first, then call `wake`. The waker accepts new requests before it calls `callback`, so a request that comes
    during the call leads to another call: there may be one call too many, never one too few.
    """

    def __init__(self, callback: Callable[[], object]) -> None:
        self._callback = callback
        self._call_soon: Callable[[Callable[[], object]], object] | None = None
        self._loop_is_closed: Callable[[], bool] = _never
        self._requested = False

    @property
    def bound(self) -> bool:
        """Whether `bind` was called."""
        return self._call_soon is not None

    def bind(self) -> None:
        """Wake the running event loop from now on."""
        # anyio has no public function for this; only the loops' own functions wake them from a thread.
        native = cast(Any, anyio.lowlevel.current_token().native_token)
        self._call_soon = getattr(native, "run_sync_soon", None) or native.call_soon_threadsafe
        # trio answers each request that it has accepted. An asyncio loop may be closed with requests left.
        self._loop_is_closed = getattr(native, "is_closed", _never)
        # An earlier loop may have ended without answering a request.
        self._requested = False

    def wake(self) -> None:
        """Have the callback called soon; for any thread.

        Raises
        ------
        RuntimeError
            If the event loop has ended, or `bind` was never called.
        """
        if self._call_soon is None:
            raise RuntimeError("bind the waker on the event loop first")
        if not self._requested:
            self._requested = True
            try:
                self._call_soon(self._call)
            except BaseException:
                self._requested = False
                raise
        elif self._loop_is_closed():
            raise RuntimeError("the event loop has ended before it answered an earlier request")

    def _call(self) -> None:
        self._requested = False
        try:
            self._callback()
        except Exception:
            # No task would hear of it, and it would end the whole run of trio.
            logging.getLogger("tfbus").exception("a callback of another thread raised")


def _never() -> bool:
    return False
