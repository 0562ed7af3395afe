"""The callbacks of a bus, the announcement of its events, and log lines that are written once for each cause."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from inspect import iscoroutinefunction
from itertools import count
from typing import Protocol, TypeVar

from tfbus.events import Event, SubscriberFailed
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.plain import printable
from tfbus.registration import Registration

_KEPT = 1_000

LINES = 100
"""The number of log lines of one kind that are written in a minute."""

_MINUTE = 60.0


class SeenKeys:
    """A set of keys that forgets the oldest when it is full.

    Parameters
    ----------
    capacity : int
        Number of keys that it keeps.
    """

    __slots__ = ("_capacity", "_keys")

    def __init__(self, capacity: int = _KEPT) -> None:
        self._capacity = capacity
        self._keys: dict[Hashable, None] = {}

    def __contains__(self, key: object) -> bool:
        return key in self._keys

    def add(self, key: Hashable) -> bool:
        """Add a key; return whether it is new."""
        if key in self._keys:
            return False
        self._keys[key] = None
        if len(self._keys) > self._capacity:
            del self._keys[next(iter(self._keys))]
        return True


class OnceLogger:
    """Writes a log line the first time that its key is seen; the last thousand keys are kept.

    A line that repeats at 100 Hz hides all others, and so do lines about ten thousand frames of a stranger. So at most
    `LINES` lines of one kind are written in a minute. Callers count each case. Names and errors of strangers are safe
    as arguments: they cannot begin a new line.
    """

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger
        self._seen = SeenKeys()
        # A wire logs in a thread of its own.
        self._lock = threading.Lock()
        # The beginning of a minute (s), and the number of lines since, by kind.
        self._written: dict[str, tuple[float, int]] = {}

    def info(self, key: Hashable, message: str, *args: object) -> None:
        """Log at the level INFO, unless `key` was seen."""
        self._log(logging.INFO, key, message, args, None)

    def warning(self, key: Hashable, message: str, *args: object, exc_info: BaseException | None = None) -> None:
        """Log at the level WARNING, unless `key` was seen."""
        self._log(logging.WARNING, key, message, args, exc_info)

    def _log(
        self, level: int, key: Hashable, message: str, args: tuple[object, ...], exc_info: BaseException | None
    ) -> None:
        with self._lock:
            is_new = self._seen.add(key)
        if not is_new:
            return
        now = time.monotonic()
        began, lines = self._written.get(message, (now, 0))
        if now - began >= _MINUTE:
            began, lines = now, 0
        self._written[message] = began, lines + 1
        if lines == LINES:
            self._logger.warning("more than %d lines in a minute, the others are left out, such as: %s", LINES, message)
        elif lines < LINES:
            shown = (arg if isinstance(arg, (int, float)) else _Printable(arg) for arg in args)
            self._logger.log(level, message, *shown, exc_info=exc_info)


class _Printable:
    """An argument of a log line; formatted only when a handler writes the line."""

    __slots__ = ("_value",)

    def __init__(self, value: object) -> None:
        self._value = value

    def __str__(self) -> str:
        return printable(str(self._value))

    def __repr__(self) -> str:
        return printable(repr(self._value))


class Listener(Protocol):
    """A reader of events."""

    def put(self, event: Event) -> object: ...


class Announcer:
    """Passes each event to all listeners.

    Check `has_listeners` before making an event: most programs have none, and an event costs more than the check.

    Parameters
    ----------
    now : callable
        Gives the present stamp in ns, which events carry.
    listeners : sequence of Listener
        The bus adds and removes listeners here.
    """

    def __init__(self, now: Callable[[], int], listeners: Sequence[Listener] = ()) -> None:
        self.now = now
        self._listeners = listeners

    @property
    def has_listeners(self) -> bool:
        """Whether anybody reads events."""
        return len(self._listeners) > 0

    def announce(self, event: Event) -> None:
        """Pass an event to every listener."""
        for listener in self._listeners:
            listener.put(event)


BatchCallback = Callable[[Batch], object]
FrameCallback = Callable[[str], object]
GivenT = TypeVar("GivenT")

_QUEUED_BATCHES = 1_000


class Subscribers:
    """Calls subscribers one batch after the other, and keeps them from harming each other or the publisher.

    A batch that a subscriber publishes is delivered after the current one, so all subscribers see the same order. If a
    subscriber removes a frame or sets the clock back, the later ones get the current batch without the removed samples.

    Attributes
    ----------
    callbacks : dict of int to callable
    calling : list of callable
        The callbacks that run now, each called by the one before it.
    failures : int
        Number of exceptions that subscribers raised.
    """

    def __init__(self, log: OnceLogger, announcer: Announcer) -> None:
        self._log = log
        self._announcer = announcer
        self.callbacks: dict[int, BatchCallback] = {}
        # Made anew at each change, because a batch is published far more often.
        self._in_order: tuple[tuple[int, BatchCallback], ...] = ()
        self._removal_callbacks: dict[int, FrameCallback] = {}
        self._keys = count()
        self._backlog: deque[Batch] = deque()
        self._current: Batch = ()
        self.calling: list[Callable[..., object]] = []
        self._queued = 0
        self.failures: int = 0

    def subscribe(self, callback: BatchCallback, latched: Batch, removed: FrameCallback | None = None) -> Registration:
        """Register a callback, and call it with the latched samples if there are any."""
        for function in (callback, removed):
            if function is not None and not callable(function):
                raise TypeError(f"a subscriber must be callable, not {function!r}")
            if iscoroutinefunction(function):
                raise TypeError(f"a subscriber must not be async, as {function!r} is: read a bus.stream() instead")
        key = next(self._keys)
        self.callbacks[key] = callback
        self._in_order = tuple(self.callbacks.items())
        if removed is not None:
            self._removal_callbacks[key] = removed
        if latched:
            self._call(key, callback, latched)
            self.deliver()
        return Registration(lambda: self._remove(key))

    def check_backlog(self) -> None:
        """Raise `RuntimeError` if callbacks publish without end."""
        if self._queued >= _QUEUED_BATCHES:
            raise RuntimeError(
                f"the subscriber {_name(self.calling[-1])} publishes without end: {self._queued} batches are queued "
                "behind the one that it was called with"
            )

    def deliver(self, batch: Batch = ()) -> None:
        """Call every subscriber with the batches that wait and this one: now, or when the callbacks that run return."""
        callbacks, calling = self.callbacks, self.calling
        if calling or self._backlog:
            if batch:
                self._backlog.append(batch)
            if calling:
                self._queued += len(batch) > 0
                return
            batch = self._backlog.popleft()
        try:
            while batch:
                self._current = batch
                for key, callback in self._in_order:
                    # A callback may have closed another registration, or removed a frame of the batch.
                    if key not in callbacks or not self._current:
                        continue
                    # As `_call`, without a function of Python for each callback.
                    calling.append(callback)
                    try:
                        callback(self._current)
                    except Exception as error:  # noqa: BLE001 - a subscriber must not stop the publisher
                        self._note_failure(key, callback, error)
                    finally:
                        calling.pop()
                batch = self._backlog.popleft() if self._backlog else ()
        finally:
            self._current = ()
            self._queued = 0

    def discard_moving(self) -> None:
        """Take the moving samples out of the batches that are not delivered yet: the clock has jumped back."""
        self._keep_only(lambda sample: sample.static)

    def forget(self, child: str) -> None:
        """Take the samples of a removed frame out of the batches that are not delivered yet."""
        self._keep_only(lambda sample: sample.child != child)

    def notify_removed(self, child: str) -> None:
        """Call the removal callbacks with a frame; batches that they publish are delivered afterwards."""
        for key, removed in tuple(self._removal_callbacks.items()):
            if key in self._removal_callbacks:
                self._call(key, removed, child)
        self.deliver()

    def _keep_only(self, wanted: Callable[[TransformStamped], bool]) -> None:
        self._current = tuple(filter(wanted, self._current))
        batches = (tuple(filter(wanted, batch)) for batch in self._backlog)
        self._backlog = deque(batch for batch in batches if batch)

    def _remove(self, key: int) -> None:
        self.callbacks.pop(key, None)
        self._in_order = tuple(self.callbacks.items())
        self._removal_callbacks.pop(key, None)

    def _call(self, key: int, callback: Callable[[GivenT], object], given: GivenT) -> None:
        self.calling.append(callback)
        try:
            callback(given)
        except Exception as error:  # noqa: BLE001 - a subscriber must not stop the publisher
            self._note_failure(key, callback, error)
        finally:
            self.calling.pop()

    def _note_failure(self, key: int, callback: Callable[..., object], error: Exception) -> None:
        self.failures += 1
        self._log.warning(("subscriber", key), "the subscriber %s raised", _name(callback), exc_info=error)
        if self._announcer.has_listeners:
            self._announcer.announce(SubscriberFailed(self._announcer.now(), _name(callback), error))


def _name(callback: Callable[..., object]) -> str:
    return getattr(callback, "__qualname__", None) or repr(callback)
