import os
import subprocess
import sys

import pytest
from support.both_kernels import COMPILED, needs_both

import tfbus
from tfbus.which_kernel import _choose

SHOW = """
from tfbus import TransformStamped
from tfbus.which_kernel import kernel
print(kernel, TransformStamped.__mro__[1].__module__)
"""


def run(wanted: str | None, script: str = SHOW) -> subprocess.CompletedProcess[str]:
    """A Python with `TFBUS_KERNEL` as wanted, which does not look into the working directory for the package."""
    environment = {name: value for name, value in os.environ.items() if name != "TFBUS_KERNEL"}
    if wanted is not None:
        environment["TFBUS_KERNEL"] = wanted
    return subprocess.run(
        [sys.executable, "-P", "-c", script], env=environment, capture_output=True, text=True, check=False, timeout=60
    )


def test_python_is_the_twin() -> None:
    assert run("python").stdout.split() == ["python", "tfbus._python_kernel"]


@needs_both
def test_the_compiled_kernel_runs_where_it_was_built() -> None:
    assert run(None).stdout.split() == ["compiled", "tfbus._kernel"]
    assert {_choose(wanted) for wanted in ("", "compiled")} == {"compiled"}


def test_another_kernel_is_an_error_that_names_the_two() -> None:
    with pytest.raises(ValueError, match="TFBUS_KERNEL must be 'python' or 'compiled', not 'rust'"):
        _choose("rust")


WITHOUT = "import sys; sys.modules['tfbus._kernel'] = None\n"


def test_the_twin_runs_where_the_compiled_kernel_is_missing() -> None:
    assert run(None, WITHOUT + SHOW).stdout.split() == ["python", "tfbus._python_kernel"]


def test_a_compiled_kernel_that_is_asked_for_must_be_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tfbus._kernel", None)
    with pytest.raises(ImportError, match=r"tfbus\._kernel halted"):
        _choose("compiled")


def test_this_process_runs_on_a_kernel_that_is_there() -> None:
    assert tfbus.kernel == "python" or COMPILED is not None
