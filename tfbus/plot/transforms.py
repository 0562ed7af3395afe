"""`plot_transforms`, which draws x, y, z and roll, pitch, yaw over time."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from tfbus.plot._style import line_styles, new_figure, shown
from tfbus.plot.series import Floats, Series, read_series
from tfbus.tree.tree import TransformTree

_NAMES = (("x [m]", "y [m]", "z [m]"), ("roll [deg]", "pitch [deg]", "yaw [deg]"))
_LEAST_SPAN = 1e-6
"""m and deg; smaller changes are those of rounding."""


def plot_transforms(
    tree: TransformTree | Sequence[tuple[str, TransformTree]],
    target: str,
    *sources: str,
    figure: Figure | None = None,
) -> Figure:
    """Draw the poses of some frames in another one over time.

    Parameters
    ----------
    tree : TransformTree, or sequence of (str, TransformTree)
        Several trees, such as two recordings, are drawn over each other, each from its own start and with its name in
        the legend.
    target : str
        The frame in which the poses are given.
    sources : str
        The frames that are drawn; at least one.
    figure : matplotlib.figure.Figure, optional
        Where to draw; by default a new figure, which no window shows.

    Returns
    -------
    matplotlib.figure.Figure
        With six axes. A line has a break where there is no answer, and where an angle passes 180 degrees.

    Raises
    ------
    TransformLookupError
        If a frame has no pose at any time.
    ValueError
        If there is no source.
    """
    drawn = labelled_series(tree, target, sources)
    result = new_figure(figure, 10.0, 6.5)
    axes = result.subplots(3, 2, sharex=True, squeeze=False)
    for (label, series), style in zip(drawn, line_styles(len(drawn)), strict=True):
        for column, values in enumerate((series.translations, _with_breaks(series.angles))):
            for row in range(3):
                axes[row, column].plot(series.seconds, values[:, row], label=label, linewidth=1.2, **style)
    for row in range(3):
        for column in range(2):
            axes[row, column].set_ylabel(_NAMES[column][row])
            axes[row, column].grid(alpha=0.3)
            low, high = axes[row, column].get_ylim()
            if high - low < _LEAST_SPAN:
                middle = (low + high) / 2.0
                axes[row, column].set_ylim(middle - _LEAST_SPAN / 2.0, middle + _LEAST_SPAN / 2.0)
    for column in range(2):
        axes[2, column].set_xlabel("time from the start [s]")
    result.suptitle(f"in {shown(target)}")
    result.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=min(len(drawn), 4))
    return result


def labelled_series(
    tree: TransformTree | Sequence[tuple[str, TransformTree]], target: str, sources: Sequence[str]
) -> list[tuple[str, Series]]:
    """The series of each source in each tree, with its text for the legend.

    Raises
    ------
    TransformLookupError, ValueError
        As `plot_transforms`.
    """
    if not sources:
        raise ValueError("there is no source: give the frames to draw")
    trees = [("", tree)] if isinstance(tree, TransformTree) else list(tree)
    if not trees:
        raise ValueError("there is no tree")
    return [
        (shown(f"{source}, {name}" if name else source), read_series(each, target, source))
        for name, each in trees
        for source in sources
    ]


def _with_breaks(angles: Floats) -> Floats:
    """The angles, with NaN after each jump of more than half a turn."""
    broken = angles.copy()
    with np.errstate(invalid="ignore"):
        jumps = np.abs(np.diff(angles, axis=0)) > 180.0
    broken[1:][jumps] = np.nan
    return broken
