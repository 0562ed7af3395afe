"""Programs as a user runs them, each in a process of its own; a test waits for the lines that they print."""

import re
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import IO

from support.processes import free_ports

TFBUS = str(Path(sys.executable).with_name("tfbus"))
PATIENCE = 60.0
"""The longest that a test waits for a line or for the end of a program, in s."""


def free_address() -> str:
    """An address on the loopback at which no program listens."""
    return f"tcp/127.0.0.1:{free_ports(1)[0]}"


class Lines:
    """The lines that a process prints to one of its streams."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file
        self._changed = threading.Condition()
        self._lines: list[str] = []
        self._read = 0
        self._ended = False
        self._reader = threading.Thread(target=self._follow)
        self._reader.start()

    @property
    def text(self) -> str:
        """All output so far."""
        with self._changed:
            return "".join(self._lines)

    def expect(self, pattern: str) -> str:
        """Wait for the next line that contains the pattern, after those that were expected before."""
        with self._changed:
            while True:
                while self._read < len(self._lines):
                    self._read += 1
                    if re.search(pattern, self._lines[self._read - 1]):
                        return self._lines[self._read - 1].rstrip("\n")
                arrived = not self._ended and self._changed.wait(PATIENCE)
                assert arrived or self._read < len(self._lines), f"no {pattern!r} in {''.join(self._lines)!r}"

    def skip(self) -> None:
        """Ignore the lines that have been printed by now."""
        with self._changed:
            self._read = len(self._lines)

    def join(self) -> None:
        """Wait for the end of the stream."""
        self._reader.join()

    def _follow(self) -> None:
        for line in self._file:
            with self._changed:
                self._lines.append(line)
                self._changed.notify_all()
        with self._changed:
            self._ended = True
            self._changed.notify_all()


class Program:
    """A process that is killed at the end of the ``with``, unless it has ended before."""

    def __init__(self, *command: str | Path, environment: Mapping[str, str] | None = None) -> None:
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, encoding="utf-8", env=environment
        )
        assert self.process.stdout is not None
        assert self.process.stderr is not None
        self.output = Lines(self.process.stdout)
        self.errors = Lines(self.process.stderr)

    def end(self, number: int = signal.SIGINT) -> int:
        """Send a signal, by default that of Ctrl-C, and wait for the end; returns the exit status."""
        self.process.send_signal(number)
        return self.wait()

    def wait(self) -> int:
        """Wait for the end of the process and of its output; returns the exit status."""
        status = self.process.wait(PATIENCE)
        self.output.join()
        self.errors.join()
        return status

    def __enter__(self) -> "Program":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        with self.process:
            self.process.kill()
            self.output.join()
            self.errors.join()


def start_tfbus(*arguments: str) -> Program:
    """Start the command ``tfbus``."""
    return Program(TFBUS, *arguments)
