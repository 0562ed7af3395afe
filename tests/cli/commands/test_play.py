"""``tfbus play``."""

import os
import re
import select
import signal
import sys
import termios
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import anyio
import pytest
from support.commands import Command, Done, nobody
from support.processes import PATIENCE, TFBUS, free_address, new_domain, start_tfbus, until
from support.recorded import SMALL, WRONG_IN_SMALL, messages_in, write_mcap
from support.rosbridge import rosbridge_server
from support.samples import moving, static

from tfbus import SECOND, Bus, SystemClock, TransformStamped
from tfbus.cli.commands.play import Keyboard, keyboard, press
from tfbus.links.rosbridge import RosbridgeLink
from tfbus.recording import Player

START = 1_700_000_000 * SECOND
pty = pytest.importorskip("pty", reason="this system has no pseudo-terminals")
Then = Callable[[list[TransformStamped]], Awaitable[object]]
BACKENDS = ["asyncio", "trio"]


@pytest.fixture
def ten_seconds(tmp_path: Path) -> Path:
    """A base that moves at 1 m/s for 10 s, with samples at 10 Hz, and a static rig on it."""
    lines = [(START, "/tf_static", [static("base", "rig", 5.0)])]
    lines += [(START + k * SECOND // 10, "/tf", [moving("map", "base", START + k, k / 10)]) for k in range(101)]
    return write_mcap(tmp_path / "ten_seconds.mcap", lines, metadata={"tfbus.authorities": '[["odometry", 1]]'})


@pytest.fixture
def hour(tmp_path: Path) -> Path:
    """A message at the beginning, two after an hour, and one more after two."""
    times = [9_000 + after for after in (0, 3_600, 3_601, 7_200)]
    return write_mcap(
        tmp_path / "hour.mcap", [(k * SECOND, "/tf", [moving("map", "base", k * SECOND, float(k))]) for k in times]
    )


def samples_in(path: Path) -> list[TransformStamped]:
    return [sample for message in messages_in(path) for sample in message.batch]


async def listen_forever(_: list[TransformStamped]) -> None:
    await anyio.sleep_forever()


def play(tfbus: Command, *arguments: object, then: Then = listen_forever) -> tuple[Done, list[TransformStamped]]:
    """Play to a peer that is found at once, until `then` ends; the list has the samples that it receives."""
    received: list[TransformStamped] = []

    async def listen(bus: Bus) -> None:
        with bus.subscribe(received.extend):
            await anyio.wait_all_tasks_blocked()
            assert received == [], "played before a peer was found"
            async with rosbridge_server() as server, RosbridgeLink(bus, server.url, send=False):
                await then(received)

    return tfbus.on_domain(listen, "play", *arguments, clock=SystemClock()), received


@pytest.mark.parametrize("backend", BACKENDS)
def test_it_publishes_the_recording_once_a_peer_is_found(tfbus: Command, ten_seconds: Path, backend: str) -> None:
    done, received = play(tfbus, ten_seconds, "--rate", "inf", "--domain", "yard", "--backend", backend)
    assert (done.returncode, done.stdout) == (0, "")
    playing, played = done.stderr.splitlines()
    assert playing == f"playing {ten_seconds} on domain 'yard'"
    assert re.fullmatch(r"102 samples in 102 messages played in \d\.\d s, 10\.0 s of the recording", played)
    assert received == samples_in(ten_seconds)


@pytest.mark.parametrize(
    ("options", "stamps"),
    [
        (("--from", "2.5", "--to", "100"), range(25, 101)),
        (("--to", "2.5"), range(26)),
        (("--from", "9.95"), range(100, 101)),
        (("--from", "10", "--to", "10"), range(100, 101)),
    ],
)
def test_a_part_is_given_in_seconds_from_the_beginning(
    tfbus: Command, ten_seconds: Path, options: Sequence[str], stamps: range
) -> None:
    done, received = play(tfbus, ten_seconds, "--rate", "inf", *options)
    assert done.stderr.splitlines()[-1].startswith(f"{1 + len(stamps)} samples in ")
    assert [sample.stamp - START for sample in received if not sample.static] == list(stamps)
    assert [sample.child for sample in received if sample.static] == ["rig"]


def test_an_offset_is_added_to_the_stamps(tfbus: Command, ten_seconds: Path) -> None:
    _, received = play(tfbus, ten_seconds, "--rate", "inf", "--to", "0", "--offset", "-0.5")
    assert [sample.stamp - START for sample in received if not sample.static] == [-SECOND // 2]


def test_an_empty_recording_plays_nothing(tfbus: Command, tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "empty.mcap", [])
    done, received = play(tfbus, path, "--from", "1", "--to", "2")
    assert (done.returncode, received) == (0, [])
    assert done.stderr.splitlines()[-1].startswith("0 samples in 0 messages played in 0.")


@pytest.mark.thorough
def test_without_a_peer_it_plays_after_a_second(tfbus: Command, ten_seconds: Path) -> None:
    done = tfbus.on_domain(nobody, "play", ten_seconds, "--rate", "inf", clock=SystemClock())
    assert done.stderr.splitlines()[-1].startswith("102 samples in 102 messages played")


def test_what_is_left_out_is_counted_by_reason(tfbus: Command) -> None:
    done, _ = play(tfbus, SMALL, "--rate", "inf")
    assert done.returncode == 0
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("tfbus: left out: ")]
    assert set(line.removeprefix("tfbus: left out: ").split(", ")) == {
        f"{count} x {reason}" for reason, count in WRONG_IN_SMALL.items()
    }


def test_an_unfinished_recording_is_played_as_far_as_it_goes(tmp_path: Path, tfbus: Command) -> None:
    path = write_mcap(tmp_path / "run.mcap", [(START, "/tf", [moving("map", "base", 1)])], finish=False)
    done, received = play(tfbus, path)
    assert done.returncode == 0
    first, *_, played, left_out = done.stderr.splitlines()
    assert first == f"tfbus: {path} is cut, or its writer did not finish it: playing its readable part"
    assert played.startswith("1 samples in 1 messages played")
    assert left_out == "tfbus: left out: 1 x unfinished"
    assert received == [moving("map", "base", 1)]


@pytest.mark.thorough
@pytest.mark.parametrize("backend", BACKENDS)
def test_another_program_receives_everything_from_the_first_sample_to_the_last(
    tmp_path: Path, ten_seconds: Path, backend: str
) -> None:
    domain, address = new_domain(), free_address()
    copy = tmp_path / "copy.mcap"
    options = ("--domain", domain, "--backend", backend)
    with start_tfbus("record", str(copy), "--listen", address, *options) as recorder:
        recorder.errors.expect("recording")
        with start_tfbus("play", str(ten_seconds), "--rate", "20", "--connect", address, *options) as player:
            assert player.wait() == 0
        assert recorder.end() == 130
    received, played = samples_in(copy), samples_in(ten_seconds)
    # Static samples travel on a channel of their own, so their order among the others is open.
    assert [sample for sample in received if sample.static] == [sample for sample in played if sample.static]
    assert [sample for sample in received if not sample.static] == [sample for sample in played if not sample.static]
    assert {sample.authority for sample in received} == {"odometry"}


@pytest.mark.thorough
@pytest.mark.parametrize("backend", BACKENDS)
def test_others_follow_the_clock_of_the_recording(ten_seconds: Path, backend: str) -> None:
    domain, address = new_domain(), free_address()
    options = ("--domain", domain, "--backend", backend)
    at_first = START // SECOND
    with start_tfbus("play", str(ten_seconds), "--clock", "--loop", "--listen", address, *options) as player:
        player.errors.expect("playing")
        with start_tfbus("echo", "map", "rig", "--rate", "20", "--json", "--connect", address, *options) as echo:
            ages = []
            for _ in range(20):
                age = re.search(r'"age": ([-\d.e]+)', echo.output.expect('"age"'))
                assert age is not None
                ages.append(float(age[1]))
        # The stamps are all in the first microsecond of the recording; the clock is at the log times.
        assert all(0.0 <= age <= 11.0 for age in ages)
        with start_tfbus("tree", "--json", "--duration", "0.3", "--connect", address, *options) as tree:
            found = re.search(r"\d+", tree.output.expect('"stamp"'))
            assert found is not None
            assert at_first <= int(found[0]) / SECOND <= at_first + 10
            assert tree.wait() == 0
        assert player.end() == 130


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("keys", "rate", "after", "paused"),
    [
        (" ", 1.0, 1.0, True),
        ("  ", 1.0, 1.0, False),
        ("x", 1.0, 1.0, False),
        ("++", 1.0, 5.0, False),
        ("=", 2.0, 5.0, False),
        ("+-", 3.0, 2.0, False),
        ("--", 1.0, 0.2, False),
        # From a hundredth to five hundred times as fast.
        ("-", 0.01, 0.01, False),
        ("+", 500.0, 500.0, False),
        ("+", 0.001, 0.01, False),
        ("-", 1_000.0, 500.0, False),
    ],
)
async def test_keys_pause_and_change_the_rate_in_steps(keys: str, rate: float, after: float, paused: bool) -> None:
    player = Player(Bus(), "run.mcap", rate=rate)
    for key in keys:
        press(player, key)
    assert player.rate == pytest.approx(after)
    assert player.paused is paused


def test_a_loop_counts_its_passes(tfbus: Command, ten_seconds: Path) -> None:
    async def three_times(received: list[TransformStamped]) -> None:
        await until(lambda: sum(sample.static for sample in received) >= 3)

    done, _ = play(tfbus, ten_seconds, "--loop", "--rate", "inf", then=three_times)
    assert done.returncode == 130
    assert re.search(r"\d samples in [\d,]+ messages played in \d\.\d s, \d+ times to the end$", done.stderr)


def test_there_is_no_keyboard_but_a_terminal_in_whose_foreground_it_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = pty.openpty()
    monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp())
    with os.fdopen(ours), os.fdopen(theirs, encoding="utf-8") as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        assert keyboard() is not None
        monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp() + 1)
        assert keyboard() is None
        before = termios.tcgetattr(theirs)
        with Keyboard(theirs):
            assert termios.tcgetattr(theirs) == before
    with Path(os.devnull).open(encoding="utf-8") as nothing:
        for stdin in (nothing, None):
            monkeypatch.setattr(sys, "stdin", stdin)
            assert keyboard() is None


