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


def test_where_a_line_does_not_fit_the_quaternion_is_on_a_second_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    row = Row("map", "base", 1_396_293_888_050_000_001, [1e12, -2.0, 0.5], [0.0, 0.0, 0.0, 1.0])
    heights = {}
    for width in (60, 103, 104):
        monkeypatch.setenv("COLUMNS", str(width))
        print_rows([row], "table", several=False)
        lines = capsys.readouterr().out.splitlines()
        assert max(map(len, lines)) <= width
        heights[width] = len(lines)
        numbers = (
            "1396293888.050000001  1.0000e+12   -2.000000    0.500000    0.000000    0.000000    0.000000    1.000000"
        )
        assert " ".join(lines).split()[-8:] == numbers.split()
        # All of one width, however large.
        assert width < 104 or lines[-1].endswith(numbers)
    assert heights == {60: 4, 103: 4, 104: 2}
