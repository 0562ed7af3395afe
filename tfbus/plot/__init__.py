"""Pictures of motions by matplotlib, from a tree such as a loaded recording.

`plot_transforms` draws coordinates over time, `plot_path` the paths of frames, `plot_gaps` the times at which each
frame was heard, and `plot_errors` the errors of a comparison. Each returns a matplotlib figure, which a notebook shows.
`sparklines` draws with letters. Needs ``pip install "tfbus[plot]"``.
"""

from tfbus.errors import pip_install

try:
    from tfbus.plot.plots import plot_errors, plot_gaps, plot_path, plot_transforms, show_in_window
except ImportError as error:
    if error.name is None or error.name.startswith("tfbus"):
        raise
    raise ImportError(f"for plots, tfbus needs one more package: {pip_install('plot')} ({error})") from error
from tfbus.plot.plots import Reception, Series, read_reception, read_series, sparklines

__all__ = [
    "Reception",
    "Series",
    "plot_errors",
    "plot_gaps",
    "plot_path",
    "plot_transforms",
    "read_reception",
    "read_series",
    "show_in_window",
    "sparklines",
]
