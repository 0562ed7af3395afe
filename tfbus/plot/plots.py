"""Plots of recordings with matplotlib, and a `Series` as lines of letters for terminals.

`plot_transforms` draws x, y, z and roll, pitch, yaw over time; `plot_path` a path from above or in space; `plot_gaps`
the times at which each frame was heard, with its periods and delays; `plot_errors` the errors of a comparison. Figures
belong to no window, and draw themselves in notebooks.
"""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from io import BytesIO
from itertools import cycle
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, MultipleLocator, NullFormatter, StrMethodFormatter

from tfbus.analysis.compare import Comparison
from tfbus.plain import printable
from tfbus.recording.recording import RecordedMessage
from tfbus.stamps import SECOND, Stamps, format_stamp, time_between
from tfbus.tree.tree import TransformTree, moving_edges

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
"""The colours of M. Okabe and K. Ito, "Color Universal Design" (2008)."""
DASHES = ("-", "--", "-.", ":")


_WIDEST = 5.0
"""The greatest width of a line, in points."""
_FIRST_YEAR = 1980

LONGEST_NAME = 60
"""The greatest length of a name in a figure: a legend with longer names leaves no room for the axes."""


class Picture(Figure):
    """A figure that a notebook shows, also while pyplot does not run."""

    def _repr_png_(self) -> bytes:
        picture = BytesIO()
        self.savefig(picture, format="png")
        return picture.getvalue()


def new_figure(figure: Figure | None, width: float, height: float) -> Figure:
    """The figure to draw in: the given one, or a new one of a size in inches."""
    return Picture(figsize=(width, height), layout="constrained") if figure is None else figure


