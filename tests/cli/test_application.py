"""The command as a whole: help, options of all commands, exit statuses, missing extras and closed pipes."""

import inspect
import json
import logging
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from support.commands import Command
from support.processes import PATIENCE, TFBUS, Program, new_domain
from support.recorded import SMALL, write_mcap
from support.samples import moving

from tfbus import Bus, kernel
from tfbus.analysis import Limits
from tfbus.cli import run
from tfbus.cli.application import COMMANDS, application
from tfbus.cli.arguments import CsvFlag, Flag, JsonFlag, UsageError
from tfbus.cli.domain import LinkOptions

URDF = Path(__file__).parents[2] / "demos" / "robot_arm.urdf"


@pytest.fixture
def instead(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[..., object]], None]:
    """Have every command that joins a domain do something else."""
    return lambda other: monkeypatch.setattr(LinkOptions, "run", other)


NEED = "--connect and --listen need one more package:"
DEFAULTS = {
    "check": f"10.0 {Limits().translation} {Limits().speed} {Limits().turn_rate} tf",
    "demo": "inf 100.0 1.0",
    "view": "frames.yaml 8080 127.0.0.1 30.0 tf",
}


def test_the_help_of_a_command_has_its_own_options_before_those_of_others_in_panels(tfbus: Command) -> None:
    text = tfbus("check", "--help").stdout
    order = ["Arguments", "WHAT", "Parameters", "--max-speed", "--json", "What to read", "--topic", "How to join"]
    places = [text.index(word, text.index("╭")) for word in (*order, "--domain STR", "Options of all commands")]
    assert places == sorted(places)


