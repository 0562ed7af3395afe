import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from recorded import SMALL

from tfbus.cli.progress import watched

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


def test_a_bar_is_on_standard_error_if_that_is_a_terminal_and_never_in_the_output(tmp_path: Path) -> None:
    for command in (("info", str(SMALL)), ("query", str(SMALL), "map", "box", "--every", "0.001", "--json")):
        plain = subprocess.run([TFBUS, *command], capture_output=True, text=True, timeout=60, check=True)
        assert "reading" not in plain.stderr
        status, shown = on_a_terminal(tmp_path / "output", *command)
        assert status == 0
        assert (tmp_path / "output").read_text() == plain.stdout
        assert "reading" in shown
    assert "looking up" in shown


def test_the_items_come_as_they_are() -> None:
    assert list(watched(iter("abc"), None, "reading")) == ["a", "b", "c"]
