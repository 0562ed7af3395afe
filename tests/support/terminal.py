"""Commands in a pseudo-terminal."""

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

TFBUS = str(Path(sys.executable).with_name("tfbus"))

pty = pytest.importorskip("pty", reason="this system has no pseudo-terminals")


def on_a_terminal(output: Path, *arguments: str) -> tuple[int, str]:
    """Status, and what a terminal gets that is standard error; standard output goes to a file."""
    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm"}
    with os.fdopen(ours, "rb", buffering=0) as terminal, output.open("wb") as file:
        process = subprocess.Popen([TFBUS, *arguments], stdout=file, stderr=theirs, env=environment)
        os.close(theirs)
        shown = b""
        # Linux tells the end of it by an error.
        with suppress(OSError):
            while part := terminal.read(4_096):
                shown += part
        return process.wait(timeout=60), shown.decode()
