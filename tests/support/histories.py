"""Histories of single frames, for the tests of the modules below the forest."""

from collections.abc import Iterable

import tfbus
from tfbus import Transform
from tfbus.rows import Row
from tfbus.tree.history import FrameHistory


def at_x(x: float) -> Transform:
    """A translation of `x` m along the first axis."""
    return Transform((x, 0.0, 0.0))


def row_of(transform: Transform) -> Row:
    return *transform.translation, *transform.rotation


def moving_edge(
    parent: str, child: str, samples: Iterable[tuple[int, Transform]] = (), keep: int | None = None
) -> FrameHistory:
    """A moving edge with its samples, in the order of insertion; `keep` in ns."""
    edge = FrameHistory(child, parent, static=False, keep=keep)
    for stamp, transform in samples:
        edge.insert(parent, stamp, row_of(transform), "")
    return edge


def held(history: FrameHistory) -> int:
    """The number of samples that a history has memory for, those that have left its window included."""
    if tfbus.kernel == "python":
        return len(history.stamps)
    return memoryview(history.columns(0, history.count)[0]).nbytes // 64


def static_edge(parent: str, child: str, transform: Transform, stamp: int = 0) -> FrameHistory:
    edge = FrameHistory(child, parent, static=True, keep=None)
    edge.insert_static(parent, stamp, row_of(transform), "")
    return edge
