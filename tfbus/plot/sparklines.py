"""`sparklines`, a plot of letters for a terminal."""

import numpy as np

from tfbus.plain import printable
from tfbus.plot.series import Floats, Series

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
