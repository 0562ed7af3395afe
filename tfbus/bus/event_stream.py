"""Events as an async iterator.

An `EventQueue` holds the events for one reader and leaves out repetitions. `Staleness` finds the moving frames whose
newest sample is too old, without a timer: `EventStream` asks it for changes and for the time of the next one, while a
task reads. A frame costs a few steps each time that it may have become stale; a sample costs nothing unless some frame
is stale.
"""

import math
from collections import deque
from collections.abc import Callable, Hashable, Iterable
from heapq import heapify, heappop, heappush
from itertools import islice

from tfbus._aio.task_groups import OneReaderStream
from tfbus.bus.queues import check_capacity
from tfbus.bus.subscribers import SeenKeys
from tfbus.bus.topology import Topology
from tfbus.clock import Clock
from tfbus.events import (
    AuthorityConflict,
    ClockReset,
    Event,
    FrameAdded,
    FrameLive,
    FrameRemoved,
    FrameStale,
    KindChanged,
    PastLoop,
    Reparented,
    SampleRejected,
    StampAhead,
    StampBehind,
)
from tfbus.geometry.stamped import Batch
from tfbus.stamps import STAMP_MIN, as_duration, from_seconds, to_seconds
from tfbus.statistics import QueueStatistics
from tfbus.tree.cycles import NewestEdge

_CLAIMS = 100
_REFUSED_FRAMES = 1_000


class EventQueue:
    """Events in the order in which they happened; when there are too many, the oldest are dropped.

    The queue gives some events only once:

    * a conflict, for each frame and pair of authorities; then a new parent or kind of that frame, for each authority
      that claims it;
    * a rejected sample, for each frame, authority and reason;
    * a stamp ahead of the clock, or behind it, for each frame and authority;
    * a loop of parents in the past, for each frame, authority and parent.

    This begins anew when the frame is removed or added, and when the clock jumps back.

    If one authority moves a frame to and fro, every move is an event, because it may be intended. If the queue is full,
    such a frame pushes out its own events and no others.

    Parameters
    ----------
    capacity : int
        How many events may be pending, at least one; the events of `known` and of `put_staleness` do not count, and are
        never dropped.
    known : iterable of tuple
        The fields of the first events, a `FrameAdded` for each frame that has a parent. Each event is made when it is
        read.
    implausible : iterable of StampAhead or StampBehind
        The next events, for each of these frames that is ahead of the clock or behind it.

    Attributes
    ----------
    dropped : int
        Number of events lost to the capacity.
    """

    def __init__(
        self,
        capacity: int,
        known: Iterable[tuple[int, str, str, str, bool]] = (),
        implausible: Iterable[StampAhead | StampBehind] = (),
    ) -> None:
        check_capacity(capacity)
        self.capacity = capacity
        self.dropped: int = 0
        self._known = deque(known)
        self._kept: deque[Event] = deque(implausible)
        self._events: deque[Event] = deque()
        self._conflicts: dict[str, SeenKeys] = {}
        self._refusals: dict[str | None, SeenKeys] = {}
        for event in self._kept:
            self._is_repetition(event)

    def __len__(self) -> int:
        return len(self._known) + len(self._kept) + len(self._events)

    def put(self, event: Event) -> None:
        """Add an event, unless the queue has given an equal conflict or refusal before."""
        if isinstance(event, (FrameAdded, FrameRemoved)):
            self._conflicts.pop(event.frame, None)
            self._refusals.pop(event.frame, None)
        elif isinstance(event, ClockReset):
            self._conflicts.clear()
            self._refusals.clear()
        elif self._is_repetition(event):
            return
        if len(self._events) == self.capacity:
            del self._events[self._place_to_drop(event)]
            self.dropped += 1
        self._events.append(event)

    def put_staleness(self, changes: Iterable[FrameStale | FrameLive]) -> None:
        """Add the changes of staleness that were found while the queue was empty: at most one event a frame."""
        self._kept.extend(changes)

    def get(self) -> Event | None:
        """The next event; None when there is none."""
        if self._known:
            return FrameAdded(*self._known.popleft())
        if self._kept:
            return self._kept.popleft()
        return self._events.popleft() if self._events else None

    def statistics(self) -> QueueStatistics:
        """The queue's counters."""
        return QueueStatistics("events", "drop_oldest", self.capacity, len(self), self.dropped)

    def _place_to_drop(self, newest: Event) -> int:
        if isinstance(newest, (Reparented, KindChanged)):
            for place, event in enumerate(self._events):
                if isinstance(event, (Reparented, KindChanged)) and event.frame == newest.frame:
                    return place
        return 0

    def _is_repetition(self, event: Event) -> bool:
        key: Hashable
        if isinstance(event, AuthorityConflict):
            seen = self._conflicts.setdefault(event.frame, SeenKeys(_CLAIMS))
            key = frozenset((event.authority, event.other))
        elif isinstance(event, (SampleRejected, StampAhead, StampBehind, PastLoop)):
            seen = self._refusals.setdefault(event.frame, SeenKeys(_CLAIMS))
            key = (type(event), event.authority, _deduplication_key(event))
            if len(self._refusals) > _REFUSED_FRAMES:
                del self._refusals[next(iter(self._refusals))]
        elif isinstance(event, Reparented) and event.frame in self._conflicts:
            seen = self._conflicts[event.frame]
            key = (event.authority, event.parent)
        elif isinstance(event, KindChanged) and event.frame in self._conflicts:
            seen = self._conflicts[event.frame]
            key = (event.authority, event.static)
        else:
            return False
        return not seen.add(key)


