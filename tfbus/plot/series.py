"""`Series`, the pose of one frame in another over time, as arrays to plot."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tfbus.stamps import SECOND, Stamps, time_between
from tfbus.tree.tree import TransformTree

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
    frames = set(tree.chain(target, source))
    edges = [edge for edge in tree.edges() if not edge.static and {edge.parent, edge.child} <= frames]
    return max((edge.oldest for edge in edges if edge.oldest is not None), default=newest), newest
