"""The messages that a filter drops: counted by reason, and passed to a callback."""

import logging
from collections import Counter
from collections.abc import Callable
from inspect import iscoroutinefunction
from typing import Generic, Literal, TypeVar

from tfbus.bus.once_logger import OnceLogger
from tfbus.errors import BusClosedError, ClockResetError, LookupTimeoutError, TransformError, UnknownFrameError

MessageT = TypeVar("MessageT")

DropReason = Literal["too old", "queue full", "timed out", "unknown frame", "clock reset", "closed"]


class DroppedMessages(Generic[MessageT]):
    """Counts dropped messages and calls a callback for each; its errors are logged and counted.

    Parameters
    ----------
    on_drop : callable or None
        Called with the message, the reason and the error, if there is one.

    Attributes
    ----------
    counts : Counter
        By reason.
    callbacks_failed : int
        Number of exceptions that the callback raised.
    """

    def __init__(self, on_drop: Callable[[MessageT, DropReason, TransformError | None], object] | None) -> None:
        if on_drop is not None and not callable(on_drop):
            raise TypeError(f"on_drop must be callable, not {on_drop!r}")
        if iscoroutinefunction(on_drop):
            raise TypeError(f"on_drop must not be async, as {on_drop!r} is")
        self._on_drop = on_drop
        self._log = OnceLogger(logging.getLogger("tfbus"))
        self.counts: Counter[DropReason] = Counter()
        self.callbacks_failed = 0

    def drop(self, message: MessageT, reason: DropReason, error: TransformError | None) -> None:
        """Count a message and call the callback; its first `Exception` is logged."""
        self.counts[reason] += 1
        if self._on_drop is None:
            return
        try:
            self._on_drop(message, reason, error)
        except Exception as raised:  # noqa: BLE001 - the callback must not stop the filter
            self.callbacks_failed += 1
            self._log.warning("on_drop", "the on_drop callback %r raised", self._on_drop, exc_info=raised)


def reason_of(error: TransformError) -> DropReason:
    """The reason for dropping a message whose lookup ended with `error`."""
    if isinstance(error, LookupTimeoutError):
        return "unknown frame" if isinstance(error.__cause__, UnknownFrameError) else "timed out"
    if isinstance(error, UnknownFrameError):
        return "unknown frame"
    if isinstance(error, ClockResetError):
        return "clock reset"
    return "closed" if isinstance(error, BusClosedError) else "too old"
