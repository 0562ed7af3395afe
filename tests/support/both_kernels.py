"""The compiled kernel and its Python twin, side by side in one process."""

import importlib
import os
import struct
import sys
from types import ModuleType
from typing import Any

import pytest

import tfbus
from tfbus import _python_kernel
from tfbus.rows import Row

try:
    COMPILED: ModuleType | None = importlib.import_module("tfbus._kernel")
except ImportError:
    COMPILED = None

needs_both = pytest.mark.skipif(COMPILED is None, reason="the compiled kernel was not built")

KERNELS = [pytest.param(_python_kernel, id="python"), pytest.param(COMPILED, id="compiled", marks=needs_both)]
"""The modules with `History`, `Chain`, `Paths` and `commit`."""


def sample_class(kernel: ModuleType) -> Any:
    """The class of samples that a kernel stores."""
    return _python_kernel.Sample if kernel is _python_kernel else kernel.Sample


def bits(row: Row | None) -> bytes | None:
    """A row as bytes: -0.0 is not 0.0."""
    return None if row is None else struct.pack("7d", *row)


def tfbus_on(kernel: str) -> Any:
    """The package `tfbus` as it is on a kernel; a second copy of it, if this process runs on the other one."""
    if kernel != tfbus.kernel and kernel not in _copies:
        _copies[kernel] = _second_copy(kernel)
    return _copies.get(kernel) or importlib.import_module("tfbus")


_copies: dict[str, ModuleType] = {}


def _second_copy(kernel: str) -> ModuleType:
    ours = {name: module for name, module in sys.modules.items() if name.partition(".")[0] == "tfbus"}
    before = os.environ.get("TFBUS_KERNEL")
    os.environ["TFBUS_KERNEL"] = kernel
    try:
        for name in ours:
            del sys.modules[name]
        copy = importlib.import_module("tfbus")
        # The package loads its modules when their names are used: these are still the names of the copy.
        for name in copy.__all__:
            getattr(copy, name)
        return copy
    finally:
        for name in [name for name in sys.modules if name.partition(".")[0] == "tfbus"]:
            del sys.modules[name]
        sys.modules.update(ours)
        if before is None:
            del os.environ["TFBUS_KERNEL"]
        else:
            os.environ["TFBUS_KERNEL"] = before
