import os
import re
import signal
import sys
from collections import Counter
from collections.abc import AsyncGenerator, AsyncIterator, Iterator, Sequence
from contextlib import aclosing, contextmanager, nullcontext
from functools import partial
from pathlib import Path

import anyio
import pytest
from support.commands import Command, Done, check_wrong_call, nobody
from support.processes import free_address, new_domain, start_tfbus
from support.recorded import SMALL, WRONG_IN_SMALL, messages_in, write_mcap
from support.samples import moving, static
from support.terminal import Terminal, on_a_terminal

from tfbus import SECOND, Bus, PeerJoined, SystemClock, TransformStamped
from tfbus.cli._keyboard import Keyboard
from tfbus.cli.commands import play as play_module
from tfbus.cli.commands.play import _print_summary, _show_progress, _steer, press
from tfbus.recording import Player

START = 1_700_000_000 * SECOND
BACKENDS = ["asyncio", "trio"]


@pytest.fixture
def ten_seconds(tmp_path: Path) -> Path:
    """A base that moves at 1 m/s for 10 s, with samples at 10 Hz, and a static rig on it."""
    lines = [(START, "/tf_static", [static("base", "rig", 5.0)])]
    lines += [(START + k * SECOND // 10, "/tf", [moving("map", "base", START + k, k / 10)]) for k in range(101)]
    return write_mcap(tmp_path / "ten_seconds.mcap", lines, metadata={"tfbus.authorities": '[["odometry", 1]]'})


def samples_in(path: Path) -> list[TransformStamped]:
    return [sample for message in messages_in(path) for sample in message.batch]


def play(tfbus: Command, *arguments: object) -> tuple[Done, list[TransformStamped]]:
    """Play to a peer that is found at once; the samples are those that it receives."""
    received: list[TransformStamped] = []

    async def listen(bus: Bus) -> None:
        with bus.subscribe(received.extend):
            await anyio.wait_all_tasks_blocked()
            assert received == [], "played before a peer was found"
            bus._announce(PeerJoined(bus.clock.now(), "tf", "peer"))
            await anyio.sleep_forever()

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


def test_an_empty_recording_plays_nothing(tfbus: Command, tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "empty.mcap", [])
    done, received = play(tfbus, path, "--from", "1", "--to", "2")
    assert (done.returncode, received) == (0, [])
    assert done.stderr.splitlines()[-1] == "0 samples in 0 messages played in 0.0 s"


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
    assert first == f"tfbus: {path} is cut, or its writer did not finish it: this is what can be read"
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
def test_a_loop_goes_on_until_ctrl_c(ten_seconds: Path) -> None:
    domain, address = new_domain(), free_address()
    options = ("--domain", domain)
    with start_tfbus("play", str(ten_seconds), "--loop", "--rate", "50", "--listen", address, *options) as player:
        player.errors.expect("playing")
        with start_tfbus("echo", "map", "rig", "--rate", "20", "--connect", address, *options) as echo:
            found = [0.0]
            # It has been near the end, and then near the beginning again.
            while not (max(found) > 13.0 and found[-1] < 8.0):
                number = re.search(r"\[([-\d.]+),", echo.output.expect("Translation"))
                assert number is not None
                found.append(float(number[1]))
        assert player.end() == 130
    assert "Traceback" not in player.errors.text


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


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (("--rate", "0"), "--rate"),
        (("--rate", "nan"), "--rate"),
        (("--from=-1",), "expected a time from the beginning on"),
        (("--from", "10.1"), "is 10.000 s long"),
        (("--from", "5", "--to", "4.9"), "--to must not be before --from"),
        (("--to", "1970-01-01"), "--to must not be before"),
        (("--from", "soon"), "expected seconds"),
    ],
)
def test_a_wrong_call_is_one_line_on_standard_error_and_status_2(
    ten_seconds: Path, arguments: Sequence[str], why: str, tfbus: Command
) -> None:
    check_wrong_call(tfbus("play", ten_seconds, *arguments), why)


@pytest.mark.parametrize("content", [None, b"", b"no recording", b"\x89MCAP0\r\n", b"\x89MC"])
def test_a_file_that_is_no_recording_is_one_line_and_status_2(
    tmp_path: Path, content: bytes | None, tfbus: Command
) -> None:
    path = tmp_path / "run.mcap"
    if content is not None:
        path.write_bytes(content)
    check_wrong_call(tfbus("play", path), f"recording '{path}': ")


@pytest.mark.thorough
def test_a_bar_is_on_standard_error_if_that_is_a_terminal(tmp_path: Path, ten_seconds: Path) -> None:
    command = ("play", str(ten_seconds), "--rate", "20", "--domain", new_domain())
    status, shown = on_a_terminal(tmp_path / "output", *command)
    assert status == 0
    assert (tmp_path / "output").read_text() == ""
    assert "playing \x1b" in shown
    assert re.search(r"[1-9]\d?%", shown)
    assert "102 samples in 102 messages played" in shown


