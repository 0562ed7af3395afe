import re
import signal

import pytest
from support.commands import Command
from support.processes import start_tfbus

BACKENDS = ["asyncio", "trio"]
SIMULATED = "".join(
    f"[ INFO] {second}.000000000: base_laser: (1.00, 0.20. 0.00) -----> base_link: (1.10, 0.20, 0.20) "
    f"at time {second - 1}.99\n"
    for second in range(1, 11)
)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_simulated_demo_prints_ten_lines_that_are_known_to_the_byte(tfbus: Command, backend: str) -> None:
    done = tfbus("demo", "--simulated", "--duration", "10", "--backend", backend)
    assert (done.returncode, done.stdout, done.stderr) == (0, SIMULATED, "")


@pytest.mark.thorough
@pytest.mark.parametrize("backend", BACKENDS)
def test_the_simulated_demo_is_the_same_every_time(tfbus: Command, backend: str) -> None:
    for _ in range(20):
        assert tfbus("demo", "--simulated", "--duration", "10", "--backend", backend).stdout == SIMULATED


def test_the_rates_can_be_chosen(tfbus: Command) -> None:
    # With a broadcast every 0.5 s, the line of 0.8 s has the transform of 0.5 s.
    done = tfbus("demo", "--simulated", "--duration", "0.8", "--rate", "2", "--listen-rate", "2.5")
    times = re.findall(r"^\[ INFO\] (\S+): .* at time (\S+)$", done.stdout, re.MULTILINE)
    assert times == [("0.400000000", "0.00"), ("0.800000000", "0.50")]


def test_without_a_broadcaster_the_errors_are_lines_of_the_output(tfbus: Command) -> None:
    done = tfbus("demo", "--simulated", "--duration", "2", "--no-broadcaster")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("[ERROR] ") == 2
    assert "frame 'base_link' is not known" in done.stdout


def test_on_the_system_clock_the_lines_have_the_time_of_the_system(tfbus: Command) -> None:
    done = tfbus("demo", "--duration", "0.15", "--listen-rate", "20")
    stamps = [int(seconds) for seconds in re.findall(r"^\[ INFO\] (\d+)\.\d{9}: ", done.stdout, re.MULTILINE)]
    assert done.returncode == 0
    assert len(stamps) > 0
    assert min(stamps) > 1_700_000_000


@pytest.mark.thorough
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("time", ["--simulated", "--duration=inf"])
def test_ctrl_c_ends_it_with_status_130_and_no_traceback(backend: str, time: str) -> None:
    with start_tfbus("demo", "--listen-rate", "20", "--backend", backend, time) as demo:
        demo.output.expect(r"^\[ INFO\] ")
        assert demo.end(signal.SIGINT) == 130
    assert demo.errors.text == ""
    assert [line for line in demo.output.text.splitlines() if not line.startswith("[ INFO] ")] == []
