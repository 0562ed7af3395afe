"""The command as a whole: its exit statuses, help texts, missing extras and closed pipes."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import pytest
from support.commands import Command, check_wrong_call
from support.processes import PATIENCE, TFBUS, Program, new_domain
from support.recorded import SMALL, write_mcap
from support.samples import moving

from tfbus import kernel
from tfbus.cli._overview import COMMANDS
from tfbus.cli.application import application
from tfbus.cli.arguments import UsageError
from tfbus.cli.domain import LinkOptions
from tfbus.errors import pip_install

LINK = ("--domain STR", "--listen STR...", "--connect STR...", "--backend CHOICE")
URDF = Path(__file__).parents[2] / "demos" / "robot_arm.urdf"


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("broadcast", ("--rate FLOAT", *LINK)),
        ("demo", ("--duration", "--rate", "--listen-rate", "--backend", "--simulated", "--no-broadcaster")),
        ("echo", ("TARGET", "SOURCE", "--rate FLOAT", "--max-age FLOAT", "--json", *LINK)),
        ("check", ("WHAT", "--from TIME", "--max-speed FLOAT", "--json", *LINK)),
        ("compare", ("REFERENCE", "ESTIMATE", "--pair STR...", "--scale", "--json")),
        ("convert", ("SOURCE", "FURTHER", "--from TIME", "--rename STR...", "--drop-static", "--overwrite")),
        ("foxglove", ("--port INT", *LINK)),
        ("info", ("FILE", "--json", "--wide", "--namespaces")),
        ("listen", ("--rate FLOAT", *LINK)),
        (
            "monitor",
            ("TARGET", "SOURCE", "--window FLOAT", "--rate FLOAT", "--once", "--duration FLOAT", "--json", *LINK),
        ),
        ("play", ("FILE", "--rate FLOAT", "--loop", "--from TIME", "--to TIME", "--topic STR...", *LINK)),
        ("plot", ("FILE", "FRAMES", "--output", "--path", "--3d", "--gaps", "--text", "--compare PATH")),
        ("query", ("FILE", "TARGET", "SOURCE", "--at TIME", "--every SECONDS", "--tum", "--csv", "--json")),
        ("record", ("FILE", "--duration FLOAT", "--overwrite", *LINK)),
        ("robot", ("FILE", "POSITION", "--tree", "--rate FLOAT", "--prefix STR", *LINK)),
        ("router", ("--listen STR", "--connect STR", "--backend")),
        ("static", ("PARENT", "CHILD", "--xyz", "--rpy", "--quaternion", "--authority STR", *LINK)),
        ("tree", ("--duration FLOAT", "--watch", "--rate FLOAT", "--dot PATH", "--svg PATH", "--json", *LINK)),
        ("view", ("FILE", "--urdf PATH", "--package-path PATH", "--fixed STR", "--trail STR", "--port INT", *LINK)),
    ],
)
def test_the_help_of_a_command_has_an_example_and_every_option(
    command: str, options: Sequence[str], tfbus: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    done = tfbus(command, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert f"Example: tfbus {command}" in done.stdout
    for option in options:
        assert re.search(rf"[│*] +{re.escape(option)}\b|{re.escape(option)} ", done.stdout), option
    # Neither `--no-json` nor `--empty-listen`: those that cyclopts adds by itself mean nothing here.
    assert re.findall(r"--(?:no|empty)-\w+", done.stdout) == (["--no-broadcaster"] if command == "demo" else [])
    assert "default: False" not in done.stdout
    assert max(map(len, done.stdout.splitlines())) <= 80


@pytest.mark.parametrize(
    ("command", "defaults"),
    [
        ("check", ["10.0", "100000000.0", "100.0", "100.0", "tf"]),
        ("compare", ["0.01", "1"]),
        ("demo", ["inf", "100.0", "1.0"]),
        ("echo", ["1.0", "inf"]),
        ("foxglove", ["8765", "127.0.0.1", "tf"]),
        ("robot", ["10.0"]),
        ("view", ["8080", "127.0.0.1", "30.0", "tf"]),
    ],
)
def test_the_help_tells_the_defaults(
    command: str, defaults: Sequence[str], tfbus: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    found = re.findall(r"\[default: ([^\]]*)\]", tfbus(command, "--help").stdout)
    assert found[: len(defaults)] == defaults


def test_the_version_is_that_of_the_package_with_the_kernel_that_runs(tfbus: Command) -> None:
    done = tfbus("--version")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == f"{version('tfbus')} ({kernel} kernel)\n"


def test_the_help_of_all_lists_the_commands(tfbus: Command) -> None:
    done = tfbus("--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert re.findall(r"│ ([a-z]+) ", done.stdout) == sorted(COMMANDS)


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (("no-such-command",), "no-such-command"),
        (("tree", "--no-such-option"), "--no-such-option"),
        (("tree", "surplus"), "surplus"),
        (("info",), "FILE"),
        (("info", SMALL, SMALL), str(SMALL)),
        (("echo", "map"), "SOURCE"),
        (("demo", "--rate", "0"), "--rate"),
        (("demo", "--listen-rate=-1"), "--listen-rate"),
        (("record", "a.mcap", "--duration", "-1"), "--duration"),
        (("listen", "--backend", "curio"), "--backend"),
        (("broadcast", "--listen", "rubbish"), "an address is like tcp/192.168.1.5:7447, not 'rubbish'"),
        (("listen", "--connect", "rubbish"), "an address is like tcp/192.168.1.5:7447, not 'rubbish'"),
        (("static", "map", "odom", "--domain", "a b"), "a domain is made of letters"),
    ],
)
def test_a_usage_error_is_one_line_on_standard_error_and_status_2(
    arguments: Sequence[object], why: str, tfbus: Command
) -> None:
    check_wrong_call(tfbus(*arguments), why)


def test_several_errors_at_once_are_a_line_each(tfbus: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise ExceptionGroup("two tasks", [UsageError("one"), UsageError("two")])

    monkeypatch.setattr(LinkOptions, "run", fail)
    done = tfbus("tree")
    assert (done.returncode, done.stdout, done.stderr) == (2, "", "tfbus: one\ntfbus: two\n")


def test_ctrl_c_is_status_130_and_silent(tfbus: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(LinkOptions, "run", interrupt)
    done = tfbus("tree")
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@pytest.mark.thorough
def test_letters_that_the_output_cannot_encode_are_escaped(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", [(1, "/tf", [moving("map", "Straße", 1)])])
    done = subprocess.run(
        [TFBUS, "info", str(path)],
        capture_output=True,
        timeout=PATIENCE,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
        check=True,
    )
    assert rb"Stra\xdfe" in done.stdout


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("package", "arguments", "status", "message"),
    [
        ("cyclopts", ("tree",), 1, f"the command needs some packages more: {pip_install('cli')}"),
        ("zenoh", ("listen",), 2, f"joining a domain needs a package more: {pip_install('cli,zenoh')}"),
        (
            "mcap.writer",
            ("record", "run.mcap", "--domain", new_domain()),
            2,
            f"to record needs a package more: {pip_install('bag')}",
        ),
        (
            "urdf_parser_py",
            ("robot", str(URDF), "--tree"),
            2,
            f"to read URDF, tfbus needs a package more: {pip_install('urdf')}",
        ),
    ],
)
def test_a_missing_extra_is_named(
    package: str, arguments: Sequence[str], status: int, message: str, tmp_path: Path
) -> None:
    hidden = f"import sys; sys.modules[{package!r}] = None; from tfbus.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", hidden, *arguments],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        cwd=tmp_path,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (status, "", f"tfbus: {message}\n")


@pytest.mark.thorough
def test_a_reader_that_closes_the_pipe_ends_the_command_silently(tmp_path: Path) -> None:
    long = "name_" * 100
    samples = [moving("a", f"{long}{number}", 1) for number in range(500)]
    path = write_mcap(tmp_path / "run.mcap", [(1, "/tf", samples)])
    # Unbuffered, Python would not report what the pipe did not take.
    environment = {**os.environ, "PYTHONUNBUFFERED": ""}
    for command in (("demo", "--simulated"), ("info", str(path))):
        pipe = subprocess.PIPE
        with subprocess.Popen([TFBUS, *command], stdout=pipe, stderr=pipe, env=environment) as process:
            assert process.stdout is not None
            assert process.stderr is not None
            # Both go on to print more than fits into a pipe.
            assert process.stdout.readline() != b""
            process.stdout.close()
            errors = process.stderr.read()
            status = process.wait(PATIENCE)
        assert (command[0], status, errors) == (command[0], 0, b"")


@pytest.mark.thorough
def test_an_optional_package_is_imported_only_by_the_command_that_needs_it() -> None:
    script = "import sys, tfbus.cli.application; print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    loaded = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split()
    assert "tfbus" in loaded
    assert set(loaded) & {"zenoh", "rich", "trio", "mcap", "rosbags", "lxml", "numpy", "anyio"} == set()


def test_every_command_has_a_module_of_its_name() -> None:
    folder = Path(sys.modules["tfbus.cli.commands"].__path__[0])
    modules = {path.stem for path in folder.glob("*.py")} - {"__init__"}
    assert {name for name in application(None) if not name.startswith("-")} == modules


@pytest.mark.thorough
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_silently_whenever_it_comes(number: signal.Signals) -> None:
    statuses = set()
    for step in range(16):
        with Program(sys.executable, "-X", "importtime", TFBUS, "tree", "--domain", new_domain()) as tree:
            # Python itself shows a traceback of its own start: until a module is loaded by the command.
            tree.errors.expect(r"\| +tfbus\.cli$")
            tree.errors.expect("import time")
            time.sleep(0.05 * step)
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
