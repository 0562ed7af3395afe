"""Messages of several streams that belong together, by their stamps.

A camera and a laser have no common trigger: their stamps never agree. A *set* has one message of each stream, and its
*width* is the time between the oldest and the newest one. The sets are those of the algorithm ``ApproximateTime`` of
ROS's message_filters, with an age penalty of zero:

* Look at the oldest message of each stream. The newest of these is the *pivot*: no set without it can begin earlier.
* Of all sets with the pivot, take the narrowest. Each stream gives its last message before the pivot or its first one
  after it. The first one after the pivot may not have come yet; then wait, unless it can be no nearer.
* If the narrowest set is too wide, the oldest message belongs to none: drop it, and look again. Otherwise deliver the
  set, and drop the messages before those in it.

::

    camera   1 . . . 2 . . . 3          the pivot is b: 1 is 2 before it, 2 is 2 after it
    laser    . . b . . . c . . .        (1, b) comes first; of two equal ones the earlier is taken
"""

from collections import Counter, deque
from collections.abc import AsyncIterable, Callable, Iterator, Sequence
from operator import attrgetter
from types import TracebackType
from typing import Any, Literal, NamedTuple

import anyio
import anyio.abc

from tfbus._aio.loops import checkpoint
from tfbus._aio.task_groups import OneReader, close_task_group, raise_unchanged, read_source
from tfbus.buffer.buffer import Buffer
from tfbus.bus.queues import check_capacity
from tfbus.errors import TransformError
from tfbus.geometry.stamped import TransformStamped
from tfbus.registration import AsyncOnly
from tfbus.stamps import SECOND, STAMP_MAX, STAMP_MIN, as_duration, as_stamp, from_seconds

SetDropReason = Literal["no partner", "out of order", "queue full", "no transform", "closed"]


_NEVER = STAMP_MAX + 1
"""The stamp of a message that has not come."""


class SynchronizedSet(NamedTuple):
    """Messages that belong together, with the transforms of their stamps.

    Attributes
    ----------
    messages : tuple
        One of each stream, in the order of the streams.
    transforms : tuple of TransformStamped
        From the frame of each message into the target.

    Examples
    --------
    >>> SynchronizedSet(("an image", "a scan"), ()).messages[1]
    'a scan'
    """

    messages: tuple[Any, ...]
    transforms: tuple[TransformStamped, ...]


class _Entry(NamedTuple):
    stamp: int
    message: Any


class Matching:
    """Finds the sets; it knows neither tasks nor clocks.

    Parameters
    ----------
    within : int
        The greatest width of a set, in ns.
    spacing : sequence of int
        The least time between two messages of each stream, in ns.
    drop : callable
        Called with the number of a stream, a message of it that belongs to no set, and the reason.
    """

    def __init__(self, within: int, spacing: Sequence[int], drop: Callable[[int, Any, SetDropReason], object]) -> None:
        self.queues: list[deque[_Entry]] = [deque() for _ in spacing]
        self._within = within
        self._spacing = spacing
        self._drop = drop
        self._newest = [STAMP_MIN] * len(spacing)
        self._ended = [False] * len(spacing)

    @property
    def exhausted(self) -> bool:
        """Whether no further set can be found."""
        return any(ended and not queue for ended, queue in zip(self._ended, self.queues, strict=True))

    def add(self, stream: int, stamp: int, message: Any) -> None:
        """Add a message; one with an older stamp than another of its stream is dropped."""
        if stamp < self._newest[stream]:
            self._drop(stream, message, "out of order")
            return
        self._newest[stream] = stamp
        self.queues[stream].append(_Entry(stamp, message))

    def end(self, stream: int) -> None:
        """Note that a stream has no further message."""
        self._ended[stream] = True

    def drop_oldest(self, stream: int, reason: SetDropReason) -> None:
        """Drop the oldest message of a stream."""
        self._drop(stream, self.queues[stream].popleft().message, reason)

    def sets(self) -> Iterator[tuple[Any, ...]]:
        """Take out the sets that are certain now."""
        while all(self.queues):
            pivot = max(queue[0].stamp for queue in self.queues)
            for stream, queue in enumerate(self.queues):
                # Its last message up to the pivot is nearer to this pivot, and to all later ones.
                while len(queue) > 1 and queue[1].stamp <= pivot:
                    self.drop_oldest(stream, "no partner")
            known = [(queue[0].stamp, queue[1].stamp if len(queue) > 1 else _NEVER) for queue in self.queues]
            width, later = _narrowest(pivot, known)
            # The width if each message that may still come has its best possible stamp.
            hoped = [self._hoped(stream, pivot, *stamps) for stream, stamps in enumerate(known)]
            least, _ = _narrowest(pivot, hoped)
            if least > self._within:
                oldest = min(range(len(self.queues)), key=lambda stream: self.queues[stream][0].stamp)
                self.drop_oldest(oldest, "no partner")
                continue
            if least < width or any(
                _distance(pivot, *best) < _distance(pivot, *stamps) for best, stamps in zip(hoped, known, strict=True)
            ):
                return
            found = []
            for stream, is_later in enumerate(later):
                if is_later:
                    self.drop_oldest(stream, "no partner")
                found.append(self.queues[stream].popleft().message)
            yield tuple(found)

    def _hoped(self, stream: int, pivot: int, before: int, after: int) -> tuple[int, int]:
        if after != _NEVER or self._ended[stream]:
            return before, after
        earliest = before + self._spacing[stream]
        return (pivot, _NEVER) if earliest <= pivot else (before, earliest)


