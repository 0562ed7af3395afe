"""Figures of paths, of gaps and of transforms over time."""

import math
from collections.abc import Callable

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from support.samples import over, static, tree_of

from tfbus import SECOND, Transform, TransformStamped, TransformTree
from tfbus.analysis import compare
from tfbus.errors import UnknownFrameError
from tfbus.plot import Reception, plot_errors, plot_gaps, plot_path, plot_transforms
from tfbus.plot.plots import line_styles, show_in_window, spans_heard

TREE = tree_of(*over("map", "a", (0, 4 * SECOND), speed=1e-9), static("a", "b", 1.0))


def test_a_path_from_above_has_equal_scales_a_legend_and_marks_of_start_and_end() -> None:
    figure = plot_path(TREE, "map", "a", "b")
    [axes] = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x in map [m]", "y in map [m]")
    assert axes.get_aspect() == 1.0
    paths = [line for line in axes.lines if line.get_linestyle() != "None"]
    assert [line.get_label() for line in paths] == ["a", "b"]
    ends = [np.asarray(line.get_xdata())[[0, -1]].tolist() for line in paths]
    assert ends == [[0.0, 4.0], [1.0, 5.0]]
    marks = {line.get_marker(): np.asarray(line.get_xdata()).tolist() for line in axes.lines[4:]}
    assert marks == {"o": [1.0], "s": [5.0]}
    [legend] = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["a", "b", "start", "end"]
    assert [getattr(handle, "get_marker")() for handle in legend.legend_handles[2:]] == ["o", "s"]  # noqa: B009
    colours = [line.get_color() for line in axes.lines]
    assert colours == [colours[0]] * 3 + [colours[3]] * 3
    assert colours[0] != colours[3]


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


def heard(*seconds: float, static: bool = False, delay: float = 0.5) -> Reception:
    received = np.array([round(second * SECOND) for second in seconds], np.int64)
    return Reception("base", received - round(delay * SECOND), received, static)


def spans(frame: Reception) -> list[tuple[float, float]]:
    return [(begin / SECOND, length / SECOND) for begin, length in spans_heard(frame)]


def bars(axes: Axes) -> float:
    """The number of values in a histogram."""
    return sum(patch.get_height() for patch in axes.patches if isinstance(patch, Rectangle))


def test_a_pause_of_more_than_three_usual_periods_is_a_gap() -> None:
    assert spans(heard(0, 1, 2, 5, 6, 7)) == [(0, 7)]
    assert spans(heard(0, 1, 2, 5.5, 6.5, 7.5)) == [(0, 2), (5.5, 2)]


def test_a_frame_that_was_heard_once_or_never_has_a_point_or_nothing() -> None:
    assert spans(heard(3)) == [(3, 0)]
    assert spans(heard()) == []
    assert spans(heard(1, 1, 1, 9)) == [(1, 0), (9, 0)]


def test_gaps_are_drawn_as_a_row_of_strips_a_frame_and_as_histograms_of_periods_and_delays() -> None:
    figure = plot_gaps({"base": heard(10, 11, 12, 20, 21), "lidar": heard(static=True)})
    strips, periods, delays = figure.axes
    assert [label.get_text() for label in strips.get_yticklabels()] == ["base", "lidar"]
    drawn = [(np.asarray(line.get_xdata()).tolist(), line.get_linestyle()) for line in strips.lines]
    assert drawn == [([0.0, 2.0], "-"), ([10.0, 11.0], "-"), ([0.0, 11.0], ":")]
    assert (periods.get_xlabel(), delays.get_xlabel()) == ("period [ms]", "delay [ms]")
    assert bars(periods) == 4
    assert bars(delays) == 5
    assert (strips.get_xlabel(), strips.get_ylim()) == ("time from the start [s]", (1.5, -0.5))
    assert strips.get_title() == "heard (static: dotted)"
    many = plot_gaps({"base": heard(10, 11), **{f"mount{i}": heard(static=True) for i in range(20)}}).axes[0]
    assert [label.get_text() for label in many.get_yticklabels()] == ["base"]
    assert many.get_title() == "heard (20 static frames: not drawn)"
    assert [np.asarray(line.get_ydata()).tolist() for line in strips.lines] == [[0, 0], [0, 0], [1, 1]]
    for axes, least, most in ((periods, 1_000.0, 8_000.0), (delays, 500.0, 500.0)):
        assert (axes.get_ylabel(), axes.get_yscale()) == ("samples", "log")
        full = [patch for patch in axes.patches if isinstance(patch, Rectangle) and patch.get_height()]
        assert full[0].get_x() - 1e-6 <= least <= full[0].get_x() + full[0].get_width() + 1e-6
        assert full[-1].get_x() - 1e-6 <= most <= full[-1].get_x() + full[-1].get_width() + 1e-6


