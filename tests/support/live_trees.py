"""Live trees without a bus."""

from tfbus import TransformTree
from tfbus.tree.forest import Forest
from tfbus.tree.tree import tree_of, window_of
from tfbus.waiting.live_tree import LiveTree


def live_tree(keep: float | None) -> LiveTree:
    """A live tree that the test fills; `keep` in s."""
    return LiveTree(Forest(window_of(keep)))


def tree_over(live: LiveTree) -> TransformTree:
    """The tree of a buffer that has this live tree."""
    return tree_of(live.forest, None)
