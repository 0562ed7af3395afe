import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="plots need matplotlib")

from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from tfbus import SECOND
from tfbus.plot import Reception, plot_gaps
from tfbus.plot.gaps import spans_heard


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


def test_no_frame_is_an_error() -> None:
    with pytest.raises(ValueError, match="no frame"):
        plot_gaps({})
