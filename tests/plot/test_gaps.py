import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="plots need matplotlib")

from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from tfbus import SECOND
from tfbus.plot import Reception, plot_gaps
from tfbus.plot.plots import spans_heard


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


def test_the_figure_has_strips_periods_and_delays() -> None:
    figure = plot_gaps({"base": heard(10, 11, 12, 20, 21), "lidar": heard(static=True)})
    strips, periods, delays = figure.axes
    assert [label.get_text() for label in strips.get_yticklabels()] == ["base", "lidar"]
    drawn = [(np.asarray(line.get_xdata()).tolist(), line.get_linestyle()) for line in strips.lines]
    assert drawn == [([0.0, 2.0], "-"), ([10.0, 11.0], "-"), ([0.0, 11.0], ":")]
    assert (periods.get_xlabel(), delays.get_xlabel()) == ("period [ms]", "delay [ms]")
    assert bars(periods) == 4
    assert bars(delays) == 5


def test_each_frame_has_a_row_and_each_axes_its_names_and_scale() -> None:
    figure = plot_gaps({"base": heard(10, 11, 12, 20, 21), "lidar": heard(static=True)})
    strips, periods, delays = figure.axes
    assert figure.get_size_inches().tolist() == pytest.approx([11.0, 3.4])
    assert (strips.get_xlabel(), strips.get_ylim()) == ("time from the start [s]", (1.5, -0.5))
    assert strips.get_title() == "heard (static: dotted)"
    assert [np.asarray(line.get_ydata()).tolist() for line in strips.lines] == [[0, 0], [0, 0], [1, 1]]
    heard_for, _, static = strips.lines
    assert heard_for.get_linewidth() > static.get_linewidth() > 1.0
    assert heard_for.get_color() != static.get_color()
    # It must not look longer than it was.
    assert heard_for.get_solid_capstyle() == "butt"
    assert (strips.xaxis.get_gridlines()[0].get_visible(), strips.yaxis.get_gridlines()[0].get_visible()) == (1, 0)
    for axes, least, most in ((periods, 1_000.0, 8_000.0), (delays, 500.0, 500.0)):
        assert (axes.get_ylabel(), axes.get_yscale()) == ("samples", "log")
        assert axes.xaxis.get_gridlines()[0].get_visible()
        full = [patch for patch in axes.patches if isinstance(patch, Rectangle) and patch.get_height()]
        assert full[0].get_x() - 1e-6 <= least <= full[0].get_x() + full[0].get_width() + 1e-6
        assert full[-1].get_x() - 1e-6 <= most <= full[-1].get_x() + full[-1].get_width() + 1e-6


def test_no_frame_is_an_error() -> None:
    with pytest.raises(ValueError, match="no frame"):
        plot_gaps({})
