"""The log lines of a command on standard error: one line where many things of one kind happen at once."""

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from tfbus.cli.output import say, warn

FIRST_WINDOW = 0.3
"""The time in s for which the first line of a kind is held back, to count those that follow."""
LONGEST_WINDOW = 10.0


@contextmanager
def log_lines(level: str) -> Iterator[None]:
    """Show what tfbus logs at a level, or at a higher one, on standard error for the body of a ``with``."""
    logger = logging.getLogger("tfbus")
    handler = FoldingHandler()
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(level)
    try:
        yield
    finally:
        logger.setLevel(before)
        logger.removeHandler(handler)
        handler.close()


class FoldingHandler(logging.Handler):
    """Prints the first line of a kind with the number of those that follow within a short time.

    Lines are of one kind if they differ only in their arguments. The time doubles each time that a kind comes again, up
    to `LONGEST_WINDOW`, and nothing is lost: `close` prints what is still held back.
    """

    def __init__(self) -> None:
        super().__init__()
        self._held: dict[str, tuple[str, int, threading.Timer]] = {}
        self._windows: dict[str, float] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """Hold a line back, or count it to the one of its kind that is held back."""
        kind = str(record.msg)
        if kind in self._held:
            line, more, timer = self._held[kind]
            self._held[kind] = (line, more + 1, timer)
            return
        window = self._windows.get(kind, FIRST_WINDOW)
        self._windows[kind] = min(2 * window, LONGEST_WINDOW)
        timer = threading.Timer(window, self._tell, (kind,))
        timer.daemon = True
        self._held[kind] = (self.format(record), 0, timer)
        timer.start()

    def close(self) -> None:
        """Print all lines that are held back."""
        for kind, (_, _, timer) in list(self._held.items()):
            timer.cancel()
            self._tell(kind)
        super().close()

    def _tell(self, kind: str) -> None:
        # A timer calls it in its own thread.
        self.acquire()
        try:
            held = self._held.pop(kind, None)
        finally:
            self.release()
        if held is not None:
            line, more, _ = held
            # Only a traceback has several lines. No message in it begins a line as those of tfbus do.
            first, *traceback = line.split("\n")
            warn(f"{first} (and {more:,} more like it)" if more else first)
            for part in traceback:
                say(f"  {part}")