def write_corner(axes: Axes, recording: str, start: int) -> None:
    """Write the name of the recording, and the date of a stamp (ns), above the right end of some axes."""
    since = datetime.fromtimestamp(start // SECOND, UTC)
    # A clock that began at zero tells no date.
    when = format_stamp(start) if since.year < _FIRST_YEAR else f"{since:%Y-%m-%d %H:%M:%S} UTC"
    text = f"start: {when}"
    axes.set_title(f"{shown(recording)}, {text}" if recording else text, loc="right", fontsize=7, color="0.4")


def shown(name: str) -> str:
    """A name as the text of a figure: short, without formulas, and never a label that a legend leaves out."""
    text = printable(name)
    if len(text) > LONGEST_NAME:
        half = LONGEST_NAME // 2
        text = f"{text[: half - 1]}…{text[-half:]}"
    text = text.replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text


def line_styles(count: int) -> list[dict[str, Any]]:
    """The colours, dashes and widths of `count` lines; the first 28 are all different.

    Each line is thinner than the lines below it, so that it does not hide them where they run together.
    """
    colours = cycle(COLOURS)
    widths = np.linspace(min(1.2 + 1.3 * (count - 1), _WIDEST), 1.2, count).tolist()
    return [
        {"color": next(colours), "linestyle": DASHES[i // len(COLOURS) % len(DASHES)], "linewidth": widths[i]}
        for i in range(count)
    ]


def show_in_window(draw: Callable[[Figure], object]) -> None:
    """Open a window with a figure, and return when it is closed.

    Parameters
    ----------
    draw : callable
        Draws into the figure that it is given.

    Raises
    ------
    RuntimeError
        If matplotlib cannot open a window here.
    """
    import matplotlib.pyplot as plt

    if plt.get_backend().lower() == "agg":
        raise RuntimeError("matplotlib has no window here" if os.environ.get("DISPLAY") else "there is no display")
    draw(plt.figure(layout="constrained", figsize=(10.0, 6.5)))
    plt.show()


Floats = npt.NDArray[np.float64]

SAMPLES = 2_000


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """The pose of `source` in `target` at n stamps; NaN where there is no answer.

    Parameters
    ----------
    target, source : str
    stamps : integer array of shape (n,)
        ns.
    seconds : array of shape (n,)
        The same in s, from the oldest moving sample of the whole tree.
    translations : array of shape (n, 3)
        x, y and z in m.
    angles : array of shape (n, 3)
        Roll, pitch and yaw in degrees, about fixed axes; from -180 to 180, pitch from -90 to 90.
    static : bool
        Whether the pose holds at every stamp.
    """

    target: str
    source: str
    stamps: Stamps
    seconds: Floats
    translations: Floats
    angles: Floats
    static: bool

    @property
    def start(self) -> int:
        """The stamp that `seconds` count from, in ns."""
        return int(self.stamps[0]) - round(float(self.seconds[0]) * SECOND)


def read_series(tree: TransformTree, target: str, source: str, samples: int = SAMPLES) -> Series:
    """The pose of a frame in another at equal intervals, over the span that all edges between the two cover.

    Parameters
    ----------
    tree : TransformTree
    target, source : str
    samples : int
        The number of stamps; at least two.

    Raises
    ------
    TransformLookupError
        If there is no answer at any stamp of the span.
    ValueError
        If there are less than two stamps.
    """
    if samples < 2:
        raise ValueError(f"a series has at least two samples, not {samples}")
    newest = tree.lookup(target, source)
    first, last = _span(tree)
    start, end = (first, last) if newest.static else _common_span(tree, target, source, newest.stamp)
    stamps = start + ((end - start) * np.arange(samples, dtype=object) // (samples - 1)).astype(np.int64)
    found = tree.lookup_many(target, source, stamps, out_of_range="nan")
    seconds = time_between(np.full_like(stamps, first), stamps).astype(np.float64) / SECOND
    return Series(target, source, stamps, seconds, found.translations, np.degrees(found.as_rpy()), newest.static)


def _span(tree: TransformTree) -> tuple[int, int]:
    """The oldest and the newest stamp of any moving frame; zero twice if all are static."""
    edges = [edge for edge in tree.edges() if edge.oldest is not None and edge.newest is not None]
    oldest = min((edge.oldest for edge in edges if edge.oldest is not None), default=0)
    return oldest, max((edge.newest for edge in edges if edge.newest is not None), default=0)


def _common_span(tree: TransformTree, target: str, source: str, newest: int) -> tuple[int, int]:
    """The span that all moving edges cover on the newest path."""
    edges = moving_edges(tree, target, source)
    return max((edge.oldest for edge in edges if edge.oldest is not None), default=newest), newest


@dataclass(frozen=True, slots=True, eq=False)
class Reception:
    """The times at which one frame was heard.

    Parameters
    ----------
    frame : str
    stamps : integer array of shape (n,)
        The stamps of its moving samples in the order of their arrival, in ns.
    received : integer array of shape (n,)
        The log times at which they arrived, in ns.
    static : bool
        Whether it has static samples only.
    """

    frame: str
    stamps: Stamps
    received: Stamps
    static: bool

    @property
    def periods(self) -> Floats:
        """The times between two successive stamps, in s, shape (m - 1,) for m different stamps."""
        stamps = np.unique(self.stamps)
        return time_between(stamps[:-1], stamps[1:]).astype(np.float64) / SECOND

    @property
    def delays(self) -> Floats:
        """The time from each stamp to its arrival, in s, shape (n,)."""
        return time_between(self.stamps, self.received).astype(np.float64) / SECOND


def read_reception(messages: Iterable[RecordedMessage]) -> dict[str, Reception]:
    """The reception of each frame, by frame, sorted by name.

    Parameters
    ----------
    messages : iterable of RecordedMessage
        Such as ``open_recording(path).messages()``.
    """
    stamps: dict[str, list[int]] = {}
    received: dict[str, list[int]] = {}
    for message in messages:
        for sample in message.batch:
            _, child, stamp, _, _, static = sample._fields
            times = stamps.setdefault(child, [])
            arrivals = received.setdefault(child, [])
            if not static:
                times.append(stamp)
                arrivals.append(message.received)
    return {
        frame: Reception(
            frame, np.array(stamps[frame], np.int64), np.array(received[frame], np.int64), not stamps[frame]
        )
        for frame in sorted(stamps)
    }


GAP = 3.0
"""A pause is a gap if it is longer than the usual period of its frame by this factor."""
_BINS = 60
_MANY_FRAMES = 20


def plot_gaps(reception: Mapping[str, Reception], figure: Figure | None = None, *, recording: str = "") -> Figure:
    """Draw a strip for each frame that shows when it was heard, and histograms of all periods and delays.

    Parameters
    ----------
    reception : mapping of str to Reception
        By frame, as `read_reception` gives it; at least one.
    figure : matplotlib.figure.Figure, optional
        The figure to draw in; by default a new one, which no window shows.
    recording : str
        The name of the recording, for the corner of the figure.

    Returns
    -------
    matplotlib.figure.Figure
        With three axes: the strips, the periods and the delays. A strip has a break where a frame was silent for more
        than ``GAP`` times its median period. Of more than 20 frames, the title counts the static ones, and
        only the moving ones have strips.

    Raises
    ------
    ValueError
        If there is no frame.
    """
    if not reception:
        raise ValueError("there is no frame to draw")
    drawn = reception
    if len(reception) > _MANY_FRAMES:
        drawn = {name: frame for name, frame in reception.items() if not frame.static} or reception
    left_out = len(reception) - len(drawn)
    frames = list(drawn.values())
    result = new_figure(figure, 11.0, 3.0 + 0.2 * len(frames))
    places = result.subplot_mosaic([["strips", "periods"], ["strips", "delays"]], width_ratios=[3, 1.3])
    arrivals = [frame.received for frame in frames if len(frame.received)]
    start = min((int(times.min()) for times in arrivals), default=0)
    end = max((int(times.max()) for times in arrivals), default=start)
    strips = places["strips"]
    for row, frame in enumerate(frames):
        if frame.static:
            strips.plot([0.0, (end - start) / SECOND], [row, row], color=COLOURS[0], linestyle=":", linewidth=2)
        for begin, length in spans_heard(frame):
            strips.plot(
                [(begin - start) / SECOND, (begin + length - start) / SECOND],
                [row, row],
                color=COLOURS[2],
                linewidth=5,
                solid_capstyle="butt",
            )
    strips.set_yticks(range(len(frames)), [shown(name) for name in drawn], fontsize=7)
    strips.set_ylim(len(frames) - 0.5, -0.5)
    strips.set_xlabel("time from the start [s]")
    strips.set_title(f"heard ({left_out} static frames: not drawn)" if left_out else "heard (static: dotted)")
    strips.grid(axis="x", alpha=0.3)
    _histogram(places["periods"], np.concatenate([frame.periods for frame in frames]), "period [ms]")
    _histogram(places["delays"], np.concatenate([frame.delays for frame in frames]), "delay [ms]")
    result.align_ylabels([places["periods"], places["delays"]])
    write_corner(places["periods"], recording, start)
    return result


def spans_heard(frame: Reception) -> list[tuple[int, int]]:
    """The begin and the length, in ns, of each time in which a frame was heard without a gap."""
    times = np.sort(frame.received)
    if not len(times):
        return []
    pauses = time_between(times[:-1], times[1:])
    usual = float(np.median(pauses)) if len(pauses) else 0.0
    breaks = np.flatnonzero(pauses > GAP * usual)
    begins = times[np.concatenate(([0], breaks + 1))]
    ends = times[np.concatenate((breaks, [len(times) - 1]))]
    return [(int(begin), int(end - begin)) for begin, end in zip(begins, ends, strict=True)]


def _histogram(axes: Axes, seconds: Floats, name: str) -> None:
    axes.hist(seconds * 1_000.0, bins=_BINS, color=COLOURS[0])
    axes.set_yscale("log", nonpositive="clip")
    axes.set_ylim(bottom=0.8)
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel(name)
    axes.set_ylabel("samples")
    axes.grid(alpha=0.3)


_LEVELS = "▁▂▃▄▅▆▇█"


def sparklines(series: Series, width: int = 60) -> str:
    """The pose of a frame over time, as six lines of block letters with their least and greatest values.

    Parameters
    ----------
    series : Series
    width : int
        The number of letters of each line; at least one. Where there is no answer, there is a blank.

    Raises
    ------
    ValueError
        If the width is less than one.
    """
    if width < 1:
        raise ValueError(f"a line has at least one letter, not {width}")
    places = np.linspace(0, len(series.seconds) - 1, width).round().astype(int)
    title = f"{series.source} in {series.target}, {series.seconds[0]:.3f} s to {series.seconds[-1]:.3f} s"
    lines = [printable(title)]
    rows = (
        zip(("x", "y", "z"), series.translations.T, strict=True),
        zip(("roll", "pitch", "yaw"), series.angles.T, strict=True),
    )
    for names, unit in zip(rows, ("m", "deg"), strict=True):
        for name, values in names:
            low, high = float(np.nanmin(values)), float(np.nanmax(values))
            lines.append(f"{name:>5}  {_letters(values[places], low, high)}  {low:z.3f} to {high:z.3f} {unit}")
    return "\n".join(lines)


def _letters(values: Floats, low: float, high: float) -> str:
    span = high - low
    letters = []
    for value in values.tolist():
        if value != value:
            letters.append(" ")
        elif span < 1e-9:
            letters.append(_LEVELS[0])
        else:
            letters.append(_LEVELS[min(int((value - low) / span * len(_LEVELS)), len(_LEVELS) - 1)])
    return "".join(letters)


_NAMES = (("x [m]", "y [m]", "z [m]"), ("roll [deg]", "pitch [deg]", "yaw [deg]"))
_LEAST_SPAN = 1e-6
"""In m and deg: smaller changes come from rounding."""


def plot_transforms(
    tree: TransformTree | Sequence[tuple[str, TransformTree]],
    target: str,
    *sources: str,
    recording: str = "",
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
    recording : str
        The name of the recording, for the corner of the figure, which has the date of the start as well.
    figure : matplotlib.figure.Figure, optional
        The figure to draw in; by default a new one, which no window shows.

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
                axes[row, column].plot(series.seconds, values[:, row], label=label, **style)
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
        result.align_ylabels(axes[:, column])
    for row in range(3):
        axes[row, 1].yaxis.set_major_locator(AngleLocator())
    axes[0, 0].set_title(f"Poses in {shown(target)}", loc="left")
    write_corner(axes[0, 1], recording, drawn[0][1].start)
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


class AngleLocator(MaxNLocator):
    """Ticks for degrees: multiples of 90 or 45 for angles of a turn, and otherwise parts of them."""

    def __init__(self) -> None:
        super().__init__(nbins=6, steps=[1, 1.5, 3, 5, 10])

    def tick_values(self, vmin: float, vmax: float) -> Any:
        """The ticks from one angle to another, in deg."""
        span = vmax - vmin
        for least, step in ((_TURN, 90.0), (_TURN / 3.0, 45.0)):
            if span > least:
                return MultipleLocator(step).tick_values(vmin, vmax)
        return super().tick_values(vmin, vmax)


_TURN = 270.0


def _with_breaks(angles: Floats) -> Floats:
    """The angles, with NaN after each jump of more than half a turn."""
    broken = angles.copy()
    with np.errstate(invalid="ignore"):
        jumps = np.abs(np.diff(angles, axis=0)) > 180.0
    broken[1:][jumps] = np.nan
    return broken


def plot_path(
    tree: TransformTree | Sequence[tuple[str, TransformTree]],
    target: str,
    *sources: str,
    three_d: bool = False,
    recording: str = "",
    figure: Figure | None = None,
) -> Figure:
    """Draw the paths of some frames in another one, seen from above or in three dimensions.

    A circle marks the start of each path, a square its end, as the legend says.

    Parameters
    ----------
    tree, target, sources, recording, figure
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
        axes.plot(*points, label=label, **style)
        known = points[:, ~(points != points).any(axis=0)]
        for place, marker in _ENDS.values():
            axes.plot(*known[:, place : place + 1 or None], marker=marker, color=style["color"], linestyle="none")
    axes.set_xlabel(f"x in {shown(target)} [m]")
    axes.set_ylabel(f"y in {shown(target)} [m]")
    if three_d:
        axes.set_zlabel(f"z in {shown(target)} [m]")  # type: ignore[attr-defined]
        # The layout does not count the label of the third axis.
        if result.get_layout_engine() is not None:
            result.set_layout_engine("constrained", rect=(0.0, 0.0, 0.93, 1.0))
        # A flat path leaves room for the numbers of its axis.
        low, high = axes.get_zlim()  # type: ignore[attr-defined]
        rise = max(high - low, max(np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())) / 4.0)
        axes.set_zlim((low + high - rise) / 2.0, (low + high + rise) / 2.0)  # type: ignore[attr-defined]
    axes.set_aspect("equal", adjustable="datalim" if not three_d else "box")
    axes.grid(alpha=0.3)
    write_corner(axes, recording, drawn[0][1].start)
    lines, names = axes.get_legend_handles_labels()
    lines += [Line2D([], [], color="0.4", linestyle="none", marker=marker) for _, marker in _ENDS.values()]
    # A place inside of the axes that covers no path takes more than a second to find for a long recording.
    result.legend(lines, [*names, *_ENDS], loc="outside lower center", ncols=min(len(drawn) + 2, 4))
    return result


_ENDS = {"start": (0, "o"), "end": (-1, "s")}
"""The place of each end of a path among its points, and its marker."""


def plot_errors(
    comparison: Comparison,
    title: str = "",
    *,
    names: tuple[str, str] = ("reference", "estimate"),
    figure: Figure | None = None,
) -> Figure:
    """Draw the absolute errors of a trajectory over time, and on the map.

    Parameters
    ----------
    comparison : Comparison
        As `tfbus.analysis.compare` gives it.
    title : str
        Such as the names of the frames.
    names : tuple of str
        Of the reference and of the estimate.
    figure : matplotlib.figure.Figure, optional
        The figure to draw in; by default a new one, which no window shows.

    Returns
    -------
    matplotlib.figure.Figure
        With three axes and a colour bar: the errors in m and in degrees with their RMSE and mean, and both paths, the
        estimate in the colours of its errors in m. The map shows the two coordinates in which the reference moves most.
    """
    errors, stamps = comparison.absolute, comparison.absolute.stamps
    start = int(stamps[0])
    seconds = time_between(np.full_like(stamps, start), stamps).astype(np.float64) / SECOND
    result = new_figure(figure, 11.0, 5.0)
    places = result.subplot_mosaic([["translation", "map"], ["rotation", "map"]], width_ratios=[1.1, 1.0])
    statistics = errors.statistics()
    for kind, values, of, factor, unit in (
        ("translation", errors.translation, statistics[0], 1.0, "m"),
        ("rotation", np.degrees(errors.rotation), statistics[1], 180.0 / np.pi, "deg"),
    ):
        axes = places[kind]
        axes.plot(seconds, values, color=COLOURS[0], linewidth=1.2)
        for name, value, style in (("RMSE", of.rmse, "-"), ("mean", of.mean, "--")):
            label = f"{name} {value * factor:.3g} {unit}"
            axes.axhline(value * factor, color=COLOURS[1], linestyle=style, linewidth=1.0, label=label, zorder=1.5)
        axes.set_ylabel(f"{kind} error [{unit}]")
        axes.set_ylim(0.0, max(float(values.max()) * 1.05, _LEAST_SPAN))
        _legend_above(axes)
        axes.grid(alpha=0.3)
    places["translation"].sharex(places["rotation"])
    places["translation"].tick_params(labelbottom=False)
    places["rotation"].set_xlabel("time from the first pose [s]")
    result.align_ylabels([places["translation"], places["rotation"]])
    wanted, found = comparison.reference.translations, comparison.estimate.translations
    across, up = sorted(np.argsort(np.ptp(wanted, axis=0), kind="stable")[-2:].tolist())
    chart = places["map"]
    chart.plot(wanted[:, across], wanted[:, up], color="0.5", linestyle="--", linewidth=1.2, label=shown(names[0]))
    points = found[:, [across, up]]
    line = LineCollection(list(np.stack((points[:-1], points[1:]), axis=1)), linewidths=2.0)
    line.set_array((errors.translation[:-1] + errors.translation[1:]) / 2.0)
    chart.add_collection(line)
    chart.plot([], [], color=line.get_cmap()(0.5), linewidth=2.0, label=shown(names[1]))
    chart.autoscale_view()
    result.colorbar(line, ax=chart, label="translation error [m]", shrink=0.8)
    chart.set_xlabel(f"{'xyz'[across]} [m]")
    chart.set_ylabel(f"{'xyz'[up]} [m]")
    chart.set_aspect("equal", adjustable="datalim")
    chart.grid(alpha=0.3)
    _legend_above(chart)
    alignment = comparison.alignment
    how = "not aligned" if alignment is None else "aligned"
    if alignment is not None and alignment.scale != 1.0:
        how = f"aligned and scaled by {alignment.scale:.6g}"
    heading = f"{shown(names[1])} against {shown(names[0])}, {how}"
    result.suptitle(f"{shown(title)}: {heading}" if title else heading)
    write_corner(chart, "", start)
    return result


def _legend_above(axes: Axes) -> None:
    """A legend that hides nothing, above the left end of the axes."""
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2, ncols=2, frameon=False, fontsize=8)
