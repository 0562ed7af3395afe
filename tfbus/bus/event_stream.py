"""Events as an async iterator."""

import math
from collections.abc import Callable

from tfbus._aio.one_reader import OneReaderStream
from tfbus.bus._event_queue import EventQueue
from tfbus.bus._staleness import Staleness
from tfbus.bus._topology import Topology
from tfbus.clock import Clock
from tfbus.events import ClockReset, Event, FrameAdded, FrameRemoved, KindChanged
from tfbus.geometry.stamped import Batch
from tfbus.stamps import as_duration, from_seconds, to_seconds


class EventStream(OneReaderStream[Event]):
    """The result of `Bus.events`: ``async for event in events``, for one reader.

    The iteration ends when the bus or the stream is closed and what was pending has been read. Stale frames are
    found while a task reads and nothing else is pending; their events are never dropped.
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
        super().__init__(check_thread, detach)
        known = topology.known()
        self.queue = EventQueue(capacity, [*known, *topology.known_ahead(), *topology.known_behind()])
        self._staleness: Staleness | None = None
        if stale_after is not None and as_duration(stale_after, "stale_after") != math.inf:
            self._staleness = Staleness(from_seconds(stale_after), topology.newest)
            for event in known:
                self._staleness.note(event.frame)
        self._clock = clock

    @property
    def dropped(self) -> int:
        """Events that the reader was too slow for."""
        return self.queue.dropped

    def put(self, event: Event) -> None:
        """Add an event and wake the reader."""
        self.queue.put(event)
        if self._staleness is not None:
            if isinstance(event, FrameAdded | KindChanged):
                self._staleness.note(event.frame)
            elif isinstance(event, FrameRemoved):
                self._staleness.forget(event.frame)
            elif isinstance(event, ClockReset):
                self._staleness.clear()
        self.wake()

    def arrived(self, batch: Batch) -> None:
        """Wake the reader if accepted samples may have changed which frames are stale."""
        if self._staleness is not None and self._staleness.arrived(batch):
            self.wake()

    def _next(self) -> Event | None:
        event = self.queue.get()
        if event is None and self._staleness is not None and not self._ended:
            self.queue.put_staleness(self._staleness.changes(self._clock.now()))
            event = self.queue.get()
        return event

    async def _wait(self) -> None:
        due = None if self._staleness is None else self._staleness.due()
        if due is None:
            await super()._wait()
            return
        # At `due` another frame may become stale.
        with self._clock.move_on_after(max(0.0, to_seconds(due - self._clock.now()))):
            await super()._wait()
