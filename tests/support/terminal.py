"""Commands on a terminal."""

import io
import os
import subprocess
from contextlib import suppress
from pathlib import Path

import pytest
from support.programs import PATIENCE, TFBUS

pty = pytest.importorskip("pty", reason="this system has no pseudo-terminals")


class Terminal(io.StringIO):
    """A stream that takes itself for a terminal, for a command in the process of the test."""

    encoding = "utf-8"

    def isatty(self) -> bool:
        return True


def on_a_terminal(output: Path, *arguments: str) -> tuple[int, str]:
    """Run ``tfbus`` with standard error on a terminal and standard output in a file.

    Returns
    -------
    The exit status, and what the terminal received.
    """
    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm"}
    with os.fdopen(ours, "rb", buffering=0) as terminal, output.open("wb") as file:
        process = subprocess.Popen([TFBUS, *arguments], stdout=file, stderr=theirs, env=environment)
        os.close(theirs)
        received = b""
        # At the end of the program, Linux raises an error.
        with suppress(OSError):
            while part := terminal.read(4_096):
                received += part
        return process.wait(timeout=PATIENCE), received.decode()
