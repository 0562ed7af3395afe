"""Log lines that come once."""

import logging
from collections.abc import Hashable

_REMEMBERED = 1_000


class SeenKeys:
    """Tells what comes for the first time; only the last so many keys are remembered."""

    __slots__ = ("_remembered", "_seen")

    def __init__(self, remembered: int = _REMEMBERED) -> None:
        self._remembered = remembered
        self._seen: dict[Hashable, None] = {}

    def first(self, key: Hashable) -> bool:
        """Whether `key` is new."""
        if key in self._seen:
            return False
        self._seen[key] = None
        if len(self._seen) > self._remembered:
            del self._seen[next(iter(self._seen))]
        return True


class OnceLogger:
    """Logs a line the first time its key is seen; the last thousand keys are remembered.

    A diagnostic that repeats at 100 Hz buries the others, so what happens again is only counted by whoever calls this.
    """

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger
        self._once = SeenKeys()

    def info(self, key: Hashable, message: str, *args: object) -> None:
        """Log what is worth knowing, unless `key` was seen."""
        self._log(logging.INFO, key, message, args, None)

    def warning(self, key: Hashable, message: str, *args: object, exc_info: BaseException | None = None) -> None:
        """Log what is probably a mistake, unless `key` was seen."""
        self._log(logging.WARNING, key, message, args, exc_info)

    def _log(
        self, level: int, key: Hashable, message: str, args: tuple[object, ...], exc_info: BaseException | None
    ) -> None:
        if self._once.first(key):
            self._logger.log(level, message, *args, exc_info=exc_info)
