import subprocess
import sys

from support.programs import TFBUS


def test_the_package_runs_as_the_command() -> None:
    first, second = (
        subprocess.run([*command, "query"], capture_output=True, text=True, check=False)
        for command in ([sys.executable, "-m", "tfbus"], [TFBUS])
    )
    assert first.returncode == second.returncode == 2
    assert first.stderr == second.stderr != ""
