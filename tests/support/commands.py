"""Runs ``tfbus`` in the process of the test, or on a terminal."""

import io
import os
import re
import signal
import struct
import subprocess
import threading
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import anyio
import anyio.lowlevel
import pytest
from support.processes import TFBUS

from tfbus import SECOND, Bus, Clock, SimulatedClock
from tfbus.testing import simulate

START = 100 * SECOND
"""The stamp at which `Command.on_domain` begins, in ns."""

OtherPrograms = Callable[[Bus], Awaitable[object]]


@dataclass(frozen=True)
class Done:
    """The exit status and the output of a command, with the names of `subprocess.CompletedProcess`."""

    returncode: int
    stdout: str
    stderr: str


class Command:
    """Calls ``tfbus`` with the arguments that a user would type."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._monkeypatch = monkeypatch
        self._capsys = capsys

    def __call__(self, *arguments: object) -> Done:
        """Run the command to its end."""
        # Loaded here, where the test is skipped if the extra is not installed.
        from tfbus.cli import run

        try:
            status = run(list(map(str, arguments)))
        except SystemExit as ended:
            assert isinstance(ended.code, int)
            status = ended.code
        return Done(status, *self._capsys.readouterr())

    def on_domain(self, others: OtherPrograms, *arguments: object, clock: Clock | None = None) -> Done:
        """Run a command that joins a domain on a bus of this process, which no link connects to others.

        Parameters
        ----------
        others : async callable
            Takes the bus and plays the other programs of the domain; begins before the command, and ends it as Ctrl-C
            does.
        arguments
        clock : Clock, optional
            By default a `SimulatedClock` that begins at `START` and goes on by itself.
        """
        from tfbus.cli.domain import LinkOptions

        def run_beside(options: Any, program: Callable[[Bus], Awaitable[Any]], **_: Any) -> Any:
            results = anyio.run(_run_beside, program, others, clock, backend=options.backend)
            if not results:
                raise KeyboardInterrupt
            return results[0]

        with self._monkeypatch.context() as patch:
            patch.setattr(LinkOptions, "run", run_beside)
            return self(*arguments)


async def _run_beside(
    program: Callable[[Bus], Awaitable[Any]], others: OtherPrograms, clock: Clock | None
) -> list[Any]:
    """Run a program until its own end or that of the others; the list holds its result if it has ended itself."""
    bus_clock = SimulatedClock(START) if clock is None else clock

    async def run_both() -> list[Any]:
        results = []
        with Bus(bus_clock) as bus:
            async with anyio.create_task_group() as tasks:

                async def run_others() -> None:
                    await others(bus)
                    tasks.cancel_scope.cancel()

                tasks.start_soon(run_others)
                # Trio shuffles the tasks that are due: after two checkpoints, the others have run to their first wait.
                await anyio.lowlevel.checkpoint()
                await anyio.lowlevel.checkpoint()
                results.append(await program(bus))
                tasks.cancel_scope.cancel()
        return results

    return await (simulate(bus_clock, run_both) if isinstance(bus_clock, SimulatedClock) else run_both())


async def nobody(_: Bus) -> None:
    """The other programs of a domain without any."""
    await anyio.sleep_forever()


def check_wrong_call(done: Done, why: str) -> None:
    """Check that a usage error is one line on standard error with `why` in it, and exit status 2."""
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("tfbus: ")
    assert why in line


# Commands on a terminal


class Terminal(io.StringIO):
    """A stream that takes itself for a terminal, for a command in the process of the test."""

    encoding = "utf-8"

    def isatty(self) -> bool:
        return True


def open_terminal() -> tuple[int, int]:
    """The two ends of a new terminal; the test is skipped where there is none."""
    pty: Any = pytest.importorskip("pty", reason="this system has no pseudo-terminals")
    ends: tuple[int, int] = pty.openpty()
    return ends


def lines_on_a_terminal(width: int, *arguments: str | Path, seconds: float | None = None) -> list[str]:
    """The lines that ``tfbus`` draws on a terminal of some width and 40 lines, without their colours.

    With `seconds`, Ctrl-C is pressed so long after the first line.
    """
    ours, theirs = open_terminal()
    fcntl: Any = pytest.importorskip("fcntl", reason="this system has no pseudo-terminals")
    termios: Any = pytest.importorskip("termios", reason="this system has no pseudo-terminals")
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, width, 0, 0))
    environment = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
    environment |= {"TERM": "xterm", "NO_COLOR": "1"}
    with os.fdopen(ours, "rb", buffering=0) as terminal:
        command = [TFBUS, *map(str, arguments)]
        process = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=subprocess.DEVNULL, env=environment)
        os.close(theirs)
        received = b""
        with process, suppress(OSError):
            while part := terminal.read(65_536):
                if seconds is not None and not received:
                    threading.Timer(seconds, process.send_signal, (signal.SIGINT,)).start()
                received += part
    # A live drawing goes back to its first line; each drawing has lines of its own here.
    drawn = re.sub(r"\r|\x1b\[[0-9;?]*[AHJK]", "\n", received.decode())
    return [line for line in re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", drawn).split("\n") if line]
