"""The command as a user runs it: in a process of its own."""

import re
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import anyio
import pytest

from tfbus import SimulatedClock
from tfbus.cli import tutorial

TFBUS = str(Path(sys.executable).with_name("tfbus"))
BACKENDS = ["asyncio", "trio"]
SIMULATED = "".join(
    f"[ INFO] {second}.000000000: base_laser: (1.00, 0.20. 0.00) -----> base_link: (1.10, 0.20, 0.20) "
    f"at time {second - 1}.99\n"
    for second in range(1, 11)
)


def tfbus(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([TFBUS, *arguments], capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_simulated_demo_prints_ten_lines_that_are_known_to_the_byte(backend: str) -> None:
    done = tfbus("demo", "--simulated", "--duration", "10", "--backend", backend)
    assert (done.stdout, done.stderr, done.returncode) == (SIMULATED, "", 0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_simulated_demo_is_the_same_twenty_times_out_of_twenty(backend: str) -> None:
    for _ in range(20):
        lines: list[str] = []
        anyio.run(partial(tutorial.run, SimulatedClock(), duration=10.0, output=lines.append), backend=backend)
        assert "".join(f"{line}\n" for line in lines) == SIMULATED


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("time", ["--simulated", "--duration=inf"])
def test_ctrl_c_ends_the_demo_with_status_130_and_no_traceback(backend: str, time: str) -> None:
    command = [TFBUS, "demo", "--listen-rate", "20", "--backend", backend, time]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=30)
    assert first.startswith("[ INFO] ")
    assert process.returncode == 130
    assert errors == ""
    assert all(line.startswith("[ INFO] ") for line in output.splitlines())


def test_on_the_system_clock_the_lines_carry_the_systems_time() -> None:
    done = tfbus("demo", "--duration", "0.3", "--listen-rate", "10")
    stamps = [int(seconds) for seconds in re.findall(r"^\[ INFO\] (\d+)\.\d{9}: ", done.stdout, re.MULTILINE)]
    assert len(stamps) == 3
    assert stamps[0] > 1_700_000_000
    assert done.returncode == 0


def test_without_a_broadcaster_the_error_lines_go_to_standard_output() -> None:
    done = tfbus("demo", "--simulated", "--duration", "2", "--no-broadcaster")
    assert done.returncode == 0
    assert done.stderr == ""
    assert done.stdout.count("[ERROR] ") == 2
    assert "frame 'base_link' is not known" in done.stdout


@pytest.mark.parametrize(
    "arguments",
    [
        ("demo", "--rate", "0"),
        ("demo", "--rate", "inf"),
        ("demo", "--listen-rate=-1"),
        ("demo", "--duration", "nan"),
        ("demo", "--backend", "curio"),
        ("demo", "--no-such-option"),
        ("no-such-command",),
    ],
)
def test_a_wrong_call_is_one_line_on_standard_error_and_status_2(arguments: tuple[str, ...]) -> None:
    done = tfbus(*arguments)
    assert done.returncode == 2
    assert done.stdout == ""
    assert re.fullmatch(r"tfbus: .+\n", done.stderr)


def test_help_shows_every_option_and_an_example() -> None:
    done = tfbus("demo", "--help")
    assert done.returncode == 0
    for option in ("--duration", "--rate", "--listen-rate", "--backend", "--simulated", "--no-broadcaster"):
        assert option in done.stdout
    assert "Example: tfbus demo" in done.stdout


def test_a_reader_that_has_had_enough_is_no_traceback() -> None:
    command = [TFBUS, "demo", "--simulated"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        errors = process.stderr.read()
        process.wait(timeout=30)
    assert errors == ""


def test_without_its_extra_the_command_names_it() -> None:
    hidden = "import sys; sys.modules['cyclopts'] = None; import tfbus.cli"
    done = subprocess.run([sys.executable, "-c", hidden], capture_output=True, text=True, check=False)
    assert done.stderr == 'tfbus: the command needs some packages more: pip install "tfbus[cli]"\n'
    assert done.returncode == 1