def _deduplication_key(event: SampleRejected | StampAhead | StampBehind | PastLoop) -> str | None:
    """The third part of the deduplication key, beside frame and authority."""
    if isinstance(event, SampleRejected):
        return event.reason
    return event.parent if isinstance(event, PastLoop) else None


_SPARE = 64
_AT_ONCE = 4_000
"""The number of frames that `Staleness.changes` looks at in one call, and so in one turn of the event loop."""


class Staleness:
    """The stale frames of a bus: those whose newest stamp is more than a limit behind the clock.

    Parameters
    ----------
    limit : int
        ns.
    newest_edge : callable
        Gives the newest edge of a child, or None if it has none.
    """

    def __init__(self, limit: int, newest_edge: Callable[[str], NewestEdge | None]) -> None:
        self._limit = limit
        self._newest_edge = newest_edge
        # The last stamp at which each frame is surely live; the frames by stamp; and a heap of stamps, some outdated.
        self._live: dict[str, int] = {}
        self._due_at: dict[int, dict[str, None]] = {}
        self._due: list[int] = []
        self._stale: set[str] = set()
        self._noted: dict[str, None] = {}

    def arrived(self, batch: Batch) -> bool:
        """Note accepted samples; return whether `changes` may have something new."""
        stale = self._stale
        if stale:
            for sample in batch:
                if sample.child in stale:
                    self.note(sample.child)
        return bool(self._noted)

    def note(self, frame: str) -> None:
        """Note a frame that is new, has become static or moving, or may be live again."""
        self._noted[frame] = None

    def changes(self, now: int) -> list[FrameStale | FrameLive]:
        """The frames that have become stale or live since the last call, as of the stamp `now`.

        It looks at some thousand frames; `due` says whether it must be called again at once.
        """
        found: list[FrameStale | FrameLive] = []
        noted = list(islice(self._noted, _AT_ONCE))
        for frame in noted:
            del self._noted[frame]
            known = self._newest_edge(frame)
            newest = None if known is None else known.newest
            if frame in self._stale:
                if known is None or (newest is not None and newest + self._limit < now):
                    continue
                self._stale.discard(frame)
                found.append(FrameLive(now, frame, newest, known.authority))
            self._unwatch(frame)
            if newest is not None:
                self._watch(frame, newest + self._limit)
        room = _AT_ONCE - len(noted)
        while room > 0 and self._due and self._due[0] < now:
            due = heappop(self._due)
            frames = sorted(self._due_at.pop(due, ()))
            frames, later = frames[:room], frames[room:]
            room -= len(frames)
            if later:
                self._due_at[due] = dict.fromkeys(later)
                heappush(self._due, due)
            for frame in frames:
                known = self._newest_edge(frame)
                newest = None if known is None else known.newest
                if newest is not None and newest + self._limit != due:
                    # The usual case: a newer sample has come meanwhile.
                    self._watch(frame, newest + self._limit)
                    continue
                del self._live[frame]
                if known is not None and newest is not None:
                    self._stale.add(frame)
                    found.append(FrameStale(now, frame, newest, known.authority))
        return found

    def due(self) -> int | None:
        """The first stamp, in ns, at which `changes` may have something new if no sample arrives; None if never."""
        if self._noted:
            return STAMP_MIN
        while self._due and self._due[0] not in self._due_at:
            heappop(self._due)
        return self._due[0] + 1 if self._due else None

    def forget(self, frame: str) -> None:
        """Forget a frame that was removed."""
        self._unwatch(frame)
        self._stale.discard(frame)
        self._noted.pop(frame, None)

    def clear(self) -> None:
        """Forget every frame: the clock has jumped back."""
        self._live.clear()
        self._due_at.clear()
        self._due.clear()
        self._stale.clear()
        self._noted.clear()

    def _watch(self, frame: str, due: int) -> None:
        self._live[frame] = due
        frames = self._due_at.get(due)
        if frames is None:
            # Many frames of one batch have one stamp, so that the heap has far less entries than frames.
            frames = self._due_at[due] = {}
            heappush(self._due, due)
        frames[frame] = None

    def _unwatch(self, frame: str) -> None:
        due = self._live.pop(frame, None)
        if due is None:
            return
        frames = self._due_at[due]
        del frames[frame]
        if not frames:
            del self._due_at[due]
            if len(self._due) > 2 * len(self._due_at) + _SPARE:
                self._due = list(self._due_at)
                heapify(self._due)


class EventStream(OneReaderStream[Event]):
    """The result of `Bus.events`: ``async for event in events``, for one reader.

    The iteration ends when the bus or the stream is closed and all pending events have been read. The stream looks for
    stale frames while a task reads and nothing else is pending; their events are never dropped.

    Examples
    --------
    >>> bus = Bus(SimulatedClock())
    >>> with bus.events() as events:
    ...     bus.publish(TransformStamped("map", "cart", 0, Transform()))
    ...     async for event in events:
    ...         print(type(event).__name__)
    ...         break
    FrameAdded
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
        implausible: list[StampAhead | StampBehind] = [*topology.known_ahead(), *topology.known_behind()]
        self.queue: EventQueue = EventQueue(capacity, topology.known(), implausible)
        self._staleness: Staleness | None = None
        if stale_after is not None and as_duration(stale_after, "stale_after") != math.inf:
            self._staleness = Staleness(from_seconds(stale_after), topology.newest)
        self._clock = clock

    @property
    def dropped(self) -> int:
        """Number of events that were dropped because the reader was too slow."""
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
        if self._staleness is None:
            return event
        if isinstance(event, FrameAdded):
            # The first events were not put into the stream.
            self._staleness.note(event.frame)
        elif event is None and not self._ended:
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
