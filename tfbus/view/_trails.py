"""Trails: the paths that frames took over the last seconds, as line segments."""

import numpy as np

from tfbus.errors import TransformLookupError
from tfbus.stamps import LATEST, from_seconds
from tfbus.tree.tree import TransformTree
from tfbus.view._scene import Floats

SAMPLES = 300
"""Points of a trail."""


def trail(tree: TransformTree, fixed: str, frame: str, at: int | None, duration: float) -> Floats:
    """The path of a frame in the fixed frame, over so many s before a stamp.

    Parameters
    ----------
    tree : TransformTree
    fixed, frame : str
    at : int or None
        The end, in ns; None for the newest stamp with an answer.
    duration : float
        In s.

    Returns
    -------
    array of shape (n, 2, 3)
        Line segments in m, with a break where there is no answer; none if the frame has no pose, or a static one.
    """
    nothing = np.empty((0, 2, 3), np.float32)
    try:
        if at is None:
            newest = tree.lookup(fixed, frame, LATEST)
            if newest.static:
                return nothing
            at = newest.stamp
        stamps = np.linspace(at - from_seconds(duration), at, SAMPLES).astype(np.int64)
        stamps[-1] = at
        found = tree.lookup_many(fixed, frame, stamps, out_of_range="nan")
    except TransformLookupError:
        return nothing
    points = found.translations.astype(np.float32)
    lines = np.stack((points[:-1], points[1:]), axis=1)
    return lines[np.isfinite(lines).all(axis=(1, 2))]
