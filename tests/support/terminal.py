"""Commands on a terminal."""

import io
import os
import re
import signal
import struct
import subprocess
import threading
from contextlib import suppress
from pathlib import Path

import pytest
from support.processes import TFBUS

pty = pytest.importorskip("pty", reason="this system has no pseudo-terminals")
fcntl = pytest.importorskip("fcntl", reason="this system has no pseudo-terminals")
termios = pytest.importorskip("termios", reason="this system has no pseudo-terminals")


class Terminal(io.StringIO):
    """A stream that takes itself for a terminal, for a command in the process of the test."""

    encoding = "utf-8"

    def isatty(self) -> bool:
        return True


def lines_on_a_terminal(width: int, *arguments: str | Path, seconds: float | None = None) -> list[str]:
    """The lines that ``tfbus`` draws on a terminal of some width and 40 lines, without their colours.

    With `seconds`, Ctrl-C is pressed so long after the first line.
    """
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, width, 0, 0))
    environment = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
    environment |= {"TERM": "xterm", "NO_COLOR": "1"}
    with os.fdopen(ours, "rb", buffering=0) as terminal:
        command = [TFBUS, *map(str, arguments)]
        process = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=subprocess.DEVNULL, env=environment)
        os.close(theirs)
        received = b""
        with process, suppress(OSError):
            while part := terminal.read(65_536):
                if seconds is not None and not received:
                    threading.Timer(seconds, process.send_signal, (signal.SIGINT,)).start()
                received += part
    # A live drawing goes back to its first line; each drawing has lines of its own here.
    drawn = re.sub(r"\r|\x1b\[[0-9;?]*[AHJK]", "\n", received.decode())
    return [line for line in re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", drawn).split("\n") if line]
