"""Short ways to write samples of which only the parent, the stamp and x matter; histories, and trees without a bus."""

from collections.abc import Iterable
from typing import Any

from hypothesis import strategies as st

import tfbus
from tfbus import LATEST, Bus, FrameAdded, Latest, Transform, TransformStamped, TransformTree
from tfbus.rows import Row
from tfbus.tree.forest import Forest
from tfbus.tree.history import FrameHistory
from tfbus.tree.tree import tree_of as tree_on
from tfbus.tree.tree import window_of
from tfbus.waiting.live_tree import LiveTree


def moving(parent: str, child: str, stamp: int, x: float = 0.0, authority: str = "") -> TransformStamped:
    """A moving sample, `x` m along the first axis."""
    return TransformStamped(parent, child, stamp, Transform((x, 0.0, 0.0)), authority)


def static(parent: str, child: str, x: float = 0.0, stamp: int = 0, authority: str = "") -> TransformStamped:
    """A static sample, `x` m along the first axis."""
    return TransformStamped(parent, child, stamp, Transform((x, 0.0, 0.0)), authority, static=True)


def over(parent: str, child: str, stamps: Iterable[int], speed: float = 1.0) -> list[TransformStamped]:
    """Samples at some stamps, x going at `speed` m a ns."""
    return [moving(parent, child, stamp, speed * stamp) for stamp in stamps]


def any_samples(names: str, last: int) -> st.SearchStrategy[TransformStamped]:
    """Samples of either kind between any two of some one-letter frames, stamped 0 to `last`; quick to draw."""
    ends = st.tuples(st.sampled_from(names), st.sampled_from(names)).filter(lambda pair: pair[0] != pair[1])
    x = st.integers(0, 9).map(float)
    kinds = st.sampled_from((moving, static))
    stamps = st.integers(0, last)
    return st.builds(lambda kind, pair, stamp, x: kind(*pair, stamp=stamp, x=x), kinds, ends, stamps, x)


def tree_of(*batch: TransformStamped, keep: float | None = 10.0) -> TransformTree:
    """A tree with a batch in it."""
    tree = TransformTree(keep)
    tree.insert_many(batch)
    return tree


def x_of(tree: TransformTree, target: str, source: str, at: int | Latest = LATEST, **question: Any) -> float:
    """The x of a lookup, in m."""
    found: TransformStamped = tree.lookup(target, source, at, **question)
    return found.transform.translation[0]


def newest_samples(stored: Iterable[TransformStamped]) -> dict[str, TransformStamped]:
    """The newest sample of each child, of samples in the order of their arrival; the last kind wins."""
    newest: dict[str, TransformStamped] = {}
    for sample in stored:
        before = newest.get(sample.child)
        if before is None or before.static or sample.static or sample.stamp >= before.stamp:
            newest[sample.child] = sample
    return newest


def edges_of(bus: Bus) -> list[FrameAdded]:
    """The newest edges of a bus, in the order in which their children came."""
    with bus.events() as events:
        return [event for event in iter(events.queue.get, None) if isinstance(event, FrameAdded)]


def latched(bus: Bus) -> dict[str, TransformStamped]:
    """The static samples that a bus gives to late joiners."""
    got: list[tuple[TransformStamped, ...]] = []
    bus.subscribe(got.append).close()
    return {sample.child: sample for batch in got for sample in batch}


# Histories of single frames, and live trees without a bus


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
    """The number of samples that a history has memory for; some may have left its window."""
    if tfbus.kernel == "python":
        return len(history.stamps)
    return memoryview(history.columns(0, history.count)[0]).nbytes // 64


def static_edge(parent: str, child: str, transform: Transform, stamp: int = 0) -> FrameHistory:
    edge = FrameHistory(child, parent, static=True, keep=None)
    edge.insert_static(parent, stamp, row_of(transform), "")
    return edge


def live_tree(keep: float | None) -> LiveTree:
    """A live tree that the test fills; `keep` in s."""
    return LiveTree(Forest(window_of(keep)))


def tree_over(live: LiveTree) -> TransformTree:
    """The tree of a buffer that has this live tree."""
    return tree_on(live.forest, None)