@pytest.mark.parametrize("columns", [60, 80, 200])
def test_the_help_of_all_lists_the_commands_as_wide_as_the_terminal(
    columns: int, tfbus: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    done = tfbus()
    lines = done.stdout.splitlines()
    assert (done.returncode, done.stderr) == (0, "")
    assert re.findall(r"│ ([a-z]+) ", done.stdout) == sorted(COMMANDS)
    assert {len(line) for line in lines if line.startswith(("╭", "│", "╰"))} == {columns}
    assert max(map(len, lines)) <= columns
    assert tfbus("--help").stdout.splitlines() == tfbus("-h").stdout.splitlines() == lines
    # With an option, cyclopts prints it, and fills lines with blanks.
    by_cyclopts = tfbus("--log-level", "debug", "--help").stdout.splitlines()
    assert [line.rstrip() for line in by_cyclopts] == lines


def test_the_level_info_is_not_the_command_of_that_name(tfbus: Command) -> None:
    for words in (("tree", "--help"), ("--help",)):
        assert tfbus("--log-level", "info", *words) == tfbus("--log-level", "debug", *words)


def test_the_help_names_the_exit_statuses_and_the_variables_of_the_environment(tfbus: Command) -> None:
    for words in ((), ("tree", "--help")):
        text = " ".join(tfbus(*words).stdout.split())
        for fact in ("0 success", "1 a lookup", "2 wrong usage", "130", "143"):
            assert fact in text, fact
        for variable in ("TFBUS_DOMAIN", "TFBUS_CONNECT", "TFBUS_RUNTIME_DIR", "NO_COLOR"):
            assert variable in text, variable


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_has_its_summary_in_the_list_and_no_option_that_cannot_be_switched_off(name: str) -> None:
    function = application(name)[name].default_command
    assert function is not None
    assert (inspect.getdoc(function) or "").splitlines()[0].replace("`", "") == COMMANDS[name]
    parameters = inspect.signature(function).parameters.values()
    flags = [each for each in parameters if each.annotation in (Flag, JsonFlag, CsvFlag)]
    assert [each.name for each in flags if each.default is not False] == []


def test_the_version_is_that_of_the_package_with_the_kernel_that_runs(tfbus: Command) -> None:
    done = tfbus("--version")
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{version('tfbus')} ({kernel} kernel)\n", "")


def test_completion_is_written_for_a_shell_with_all_commands(
    tfbus: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # It has the shell load the script at its start.
    monkeypatch.setenv("HOME", str(tmp_path))
    script = tmp_path / "tfbus.bash"
    assert tfbus("--install-completion", "--shell", "bash", "--output", script).returncode == 0
    assert str(script) in (tmp_path / ".bashrc").read_text()
    assert set(COMMANDS) <= set(re.findall(r"\w+", script.read_text()))


@pytest.mark.parametrize(
    ("error", "status", "lines"),
    [
        (ExceptionGroup("two tasks", [UsageError("one"), UsageError("two")]), 2, "tfbus: one\ntfbus: two\n"),
        (KeyboardInterrupt(), 130, ""),
    ],
)
def test_errors_are_a_line_each_and_ctrl_c_is_silent(
    error: BaseException, status: int, lines: str, tfbus: Command, instead: Callable[[Callable[..., object]], None]
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    instead(fail)
    done = tfbus("tree")
    assert (done.returncode, done.stdout, done.stderr) == (status, "", lines)


def test_a_domain_and_addresses_come_from_the_environment_unless_they_are_given(
    tfbus: Command, instead: Callable[[Callable[..., object]], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[LinkOptions] = []
    instead(lambda options, *_, **__: seen.append(options))
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


def test_the_caller_is_called_once_all_is_loaded_and_before_the_command(
    instead: Callable[[Callable[..., object]], None],
) -> None:
    steps: list[str] = []
    instead(lambda *_, **__: steps.append("run"))
    assert run(["listen"], lambda: steps.append("loaded")) == 0
    assert run(["listen", "--no-such-option"], lambda: steps.append("loaded")) == 2
    assert steps == ["loaded", "run"]


def test_a_reader_that_has_gone_is_no_error_and_not_told_again_at_the_end(
    instead: Callable[[Callable[..., object]], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w", encoding="utf-8") as output:
        monkeypatch.setattr(sys, "stdout", output)
        instead(lambda *_, **__: print("something"))
        assert run(["listen"]) == 0
        # As Python does when it ends.
        print("more")
        output.flush()


def run_process(*command: str, **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False, **options)


@pytest.mark.thorough
def test_letters_that_the_output_cannot_encode_are_escaped(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", [(1, "/tf", [moving("map", "Straße", 1)])])
    ascii_only = {**os.environ, "PYTHONIOENCODING": "ascii", "COLUMNS": "80"}
    assert r"Stra\xdfe" in run_process(TFBUS, "info", str(path), env=ascii_only).stdout
    # The help has boxes of other characters there.
    assert run_process(TFBUS, env=ascii_only).stdout.isascii()


WITHOUT_EXTRAS = """
import json, sys
from importlib import import_module
from tfbus.cli import run
rooms, commands = json.loads(sys.argv[1])
sys.modules.update(dict.fromkeys(["cyclonedds", "foxglove", "matplotlib", "mcap", "pyarrow", "ruamel"]))
sys.modules.update(dict.fromkeys(["urdf_parser_py", "trimesh", "wsproto", "zenoh"]))
for room in rooms:
    try:
        import_module(f"tfbus.{room}")
    except ImportError as error:
        print(error)
for command in commands:
    assert run(command.split()) == 2, command
sys.modules["cyclopts"] = None
run(["tree"])
"""


def test_rooms_and_commands_without_their_extras_name_them(tmp_path: Path) -> None:
    rooms = {"plot": "plot", "view": "view", "links.dds": "dds", "links.foxglove": "foxglove"}
    rooms |= {"links.rosbridge": "rosbridge", "links.rmw_zenoh": "zenoh", "links.zenoh": "zenoh"}
    (tmp_path / "rig.yaml").write_text("laser:\n  parent: base\n")
    commands = {
        "router": "a router needs one more package: |cli,zenoh",
        "listen --connect tcp/127.0.0.1:1": f"{NEED} |cli,zenoh",
        "tree --listen tcp/127.0.0.1:1": f"{NEED} |cli,zenoh",
        "bridge tf dds --connect tcp/127.0.0.1:1": "a link over DDS needs one more package: |dds",
        f"record run.mcap --domain {new_domain()}": "recording needs one more package: |bag",
        f"robot {URDF} --tree": "to read URDF, tfbus needs one more package: |urdf",
        f"plot {SMALL} map odom": "for plots, tfbus needs one more package: |plot",
        "view": "for the live page, tfbus needs more packages: |view",
        "foxglove": "serving Foxglove needs one more package: |foxglove",
        f"query {SMALL} map odom --parquet x.parquet": "--parquet needs one more package: |parquet",
        "static rig.yaml": "to read YAML, tfbus needs one more package: |bag",
        f"convert {SMALL} x.mcap": "recording 'x.mcap': to write it, tfbus needs more packages: |bag",
    }
    asked = json.dumps([[*rooms], [*commands]])
    done = run_process(sys.executable, "-P", "-c", WITHOUT_EXTRAS, asked, cwd=tmp_path)
    assert done.returncode == 1
    expected = [*commands.values(), "the command needs more packages: |cli"]
    told = [line for line in done.stderr.splitlines() if "left out of" not in line]
    for line, (need, _, extras) in zip(told, (text.partition("|") for text in expected), strict=True):
        assert line.startswith(f'tfbus: {need}pip install "tfbus[{extras}]"')
    for line, extra in zip(done.stdout.splitlines(), rooms.values(), strict=True):
        assert f'pip install "tfbus[{extra}]", or ".[{extra}]" in a checkout' in line


@pytest.mark.thorough
def test_two_terminals_need_no_zenoh() -> None:
    hidden = "import sys; sys.modules['zenoh'] = None; from tfbus.cli import main; main()"
    words = ("--domain", new_domain())
    with (
        Program(sys.executable, "-P", "-c", hidden, "broadcast", *words) as broadcast,
        Program(sys.executable, "-P", "-c", hidden, "listen", *words) as listen,
        Program(sys.executable, "-P", "-c", hidden, "echo", "base_link", "base_laser", *words) as echo,
    ):
        assert listen.output.expect("base_laser: ").startswith("[ INFO]")
        assert echo.output.expect("Translation") == "- Translation: [0.100000, 0.000000, 0.200000] m"
        with Program(sys.executable, "-P", "-c", hidden, "tree", *words) as tree:
            assert tree.wait() == 0
        assert tree.errors.text == "hears 3 peers on this machine\n"
        for program in (broadcast, listen, echo):
            assert program.end() == 130
        assert [program.errors.text.count("\n") for program in (broadcast, echo)] == [1, 0]


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_the_help_of_all_and_the_version_load_no_optional_package_and_no_numpy(option: str) -> None:
    script = (
        f"import sys, tfbus.cli as cli; cli.run(['{option}']); "
        "print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    )
    loaded = run_process(sys.executable, "-P", "-c", script).stdout.splitlines()[-1].split()
    assert "tfbus" in loaded
    assert set(loaded) & {"cyclopts", "rich", "zenoh", "trio", "mcap", "rosbags", "lxml", "anyio", "numpy"} == set()


HELPS = """
import io, json, sys
from contextlib import redirect_stdout
import tfbus.cli as cli
helps = {}
for name in sys.argv[1:]:
    with redirect_stdout(io.StringIO()) as said:
        assert cli.run([name, "--help"]) == 0
    helps[name] = said.getvalue()
loaded = [*sys.modules]
cli.run(["echo", "map"])
from tfbus.cli.commands.echo import describe
from tfbus import TransformStamped, Transform
at = describe(TransformStamped("map", "base", 0, Transform.identity(), static=True), None)
print(json.dumps([helps, loaded, at]))
"""


def test_the_help_of_a_command_has_an_example_and_defaults_and_loads_none_of_its_work() -> None:
    environment = {**os.environ, "COLUMNS": "80"}
    done = run_process(sys.executable, "-P", "-c", HELPS, *COMMANDS, env=environment)
    assert re.fullmatch("tfbus: .*SOURCE.*\n", done.stderr)
    helps, loaded, at = json.loads(done.stdout)
    for command, text in helps.items():
        assert f"Example: tfbus {command}" in text
        arguments = re.findall(r"│ [* ]? *([A-Z]+)  ", text)
        usage = re.fullmatch(rf"Usage: tfbus {command} \[OPTIONS\](.*)", text.splitlines()[0])
        assert usage is not None, command
        assert re.findall("[A-Z]+", usage[1]) == arguments, command
        # Neither `--no-json` nor `--empty-listen`: the options that cyclopts adds by itself mean nothing here.
        no = ["--no-broadcaster"] if command == "demo" else []
        assert re.findall(r"--(?:no|empty)-\w+", text) == no, command
        defaults = re.findall(r"\[default:[\s│]*([^\]]*)\]", text)
        assert not set(defaults) & {"None", "False", "()", '""'}, command
        assert " ".join(defaults).startswith(DEFAULTS.get(command, "")), command
        assert "[default: warning]" in text, command
        assert max(map(len, text.splitlines())) <= 80, command
    work = {"tfbus.stamps", "tfbus.bus", "tfbus.links", "tfbus.recording", "numpy", "anyio", "asyncio", "zenoh", "mcap"}
    assert set(loaded) & work == set()
    # It can be loaded later.
    assert at.startswith("At any time: 'base' in 'map'\n")


@pytest.mark.thorough
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_silently_whenever_it_comes(number: signal.Signals) -> None:
    statuses = set()
    for step in range(8):
        with Program(sys.executable, "-X", "importtime", TFBUS, "tree", "--domain", new_domain()) as tree:
            # Python itself shows a traceback of its own start: until a module is loaded by the command.
            tree.errors.expect(r"\| +tfbus\.cli$")
            tree.errors.expect("import time")
            time.sleep(0.1 * step)
            statuses.add(tree.end(number))
        said = [line for line in tree.errors.text.splitlines() if not line.startswith("import time:")]
        assert not said or (len(said) == 1 and said[0].startswith("waiting for transforms"))
    assert statuses <= {-number, 128 + number}


@pytest.mark.thorough
def test_where_ctrl_c_is_ignored_a_termination_ends_it() -> None:
    script = 'trap "" INT; exec "$0" tree --domain "$1"'
    with Program("sh", "-c", script, TFBUS, new_domain()) as tree:
        tree.errors.expect("waiting")
        tree.process.send_signal(signal.SIGINT)
        assert tree.end(signal.SIGTERM) == -signal.SIGTERM
