import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="plots need matplotlib")

from support.samples import over, static, tree_of

from tfbus import SECOND
from tfbus.plot import plot_path

TREE = tree_of(*over("map", "a", (0, 4 * SECOND), speed=1e-9), static("a", "b", 1.0))


def test_a_path_from_above_has_equal_scales_and_names_the_target() -> None:
    [axes] = plot_path(TREE, "map", "a", "b").axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x in map [m]", "y in map [m]")
    assert axes.get_aspect() == 1.0
    paths = [line for line in axes.lines if line.get_linestyle() != "None"]
    assert [line.get_label() for line in paths] == ["a", "b"]
    ends = [np.asarray(line.get_xdata())[[0, -1]].tolist() for line in paths]
    assert ends == [[0.0, 4.0], [1.0, 5.0]]


def test_a_circle_marks_the_start_and_a_square_the_end() -> None:
    [axes] = plot_path(TREE, "map", "b").axes
    marks = {line.get_marker(): np.asarray(line.get_xdata()).tolist() for line in axes.lines[1:]}
    assert marks == {"o": [1.0], "s": [5.0]}


def test_the_lines_have_colours_of_their_own_and_a_legend() -> None:
    [axes] = plot_path(TREE, "map", "a", "b").axes
    legend = axes.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["a", "b"]
    colours = [line.get_color() for line in axes.lines]
    assert colours == [colours[0]] * 3 + [colours[3]] * 3
    assert colours[0] != colours[3]
    assert axes.xaxis.get_gridlines()[0].get_visible()
    assert axes.get_adjustable() == "datalim"


def test_an_instant_without_an_answer_is_neither_start_nor_end() -> None:
    tree = tree_of(*over("map", "a", (SECOND, 3 * SECOND), speed=1e-9), *over("map", "b", (0, 4 * SECOND)), keep=None)
    [axes] = plot_path(tree, "b", "a").axes
    marks = {line.get_marker(): np.asarray(line.get_xdata()).tolist() for line in axes.lines[1:]}
    assert [len(places) for places in marks.values()] == [1, 1]
    assert all(np.isfinite(places).all() for places in marks.values())


def test_three_dimensions_have_three_axes() -> None:
    [axes] = plot_path(TREE, "map", "a", three_d=True).axes
    assert axes.name == "3d"
    assert axes.get_zlabel() == "z in map [m]"  # type: ignore[attr-defined]
