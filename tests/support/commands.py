"""Commands as a user types them, without a process for each."""

import sys
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from tfbus.cli import main


@dataclass(frozen=True)
class Done:
    """What a command has left, as `subprocess.CompletedProcess` names it."""

    returncode: int
    stdout: str
    stderr: str


Command = Callable[..., Done]


def command(name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Runs a command of ``tfbus`` in this process."""

    def run(*arguments: object) -> Done:
        monkeypatch.setattr(sys, "argv", ["tfbus", name, *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        assert isinstance(ended.value.code, int)
        return Done(ended.value.code, *capsys.readouterr())

    return run


def check_wrong_call(done: Done, why: str) -> None:
    """A command that was called wrongly says so in one line, with `why` in it, and does nothing."""
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("tfbus: ")
    assert why in line
