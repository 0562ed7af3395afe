"""The bounded queue of samples, and the stream of batches that a task reads from one."""

from collections import deque
from collections.abc import Callable, Iterable
from typing import Literal

from tfbus._aio.task_groups import OneReaderStream
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.statistics import QueueStatistics

Overflow = Literal["conflate", "drop_oldest"]

TimedBatch = tuple[int, Batch]
"""The instant at which a batch was published, in ns, and the batch."""


def check_capacity(capacity: object, name: str = "capacity") -> None:
    """Raise `TypeError` or `ValueError` unless this is an int of at least one; `name` is for the error."""
    if isinstance(capacity, bool) or not isinstance(capacity, int):
        raise TypeError(f"{name} must be an int, not {capacity!r}")
    if capacity < 1:
        raise ValueError(f"{name} must be at least 1, got {capacity}")


class SampleQueue:
    """Batches in the order they came, or the newest sample of each child.

    Static samples are never dropped: they do not count towards the capacity, and the newest one of each child stays.

    Parameters
    ----------
    capacity : int
        How many moving samples may be pending, at least one; with ``"conflate"``, of how many children.
    overflow : {"conflate", "drop_oldest"}
        ``"conflate"`` keeps the newest sample of each child; when there are too many children, it drops the child that
        has waited longest. ``"drop_oldest"`` drops the oldest whole batches. It also does so when more than `capacity`
        batches are pending, because static samples alone would never fill the queue. The newest batch always stays.

    Attributes
    ----------
    dropped : int
        Moving samples lost to the capacity, or discarded with their frame or their time.
    conflated : int
        Moving samples that another sample of the same child has replaced; only with ``"conflate"``.
    """

    def __init__(self, capacity: int, overflow: Overflow) -> None:
        check_capacity(capacity)
        if overflow not in ("conflate", "drop_oldest"):
            raise ValueError(f"overflow must be 'conflate' or 'drop_oldest', not {overflow!r}")
        self.capacity = capacity
        self.overflow: Overflow = overflow
        self.dropped: int = 0
        self.conflated: int = 0
        # With "conflate", the newest sample of each child; with "drop_oldest", batches, and the static samples of
        # dropped batches.
        self._newest: dict[str, TransformStamped] = {}
        self._batches: deque[TimedBatch] = deque()
        self._kept: dict[str, tuple[int, TransformStamped]] = {}
        self._size = 0
        self._moving = 0

    def __len__(self) -> int:
        return len(self._newest) + len(self._kept) + self._size

    def put(self, batch: Batch, published: int = 0) -> None:
        """Add a batch, dropping what does not fit.

        Parameters
        ----------
        batch : tuple of TransformStamped
        published : int
            The instant of its publication in ns; only subclasses read it.
        """
        if self.overflow == "conflate":
            newest = self._newest
            for sample in batch:
                child, static = sample.child, sample.static
                pending = newest.get(child)
                if pending is None or pending.static:
                    self._moving += not static
                else:
                    self.conflated += 1
                    # The last kind wins; among moving samples, the newest stamp wins.
                    if static:
                        self._moving -= 1
                    elif sample.stamp < pending.stamp:
                        continue
                if pending is not None:
                    # The new one comes behind the others.
                    del newest[child]
                newest[child] = sample
            if self._moving > self.capacity:
                self._drop_children()
        else:
            self._batches.append((published, batch))
            self._size += len(batch)
            self._moving += _count_moving(batch)
            while max(self._moving, len(self._batches)) > self.capacity and len(self._batches) > 1:
                self._drop_batch()

    def get(self) -> Batch | None:
        """The next batch; with ``"conflate"``, all pending samples as one batch. None when there is nothing."""
        if self._newest:
            batch = tuple(self._newest.values())
            self._newest.clear()
            self._moving -= _count_moving(batch)
        elif self._kept:
            batch = tuple(sample for _, sample in self._kept.values())
            self._kept.clear()
        elif self._batches:
            _, batch = self._pop_batch()
        else:
            return None
        return batch

    def forget(self, child: str) -> None:
        """Take out every sample of a frame that has been removed; moving ones count as dropped."""
        self._kept.pop(child, None)
        pending = self._newest.pop(child, None)
        if pending is not None and not pending.static:
            self._moving -= 1
            self.dropped += 1
        if any(sample.child == child for _, batch in self._batches for sample in batch):
            before = self._moving
            self._keep_only(lambda sample: sample.child != child)
            self.dropped += before - self._moving

    def discard_moving(self) -> None:
        """Take out every moving sample, as when the clock jumps back; they count as dropped."""
        self.dropped += self._moving
        self._keep_only(lambda sample: sample.static)

    def statistics(self, kind: str) -> QueueStatistics:
        """The queue's counters; `kind` is its purpose."""
        return QueueStatistics(kind, self.overflow, self.capacity, len(self), self.dropped, self.conflated)

    def _drop_children(self) -> None:
        for child in [child for child, sample in self._newest.items() if not sample.static]:
            if self._moving <= self.capacity:
                return
            del self._newest[child]
            self._moving -= 1
            self.dropped += 1

    def _drop_batch(self) -> None:
        before = self._moving
        published, batch = self._pop_batch()
        moving = before - self._moving
        self.dropped += moving
        if moving < len(batch):
            for sample in batch:
                if sample.static:
                    self._keep_static(published, sample)

    def _pop_batch(self) -> TimedBatch:
        published, batch = self._batches.popleft()
        self._size -= len(batch)
        self._moving -= _count_moving(batch)
        return published, batch

    def _keep_static(self, published: int, sample: TransformStamped) -> None:
        # Behind the others, to keep the order of publication.
        self._kept.pop(sample.child, None)
        self._kept[sample.child] = published, sample

    def _keep_only(self, wanted: Callable[[TransformStamped], bool]) -> None:
        self._newest = {child: sample for child, sample in self._newest.items() if wanted(sample)}
        filtered = ((published, tuple(filter(wanted, batch))) for published, batch in self._batches)
        self._batches = deque((published, batch) for published, batch in filtered if batch)
        self._size = sum(len(batch) for _, batch in self._batches)
        self._moving = _count_moving(self._newest.values())
        self._moving += sum(_count_moving(batch) for _, batch in self._batches)


def _count_moving(samples: Iterable[TransformStamped]) -> int:
    return len([sample for sample in samples if not sample.static])


class Stream(OneReaderStream[Batch]):
    """The result of `Bus.stream`: ``async for batch in stream``, for one reader.

    The iteration ends when the bus or the stream is closed and all pending batches have been read.

    Examples
    --------
    >>> bus = Bus(SimulatedClock())
    >>> with bus.stream(overflow="conflate") as batches:
    ...     for stamp in range(3):
    ...         bus.publish(TransformStamped("map", "cart", stamp, Transform()))
    ...     async for batch in batches:
    ...         print([sample.stamp for sample in batch])
    ...         break
    [2]
    """

    def __init__(
        self,
        capacity: int,
        overflow: Overflow,
        check_thread: Callable[[], object],
        detach: Callable[["Stream"], object],
    ) -> None:
        super().__init__(check_thread, detach)
        self.queue: SampleQueue = SampleQueue(capacity, overflow)

    @property
    def dropped(self) -> int:
        """Number of moving samples that were dropped because the reader was too slow."""
        return self.queue.dropped

    def _next(self) -> Batch | None:
        return self.queue.get()
