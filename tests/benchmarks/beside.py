"""The table that all benchmarks fill, the turns that their sides take, and our side of the cases."""

import os
import platform
from collections.abc import Callable, Iterable
from importlib.metadata import distributions
from statistics import median
from time import perf_counter
from typing import Any

import cases
import pytest
from cases import AUTHORITY, BASE, START, Case, Vector
from support.both_kernels import COMPILED, tfbus_on

import tfbus
from tfbus import TransformStamped, TransformTree

Ask = Callable[[Case], tuple[float, Vector]]
"""Has a peer measure one round of a case."""
Turn = Callable[[], float]
"""Has one side do its work once: seconds for each call, stamp or sample."""

ROUNDS = 25


def take_turns(*sides: Turn, rounds: int = ROUNDS) -> list[list[float]]:
    """The seconds of all rounds of each side; the sides take turns, because the speed of a shared machine drifts."""
    together = [[side() for side in sides] for _ in range(rounds)]
    return [[*seconds] for seconds in zip(*together, strict=True)]


def timed(call: Callable[[], Any], count: int = 1) -> Turn:
    def one_turn() -> float:
        # The turn of another side has left other things in the caches.
        call()
        start = perf_counter()
        call()
        return (perf_counter() - start) / count

    return one_turn


def other_kernel() -> dict[str, Any]:
    """The package on the kernel that this process does not run on, by the kernel's name; empty if it was not built."""
    name = "python" if tfbus.kernel == "compiled" else "compiled"
    return {name: tfbus_on(name)} if name == "python" or COMPILED is not None else {}


class Table:
    """The measurements, shown at the end of the run."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self.add("", "tfbus", "peer", "ratio", "wanted")

    def add(self, label: str, ours: str, peer: str = "", ratio: str = "", wanted: str = "") -> None:
        self._lines.append(f"{label:41} {ours:>22}   {peer:36} {ratio:18} {wanted}".rstrip())

    def compare(
        self, label: str, ours: list[float], name: str, peer: list[float], wanted: str = "", unit: str = "us"
    ) -> None:
        """Add a line from the seconds of each round, ours and the peer's."""
        ratios = [mine / other for mine, other in zip(ours, peer, strict=True)]
        ratio = f"{median(ratios):.2f} ({min(ratios):.2f}-{max(ratios):.2f})"
        self.add(label, show(ours, unit), f"{name} {show(peer, unit)}", ratio, wanted)

    def measure(
        self, label: str, on: Callable[[Any], Turn], name: str, peer: Turn | None, wanted: str = "", unit: str = "us"
    ) -> None:
        """Measure our side, as it is `on` each kernel, beside a peer if there is one."""
        ours = {label: on(tfbus)} | {f"  on the {name} kernel": on(package) for name, package in other_kernel().items()}
        rounds = take_turns(*ours.values(), *([peer] if peer else []))
        for line, mine, goal in zip(ours, rounds, (wanted, ""), strict=False):
            if peer:
                self.compare(line, mine, name, rounds[-1], goal, unit)
            else:
                self.add(line, show(mine, unit), name and f"no {name}", "", goal)

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
    found = {each.name.replace("_", "-"): each.version for each in distributions()}
    versions = [f"{name} {found.get(name, 'not installed')}" for name in ("numpy", "transform-tree")]
    threads = os.environ.get("OPENBLAS_NUM_THREADS", "not set")
    machine = f"{os.cpu_count()} cores ({platform.machine()}), OPENBLAS_NUM_THREADS {threads}"
    return f"Python {platform.python_version()}, {', '.join(versions)}; {machine}"


def build(samples: Iterable[cases.Sample], package: Any = tfbus) -> list[TransformStamped]:
    """Samples of ours; of another copy of the package, if one is given."""
    stamped, transform = package.TransformStamped, package.Transform
    return [
        stamped(each.parent, each.child, each.stamp, transform(each.translation, each.rotation), AUTHORITY, each.static)
        for each in samples
    ]


def samples_of(package: Any, child: str, count: int, parent: str = BASE) -> list[Any]:
    stamps = range(START, START + count * cases.PERIOD, cases.PERIOD)
    return [package.TransformStamped(parent, child, stamp, package.Transform(), AUTHORITY) for stamp in stamps]


def tree_of(chain: str, package: Any = tfbus) -> TransformTree:
    tree: TransformTree = package.TransformTree(keep=2.0 * cases.KEEP)
    tree.insert_many(build(cases.history(chain), package))
    return tree


def edges(chain: str) -> str:
    return f"{len(chain)} edge{'s' * (len(chain) > 1)}"


def last_of(chain: str) -> str:
    return f"f{len(chain) - 1}"


def name_of(backend: tuple[str, dict[str, Any]]) -> str:
    return "uvloop" if backend[1] else backend[0]
