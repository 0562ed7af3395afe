"""What a bus sees of a buffer: it puts batches into the tree and wakes the lookups that they can have unblocked.

Sans-IO like the tree and the index that it joins: waking is calling what each waiter brought along.
"""

from collections.abc import Iterable

from tfbus.errors import ClockResetError, UnknownFrameError
from tfbus.stamped import Batch
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
        self.tree = TransformTree(keep)
        self.waiting = WaitingIndex()
        self.ended = ""
        self.last_reset: ClockResetError | None = None
        self._blocked = self.waiting.blocked

    def receive(self, batch: Batch) -> None:
        """Insert a batch that the bus has judged, and wake whom it can have unblocked."""
        blocked = self._blocked
        if not blocked:
            self.tree.commit(batch)
            return
        before = self.tree.commit(batch)
        forest = self.tree.forest
        if before is not None and forest.structure_version != before[0]:
            _wake(self.waiting.take_all())
            return
        for sample in batch:
            fields = sample._fields
            if fields[1] in blocked:
                _wake(self.waiting.take(fields[1], fields[2]))
        if before is not None and forest.edges_version != before[1]:
            for sample in batch:
                _wake(self.waiting.take(sample.parent, None))

    def remove_frame(self, frame: str) -> None:
        """Forget a frame, if it is known; lookups that wait learn of it."""
        try:
            self.tree.remove_frame(frame)
        except UnknownFrameError:
            return
        _wake(self.waiting.take_all())

    def reset(self, before: int, after: int) -> None:
        """Drop moving samples: the clock has jumped back. Lookups that wait get a `ClockResetError`."""
        self.tree.clear()
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


def _wake(waiters: Iterable[Waiter]) -> None:
    for waiter in waiters:
        waiter.wake()
