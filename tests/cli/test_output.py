import csv
import errno
import io
import os
import re
import sys
from pathlib import Path

import pytest

from tfbus import Transform
from tfbus.cli.arguments import UsageError
from tfbus.cli.output import (
    csv_name,
    csv_writer,
    format_counts,
    format_numbers,
    format_seconds,
    format_transform,
    print_now,
    say,
    track,
    warn,
    write_file,
)


def test_results_go_to_standard_output_and_everything_else_to_standard_error(
    capsys: pytest.CaptureFixture[str],
) -> None:
    print_now("a result")
    say("a notice")
    warn("a warning")
    assert capsys.readouterr() == ("a result\n", "a notice\ntfbus: a warning\n")


def test_a_notice_is_one_line_whatever_names_are_in_it(capsys: pytest.CaptureFixture[str]) -> None:
    say("waiting for x\ny\x1b[2J")
    warn("no x\rtfbus: all is well")
    assert capsys.readouterr().err == "waiting for x\\ny\\x1b[2J\ntfbus: no x\\rtfbus: all is well\n"


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


@pytest.mark.parametrize(
    ("nanoseconds", "text"),
    [(0, "0.000000000"), (1, "0.000000001"), (-1, "-0.000000001"), (-1_500_000_000, "-1.500000000")],
)
def test_seconds_have_nine_decimals(nanoseconds: int, text: str) -> None:
    assert format_seconds(nanoseconds) == text


def test_numbers_have_no_needless_digits_and_no_negative_zero() -> None:
    assert format_numbers([1.5, -0.25, -0.0, 1 / 3]) == "1.5 -0.25 0 0.333333"


def test_a_transform_has_its_units() -> None:
    transform = Transform.from_xyz_rpy((1.5, 0.0, -0.25), (0.1, -0.2, 0.3))
    assert format_transform(transform) == "xyz 1.5 0 -0.25 m, rpy 0.1 -0.2 0.3 rad"


def test_counts_keep_their_order() -> None:
    assert format_counts({"not finite": 1_234, "cycle": 1}) == "1,234 x not finite, 1 x cycle"
    assert format_counts({}) == ""


def test_items_are_tracked_without_a_bar_where_standard_error_is_no_terminal(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert list(track(iter("abc"), None, "reading")) == ["a", "b", "c"]
    assert capsys.readouterr() == ("", "")


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
