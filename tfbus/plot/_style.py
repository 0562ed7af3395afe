"""The style of all figures: colours that people tell apart with any colour vision, and the axes of time."""

from itertools import cycle
from typing import Any

from matplotlib.figure import Figure

from tfbus.plain import printable

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
"""Of M. Okabe and K. Ito, "Color Universal Design" (2008)."""
DASHES = ("-", "--", "-.", ":")


LONGEST_NAME = 60
"""Letters of a name in a figure; a legend with longer ones leaves no room for the axes."""


def new_figure(figure: Figure | None, width: float, height: float) -> Figure:
    """The figure to draw in: the given one, or a new one of a size in inches."""
    return Figure(figsize=(width, height), layout="constrained") if figure is None else figure


def shown(name: str) -> str:
    """A name as the text of a figure: short, with no formula in it, and none of the labels that a legend leaves out."""
    text = printable(name)
    if len(text) > LONGEST_NAME:
        half = LONGEST_NAME // 2
        text = f"{text[: half - 1]}…{text[-half:]}"
    text = text.replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text


def line_styles(count: int) -> list[dict[str, Any]]:
    """The colour and the dashes of so many lines; no two of the first 28 are alike."""
    colours = cycle(COLOURS)
    return [{"color": next(colours), "linestyle": DASHES[i // len(COLOURS) % len(DASHES)]} for i in range(count)]
