"""The table that all benchmarks fill, and our side of the cases."""

import os
import platform
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from statistics import median
from typing import Any

import cases
import pytest
from cases import AUTHORITY, Case, Vector

import tfbus
from tfbus import TransformStamped

Ask = Callable[[Case], tuple[float, Vector]]
"""Has a peer measure one round of a case."""


class Table:
    """The measurements, shown at the end of the run."""

    def __init__(self) -> None:
        self._lines: list[str] = []

    def add(self, label: str, ours: str, peer: str = "", ratio: str = "", wanted: str = "") -> None:
        self._lines.append(f"{label:41} {ours:>22}   {peer:36} {ratio:18} {wanted}".rstrip())

    def compare(
        self, label: str, ours: list[float], name: str, peer: list[float], wanted: str = "", unit: str = "us"
    ) -> None:
        """Add a line from the seconds a call of each round, ours and the peer's."""
        ratios = [mine / other for mine, other in zip(ours, peer, strict=True)]
        ratio = f"{median(ratios):.2f} ({min(ratios):.2f}-{max(ratios):.2f})"
        self.add(label, show(ours, unit), f"{name} {show(peer, unit)}", ratio, wanted)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        terminalreporter.write_sep("=", "speed")
        terminalreporter.write_line(conditions())
        terminalreporter.write_line("median and (least) time of a call over the rounds, median ratio and (range)")
        for line in self._lines:
            terminalreporter.write_line(line)


def show(rounds: list[float], unit: str) -> str:
    scale = {"ns": 1e9, "us": 1e6, "ms": 1e3}[unit]
    return f"{median(rounds) * scale:.2f} ({min(rounds) * scale:.2f}) {unit}"


def conditions() -> str:
    """The versions and the machine that the times depend on."""
    packages = [f"{name} {version_of(name)}" for name in ("numpy", "transform-tree", "pytransform3d")]
    threads = os.environ.get("OPENBLAS_NUM_THREADS", "not set")
    machine = f"{os.cpu_count()} cores ({platform.machine()}), OPENBLAS_NUM_THREADS {threads}"
    return f"Python {platform.python_version()}, {', '.join(packages)}; {machine}"


def version_of(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def build(sample: cases.Sample, package: Any = tfbus) -> TransformStamped:
    """A sample of ours; of another copy of the package, if one is given."""
    transform = package.Transform(sample.translation, sample.rotation)
    made: TransformStamped = package.TransformStamped(
        sample.parent, sample.child, sample.stamp, transform, AUTHORITY, sample.static
    )
    return made
