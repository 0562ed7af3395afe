import pytest

from tfbus.cli._transform_rows import Row, print_rows


def test_without_rows_nothing_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    for kind in ("table", "csv", "json", "tum"):
        print_rows([], kind, several=False)
    assert capsys.readouterr() == ("", "")


def test_a_table_begins_anew_with_each_pair(capsys: pytest.CaptureFixture[str]) -> None:
    rows = [Row("map", name, 1, [1.0, -0.0, 0.0], [0.0, 0.0, 0.0, 1.0]) for name in ("a", "a", "b\x1b")]
    print_rows(rows, "table", several=True)
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if " in " in line] == ["a in map", "b\\x1b in map"]
    assert sum("stamp [s]" in line for line in lines) == 2
    assert "-0" not in lines[2]
