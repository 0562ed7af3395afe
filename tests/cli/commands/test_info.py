"""The command as a user types it; once in a process of its own."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.commands import Command, command
from support.recorded import SMALL, WRONG_IN_SMALL, real, write_mcap
from support.samples import moving, static

TFBUS = str(Path(sys.executable).with_name("tfbus"))


@pytest.fixture
def info(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    return command("info", monkeypatch, capsys)


def in_a_process(*arguments: object) -> subprocess.CompletedProcess[str]:
    whole = [TFBUS, "info", *map(str, arguments)]
    return subprocess.run(whole, capture_output=True, text=True, timeout=60, check=False)


def rows_of(output: str) -> dict[str, list[str]]:
    """The lines of the table by frame, split where there are two blanks or more."""
    _, _, table = output.partition("\n\n")
    return {cells[0]: cells[1:] for line in table.splitlines() if (cells := re.split(r"  +", line.strip()))}


def test_the_table_shows_every_frame_and_what_is_wrong() -> None:
    done = in_a_process(SMALL)
    assert (done.returncode, done.stderr) == (0, "")
    head, _, _ = done.stdout.partition("\n\n")
    assert head.splitlines() == [
        str(SMALL),
        "start     99.000000000 s  1970-01-01 00:01:39 UTC",
        "end       109.982000000 s  1970-01-01 00:01:49 UTC",
        "duration  10.982000000 s",
        "contents  992 transforms in 789 messages",
        "frames    12, below hen, island, map",
        "left out  3 x not finite, 2 x frame name, 1 x zero quaternion, 1 x not a unit quaternion, 1 x self transform, "
        "1 x cycle",
    ]
    rows = rows_of(done.stdout)
    assert rows["frame"] == ["parent", "kind", "samples", "rate", "span", "longest gap", "authority"]
    assert rows["odom"] == ["map", "moving", "100", "10.0 Hz", "9.9 s", "100 ms", "slam"]
    assert rows["base_link"] == ["odom", "moving", "426", "42.6 Hz", "9.98 s", "1.52 s", "odometry"]
    assert rows["box"][:2] == ["table, gripper", "moving"]
    assert rows["laser"] == ["base_link", "static", "1", "calibration"]
    assert len(rows) == 13


def test_json_has_the_same_with_all_digits(info: Command) -> None:
    done = info(SMALL, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    data = json.loads(done.stdout)
    assert data["path"] == str(SMALL)
    assert (data["start"], data["end"], data["duration"]) == ("99.000000000", "109.982000000", 10.982)
    assert (data["finished"], data["messages"], data["transforms"]) == (True, 789, 992)
    assert (data["roots"], data["problems"]) == (["hen", "island", "map"], WRONG_IN_SMALL)
    frames = {frame["frame"]: frame for frame in data["frames"]}
    assert frames["odom"] == {
        "frame": "odom",
        "parents": ["map"],
        "kind": "moving",
        "static": 0,
        "moving": 100,
        "oldest": "100.000000000",
        "newest": "109.900000000",
        "rate": 10.0,
        "span": 9.9,
        "longest_gap": 0.1,
        "authorities": ["slam"],
    }
    assert frames["laser"]["oldest"] is None


def test_of_the_turtles_every_sender_and_the_day_are_shown(info: Command) -> None:
    done = info(real("turtlesim.bag"))
    assert "start     1396293887.844783943 s  2014-03-31 19:24:47 UTC" in done.stdout
    assert rows_of(done.stdout)["turtle1"] == [
        "world", "moving", "1,344", "62.5 Hz", "21.5 s", "16.2 ms", "turtle1_tf_broadcaster"
    ]  # fmt: skip


def test_names_are_shown_as_they_are_and_in_full_where_a_program_reads_them(tmp_path: Path, info: Command) -> None:
    long = "a_link_with_a_very_long_name_" * 10
    samples = [moving("[bold]map[/bold]", ":robot:", 1), moving(":robot:", long, 1)]
    rows = rows_of(info(write_mcap(tmp_path / "run.mcap", [(1, "/tf", samples)])).stdout)
    assert rows[":robot:"][0] == "[bold]map[/bold]"
    assert rows[long][0] == ":robot:"


def test_names_do_not_control_the_terminal(tmp_path: Path, info: Command) -> None:
    samples = [moving("\x1b[2Jroot", "red\x1b[31m\nhot", 1), moving("red\x1b[31m\nhot", "leaf", 1)]
    metadata = {"tfbus.authorities": json.dumps([["\x1b]0;title\x07", 1]])}
    done = info(write_mcap(tmp_path / "run.mcap", [(1, "/tf", samples)], metadata=metadata))
    assert "\x1b" not in done.stdout
    assert r"frames    2, below \x1b[2Jroot" in done.stdout
    rows = rows_of(done.stdout)
    assert rows[r"red\x1b[31m\nhot"][0] == r"\x1b[2Jroot"
    assert rows["leaf"][0] == r"red\x1b[31m\nhot"
    assert rows["leaf"][-1] == r"\x1b]0;title\x07"


def test_no_line_ends_with_blanks(info: Command) -> None:
    assert all(line == line.rstrip() for line in info(SMALL).stdout.splitlines())


def test_a_frame_of_both_kinds_shows_both(tmp_path: Path, info: Command) -> None:
    lines = [(1, "/tf_static", [static("a", "b")]), (2, "/tf", [moving("a", "b", 1)])]
    assert rows_of(info(write_mcap(tmp_path / "run.mcap", lines)).stdout)["b"][:3] == ["a", "static, moving", "2"]


def test_an_unfinished_file_is_told_as_such_and_read(tmp_path: Path, info: Command) -> None:
    path = write_mcap(tmp_path / "run.mcap", [(1, "/tf", [moving("a", "b", 1)])], finish=False)
    done = info(path)
    assert done.returncode == 0
    assert done.stdout.splitlines()[0] == f"{path}, not finished by its writer"
    assert "b" in rows_of(done.stdout)


def test_a_recording_without_transforms_has_no_table(tmp_path: Path, info: Command) -> None:
    done = info(write_mcap(tmp_path / "run.mcap", [(1, "/camera", b"")]))
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[-2:] == ["contents  0 transforms in 0 messages", "frames    0"]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "there is no such file"),
        (b"", "the file is empty"),
        (b"\x89MCAP0\r\n\x01", "the file ends before its first message"),
        (b"Dear diary,\n", "it is no recording of ROS 1 (.bag) or ROS 2 (.mcap, .db3)"),
        (SMALL.read_bytes()[:-1_000], "it cannot be read as a bag of ROS 1: "),
    ],
    ids=["missing", "empty", "truncated", "foreign", "truncated bag"],
)
def test_a_file_that_is_no_recording_is_one_line_and_status_2(
    tmp_path: Path, content: bytes | None, says: str, info: Command
) -> None:
    path = tmp_path / "run.mcap"
    if content is not None:
        path.write_bytes(content)
    done = info(path)
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(r"tfbus: recording '.*run\.mcap': .+\n", done.stderr)
    assert says in done.stderr


def test_a_wrong_call_is_one_line_and_status_2(info: Command) -> None:
    for arguments in ((), ("--jsn", SMALL), (SMALL, SMALL)):
        done = info(*arguments)
        assert (done.returncode, done.stdout) == (2, "")
        assert re.fullmatch(r"tfbus: .+\n", done.stderr)


def test_a_missing_file_is_one_line_and_status_2_for_a_shell_too(tmp_path: Path) -> None:
    done = in_a_process(tmp_path / "run.mcap")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"tfbus: recording '{tmp_path / 'run.mcap'}': there is no such file\n"


def test_help_has_an_example(info: Command) -> None:
    done = info("--help")
    assert done.returncode == 0
    assert "Example: tfbus info run.mcap" in done.stdout
    assert "--json" in done.stdout


def test_a_reader_that_has_had_enough_is_no_traceback(tmp_path: Path) -> None:
    samples = [moving("a", f"frame_{number}", 1) for number in range(5_000)]
    path = write_mcap(tmp_path / "run.mcap", [(1, "/tf", samples)])
    # Unbuffered, Python says nothing of what a pipe takes only a part of.
    environment = {**os.environ, "PYTHONUNBUFFERED": ""}
    command = [TFBUS, "info", str(path)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, env=environment) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        # In the middle of the table, which is more than fits into a pipe.
        assert any(line.startswith(b"frame_") for line in process.stdout)
        process.stdout.close()
        errors = process.stderr.read()
        status = process.wait(timeout=30)
    assert (status, errors) == (0, b"")


def test_without_its_extra_the_command_names_it() -> None:
    program = "import sys; sys.modules['mcap'] = None; from tfbus.cli import main; main()"
    command = [sys.executable, "-c", program, "info", str(SMALL)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert 'pip install "tfbus[bag]"' in done.stderr
