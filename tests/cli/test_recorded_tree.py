from pathlib import Path

import pytest
from support.recorded import SMALL, write_mcap
from support.samples import moving, static

from tfbus.cli.recorded_tree import load_tree


def test_a_tree_comes_with_the_log_time_of_the_first_message(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [(7, "/tf_static", [static("base", "laser", 100.0)]), (9, "/tf", [moving("map", "base", 5)])]
    tree, start = load_tree(write_mcap(tmp_path / "run.mcap", lines))
    assert tree.frames() == ["base", "laser", "map"]
    assert start == 7
    assert capsys.readouterr() == ("", "")


def test_what_is_left_out_is_told_on_standard_error(capsys: pytest.CaptureFixture[str]) -> None:
    load_tree(Path(SMALL))
    told = capsys.readouterr()
    assert told.out == ""
    assert "left out of" in told.err
    assert "1 x cycle" in told.err
