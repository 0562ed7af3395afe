"""Log lines that are written once for each cause."""

import logging
from collections.abc import Hashable

from tfbus.plain import printable

_KEPT = 1_000


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

    A line that repeats at 100 Hz buries all others. Callers count the repetitions. Names and errors of strangers may be
    arguments as they are: none of them begins a line of its own.
    """

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger
        self._seen = SeenKeys()

    def info(self, key: Hashable, message: str, *args: object) -> None:
        """Log at the level INFO, unless `key` was seen."""
        self._log(logging.INFO, key, message, args, None)

    def warning(self, key: Hashable, message: str, *args: object, exc_info: BaseException | None = None) -> None:
        """Log at the level WARNING, unless `key` was seen."""
        self._log(logging.WARNING, key, message, args, exc_info)

    def _log(
        self, level: int, key: Hashable, message: str, args: tuple[object, ...], exc_info: BaseException | None
    ) -> None:
        if self._seen.add(key):
            shown = (arg if isinstance(arg, (int, float)) else _Printable(arg) for arg in args)
            self._logger.log(level, message, *shown, exc_info=exc_info)


class _Printable:
    """An argument of a line; made a text when a handler wants the line, as other arguments are."""

    __slots__ = ("_value",)

    def __init__(self, value: object) -> None:
        self._value = value

    def __str__(self) -> str:
        return printable(str(self._value))

    def __repr__(self) -> str:
        return printable(repr(self._value))
