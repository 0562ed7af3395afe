"""What a bus sees of a buffer: it puts batches into the tree and wakes the lookups that they can have unblocked.

Sans-IO like the tree and the index that it joins: waking is calling what each waiter brought along.
"""

from collections.abc import Iterable
from contextlib import suppress

from tfbus.errors import ClockResetError, UnknownFrameError
from tfbus.history import Outcome
from tfbus.stamped import Batch, TransformStamped
from tfbus.statistics import BufferStatistics
from tfbus.tree import TransformTree
from tfbus.waiting import Waiter, WaitingIndex


class Feed:
    """A tree and the lookups that wait for it.

    Parameters
    ----------
    keep : float or None
        As `TransformTree`.

    Attributes
    ----------
    tree : TransformTree
    waiting : WaitingIndex
    ended : str
        Why nothing more will come; empty while it may.
    last_reset : ClockResetError or None
        The last jump back of the clock; another object for each.
    """

    def __init__(self, keep: float | None) -> None:
        self.tree: TransformTree = _FedTree(keep)
        self.waiting = WaitingIndex()
        self.ended = ""
        self.last_reset: ClockResetError | None = None
        self._blocked = self.waiting.blocked

    def receive(self, batch: Batch) -> None:
        """Insert a batch that the bus has judged, and wake whom it can have unblocked."""
        blocked = self._blocked
        plain = self.tree.commit(batch)
        if blocked:
            for sample in batch:
                fields = sample._fields
                if fields[1] in blocked:
                    _wake(self.waiting.take(fields[1], fields[2]))
        if not plain:
            self._wake_for_the_shape()

    def _wake_for_the_shape(self) -> None:
        """Wake whom a new edge, another parent or kind, or a longer past can have unblocked."""
        forest = self.tree.forest
        if self._blocked:
            for name in forest.joined:
                _wake(self.waiting.take(name, None))
            if forest.changed:
                _wake(self.waiting.take_asking(forest.below(forest.changed)))
        forest.forget_changes()

    def remove_frame(self, frame: str) -> None:
        """Forget a frame, if it is known; lookups that wait learn of it."""
        try:
            TransformTree.remove_frame(self.tree, frame)
        except UnknownFrameError:
            return
        _wake(self.waiting.take_all())

    def reset(self, before: int, after: int) -> None:
        """Drop moving samples: the clock has jumped back. Lookups that wait get a `ClockResetError`."""
        TransformTree.clear(self.tree)
        self.last_reset = ClockResetError(before=before, after=after)
        _wake(self.waiting.take_all())

    def end(self, reason: str) -> None:
        """Wake every waiter for the last time: nothing more will come."""
        self.ended = self.ended or reason
        _wake(self.waiting.take_all())

    def statistics(self, offered: int) -> BufferStatistics:
        """Counters; how many samples it was offered, the bus knows."""
        tree = self.tree
        return BufferStatistics(offered, tree.inserted, tree.replaced, tree.expired, len(self.waiting))


class _FedTree(TransformTree):
    """A tree that only its bus changes: what somebody else put in would wake nobody."""

    def insert_many(self, samples: Iterable[TransformStamped]) -> list[Outcome]:  # noqa: ARG002
        raise RuntimeError("a bus feeds this tree: use bus.publish, or a copy() of the tree")

    def remove_frame(self, frame: str) -> None:  # noqa: ARG002
        raise RuntimeError("a bus feeds this tree: use bus.remove_frame, or a copy() of the tree")

    def clear(self) -> None:
        raise RuntimeError("a bus feeds this tree: clear a copy() of it")


def _wake(waiters: Iterable[Waiter]) -> None:
    for waiter in waiters:
        # The event loop of one that was never cancelled may be gone; the others are waiting all the same.
        with suppress(RuntimeError):
            waiter.wake()
