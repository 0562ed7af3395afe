"""The options that all commands share."""

import inspect
import logging
import pkgutil
import re
from importlib import import_module
from pathlib import Path

import pytest
from support.commands import Command, check_wrong_call, nobody

from tfbus import Bus
from tfbus.cli import commands
from tfbus.cli._overview import COMMANDS
from tfbus.cli.arguments import CsvFlag, Flag, JsonFlag
from tfbus.cli.domain import LinkOptions


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


MODULES = [module.name for module in pkgutil.iter_modules(commands.__path__)]


@pytest.mark.parametrize("name", MODULES)
def test_no_option_is_on_that_cannot_be_switched_off(name: str) -> None:
    command = getattr(import_module(f"tfbus.cli.commands.{name}"), name)
    parameters = inspect.signature(command).parameters.values()
    flags = [each for each in parameters if each.annotation in (Flag, JsonFlag, CsvFlag)]
    assert [each.name for each in flags if each.default is not False] == []


@pytest.mark.parametrize("name", MODULES)
def test_help_shows_the_defaults_that_do_something_and_has_no_option_for_an_empty_list(
    name: str, tfbus: Command
) -> None:
    text = tfbus(name, "--help").stdout
    assert not set(re.findall(r"\[default:[\s│]*([^\]]*)\]", text)) & {"None", "False", "()", '""'}
    assert "--empty" not in text
    assert "[default: warning]" in text
