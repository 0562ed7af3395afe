import os
import signal
import sys
import termios
import time
from collections.abc import AsyncGenerator, Iterator
from contextlib import aclosing, contextmanager, suppress
from functools import partial
from pathlib import Path

import pytest
from support.processes import TFBUS, new_domain
from support.recorded import write_mcap
from support.samples import moving

from tfbus import SECOND
from tfbus.cli._keyboard import Keyboard, _split, follow_job, keyboard

pty = pytest.importorskip("pty", reason="this system has no pseudo-terminals")

_LIMIT = 60.0


def test_letters_and_arrows_are_told_apart() -> None:
    assert list(_split(b"s \x1b[C\x1b[A\x1b[B\x1b[D+\x1b\xff")) == [
        *("s", " ", "right", "up", "down", "left", "+", "\x1b", "\xff")
    ]


@pytest.mark.anyio
async def test_the_keys_end_with_the_terminal() -> None:
    terminal, typist = os.pipe()
    os.write(typist, b"q")
    os.close(typist)
    try:
        keys = Keyboard(terminal).keys()
        assert [key async for key in keys] == ["q"]
    finally:
        os.close(terminal)


def test_there_is_no_keyboard_where_standard_input_is_no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    with Path(os.devnull).open(encoding="utf-8") as nothing:
        monkeypatch.setattr(sys, "stdin", nothing)
        assert keyboard() is None
    monkeypatch.setattr(sys, "stdin", None)
    assert keyboard() is None


def test_a_terminal_of_another_session_is_left_alone() -> None:
    ours, theirs = pty.openpty()
    try:
        before = termios.tcgetattr(theirs)
        with Keyboard(theirs):
            assert termios.tcgetattr(theirs) == before
        assert termios.tcgetattr(theirs) == before
    finally:
        os.close(ours)
        os.close(theirs)


def test_in_the_foreground_keys_come_one_by_one_and_unseen_until_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = pty.openpty()
    monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp())
    try:
        before = termios.tcgetattr(theirs)
        raw = [*before[:3], before[3] & ~(termios.ICANON | termios.ECHO)]
        with Keyboard(theirs) as keys:
            assert termios.tcgetattr(theirs)[:4] == raw
            # After a stop, a shell may have left it as it was.
            keys.take()
            assert termios.tcgetattr(theirs)[:4] == raw
        assert termios.tcgetattr(theirs) == before
        with os.fdopen(os.dup(theirs), encoding="utf-8") as terminal:
            monkeypatch.setattr(sys, "stdin", terminal)
            assert keyboard() is not None
            monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp() + 1)
            assert keyboard() is None
    finally:
        os.close(ours)
        os.close(theirs)


@pytest.mark.anyio
async def test_the_terminal_is_given_back_before_the_program_stops(monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[object] = []

    class Noted(Keyboard):
        def take(self) -> None:
            steps.append("take")

        def give_back(self) -> None:
            steps.append("give back")

    async def signals() -> AsyncGenerator[signal.Signals, None]:
        for number in (signal.SIGCONT, signal.SIGTSTP, signal.SIGTERM, signal.SIGTSTP):
            yield number

    monkeypatch.setattr(os, "kill", lambda process, number: steps.append((process, number)))
    async with aclosing(signals()) as received:
        await follow_job(Noted(0), received, partial(steps.append, "stopped"), partial(steps.append, "continued"))
    stop = (os.getpid(), signal.SIGSTOP)
    assert steps == ["take", "stopped", "give back", stop, "take", "continued"]


class Session:
    """``tfbus play`` as the foreground program of a terminal of its own."""

    def __init__(self, process: int, terminal: int, before: list[object]) -> None:
        self.process = process
        self.terminal = terminal
        self.before = before
        self.shown = ""

    def expect(self, text: str) -> None:
        """Read until a text is shown behind all that was expected before."""
        deadline = time.monotonic() + _LIMIT
        while text not in self.shown:
            assert time.monotonic() < deadline, self.shown[-300:]
            with suppress(OSError):
                self.shown += os.read(self.terminal, 4_096).decode()
        self.shown = self.shown.partition(text)[2]

    def press(self, keys: bytes) -> None:
        os.write(self.terminal, keys)

    def is_raw(self) -> bool:
        return not termios.tcgetattr(self.terminal)[3] & termios.ICANON

    def until_raw(self, raw: bool) -> None:
        deadline = time.monotonic() + _LIMIT
        while self.is_raw() is not raw:
            assert time.monotonic() < deadline, "the terminal has not changed"
            time.sleep(0.01)

    def wait(self, options: int = 0) -> int:
        """Wait for a change of the process; what it shows is read meanwhile, for it would wait for that."""
        deadline = time.monotonic() + _LIMIT
        while time.monotonic() < deadline:
            process, status = os.waitpid(self.process, options | os.WNOHANG)
            if process:
                return status
            with suppress(OSError):
                os.set_blocking(self.terminal, False)
                os.read(self.terminal, 4_096)
            os.set_blocking(self.terminal, True)
            time.sleep(0.01)
        raise AssertionError("it goes on")


@contextmanager
def session(path: Path, *options: str) -> Iterator[Session]:
    process, terminal = pty.fork()
    if process == 0:
        with suppress(BaseException):
            signal.signal(signal.SIGINT, signal.default_int_handler)
            os.execve(TFBUS, [TFBUS, "play", str(path), *options], {**os.environ, "TERM": "xterm"})
        os._exit(1)
    try:
        yield Session(process, terminal, termios.tcgetattr(terminal))
    finally:
        with suppress(OSError):
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)
        os.close(terminal)


