"""`plot_gaps`, which draws when each frame was heard, and how regularly."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tfbus.plot._style import COLOURS, new_figure, shown
from tfbus.plot.reception import Floats, Reception
from tfbus.stamps import SECOND, time_between

GAP = 3.0
"""A pause is a gap if it is longer than so many times the usual period of its frame."""
_BINS = 60


def plot_gaps(reception: Mapping[str, Reception], figure: Figure | None = None) -> Figure:
    """Draw a strip for each frame that shows when it was heard, and histograms of all periods and delays.

    Parameters
    ----------
    reception : mapping of str to Reception
        By frame, as `read_reception` gives it; at least one.
    figure : matplotlib.figure.Figure, optional
        Where to draw; by default a new figure, which no window shows.

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