def test_no_frame_is_an_error() -> None:
    with pytest.raises(ValueError, match="no frame"):
        plot_gaps({})


def turning() -> TransformTree:
    """A frame that turns by 400 degrees about z in four seconds, as it moves along x at 1 m/s."""
    tree = TransformTree()
    for step in range(41):
        pose = Transform.from_xyz_rpy((step / 10, 2.0, 3.0), (0.0, 0.0, math.radians(10 * step)))
        tree.insert(TransformStamped("map", "base", step * SECOND // 10, pose))
    return tree


def test_each_axes_has_one_coordinate_of_each_frame_with_its_unit() -> None:
    figure = plot_transforms(turning(), "map", "base")
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels == ["x [m]", "roll [deg]", "y [m]", "pitch [deg]", "z [m]", "yaw [deg]"]
    figure.draw_without_rendering()
    for column in (figure.axes[::2], figure.axes[1::2]):
        left, *others = (axes.yaxis.label.get_window_extent().x0 for axes in column)
        assert others == pytest.approx([left, left])
    assert [axes.get_xlabel() for axes in figure.axes][-2:] == ["time from the start [s]"] * 2
    x, _, y, _, z, yaw = (axes.lines[0] for axes in figure.axes)
    assert np.allclose(x.get_ydata(), x.get_xdata())
    assert set(np.asarray(y.get_ydata()).tolist()) == {2.0}
    assert set(np.asarray(z.get_ydata()).tolist()) == {3.0}
    seconds, angles = np.asarray(yaw.get_xdata()), np.asarray(yaw.get_ydata())
    known = ~np.isnan(angles)
    wanted = (100.0 * seconds + 180.0) % 360.0 - 180.0
    assert np.abs((angles - wanted + 180.0) % 360.0 - 180.0)[known].max() < 1e-6
    # One break, where the angle passes 180 degrees.
    assert np.count_nonzero(~known) == 1


def test_several_frames_and_recordings_have_lines_and_names_of_their_own() -> None:
    tree = tree_of(*over("map", "a", (0, SECOND)), static("a", "b", 1.0))
    figure = plot_transforms([("first", tree), ("second", tree)], "map", "a", "b")
    lines = figure.axes[0].lines
    assert [line.get_label() for line in lines] == ["a, first", "b, first", "a, second", "b, second"]
    assert len({line.get_color() for line in lines}) == 4
    assert figure.axes[0].get_title(loc="left") == "Poses in map"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [str(line.get_label()) for line in lines]


def test_where_lines_run_together_each_is_wider_than_the_next() -> None:
    figure = plot_transforms([("first", turning()), ("second", turning()), ("third", turning())], "map", "base")
    widths = [line.get_linewidth() for line in figure.axes[0].lines]
    assert widths == sorted(widths, reverse=True)
    assert len(set(widths)) == 3


@pytest.mark.parametrize(
    ("turn", "ticks"),
    [(400.0, [-180, -90, 0, 90, 180]), (130.0, [0, 45, 90, 135]), (50.0, [0, 10, 20, 30, 40, 50]), (1.0, None)],
)
def test_angles_have_ticks_at_round_parts_of_a_turn(turn: float, ticks: list[int] | None) -> None:
    tree = TransformTree()
    for step in range(41):
        pose = Transform.from_xyz_rpy((0.0, 0.0, 0.0), (0.0, 0.0, math.radians(turn * step / 40)))
        tree.insert(TransformStamped("map", "base", step * SECOND // 10, pose))
    yaw = plot_transforms(tree, "map", "base").axes[5]
    low, high = yaw.get_ylim()
    shown = [tick for tick in yaw.get_yticks() if low <= tick <= high]
    assert len(shown) >= 4
    assert ticks is None or shown == ticks


@pytest.mark.parametrize("draw", [plot_transforms, plot_path])
def test_the_corner_has_the_name_of_the_recording_and_the_date_of_its_start(draw: Callable[..., Figure]) -> None:
    start = 1_396_293_888 * SECOND
    for first, text in ((start, "run.mcap, start: 2014-03-31 19:24:48 UTC"), (0, "run.mcap, start: 0.000 s")):
        tree = tree_of(*over("map", "a", (first, first + SECOND), speed=0.0))
        figure = draw(tree, "map", "a", recording="run.mcap")
        assert text in [axes.get_title(loc="right") for axes in figure.axes]
    assert "start: 0.000 s" in [axes.get_title(loc="right") for axes in draw(tree, "map", "a").axes]
    gaps = plot_gaps({"base": heard(10, 11)}, recording="run.mcap")
    assert gaps.axes[1].get_title(loc="right") == "run.mcap, start: 10.000 s"


@pytest.mark.parametrize("align", [False, True])
def test_errors_are_drawn_over_time_and_on_the_map(align: bool) -> None:
    """The reference is in the plane of x and z; the estimate is 2 m beside it, and turned by 90 degrees."""
    wanted, found = TransformTree(), TransformTree()
    beside = Transform.from_axis_angle((0.0, 1.0, 0.0), math.pi / 2, (0.0, 2.0, 0.0))
    for k in range(10):
        pose = Transform((float(k), 0.0, 0.1 * k * k))
        wanted.insert(TransformStamped("map", "base", k * SECOND, pose))
        found.insert(TransformStamped("map", "base", k * SECOND, pose @ beside))
    figure = plot_errors(compare(wanted, found, "map", "base", align=align), "map:base", names=("truth", "slam"))
    translation, chart, rotation, _ = figure.axes
    assert (translation.get_ylabel(), rotation.get_ylabel()) == ("translation error [m]", "rotation error [deg]")
    expected = 0.0 if align else 2.0
    for axes, value in ((translation, expected), (rotation, 90.0)):
        curve = axes.lines[0]
        assert np.asarray(curve.get_xdata()) == pytest.approx(range(10))
        assert np.asarray(curve.get_ydata()) == pytest.approx([value] * 10, abs=1e-6)
        legend = axes.get_legend()
        assert legend is not None
        assert align or legend.get_texts()[0].get_text().startswith(f"RMSE {value:.3g} ")
    assert (chart.get_xlabel(), chart.get_ylabel()) == ("x [m]", "z [m]")
    assert np.asarray(chart.lines[0].get_ydata()) == pytest.approx([0.1 * k * k for k in range(10)])
    [coloured] = chart.collections
    colours = coloured.get_array()
    assert colours is not None
    assert np.asarray(colours).tolist() == pytest.approx([expected] * 9, abs=1e-6)
    assert figure.get_suptitle() == f"map:base: slam against truth, {'aligned' if align else 'not aligned'}"


def test_changes_of_rounding_do_not_fill_an_axis() -> None:
    tree = TransformTree()
    for step in range(4):
        tree.insert(TransformStamped("map", "base", step * SECOND, Transform((1e-17 * (step % 2), 1e-5 * step, 0.0))))
    x, _, y, *_ = plot_transforms(tree, "map", "base").axes
    low, high = x.get_ylim()
    assert (low, high) == pytest.approx((-5e-7, 5e-7))
    low, high = y.get_ylim()
    assert 3e-5 <= high - low <= 4e-5


def test_a_given_figure_is_drawn_in() -> None:
    figure = Figure()
    assert plot_transforms(turning(), "map", "base", figure=figure) is figure
    assert len(figure.axes) == 6


def test_no_source_no_tree_and_unknown_frames_are_errors() -> None:
    with pytest.raises(ValueError, match="source"):
        plot_transforms(turning(), "map")
    with pytest.raises(ValueError, match="tree"):
        plot_transforms([], "map", "base")
    with pytest.raises(UnknownFrameError):
        plot_transforms(turning(), "map", "bass")


@pytest.mark.parametrize(("display", "why"), [("", "there is no display"), (":0", "has no window here")])
def test_without_a_window_nothing_is_drawn(display: str, why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plt, "get_backend", lambda: "agg")
    monkeypatch.setenv("DISPLAY", display)
    with pytest.raises(RuntimeError, match=why):
        show_in_window(lambda _: pytest.fail("drawn"))


def test_the_figure_is_drawn_and_then_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[object] = []
    plt.switch_backend("agg")
    monkeypatch.setattr(plt, "get_backend", lambda: "tkagg")
    monkeypatch.setattr(plt, "show", lambda: drawn.append("shown"))
    show_in_window(drawn.append)
    figure, last = drawn
    assert isinstance(figure, Figure)
    assert last == "shown"
    plt.close("all")


def test_no_two_of_28_lines_look_alike() -> None:
    styles = [tuple(style.items()) for style in line_styles(28)]
    assert len(set(styles)) == len(styles) == 28
