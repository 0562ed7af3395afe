"""Single keys from the terminal, which is as before on every way out of the program."""

import os
import signal
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Any, Final

import anyio

try:
    import termios
except ImportError:
    # On Windows.
    termios = None  # type: ignore[assignment]

_ESCAPED: Final = {b"\x1b[A": "up", b"\x1b[B": "down", b"\x1b[C": "right", b"\x1b[D": "left"}
_LONGEST: Final = 64


class Keyboard:
    """The keys that are pressed, for the body of a ``with``: ``async for key in keyboard.keys()``.

    A key is its letter, or ``"up"``, ``"down"``, ``"left"``, ``"right"``. Ctrl-C and Ctrl-Z do what they always do.

    Parameters
    ----------
    terminal : int
        A file descriptor.
    """

    def __init__(self, terminal: int) -> None:
        self._terminal = terminal
        self._before: list[Any] | None = None

    def __enter__(self) -> "Keyboard":
        self.take()
        return self

    def __exit__(self, *_: object) -> None:
        self.give_back()

    def take(self) -> None:
        """Have the terminal pass each key on at once, and show none; does nothing in the background."""
        with suppress(OSError, termios.error):
            # To change the terminal from the background would stop the program.
            if os.tcgetpgrp(self._terminal) != os.getpgrp():
                return
            found = termios.tcgetattr(self._terminal)
            if self._before is None:
                self._before = found
            flags = [*found]
            flags[3] &= ~(termios.ICANON | termios.ECHO)
            termios.tcsetattr(self._terminal, termios.TCSADRAIN, flags)

    def give_back(self) -> None:
        """Set the terminal as it was before."""
        before, self._before = self._before, None
        if before is not None:
            with suppress(OSError, termios.error):
                termios.tcsetattr(self._terminal, termios.TCSADRAIN, before)

    async def keys(self) -> AsyncIterator[str]:
        """The keys, until the terminal is closed."""
        while True:
            await anyio.wait_readable(self._terminal)
            try:
                typed = os.read(self._terminal, _LONGEST)
            except OSError:
                return
            if not typed:
                return
            for key in _split(typed):
                yield key


def _split(typed: bytes) -> Iterator[str]:
    while typed:
        if typed[:3] in _ESCAPED:
            yield _ESCAPED[typed[:3]]
            typed = typed[3:]
        else:
            yield typed[:1].decode("latin-1")
            typed = typed[1:]


def keyboard() -> Keyboard | None:
    """The keyboard, if standard input is a terminal in whose foreground this program runs."""
    if termios is None or not sys.stdin or not sys.stdin.isatty():
        return None
    terminal = sys.stdin.fileno()
    with suppress(OSError):
        if os.tcgetpgrp(terminal) == os.getpgrp():
            return Keyboard(terminal)
    return None


@contextmanager
def job_signals() -> Iterator[AsyncIterator[signal.Signals]]:
    """The signals that stop, continue and end a program."""
    with _open(signal.SIGTSTP, signal.SIGCONT, signal.SIGTERM) as signals:
        yield signals


def _open(*signals: signal.Signals) -> AbstractContextManager[AsyncIterator[signal.Signals]]:
    return anyio.open_signal_receiver(*signals)


async def follow_job(
    keys: Keyboard,
    signals: AsyncIterator[signal.Signals],
    stopped: Callable[[], object],
    continued: Callable[[], object],
) -> None:
    """Give the terminal back while the program is stopped; returns when it is to end, at SIGTERM.

    Parameters
    ----------
    keys : Keyboard
    signals : async iterator
        As `job_signals` gives it.
    stopped, continued : callable
        Called before the program is stopped, and after.
    """
    async for number in signals:
        if number == signal.SIGTERM:
            return
        if number == signal.SIGTSTP:
            stopped()
            keys.give_back()
            os.kill(os.getpid(), signal.SIGSTOP)
        keys.take()
        if number == signal.SIGTSTP:
            continued()
