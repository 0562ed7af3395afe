"""Log lines that come once."""

import logging
from collections.abc import Hashable

_REMEMBERED = 1_000


class OnceLogger:
    """Logs a line the first time its key is seen; the last thousand keys are remembered.

    A diagnostic that repeats at 100 Hz buries the others, so what happens again is only counted by whoever calls this.
    """

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger
        self._seen: dict[Hashable, None] = {}

    def info(self, key: Hashable, message: str, *args: object) -> None:
        """Log what is worth knowing, unless `key` was seen."""
        self._log(logging.INFO, key, message, args, None)

    def warning(self, key: Hashable, message: str, *args: object, exc_info: BaseException | None = None) -> None:
        """Log what is probably a mistake, unless `key` was seen."""
        self._log(logging.WARNING, key, message, args, exc_info)

    def _log(
        self, level: int, key: Hashable, message: str, args: tuple[object, ...], exc_info: BaseException | None
    ) -> None:
        if key in self._seen:
            return
        self._seen[key] = None
        if len(self._seen) > _REMEMBERED:
            del self._seen[next(iter(self._seen))]
        self._logger.log(level, message, *args, exc_info=exc_info)
