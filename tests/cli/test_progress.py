import subprocess
from pathlib import Path

from support.recorded import SMALL
from support.terminal import TFBUS, on_a_terminal

from tfbus.cli.progress import watched


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
