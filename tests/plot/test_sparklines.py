import pytest
from support.samples import moving, over, static, tree_of

from tfbus import SECOND
from tfbus.plot import read_series, sparklines


def test_each_coordinate_has_a_line_from_its_least_to_its_greatest_value() -> None:
    series = read_series(tree_of(*over("map", "base", (0, 7 * SECOND), speed=1e-9)), "map", "base")
    lines = sparklines(series, width=8).split("\n")
    assert lines[0] == "base in map, 0.000 s to 7.000 s"
    assert lines[1] == "    x  ▁▂▃▄▅▆▇█  0.000 to 7.000 m"
    assert lines[2] == "    y  ▁▁▁▁▁▁▁▁  0.000 to 0.000 m"
    assert [line.split()[0] for line in lines[1:]] == ["x", "y", "z", "roll", "pitch", "yaw"]
    assert lines[6].endswith("deg")


def test_there_is_a_blank_where_there_is_no_answer() -> None:
    tree = tree_of(*over("map", "base", (0, 2 * SECOND)), static("world", "anchor"), keep=None)
    tree.insert_many([moving("world", "base", 4 * SECOND, 1.0), moving("world", "base", 6 * SECOND, 2.0)])
    assert sparklines(read_series(tree, "world", "base", samples=7), width=7).split("\n")[1] == (
        "    x      ▁▅█  1.000 to 2.000 m"
    )


def test_a_line_has_at_least_one_letter() -> None:
    series = read_series(tree_of(*over("map", "base", (0, SECOND))), "map", "base")
    with pytest.raises(ValueError, match="letter"):
        sparklines(series, width=0)
    assert "▁" in sparklines(series, width=1)