class Recorded:
    """A player that notes what is done with it."""

    def __init__(self, paused: bool, rate: float) -> None:
        self.paused = paused
        self.rate = rate
        self.done = ""

    def pause(self) -> None:
        self.done = "pause"

    def resume(self) -> None:
        self.done = "resume"

    def step(self) -> None:
        self.done = "step"


@pytest.mark.parametrize(
    ("key", "paused", "rate", "done", "after"),
    [
        (" ", False, 1.0, "pause", 1.0),
        (" ", True, 1.0, "resume", 1.0),
        ("s", False, 1.0, "step", 1.0),
        ("right", True, 1.0, "step", 1.0),
        ("x", False, 1.0, "", 1.0),
        ("+", False, 1.0, "", 2.0),
        ("=", False, 2.0, "", 5.0),
        ("up", False, 3.0, "", 5.0),
        ("-", False, 1.0, "", 0.5),
        ("down", False, 3.0, "", 2.0),
        # From a hundredth to five hundred times as fast.
        ("-", False, 0.01, "", 0.01),
        ("+", False, 500.0, "", 500.0),
        ("+", False, 0.001, "", 0.01),
        ("-", False, 1_000.0, "", 500.0),
    ],
)
def test_each_key_does_one_thing(key: str, paused: bool, rate: float, done: str, after: float) -> None:
    player = Recorded(paused, rate)
    press(player, key)  # type: ignore[arg-type]
    assert player.done == done
    assert player.rate == pytest.approx(after)


class Typed(Keyboard):
    """Keys that are typed at once, on no terminal."""

    def __init__(self, *typed: str) -> None:
        super().__init__(-1)
        self._typed = typed
        self.read = anyio.Event()

    async def keys(self) -> AsyncIterator[str]:
        for key in self._typed:
            yield key
        self.read.set()
        await anyio.sleep_forever()


@pytest.mark.anyio
async def test_keys_steer_the_player_and_a_stopped_program_plays_on_unless_it_was_paused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    keys, player = Typed(" ", " ", "+"), Player(Bus(), "run.mcap")
    paused: list[bool] = []
    ended_by: list[int] = []

    async def signals() -> AsyncGenerator[signal.Signals, None]:
        await keys.read.wait()
        for before in (False, True):
            if before:
                player.pause()
            yield signal.SIGTSTP
            paused.append(player.paused)
        yield signal.SIGTERM

    monkeypatch.setattr(os, "kill", lambda *_: paused.append(player.paused))
    async with aclosing(signals()) as received:
        monkeypatch.setattr(play_module, "job_signals", partial(nullcontext, received))
        with anyio.fail_after(10), anyio.CancelScope() as everything:
            await _steer(keys, player, everything, ended_by)
    assert capsys.readouterr().err.splitlines() == ["paused", "playing", "playing at 2 x"]
    assert paused == [True, False, True, True]
    assert everything.cancelled_caught
    assert ended_by == [signal.SIGTERM]


def test_with_a_keyboard_it_names_the_keys_and_sigterm_ends_it(
    tfbus: Command, ten_seconds: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    @contextmanager
    def job_signals() -> Iterator[AsyncIterator[signal.Signals]]:
        async def signals() -> AsyncIterator[signal.Signals]:
            yield signal.SIGTERM

        yield signals()

    monkeypatch.setattr(play_module, "keyboard", Typed)
    monkeypatch.setattr(play_module, "job_signals", job_signals)
    done, _ = play(tfbus, ten_seconds)
    assert done.returncode == 128 + signal.SIGTERM
    assert done.stderr.splitlines()[1].startswith("space pauses, s or the right arrow plays the next message")


@pytest.mark.parametrize(
    ("passes", "position", "told"),
    [
        (0, None, "7 samples in 5 messages played in 1.5 s"),
        (1, 3 * SECOND, "7 samples in 5 messages played in 1.5 s, 2.0 s of the recording"),
        (2, 3 * SECOND, "7 samples in 5 messages played in 1.5 s, 2 times to the end"),
    ],
)
def test_the_last_line_counts_what_was_played(
    capsys: pytest.CaptureFixture[str], passes: int, position: int | None, told: str
) -> None:
    with Bus() as bus:
        player = Player(bus, "run.mcap")
        player.played, player.messages, player.passes = 7, 5, passes
        player.start, player.position = SECOND, position
        _print_summary(player, bus, 1.5)
        assert capsys.readouterr().err == f"{told}\n"
        player.bad = Counter(nan=2)
        _print_summary(player, bus, 1.5)
        assert capsys.readouterr().err == f"{told}\ntfbus: left out: 2 x nan\n"


@pytest.mark.anyio
async def test_the_bar_shows_how_far_and_how_fast_it_plays(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    player = Player(Bus(), "run.mcap", rate=2.0)
    player.start, player.end, player.position = 10 * SECOND, 14 * SECOND, 11 * SECOND
    player.pause()
    with anyio.move_on_after(0.0):
        await _show_progress(player)
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.getvalue())
    assert "paused at 2 x" in shown
    assert " 25%" in shown
