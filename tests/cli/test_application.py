"""The command line as a whole: summaries of commands that are not loaded, and the options that all of them share."""

import importlib
import inspect
import logging
import re
from pathlib import Path

import pytest
from support.commands import Command, check_wrong_call, nobody

from tfbus import Bus
from tfbus.cli.application import COMMANDS, run
from tfbus.cli.domain import LinkOptions


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


def test_a_domain_and_addresses_come_from_the_environment_unless_they_are_given(
    tfbus: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[LinkOptions] = []
    monkeypatch.setattr(LinkOptions, "run", lambda options, *_, **__: seen.append(options))
    monkeypatch.setenv("TFBUS_DOMAIN", "yard")
    monkeypatch.setenv("TFBUS_CONNECT", "tcp/10.0.0.1:7447 tcp/10.0.0.2:7447")
    tfbus("listen")
    tfbus("listen", "--domain", "hall", "--connect", "tcp/10.0.0.3:7447")
    assert [(options.domain, options.connect) for options in seen] == [
        ("yard", ("tcp/10.0.0.1:7447", "tcp/10.0.0.2:7447")),
        ("hall", ("tcp/10.0.0.3:7447",)),
    ]


@pytest.mark.parametrize(
    ("options", "lines"),
    [
        ((), ["tfbus: a warning"]),
        (("--log-level", "debug"), ["tfbus: a note", "tfbus: a remark", "tfbus: a warning"]),
        (("--log-level", "info"), ["tfbus: a remark", "tfbus: a warning"]),
        (("--log-level=error",), []),
    ],
)
def test_the_log_level_chooses_the_lines_on_standard_error(
    tfbus: Command, options: tuple[str, ...], lines: list[str]
) -> None:
    async def log(_: Bus) -> None:
        logger = logging.getLogger("tfbus")
        logger.debug("a note")
        logger.info("a %s", "remark")
        logger.warning("a warning")

    for words in (("listen", *options), (*options, "listen")):
        done = tfbus.on_domain(log, *words)
        assert (done.returncode, done.stdout, sorted(done.stderr.splitlines())) == (130, "", lines)
    assert logging.getLogger("tfbus").handlers == []


def test_another_log_level_is_a_usage_error(tfbus: Command) -> None:
    check_wrong_call(tfbus.on_domain(nobody, "listen", "--log-level", "loud"), "--log-level")


def test_completion_is_written_for_a_shell_with_all_commands(
    tfbus: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # It has the shell load the script at its start.
    monkeypatch.setenv("HOME", str(tmp_path))
    script = tmp_path / "tfbus.bash"
    done = tfbus("--install-completion", "--shell", "bash", "--output", script)
    assert done.returncode == 0
    assert str(script) in (tmp_path / ".bashrc").read_text()
    assert set(COMMANDS) <= set(re.findall(r"\w+", script.read_text()))


def test_what_the_caller_does_once_all_is_loaded_comes_before_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[str] = []
    monkeypatch.setattr(LinkOptions, "run", lambda *_, **__: steps.append("run"))
    assert run(["listen"], lambda: steps.append("loaded")) == 0
    assert run(["listen", "--no-such-option"], lambda: steps.append("loaded")) == 2
    assert steps == ["loaded", "run"]
