"""`show_in_window`, which shows a figure on the screen."""

import os
from collections.abc import Callable

import matplotlib.pyplot as plt
from matplotlib.figure import Figure


def show_in_window(draw: Callable[[Figure], object]) -> None:
    """Open a window with a figure, and return when it is closed.

    Parameters
    ----------
    draw : callable
        Draws into the figure that it is given.

    Raises
    ------
    RuntimeError
        If matplotlib can open no window here.
    """
    if plt.get_backend().lower() == "agg":
        raise RuntimeError("matplotlib has no window here" if os.environ.get("DISPLAY") else "there is no display")
    draw(plt.figure(layout="constrained", figsize=(10.0, 6.5)))
    plt.show()
