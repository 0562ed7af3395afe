import io
import subprocess
import sys
from pathlib import Path

import pytest
from support.programs import PATIENCE, TFBUS
from support.recorded import SMALL
from support.terminal import on_a_terminal

from tfbus.cli._progress_bar import progress_bar
from tfbus.cli.output import track


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_the_bar_is_on_standard_error_and_leaves_the_output_alone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    for item in track(iter("abc"), 3, "reading"):
        print(item)
        print("notice", file=sys.stderr)
    assert capsys.readouterr().out == "a\nb\nc\n"
    shown = terminal.getvalue()
    assert "reading" in shown
    assert shown.count("notice\n") == 3
    # At its end, the bar erases its line.
    assert shown.endswith("\x1b[2K")


def test_the_bar_disappears_at_its_end() -> None:
    bar = progress_bar()
    assert bar.live.transient
    assert bar.console.stderr


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("command", "steps"),
    [
        (("info", str(SMALL)), ["reading"]),
        (("query", str(SMALL), "map", "box", "--every", "0.001", "--json"), ["reading", "looking up"]),
    ],
)
def test_on_a_terminal_a_command_prints_the_same_beside_its_bar(
    tmp_path: Path, command: tuple[str, ...], steps: list[str]
) -> None:
    plain = subprocess.run([TFBUS, *command], capture_output=True, text=True, timeout=PATIENCE, check=True)
    status, shown = on_a_terminal(tmp_path / "output", *command)
    assert status == 0
    assert (tmp_path / "output").read_text() == plain.stdout
    for step in steps:
        assert step in shown
        assert step not in plain.stderr
