import importlib
import inspect
import io
import sys

import pytest
from support.commands import Command

from tfbus.cli._overview import COMMANDS, overview
from tfbus.cli.application import application


@pytest.mark.parametrize("name", COMMANDS)
def test_the_summary_of_a_command_is_the_first_line_of_its_help(name: str) -> None:
    function = getattr(importlib.import_module(f"tfbus.cli.commands.{name}"), name)
    assert (inspect.getdoc(function) or "").splitlines()[0].replace("`", "") == COMMANDS[name]


def test_the_help_names_the_exit_statuses_and_the_variables_of_the_environment(tfbus: Command) -> None:
    for words in ((), ("--help",), ("tree", "--help")):
        done = tfbus(*words)
        assert (done.returncode, done.stderr) == (0, "")
        text = " ".join(done.stdout.split())
        for fact in ("0 success", "1 a lookup", "2 wrong usage", "130", "143", "TFBUS_DOMAIN", "TFBUS_CONNECT"):
            assert fact in text, fact


def words_of(text: str) -> list[str]:
    return text.translate(str.maketrans("╭╮╰╯─│", " " * 6)).split()


def test_the_overview_says_what_cyclopts_says(
    tfbus: Command, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    print_help, arguments, _ = application(None).meta.parse_args(["--help"], exit_on_error=False, print_error=False)
    print_help(*arguments.args, **arguments.kwargs)
    expected = words_of(capsys.readouterr().out)
    for words in ((), ("-h",), ("--help",)):
        assert words_of(tfbus(*words).stdout) == expected


@pytest.mark.parametrize("columns", [60, 80, 200])
def test_the_overview_is_as_wide_as_the_terminal(columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    lines = overview().splitlines()
    assert max(map(len, lines)) <= columns
    assert {len(line) for line in lines if line.startswith(("╭", "│", "╰"))} == {columns}


def test_a_terminal_without_box_characters_gets_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), "ascii"))
    assert overview().isascii()
