"""Lines, tables, progress, values as text, files and log lines."""

import csv
import errno
import io
import logging
import os
import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
from support.commands import Terminal

from tfbus import Transform
from tfbus.cli.arguments import UsageError
from tfbus.cli.output import (
    Column,
    csv_name,
    csv_writer,
    format_counts,
    format_numbers,
    format_transform,
    log_lines,
    print_now,
    say,
    shorten,
    table_lines,
    terminal_width,
    track,
    wrapped,
    write_file,
)
from tfbus.stamps import format_seconds


class Screen(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_name_in_csv_is_as_it_is_but_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    for screen, cell in ((io.StringIO(newline=""), "x\x1b[2J\r"), (Screen(newline=""), r"x\x1b[2J\r")):
        monkeypatch.setattr(sys, "stdout", screen)
        csv_writer().writerow((csv_name("x\x1b[2J\r"), 1.5))
        assert screen.getvalue().endswith("\n")
        assert next(csv.reader(io.StringIO(screen.getvalue(), newline=""))) == [cell, "1.5"]


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_lines_leave_a_buffered_stream_at_once(stream: str, monkeypatch: pytest.MonkeyPatch) -> None:
    received = io.BytesIO()
    monkeypatch.setattr(sys, stream, io.TextIOWrapper(io.BufferedWriter(received), encoding="utf-8"))
    (print_now if stream == "stdout" else say)("line")
    assert received.getvalue() == b"line\n"


def test_values_are_texts_for_people() -> None:
    nanoseconds = {0: "0.000000000", 1: "0.000000001", -1: "-0.000000001", -1_500_000_000: "-1.500000000"}
    assert {each: format_seconds(each) for each in nanoseconds} == nanoseconds
    assert format_numbers([1.5, -0.25, -0.0, 1 / 3]) == "1.5 -0.25 0 0.333333"
    transform = Transform.from_xyz_rpy((1.5, 0.0, -0.25), (0.1, -0.2, 0.3))
    assert format_transform(transform) == "xyz 1.5 0 -0.25 m, rpy 0.1 -0.2 0.3 rad"
    assert format_counts({"not finite": 1_234, "cycle": 1}) == "1,234 x not finite, 1 x cycle"


def test_a_file_is_replaced_as_a_whole_without_leaving_others(tmp_path: Path) -> None:
    path = tmp_path / "frames.dot"
    for content in (b"first", b"second"):
        write_file(path, content)
        assert path.read_bytes() == content
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_cannot_be_replaced_leaves_nothing_unfinished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(UsageError, match="Input/output error"):
        write_file(tmp_path / "frames.dot", b"digraph")
    assert list(tmp_path.iterdir()) == []


def test_a_pipe_is_written_to_and_not_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_file(pipe, b"digraph")
        assert os.read(reader, 100) == b"digraph"
    finally:
        os.close(reader)
    assert pipe.is_fifo()


@pytest.mark.parametrize("name", ["nowhere/frames.dot", "."])
def test_an_error_names_the_file_that_cannot_be_written(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    with pytest.raises(UsageError, match=re.escape(f"cannot write {path}: ")):
        write_file(path, b"")


def test_a_link_that_somebody_has_made_beside_a_file_leads_nowhere(tmp_path: Path) -> None:
    path, precious = tmp_path / "frames.dot", tmp_path / "precious"
    precious.write_bytes(b"precious")
    (tmp_path / ".frames.dot.part").symlink_to(precious)
    write_file(path, b"digraph")
    assert (path.read_bytes(), precious.read_bytes()) == (b"digraph", b"precious")


def test_a_pipe_has_room_for_any_line_unless_the_environment_says_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    assert terminal_width() is None
    monkeypatch.setenv("COLUMNS", "60")
    assert terminal_width() == 60
    monkeypatch.setenv("COLUMNS", "many")
    assert terminal_width() is None
    monkeypatch.setattr(sys, "stdout", Terminal())
    assert isinstance(terminal_width(), int)


@pytest.mark.parametrize(
    ("text", "width", "shortened"),
    [
        ("base_link", 9, "base_link"),
        ("base_link", 8, "bas…link"),
        ("base_link", 5, "ba…nk"),
        ("base_link", 2, "…k"),
        ("base_link", 1, "…"),
        ("base_link", 0, ""),
        ("雷达雷达", 7, "雷…雷达"),
        ("雷达雷达", 5, "雷…达"),
        ("雷达雷达", 4, "…达"),
    ],
)
def test_the_middle_of_a_long_text_is_cut_out(text: str, width: int, shortened: str) -> None:
    assert shorten(text, width) == shortened


def test_a_line_is_broken_between_words_and_a_longer_word_is_shortened() -> None:
    assert wrapped("one two three", None, 2) == wrapped("one two three", 13, 2) == ["one two three"]
    assert wrapped("one two three", 8, 2) == ["one two", "  three"]
    assert wrapped("at /a/very/long/path it is", 10, 2) == ["at", "  /a/…path", "  it is"]


COLUMNS = (Column("name"), Column("least", importance=1), Column("count", right=True, importance=2))
ROWS = [("a", "xyz", "1"), ("long name", "w", "1,000")]


LINKS = [("left_shoulder_link", "fixed"), ("arm", "revolute")]
WHOLE = ["name       least  count", "a          xyz        1", "long name  w      1,000"]


@pytest.mark.parametrize(
    ("columns", "rows", "width", "titles", "lines"),
    [
        (COLUMNS, ROWS, None, True, WHOLE),
        (COLUMNS, ROWS, 23, True, WHOLE),
        # The least important columns go first; the others are shortened, but to eight columns at least.
        (COLUMNS, ROWS, 22, True, ["name       count", "a              1", "long name  1,000"]),
        (COLUMNS, ROWS, 15, True, ["name", "a", "long name"]),
        (COLUMNS[:1] * 2, LINKS, 20, False, ["left…_link  fixed", "arm         revolute"]),
        (COLUMNS[:1] * 2, LINKS, 3, False, ["lef…link  fixed", "arm       revolute"]),
        # A column without cells is left out, and a wide letter takes two columns.
        (COLUMNS, [("a", "", "1")], None, True, ["name  count", "a         1"]),
        (COLUMNS, [], None, False, []),
        (COLUMNS[::2], [("雷达", "1"), ("abcd", "2")], None, False, ["雷达  1", "abcd  2"]),
    ],
)
def test_a_table_has_the_columns_that_fit_with_numbers_at_the_right(
    columns: Sequence[Column], rows: list[tuple[str, ...]], width: int | None, titles: bool, lines: list[str]
) -> None:
    assert list(table_lines(columns, rows, width, titles)) == lines


def test_the_bar_is_on_standard_error_and_leaves_the_output_alone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    for item in track(iter("abc"), 3, "reading"):
        print(item)
        print("notice", file=sys.stderr)
    assert capsys.readouterr().out == "a\nb\nc\n"
    shown = terminal.getvalue()
    assert "reading" in shown
    assert shown.count("notice\n") == 3
    # At its end, the bar erases its line.
    assert shown.endswith("\x1b[2K")


LOGGER = logging.getLogger("tfbus")


def test_log_lines_of_one_kind_are_one_line_with_their_number(capsys: pytest.CaptureFixture[str]) -> None:
    with log_lines("WARNING"):
        for number in range(83):
            LOGGER.warning("frame %r comes from two authorities", f"f{number}")
        LOGGER.warning("the clock jumped back")
    assert capsys.readouterr().err.splitlines() == [
        "tfbus: frame 'f0' comes from two authorities (and 82 more like it)",
        "tfbus: the clock jumped back",
    ]


def test_a_log_line_is_printed_when_its_time_is_over_and_the_time_doubles(capsys: pytest.CaptureFixture[str]) -> None:
    times = []
    with log_lines("WARNING", first_window=0.001):
        for round_ in range(6):
            began = time.monotonic()
            LOGGER.warning("round %d", round_)
            printed = ""
            # A line and its end may be written one after the other.
            while not printed.endswith("\n") and time.monotonic() < began + 60.0:
                time.sleep(0.0001)
                printed += capsys.readouterr().err
            times.append(time.monotonic() - began)
            assert printed == f"tfbus: round {round_}\n"
    assert [spent >= 0.001 * 2**round_ for round_, spent in enumerate(times)] == [True] * 6


def test_a_traceback_stays_with_its_line(capsys: pytest.CaptureFixture[str]) -> None:
    with log_lines("WARNING"):
        LOGGER.warning("the callback raised", exc_info=ValueError("no\ntfbus: all is well\x1b[2J"))
    first, *traceback = capsys.readouterr().err.split("\n")
    assert first == "tfbus: the callback raised"
    assert traceback[-3:] == ["  ValueError: no", r"  tfbus: all is well\x1b[2J", ""]
    assert all(line.startswith("  ") for line in traceback[:-1])