@pytest.mark.anyio
async def test_letters_and_arrows_are_told_apart_until_the_terminal_is_closed() -> None:
    terminal, typist = os.pipe()
    os.write(typist, b"s \x1b[C\x1b[A\x1b[B\x1b[D+\x1b\xff")
    os.close(typist)
    keys = [key async for key in Keyboard(terminal).keys()]  # noqa: SIM118 - it is no mapping
    os.close(terminal)
    assert keys == ["s", " ", "right", "up", "down", "left", "+", "\x1b", "\xff"]


class Session:
    """``tfbus play`` as the foreground program of a terminal of its own."""

    def __init__(self, process: int, terminal: int) -> None:
        self.process = process
        self.terminal = terminal
        self.before = termios.tcgetattr(terminal)
        self.shown = ""

    def wait_until(self, condition: Callable[[], Any]) -> Any:
        """Read what is shown until a condition holds: the program waits while nobody reads."""
        deadline = time.monotonic() + PATIENCE
        while not (found := condition()):
            assert time.monotonic() < deadline, self.shown[-300:]
            # At the end of the program, Linux raises an error.
            with suppress(OSError):
                if select.select([self.terminal], [], [], 0.01)[0]:
                    self.shown += os.read(self.terminal, 4_096).decode()
        return found

    def expect(self, text: str) -> None:
        """Wait until a text is shown behind all that was expected before."""
        self.wait_until(lambda: text in self.shown)
        self.shown = self.shown.partition(text)[2]

    def press(self, keys: bytes, text: str) -> None:
        os.write(self.terminal, keys)
        self.expect(text)

    def wait_until_raw(self) -> None:
        self.wait_until(lambda: not termios.tcgetattr(self.terminal)[3] & termios.ICANON)

    def wait(self, options: int = 0) -> int:
        """Wait for a change of the process, which leaves the terminal as it was before."""
        _, status = self.wait_until(lambda: (found := os.waitpid(self.process, options | os.WNOHANG))[0] and found)
        assert termios.tcgetattr(self.terminal) == self.before
        return int(status)


