"""Histories of single frames, and live trees without a bus, for the tests of the modules below the buffer."""

from collections.abc import Iterable

import tfbus
from tfbus import Transform, TransformTree
from tfbus.rows import Row
from tfbus.tree.forest import Forest
from tfbus.tree.history import FrameHistory
from tfbus.tree.tree import tree_of, window_of
from tfbus.waiting.live_tree import LiveTree


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


# Live trees without a bus


def live_tree(keep: float | None) -> LiveTree:
    """A live tree that the test fills; `keep` in s."""
    return LiveTree(Forest(window_of(keep)))


def tree_over(live: LiveTree) -> TransformTree:
    """The tree of a buffer that has this live tree."""
    return tree_of(live.forest, None)