@pytest.fixture
def hour(tmp_path: Path) -> Path:
    """A message at the beginning, two after an hour, and one more after two."""
    times = (0, 3_600, 3_601, 7_200)
    return write_mcap(
        tmp_path / "hour.mcap", [(k * SECOND, "/tf", [moving("map", "base", k * SECOND, float(k))]) for k in times]
    )


@pytest.mark.thorough
@pytest.mark.parametrize("options", [(), ("--clock",), ("--backend", "trio"), ("--clock", "--backend", "trio")])
def test_keys_pause_step_and_change_the_rate_to_the_end(hour: Path, options: tuple[str, ...]) -> None:
    with session(hour, "--domain", new_domain(), *options) as play:
        play.expect("space pauses")
        play.until_raw(True)
        play.expect(" 0%")
        play.press(b" ")
        play.expect("paused")
        # The next message, after an hour, and then the one after it.
        play.press(b"s")
        play.expect("50%")
        play.press(b"\x1b[C")
        play.press(b"-")
        play.expect("0.5 x")
        play.press(b"+++")
        play.expect("5 x")
        play.press(b" ")
        play.expect("playing at 5 x")
        play.press(b" s")
        play.expect("4 samples in 4 messages played")
        assert os.waitstatus_to_exitcode(play.wait()) == 0
        assert termios.tcgetattr(play.terminal) == play.before


@pytest.mark.thorough
@pytest.mark.parametrize("end", ["ctrl-c", "sigterm"])
@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_the_terminal_is_as_before_after_every_end(hour: Path, end: str, backend: str) -> None:
    with session(hour, "--domain", new_domain(), "--backend", backend) as play:
        play.expect("space pauses")
        play.until_raw(True)
        play.expect(" 0%")
        if end == "ctrl-c":
            play.press(b"\x03")
        else:
            os.kill(play.process, signal.SIGTERM)
        play.expect("1 samples in 1 messages played")
        assert os.waitstatus_to_exitcode(play.wait()) == (130 if end == "ctrl-c" else 143)
        assert termios.tcgetattr(play.terminal) == play.before


@pytest.mark.thorough
def test_the_terminal_is_as_before_while_the_program_is_stopped(hour: Path) -> None:
    with session(hour, "--domain", new_domain()) as play:
        play.expect("space pauses")
        play.until_raw(True)
        play.expect(" 0%")
        for _ in range(2):
            play.press(b"\x1a")
            assert os.WIFSTOPPED(play.wait(os.WUNTRACED))
            assert termios.tcgetattr(play.terminal) == play.before
            os.kill(play.process, signal.SIGCONT)
            play.until_raw(True)
        play.press(b" ")
        play.expect("paused")
        play.press(b"\x03")
        assert os.waitstatus_to_exitcode(play.wait()) == 130
        assert termios.tcgetattr(play.terminal) == play.before
