"""Pictures of motions by matplotlib, from a tree such as a loaded recording.

`plot_transforms` draws coordinates over time, `plot_path` the paths of frames, and `plot_gaps` when each frame was
heard; each returns matplotlib's own figure. `sparklines` draws with letters. Needs ``pip install "tfbus[plot]"``.
"""

from tfbus.errors import pip_install

try:
    from tfbus.plot.gaps import plot_gaps
    from tfbus.plot.path import plot_path
    from tfbus.plot.transforms import plot_transforms
    from tfbus.plot.window import show_in_window
except ImportError as error:
    if error.name is None or error.name.startswith("tfbus"):
        raise
    raise ImportError(f"for plots, tfbus needs a package more: {pip_install('plot')} ({error})") from error
from tfbus.plot.reception import Reception, read_reception
from tfbus.plot.series import Series, read_series
from tfbus.plot.sparklines import sparklines

__all__ = [
    "Reception",
    "Series",
    "plot_gaps",
    "plot_path",
    "plot_transforms",
    "read_reception",
    "read_series",
    "show_in_window",
    "sparklines",
]
