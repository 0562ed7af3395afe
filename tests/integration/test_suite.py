"""The promises of `tests/conftest.py` for every test: it ends in time, leaves no process behind, and needs no extra."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.skipif(
        not Path("/proc/self/task").is_dir(), reason="this system does not show the children of a process"
    ),
]

TESTS = Path(__file__).parents[1]
HANGING = """
import time

def test_that_sleeps() -> None:
    time.sleep(100.0)

def test_that_spins() -> None:
    while True:
        pass

def test_that_ends() -> None:
    pass
"""
LEAVING = """
import subprocess
from pathlib import Path
import conftest

class Proc(type(Path())):
    def glob(self, pattern: str) -> list[Path]:
        return [Path("/proc/self/task/0/children"), *super().glob(pattern)]

def test_that_leaves_a_process() -> None:
    process = subprocess.Popen(["sh", "-c", "echo up; read end"], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    process.stdout.readline()
    Path(__file__).with_name("left").write_text(str(process.pid))
    # As if a thread had ended since it was listed.
    conftest.Path = Proc
"""
AFTER_IT = """
import os
import signal
from pathlib import Path

def test_that_it_has_been_killed() -> None:
    process = int(Path(__file__).with_name("left").read_text())
    assert os.waitid(os.P_PID, process, os.WEXITED).si_status == signal.SIGKILL
"""
NEEDY = """
def test_that_needs_an_extra() -> None:
    import package_of_an_extra

def test_that_is_told_to_install_it() -> None:
    raise ValueError('to do this, pip install "tfbus[cli,fancy]"')

def test_that_calls_a_command_that_needs_it() -> None:
    raise SystemExit('pip install "tfbus[fancy]"')

def test_that_needs_another_package() -> None:
    import package_of_nobody
"""


def run(folder: Path, **files: str) -> list[str]:
    """Run files of tests under a copy of our conftest, whose time limit is 1 s; returns the lines of its output."""
    conftest = (TESTS / "conftest.py").read_text(encoding="utf-8")
    limits = "LIMIT, THOROUGH_LIMIT = 60.0, "
    assert limits in conftest
    conftest = conftest.replace(limits, "LIMIT, THOROUGH_LIMIT = 1.0, ")
    conftest += '\n\nfrom support.extras import EXTRAS\nEXTRAS["fancy"] = ("package_of_an_extra",)\n'
    for name, text in {"conftest": conftest, **files}.items():
        (folder / f"{name}.py").write_text(text, encoding="utf-8")
    settings = f"[pytest]\npythonpath = {str(TESTS)!r}\nmarkers =\n  thorough\n  every_loop\n"
    (folder / "pytest.ini").write_text(settings, encoding="utf-8")
    options = ["-n0", "-rA", "--tb=short", "-p", "no:cacheprovider", "-m", "not thorough"]
    command = [sys.executable, "-m", "pytest", *options]
    done = subprocess.run([*command, str(folder)], cwd=folder, capture_output=True, text=True, timeout=60, check=False)
    return done.stdout.splitlines()


def test_a_suite_ends_in_time_leaves_no_process_and_skips_what_needs_an_absent_extra(tmp_path: Path) -> None:
    texts = {"test_a_leaving": LEAVING, "test_b_after_it": AFTER_IT, "test_hanging": HANGING, "test_needy": NEEDY}
    lines = run(tmp_path, **texts, test_file="import package_of_an_extra\n")
    assert "PASSED test_b_after_it.py::test_that_it_has_been_killed" in lines, "\n".join(lines)
    assert "PASSED test_hanging.py::test_that_ends" in lines
    skipped = [line for line in lines if line.startswith("SKIPPED")]
    assert sum(int(line.partition("[")[2].partition("]")[0]) for line in skipped) == 4
    assert all(line.endswith(": the extra fancy is not installed") for line in skipped)
    slept, spun, needs = sorted(line for line in lines if line.startswith("FAILED"))
    assert slept == "FAILED test_hanging.py::test_that_sleeps - Failed: it has not ended within 1 s"
    assert spun == "FAILED test_hanging.py::test_that_spins - Failed: it has not ended within 1 s"
    assert "test_that_needs_another_package" in needs