def _distance(pivot: int, before: int, after: int) -> int:
    return min(pivot - before, after - pivot)


def _narrowest(pivot: int, around: Sequence[tuple[int, int]]) -> tuple[int, list[bool]]:
    """The width of the narrowest set with the pivot, and the streams that give their first message after it.

    `around` has the stamps of the last message up to the pivot and of the first one after it, for each stream.
    """
    # A set that ends at some stamp begins with the oldest of the streams whose later message comes after that.
    ends = {pivot, *(after for _, after in around if after != _NEVER)}
    width, end = min((end - min(pivot if after <= end else before for before, after in around), end) for end in ends)
    # Of two messages that fit in there, take the nearer one.
    return width, [
        after <= end and (before < end - width or after - pivot < pivot - before) for before, after in around
    ]


class Synchronizer(AsyncOnly):
    """Sets of messages of several streams with nearly the same stamps, each once.

    ``async with Synchronizer(images, scans, within=0.05) as sets: async for image, scan in sets``. Every message is
    delivered in one set or dropped once, and no drop is silent: `dropped` counts them by stream and reason, and
    `on_drop` is called for each.

    Parameters
    ----------
    *streams : async iterable
        At least two; each gives its messages in the order of their stamps. Leaving the ``async with`` closes an async
        generator for good, but no other stream.
    within : float
        The greatest time between the stamps of a set, in s.
    offsets : sequence of float, optional
        Added to the stamps of each stream, in s, such as the known latency of a camera with the opposite sign. The
        messages keep their stamps.
    spacing : float, or sequence of float
        The least time between two messages of a stream, in s, for all streams or for each. With it a set need not wait
        for the next message of a stream, which might be nearer: give a little less than the period.
    stamp : callable, optional
        Gives the stamp of a message in ns; by default its attribute `stamp`.
    capacity : int
        How many messages of each stream may wait for the others, and how many sets for the reader.
    block : bool
        Whether a stream is not read while it is full, as for a recording, which does not wait by itself. By default the
        oldest message, or set, is dropped.
    buffer, target : Buffer and str, optional
        Give both to get a `SynchronizedSet` for each set: its messages, and the transforms from their frames into the
        target at their own stamps. Then messages need an attribute `frame` too.
    timeout : float, optional
        The longest wait for the transforms of a set, in s on the bus's clock; None waits for ever.
    on_drop : callable, optional
        Called with the number of the stream, the message and the reason. It must not raise.

    Raises
    ------
    TypeError, ValueError
        If an argument is of the wrong type, negative, or of another length than the streams.

    Notes
    -----
    The reasons are ``"no partner"``, ``"out of order"`` (older than another of its stream), ``"queue full"``,
    ``"no transform"`` (its set was complete, but there is none of one of its messages, or not in time) and
    ``"closed"``.

    The iteration ends when a stream has ended and no further set is possible. An error of a stream is raised unchanged
    by the iteration, after the sets that are ready.

    Examples
    --------
    >>> async def points(frame: str, *stamps: int):
    ...     for stamp in stamps:
    ...         yield PointStamped(frame, stamp, (1.0, 0.0, 0.0))
    >>> async with Synchronizer(points("camera", 100, 200), points("laser", 103, 199), within=1e-8) as sets:
    ...     print([(image.stamp, scan.stamp) async for image, scan in sets])
    [(100, 103), (200, 199)]
    """

    def __init__(
        self,
        *streams: AsyncIterable[Any],
        within: float,
        offsets: Sequence[float] | None = None,
        spacing: float | Sequence[float] = 0.0,
        stamp: Callable[[Any], int] | None = None,
        capacity: int = 100,
        block: bool = False,
        buffer: Buffer | None = None,
        target: str | None = None,
        timeout: float | None = None,
        on_drop: Callable[[int, Any, SetDropReason], object] | None = None,
    ) -> None:
        if len(streams) < 2:
            raise ValueError(f"there must be at least two streams, got {len(streams)}")
        for stream in streams:
            if not isinstance(stream, AsyncIterable):
                raise TypeError(f"a stream must be an async iterable, not {stream!r}")
        if (buffer is None) is not (target is None):
            raise TypeError("give both buffer and target, or neither")
        check_capacity(capacity)
        waits = list(spacing) if isinstance(spacing, Sequence) else [spacing] * len(streams)
        moves = [0.0] * len(streams) if offsets is None else list(offsets)
        for name, values in (("spacing", waits), ("offsets", moves)):
            if len(values) != len(streams):
                raise ValueError(f"{name} must have one number for each of {len(streams)} streams, got {len(values)}")
        self._streams = streams
        self._offsets = [from_seconds(offset) for offset in moves]
        least = [from_seconds(as_duration(each, "spacing")) for each in waits]
        self._matching = Matching(from_seconds(as_duration(within, "within")), least, self._dropped)
        self._stamp: Callable[[Any], int] = stamp or attrgetter("stamp")
        # A set may need the message behind the one that waits.
        self._capacity = max(capacity, 2) if block else capacity
        self._block = block
        self._buffer = buffer
        self._target = target
        self._timeout = timeout
        self._on_drop = on_drop
        self._ready: deque[tuple[Any, ...]] = deque()
        self._counts: list[Counter[SetDropReason]] = [Counter() for _ in streams]
        self._delivered = 0
        self._tasks: anyio.abc.TaskGroup | None = None
        self._error: BaseException | None = None
        self._reader = OneReader()
        self._room = anyio.Event()
        self._warn_unless_entered()

    @property
    def delivered(self) -> int:
        """Number of sets that the reader has got."""
        return self._delivered

    @property
    def dropped(self) -> tuple[Counter[SetDropReason], ...]:
        """Number of dropped messages of each stream by reason; copies."""
        return tuple(counts.copy() for counts in self._counts)

    async def __aenter__(self) -> "Synchronizer":
        self._enter_once()
        self._tasks = await anyio.create_task_group().__aenter__()
        for number, stream in enumerate(self._streams):
            self._tasks.start_soon(self._read, number, stream)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        assert self._tasks is not None
        self._tasks.cancel_scope.cancel()
        try:
            await close_task_group(self._tasks)
        finally:
            while self._ready:
                self._drop_set("closed")
            for stream, queue in enumerate(self._matching.queues):
                while queue:
                    self._matching.drop_oldest(stream, "closed")
        if error is None:
            self._raise_error()

    def __aiter__(self) -> "Synchronizer":
        return self

    async def __anext__(self) -> Any:
        if self._tasks is None:
            raise RuntimeError("enter the synchronizer first: async with Synchronizer(...) as sets")
        with self._reader:
            await checkpoint()
            while True:
                while not self._ready:
                    self._raise_error()
                    if self._matching.exhausted:
                        raise StopAsyncIteration
                    await self._reader.wait()
                if self._buffer is None:
                    return self._take()
                # The set stays in the queue meanwhile, because this task may be cancelled.
                messages = self._ready[0]
                try:
                    transforms = await self._transforms(messages)
                except TransformError:
                    if self._ready and self._ready[0] is messages:
                        self._drop_set("no transform")
                        self._make_room()
                else:
                    if self._ready and self._ready[0] is messages:
                        return SynchronizedSet(self._take(), transforms)

    def _take(self) -> tuple[Any, ...]:
        self._delivered += 1
        messages = self._ready.popleft()
        self._make_room()
        return messages

    async def _transforms(self, messages: tuple[Any, ...]) -> tuple[TransformStamped, ...]:
        assert self._buffer is not None
        assert self._target is not None
        clock = self._buffer.bus.clock
        end = None if self._timeout is None else clock.now() + from_seconds(self._timeout)
        found = []
        for message in messages:
            left = None if end is None else max(0.0, (end - clock.now()) / SECOND)
            found.append(await self._buffer.lookup(self._target, message.frame, message.stamp, timeout=left))
        return tuple(found)

    async def _read(self, number: int, stream: AsyncIterable[Any]) -> None:
        async def take(message: Any) -> None:
            self._accept(number, message)
            await checkpoint()
            while self._block and (
                len(self._matching.queues[number]) >= self._capacity or len(self._ready) >= self._capacity
            ):
                await self._room.wait()

        error = await read_source(stream, take)
        self._error = self._error or error
        self._matching.end(number)
        self._match()
        self._reader.wake()

    def _accept(self, number: int, message: Any) -> None:
        stamp = as_stamp(self._stamp(message)) + self._offsets[number]
        if not self._block and len(self._matching.queues[number]) >= self._capacity:
            self._matching.drop_oldest(number, "queue full")
        self._matching.add(number, stamp, message)
        self._match()

    def _match(self) -> None:
        found = False
        for messages in self._matching.sets():
            if not self._block and len(self._ready) >= self._capacity:
                self._drop_set("queue full")
            self._ready.append(messages)
            found = True
        self._make_room()
        if found or self._matching.exhausted:
            self._reader.wake()

    def _make_room(self) -> None:
        """Let the streams that wait look again."""
        if self._block:
            self._room.set()
            self._room = anyio.Event()

    def _drop_set(self, reason: SetDropReason) -> None:
        for number, message in enumerate(self._ready.popleft()):
            self._dropped(number, message, reason)

    def _dropped(self, number: int, message: Any, reason: SetDropReason) -> None:
        self._counts[number][reason] += 1
        if self._on_drop is not None:
            self._on_drop(number, message, reason)

    def _raise_error(self) -> None:
        if self._error is not None:
            error, self._error = self._error, None
            raise_unchanged(error)