@contextmanager
def session(path: Path, *options: str, errors: Path | None = None) -> Iterator[Session]:
    """With `errors`, standard error is that file and no terminal."""
    process, terminal = pty.fork()
    if process == 0:
        with suppress(BaseException):
            signal.signal(signal.SIGINT, signal.default_int_handler)
            if errors is not None:
                os.dup2(os.open(errors, os.O_WRONLY | os.O_CREAT), 2)
            os.execve(TFBUS, [TFBUS, "play", str(path), *options], {**os.environ, "TERM": "xterm"})
        os._exit(1)
    try:
        yield Session(process, terminal)
    finally:
        with suppress(OSError):
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)
        os.close(terminal)


@pytest.mark.parametrize(
    ("options", "last", "status"),
    [
        ("", b" s", 0),
        pytest.param("--clock", b"\x03", 130, marks=pytest.mark.thorough),
        pytest.param("--backend trio", b"\x03", 130, marks=pytest.mark.thorough),
        pytest.param("--clock --backend trio", None, 143, marks=pytest.mark.thorough),
    ],
)
def test_keys_steer_it_on_a_terminal_which_is_as_before_while_it_is_stopped_and_after_every_end(
    hour: Path, options: str, last: bytes | None, status: int
) -> None:
    with session(hour, "--domain", new_domain(), *options.split()) as play:
        play.expect("space pauses")
        play.wait_until_raw()
        play.expect(" 0%")
        os.write(play.terminal, b"\x1a")
        assert os.WIFSTOPPED(play.wait(os.WUNTRACED))
        os.kill(play.process, signal.SIGCONT)
        play.wait_until_raw()
        play.press(b" ", "paused")
        # The next message, after an hour, and then the one after it.
        play.press(b"s", "50%")
        play.press(b"\x1b[C-", "0.5 x")
        play.press(b"+++", "5 x")
        play.press(b" ", "playing at 5 x")
        if last is None:
            os.kill(play.process, signal.SIGTERM)
        else:
            os.write(play.terminal, last)
        play.expect("samples in ")
        play.expect("messages played")
        assert os.waitstatus_to_exitcode(play.wait()) == status


@pytest.mark.thorough
def test_where_standard_error_is_no_terminal_each_key_tells_the_state_in_a_line(hour: Path, tmp_path: Path) -> None:
    told = tmp_path / "told"
    with session(hour, "--domain", new_domain(), errors=told) as play:
        play.wait_until_raw()
        os.write(play.terminal, b" +s")
        play.wait_until(lambda: told.read_text().count("at 2 x\n") == 2)
        os.kill(play.process, signal.SIGTERM)
        assert os.waitstatus_to_exitcode(play.wait()) == 128 + signal.SIGTERM
    assert told.read_text().splitlines()[2:-1] == ["paused", "paused at 2 x", "paused at 2 x"]
