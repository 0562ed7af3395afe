"""Log lines that come once."""

import logging
from collections.abc import Hashable

_REMEMBERED = 1_000


class OnceLogger:
    """Logs a warning the first time its key is seen; the last thousand keys are remembered.

    A diagnostic that repeats at 100 Hz buries the others, so what happens again is only counted by whoever calls this.
    """

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger
        self._seen: dict[Hashable, None] = {}

    def warning(self, key: Hashable, message: str, *args: object, exc_info: BaseException | None = None) -> None:
        """Log `message` unless `key` was seen."""
        if key in self._seen:
            return
        self._seen[key] = None
        if len(self._seen) > _REMEMBERED:
            del self._seen[next(iter(self._seen))]
        self._logger.warning(message, *args, exc_info=exc_info)
