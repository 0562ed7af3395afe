"""`plot_path`, which draws the paths that frames take."""

from collections.abc import Sequence

from matplotlib.figure import Figure

from tfbus.plot._style import line_styles, new_figure, shown
from tfbus.plot.transforms import labelled_series
from tfbus.tree.tree import TransformTree


def plot_path(
    tree: TransformTree | Sequence[tuple[str, TransformTree]],
    target: str,
    *sources: str,
    three_d: bool = False,
    figure: Figure | None = None,
) -> Figure:
    """Draw the paths of some frames in another one, seen from above or in three dimensions.

    A circle marks the start of each path, a square its end.

    Parameters
    ----------
    tree, target, sources, figure
        As `plot_transforms`.
    three_d : bool
        Whether to draw x, y and z; by default only x and y, with the same scale.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    TransformLookupError, ValueError
        As `plot_transforms`.
    """
    drawn = labelled_series(tree, target, sources)
    result = new_figure(figure, 7.0, 6.5)
    axes = result.add_subplot(projection="3d" if three_d else None)
    for (label, series), style in zip(drawn, line_styles(len(drawn)), strict=True):
        points = series.translations[:, : 3 if three_d else 2].T
        axes.plot(*points, label=label, linewidth=1.5, **style)
        known = points[:, ~(points != points).any(axis=0)]
        for place, marker in ((0, "o"), (-1, "s")):
            axes.plot(*known[:, place : place + 1 or None], marker=marker, color=style["color"], linestyle="none")
    axes.set_xlabel(f"x in {shown(target)} [m]")
    axes.set_ylabel(f"y in {shown(target)} [m]")
    if three_d:
        axes.set_zlabel(f"z in {shown(target)} [m]")  # type: ignore[attr-defined]
    axes.set_aspect("equal", adjustable="datalim" if not three_d else "box")
    axes.grid(alpha=0.3)
    axes.legend()
    return result
