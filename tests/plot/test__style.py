import pytest

pytest.importorskip("matplotlib", reason="plots need matplotlib")

from matplotlib.figure import Figure

from tfbus.plot.plots import line_styles, new_figure


def test_a_given_figure_is_drawn_in_and_otherwise_there_is_a_new_one() -> None:
    figure = Figure()
    assert new_figure(figure, 1.0, 2.0) is figure
    assert new_figure(None, 3.0, 2.0).get_size_inches().tolist() == [3.0, 2.0]


def test_no_two_of_28_lines_look_alike() -> None:
    styles = [tuple(style.items()) for style in line_styles(28)]
    assert len(set(styles)) == len(styles) == 28
