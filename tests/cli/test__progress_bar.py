import subprocess
import sys
from pathlib import Path

import pytest
from support.processes import PATIENCE, TFBUS
from support.recorded import SMALL
from support.terminal import Terminal, on_a_terminal

from tfbus.cli.output import track


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
