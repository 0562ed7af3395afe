"""Plots of recordings with matplotlib, and a `Series` as lines of letters for terminals.

`plot_transforms` draws x, y, z and roll, pitch, yaw over time; `plot_path` a path from above or in space; `plot_gaps`
the times at which each frame was heard, with its periods and delays.
"""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tfbus.plain import printable
from tfbus.recording.recording import RecordedMessage
from tfbus.stamps import SECOND, Stamps, time_between
from tfbus.tree.tree import TransformTree, moving_edges

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
"""The colours of M. Okabe and K. Ito, "Color Universal Design" (2008)."""
DASHES = ("-", "--", "-.", ":")


LONGEST_NAME = 60
"""The greatest length of a name in a figure: a legend with longer names leaves no room for the axes."""


def new_figure(figure: Figure | None, width: float, height: float) -> Figure:
    """The figure to draw in: the given one, or a new one of a size in inches."""
    return Figure(figsize=(width, height), layout="constrained") if figure is None else figure


def shown(name: str) -> str:
    """A name as the text of a figure: short, without formulas, and never a label that a legend leaves out."""
    text = printable(name)
    if len(text) > LONGEST_NAME:
        half = LONGEST_NAME // 2
        text = f"{text[: half - 1]}…{text[-half:]}"
    text = text.replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text


def line_styles(count: int) -> list[dict[str, Any]]:
    """The colours and dashes of `count` lines; the first 28 are all different."""
    colours = cycle(COLOURS)
    return [{"color": next(colours), "linestyle": DASHES[i // len(COLOURS) % len(DASHES)]} for i in range(count)]


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


def plot_gaps(reception: Mapping[str, Reception], figure: Figure | None = None) -> Figure:
    """Draw a strip for each frame that shows when it was heard, and histograms of all periods and delays.

    Parameters
    ----------
    reception : mapping of str to Reception
        By frame, as `read_reception` gives it; at least one.
    figure : matplotlib.figure.Figure, optional
        The figure to draw in; by default a new one, which no window shows.

    Returns
    -------
    matplotlib.figure.Figure
        With three axes: the strips, the periods and the delays. A strip has a break where a frame was silent for more
        than ``GAP`` times its median period.

    Raises
    ------
    ValueError
        If there is no frame.
    """
    if not reception:
        raise ValueError("there is no frame to draw")
    frames = list(reception.values())
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
    strips.set_yticks(range(len(frames)), [shown(name) for name in reception], fontsize=7)
    strips.set_ylim(len(frames) - 0.5, -0.5)
    strips.set_xlabel("time from the start [s]")
    strips.set_title("heard (static: dotted)")
    strips.grid(axis="x", alpha=0.3)
    _histogram(places["periods"], np.concatenate([frame.periods for frame in frames]), "period [ms]")
    _histogram(places["delays"], np.concatenate([frame.delays for frame in frames]), "delay [ms]")
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
    # A place inside of the axes that covers no path takes more than a second to find for a long recording.
    result.legend(loc="outside lower center", ncols=min(len(drawn), 4))
    return result
