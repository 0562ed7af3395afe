"""What a bus sees of a buffer: it puts batches into the tree and wakes the lookups and watches that they concern.

Sans-IO like the tree and the indexes that it joins: waking is calling what each waiter brought along.
"""

import logging
from collections.abc import Callable, Iterable
from contextlib import suppress

from tfbus.errors import ClockResetError, UnknownFrameError
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.registration import Registration
from tfbus.statistics import BufferStatistics
from tfbus.tree.history import Outcome
from tfbus.tree.tree import TransformTree
from tfbus.waiting.waiting_index import Waiter, WaitingIndex
from tfbus.waiting.watch_index import Watched, WatchIndex


class LiveTree:
    """A tree, the lookups that wait for it, and the watches that follow it.

    Parameters
    ----------
    keep : float or None
        As `TransformTree`.

    Attributes
    ----------
    tree : TransformTree
    waiting : WaitingIndex
    watching : WatchingIndex
    ended : str
        Why nothing more will come; empty while it may.
    last_reset : ClockResetError or None
        The last jump back of the clock; another object for each.
    """

    def __init__(self, keep: float | None) -> None:
        self.tree: TransformTree = _FedTree(keep)
        self.waiting = WaitingIndex()
        self.watching = WatchIndex()
        self.ended = ""
        self.last_reset: ClockResetError | None = None
        self._blocked = self.waiting.blocked
        self._watched = self.watching.under
        self._at_end: dict[Registration, Callable[[], object]] = {}

    def prefill(self, tree: TransformTree) -> None:
        """Start with what another tree holds, as far back as this one keeps it; before anything is received."""
        TransformTree.adopt(self.tree, tree)

    def receive(self, batch: Batch) -> None:
        """Insert a batch that the bus has judged, and wake whom it can have unblocked and who watches it."""
        blocked = self._blocked
        plain = self.tree.commit(batch)
        if blocked:
            for sample in batch:
                fields = sample._fields
                if fields[1] in blocked:
                    _wake(self.waiting.take(fields[1], fields[2]))
        if self._watched:
            _wake(self.watching.flag([sample._fields[1] for sample in batch]))
        if not plain:
            self._wake_for_the_shape()

    def _wake_for_the_shape(self) -> None:
        """Wake whom a new edge, another parent or kind, or a longer past can have unblocked."""
        forest = self.tree.forest
        if self._blocked:
            for name in forest.joined:
                _wake(self.waiting.take(name, None))
        if forest.changed and (self._blocked or self._watched):
            concerned = forest.below(forest.changed)
            _wake(self.waiting.take_asking(concerned))
            _wake(self.watching.flag_asking(concerned))
        forest.forget_changes()

    def remove_frame(self, frame: str) -> None:
        """Forget a frame, if it is known; lookups that wait learn of it, and who watches it."""
        forest = self.tree.forest
        parents = forest.frames[frame].mentioned if frame in forest.frames else ()
        try:
            TransformTree.remove_frame(self.tree, frame)
        except UnknownFrameError:
            return
        if self._blocked:
            gone = {name for name in parents if name not in forest.names}
            below = forest.below({frame}) if frame in forest.names else {frame}
            _wake(self.waiting.take_asking(below | gone))
        _wake(self.watching.flag((frame,)))

    def reset(self, before: int, after: int) -> None:
        """Drop moving samples: the clock has jumped back. Lookups that wait get a `ClockResetError`, and watches."""
        TransformTree.clear(self.tree)
        self.last_reset = ClockResetError(before=before, after=after)
        _wake(self.waiting.take_all())
        _wake(self.watching.reset(self.last_reset))

    def end(self, reason: str) -> None:
        """Wake every waiter for the last time: nothing more will come."""
        self.ended = self.ended or reason
        _wake(self.waiting.take_all())
        _wake(self.watching.end())

    def tell_the_end(self) -> None:
        """Call whoever asked to hear of the end, once; what one of them raises, nobody else notices."""
        while self._at_end:
            registration = next(iter(self._at_end))
            callback = self._at_end.pop(registration)
            try:
                callback()
            except Exception as error:
                logging.getLogger("tfbus").warning("what was to be called at the end raised", exc_info=error)

    def on_end(self, callback: Callable[[], object]) -> Registration:
        """Have `tell_the_end` call this, or call it now if the end was; closing the registration takes it back."""
        registration = Registration(lambda: self._at_end.pop(registration, None))
        if self.ended:
            callback()
        else:
            self._at_end[registration] = callback
        return registration

    @property
    def anyone_waits(self) -> bool:
        """Whether somebody has to be told on the event loop of what comes, or of the end."""
        return bool(self.waiting) or self.watching.anyone_waits or bool(self._at_end)

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

    def adopt(self, other: TransformTree) -> None:  # noqa: ARG002
        raise RuntimeError("a bus feeds this tree: have another one adopt it")


def _wake(waiters: Iterable[Waiter | Watched]) -> None:
    for waiter in waiters:
        # The event loop of one that was never cancelled may be gone; the others are waiting all the same.
        with suppress(RuntimeError):
            waiter.wake()
