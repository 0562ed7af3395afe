import math

import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="plots need matplotlib")

from matplotlib.figure import Figure
from support.samples import over, static, tree_of

from tfbus import SECOND, Transform, TransformStamped, TransformTree
from tfbus.errors import UnknownFrameError
from tfbus.plot import plot_transforms


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
    assert figure.get_suptitle() == "in map"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [str(line.get_label()) for line in lines]


def test_the_axes_have_grids_and_share_their_time_and_the_legend_has_at_most_four_columns() -> None:
    tree = tree_of(*over("map", "a", (0, SECOND)), *(static("a", f"b{k}", 1.0) for k in range(5)))
    figure = plot_transforms(tree, "map", "a", *(f"b{k}" for k in range(5)))
    first, *others = figure.axes
    assert all(axes.xaxis.get_gridlines()[0].get_visible() for axes in figure.axes)
    assert all(axes.get_shared_x_axes().joined(first, axes) for axes in others)
    assert figure.legends[0]._ncols == 4  # type: ignore[attr-defined]
    assert plot_transforms(tree, "map", "a", "b1").legends[0]._ncols == 2  # type: ignore[attr-defined]


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
