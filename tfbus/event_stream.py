"""Events as an async iterator."""

import math
from collections.abc import Callable
from types import TracebackType

import anyio
import anyio.lowlevel

from tfbus.clock import Clock
from tfbus.event_queue import EventQueue
from tfbus.events import ClockReset, Event, FrameRemoved
from tfbus.staleness import Staleness
from tfbus.stamped import Batch
from tfbus.stamps import as_duration, from_seconds, to_seconds
from tfbus.topology import Topology


class EventStream:
    """What `Bus.events` gives: ``async for event in events``, for one reader.

    The iteration ends when the bus or the stream is closed and what was pending has been read. Whether a frame is stale
    is worked out while somebody reads, and told behind what is pending.
    """

    def __init__(
        self,
        capacity: int,
        stale_after: float | None,
        topology: Topology,
        clock: Clock,
        check_thread: Callable[[], object],
        detach: Callable[["EventStream"], object],
    ) -> None:
        known = topology.known()
        self.queue = EventQueue(capacity, known)
        self._staleness: Staleness | None = None
        if stale_after is not None and as_duration(stale_after, "stale_after") != math.inf:
            self._staleness = Staleness(from_seconds(stale_after), topology.newest)
            for event in known:
                self._staleness.hear(event.frame)
        self._clock = clock
        self._check_thread = check_thread
        self._detach = detach
        self._reading = anyio.ResourceGuard("reading from")
        self._reader: anyio.Event | None = None
        self._ended = False

    @property
    def dropped(self) -> int:
        """Events that the reader was too slow for."""
        return self.queue.dropped

    @property
    def waiting(self) -> bool:
        """Whether a reader waits for an event."""
        return self._reader is not None

    def put(self, event: Event) -> None:
        """Add an event and wake the reader."""
        self.queue.put(event)
        if self._staleness is not None:
            if isinstance(event, FrameRemoved):
                self._staleness.forget(event.frame)
            elif isinstance(event, ClockReset):
                self._staleness.clear()
        self.wake()

    def arrived(self, batch: Batch) -> None:
        """Wake the reader if samples that the bus has accepted may have changed what is stale."""
        if self._staleness is not None and self._staleness.arrived(batch):
            self.wake()

    def wake(self) -> None:
        """Have the reader look at the clock and the queue."""
        if self._reader is not None:
            self._reader.set()

    def end(self) -> None:
        """Let the reader finish what is pending, then stop."""
        self._ended = True
        self.wake()

    def close(self) -> None:
        """Take the stream off the bus; a second call does nothing."""
        self._detach(self)
        self.end()

    def __enter__(self) -> "EventStream":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def __aiter__(self) -> "EventStream":
        return self

    async def __anext__(self) -> Event:
        self._check_thread()
        with self._reading:
            await anyio.lowlevel.checkpoint()
            while (event := self._next()) is None:
                if self._ended:
                    raise StopAsyncIteration
                await self._wait()
        return event

    def _next(self) -> Event | None:
        if self._staleness is not None and not self._ended:
            for event in self._staleness.news(self._clock.now()):
                self.queue.put(event)
        return self.queue.get()

    async def _wait(self) -> None:
        """Wait for something that happens or arrives, or until another frame may be stale."""
        due = None if self._staleness is None else self._staleness.due()
        self._reader = anyio.Event()
        try:
            if due is None:
                await self._reader.wait()
            else:
                with self._clock.move_on_after(max(0.0, to_seconds(due - self._clock.now()))):
                    await self._reader.wait()
        finally:
            self._reader = None
