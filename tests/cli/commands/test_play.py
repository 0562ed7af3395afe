import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.processes import new_domain
from support.programs import PATIENCE, TFBUS, free_address, tfbus
from support.recorded import SMALL, messages_in, write_mcap
from support.samples import moving, static
from support.terminal import on_a_terminal

from tfbus import SECOND, TransformStamped
from tfbus.cli import main

START = 1_700_000_000 * SECOND
BACKENDS = ["asyncio", "trio"]


@pytest.fixture
def ten_seconds(tmp_path: Path) -> Path:
    """A rig that is static on a base, which is at k dm after k tenths of a second."""
    lines = [(START, "/tf_static", [static("base", "rig", 5.0)])]
    lines += [(START + k * SECOND // 10, "/tf", [moving("map", "base", START + k, k / 10)]) for k in range(101)]
    return write_mcap(tmp_path / "ten_seconds.mcap", lines, metadata={"tfbus.authorities": '[["odometry", 1]]'})


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([TFBUS, "play", *arguments], capture_output=True, text=True, timeout=PATIENCE, check=False)


def samples_in(path: Path) -> list[TransformStamped]:
    return [sample for message in messages_in(path) for sample in message.batch]


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_it_plays_arrives_at_whoever_is_there_from_the_first_to_the_last(
    tmp_path: Path, ten_seconds: Path, backend: str
) -> None:
    domain, address = new_domain(), free_address()
    copy = tmp_path / "copy.mcap"
    options = ("--domain", domain, "--backend", backend)
    with tfbus("record", str(copy), "--listen", address, *options) as recorder:
        recorder.errors.expect("recording")
        with tfbus("play", str(ten_seconds), "--rate", "20", "--connect", address, *options) as player:
            assert player.wait() == 0
            assert player.output.text == ""
            assert player.errors.text == f"playing {ten_seconds} on domain '{domain}'\n102 samples played\n"
        assert recorder.end() == 130
    # What is static goes over the link on a way of its own.
    received, played = samples_in(copy), samples_in(ten_seconds)
    assert [sample for sample in received if sample.static] == [sample for sample in played if sample.static]
    assert [sample for sample in received if not sample.static] == [sample for sample in played if not sample.static]
    assert {sample.authority for sample in received} == {"odometry"}
    times = [message.received for message in messages_in(copy)]
    # At twenty times the pace, ten seconds take half of one; however slow the machine is, not less.
    assert times[-1] - times[0] > 0.45 * SECOND


@pytest.mark.parametrize(
    ("options", "count"),
    [
        (("--from", "2.5", "--to", "100"), 1 + 76),
        (("--to", "2.5"), 1 + 26),
        (("--from", "10", "--to", "10"), 1 + 1),
    ],
)
def test_a_part_is_told_in_seconds_from_the_beginning(ten_seconds: Path, options: tuple[str, ...], count: int) -> None:
    done = run(str(ten_seconds), "--rate", "inf", "--domain", new_domain(), *options)
    assert (done.returncode, done.stderr.splitlines()[-1]) == (0, f"{count} samples played")


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_loop_goes_on_until_ctrl_c(ten_seconds: Path, backend: str) -> None:
    domain, address = new_domain(), free_address()
    options = ("--domain", domain, "--backend", backend)
    with tfbus("play", str(ten_seconds), "--loop", "--rate", "50", "--listen", address, *options) as player:
        player.errors.expect("playing")
        with tfbus("echo", "map", "rig", "--rate", "20", "--connect", address, *options) as echo:
            found = [0.0]
            # It is at the end, and then at the beginning again.
            while not (max(found) > 13.0 and found[-1] < 8.0):
                number = re.search(r"\[([-\d.]+),", echo.output.expect("Translation"))
                assert number is not None
                found.append(float(number[1]))
        assert player.end() == 130
        assert "Traceback" not in player.errors.text


def test_what_is_left_out_is_told_by_reason() -> None:
    done = run(str(SMALL), "--rate", "inf", "--domain", new_domain())
    assert done.returncode == 0
    last = done.stderr.splitlines()[-1]
    assert last.startswith("tfbus: left out: ")
    assert "3 x not finite" in last
    assert "1 x cycle" in last


def test_a_file_that_was_never_finished_is_played_as_far_as_it_goes(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", [(START, "/tf", [moving("map", "base", 1)])], finish=False)
    done = run(str(path), "--domain", new_domain())
    assert done.returncode == 0
    assert done.stderr.splitlines()[0] == f"tfbus: {path} was not finished by its writer: this is what can be read"
    assert done.stderr.splitlines()[-1] == "1 samples played"


@pytest.mark.parametrize(
    "arguments",
    [
        ("--rate", "0"),
        ("--rate", "nan"),
        ("--rate=-1",),
        ("--from=-1",),
        ("--from", "11"),
        ("--from", "5", "--to", "4"),
        ("--from", "soon"),
        ("--to=-1",),
    ],
)
def test_a_wrong_call_is_one_line_on_standard_error_and_status_2(
    ten_seconds: Path,
    arguments: tuple[str, ...],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["tfbus", "play", str(ten_seconds), *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    output, errors = capsys.readouterr()
    assert (ended.value.code, output, len(errors.splitlines())) == (2, "", 1)
    assert errors.startswith("tfbus: ")


@pytest.mark.parametrize("content", [None, b"", b"no recording", b"\x89MCAP0\r\n", b"\x89MC"])
def test_what_is_no_recording_is_one_line_and_status_2(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "run.mcap"
    if content is not None:
        path.write_bytes(content)
    done = run(str(path))
    assert (done.returncode, done.stdout, len(done.stderr.splitlines())) == (2, "", 1)
    assert done.stderr.startswith(f"tfbus: recording '{path}': ")


def test_a_bar_is_on_standard_error_if_that_is_a_terminal(tmp_path: Path, ten_seconds: Path) -> None:
    command = ("play", str(ten_seconds), "--rate", "20", "--domain", new_domain())
    status, shown = on_a_terminal(tmp_path / "output", *command)
    assert status == 0
    assert (tmp_path / "output").read_text() == ""
    assert "playing \x1b" in shown
    assert re.search(r"[1-9]\d?%", shown)
    assert "102 samples played" in shown


def test_help_shows_an_example_and_every_option() -> None:
    done = subprocess.run([TFBUS, "play", "--help"], capture_output=True, text=True, timeout=PATIENCE, check=True)
    assert "Example: tfbus play" in done.stdout
    for option in ("--rate", "--loop", "--from", "--to", "--domain", "--listen", "--connect", "--backend"):
        assert option in done.stdout
