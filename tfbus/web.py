"""For web services on a buffer: the statuses of errors for HTTP, and an end that waits for no stream.

Neither depends on a web framework.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, Protocol

import anyio.lowlevel

from tfbus.errors import (
    BusClosedError,
    ClockResetError,
    DisconnectedError,
    ExtrapolationError,
    FutureExtrapolationError,
    LookupTimeoutError,
    RemoteLookupError,
    UnknownFrameError,
)

# The first class that fits decides.
_STATUSES: tuple[tuple[type[Exception], int], ...] = (
    (UnknownFrameError, 404),
    (DisconnectedError, 409),
    (FutureExtrapolationError, 504),
    (ExtrapolationError, 410),
    (LookupTimeoutError, 504),
    (RemoteLookupError, 502),
    (BusClosedError, 503),
    (ClockResetError, 503),
    (ValueError, 422),
)


class _Closable(Protocol):
    """A bus, a buffer, or anything else with a method that closes it at once."""

    def close(self) -> None:
        """Close it."""


def status_of(error: Exception) -> int:
    """The status of HTTP for an error of a lookup.

    Parameters
    ----------
    error : Exception
        A `LookupTimeoutError` has the status of its cause, the lookup error at the end of the time.

    Returns
    -------
    404 for an unknown frame, 409 for frames that are not connected, 410 for a stamp that is too old or in a gap, 504
    for a transform that has not come in time, 502 for a buffer of another process that does not answer, 503 after the
    end of the bus or a reset of its clock, 422 for other arguments that have no answer, and 500 for every other error.

    Examples
    --------
    >>> import tfbus, tfbus.web
    >>> try:
    ...     tfbus.TransformTree().lookup("map", "base_link")
    ... except tfbus.TransformLookupError as error:
    ...     print(tfbus.web.status_of(error))
    404
    """
    reason: BaseException = error
    if isinstance(error, LookupTimeoutError) and error.__cause__ is not None:
        reason = error.__cause__
    return next((status for kind, status in _STATUSES if isinstance(reason, kind)), 500)


@contextmanager
def close_on_signal(*closing: _Closable) -> Iterator[None]:
    """Close buffers or buses as soon as SIGINT or SIGTERM ends the server, not only when its requests have ended.

    A server that is told to end waits for its open requests, and ends the application's lifespan only then. A stream
    has no end of its own, and a lookup may wait for a minute. If their buffer is closed, a stream ends after its last
    answer, and a waiting lookup raises `BusClosedError`.

    The handlers that the server has set are called as before, so enter this in the lifespan. It does nothing in a
    thread other than the main one, as under a test client, and for a signal that has no handler.

    Parameters
    ----------
    *closing : Bus, Buffer, or another object with ``close()``
        Closed in this order, on the running event loop of asyncio or trio. A closed buffer leaves the bus open, so
        the tasks that send are not disturbed.

    Examples
    --------
    >>> import contextlib, tfbus, tfbus.web
    >>> @contextlib.asynccontextmanager
    ... async def lifespan(app):
    ...     with tfbus.Bus() as bus, tfbus.Buffer(bus) as buffer, tfbus.web.close_on_signal(buffer):
    ...         yield {"buffer": buffer}
    >>> async with lifespan(None) as state:
    ...     print(state["buffer"])
    <Buffer of 0 frames, keeps 10 s, 0 lookups waiting>
    """
    loop: Any = anyio.lowlevel.current_token().native_token
    # Of all functions of a loop, only these wake it from a signal handler.
    call_soon = getattr(loop, "run_sync_soon", None) or loop.call_soon_threadsafe
    before: dict[int, Any] = {}

    def close() -> None:
        for each in closing:
            each.close()

    def handle(number: int, frame: FrameType | None) -> None:
        # The loop may have ended before the lifespan.
        with suppress(RuntimeError):
            call_soon(close)
        before[number](number, frame)

    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            handler = signal.getsignal(number)
            if callable(handler):
                before[number] = handler
                signal.signal(number, handle)
    try:
        yield
    finally:
        for replaced in before:
            if signal.getsignal(replaced) is handle:
                signal.signal(replaced, before[replaced])
