"""Log lines that are written once for each cause."""

import logging
from collections.abc import Hashable

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

    A line that repeats at 100 Hz buries all others. Callers count the repetitions.
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
            self._logger.log(level, message, *args, exc_info=exc_info)
