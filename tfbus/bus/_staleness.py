"""Which moving frames have had nothing new for too long.

Nothing is timed here: whoever wants to know asks, and is told when to ask again. A frame costs a few steps once it may
have become stale, and none for each of its samples.
"""

from collections.abc import Callable
from heapq import heapify, heappop, heappush
from typing import Protocol

from tfbus.events import FrameLive, FrameStale
from tfbus.geometry.stamped import Batch

_SPARE = 64


class LastHeard(Protocol):
    """The newest that is known of one child."""

    @property
    def static(self) -> bool: ...

    @property
    def newest(self) -> int | None: ...

    @property
    def authority(self) -> str: ...


class Staleness:
    """Tells stale frames from live ones: those whose newest stamp is more than a limit behind the clock.

    Parameters
    ----------
    limit : int
        ns.
    known : callable
        Gives the newest of a child, or None if nothing is known of it.
    """

    def __init__(self, limit: int, known: Callable[[str], LastHeard | None]) -> None:
        self._limit = limit
        self._known = known
        # The last stamp at which a frame is live for sure, and all of these in order, with some that hold no longer.
        self._live: dict[str, int] = {}
        self._due: list[tuple[int, str]] = []
        self._stale: set[str] = set()
        self._heard: dict[str, None] = {}

    def __len__(self) -> int:
        return len(self._due) + len(self._stale)

    def arrived(self, batch: Batch) -> bool:
        """Take note of samples that the bus has accepted; whether it is worth asking for news."""
        live = self._live
        news = False
        for sample in batch:
            _, child, _, _, _, static = sample._fields
            if static or child not in live:
                news |= self.hear(child)
        return news

    def hear(self, frame: str) -> bool:
        """Take note of a frame that is new, stale or static; whether it is worth asking for news."""
        if frame in self._stale:
            self._heard[frame] = None
            return True
        self._live.pop(frame, None)
        return self._watch(frame)

    def news(self, now: int) -> list[FrameStale | FrameLive]:
        """What has changed since it was last asked, as seen at a stamp."""
        found: list[FrameStale | FrameLive] = []
        heard, self._heard = self._heard, {}
        for frame in heard:
            known = self._known(frame)
            if known is not None and (known.newest is None or known.newest + self._limit >= now):
                self._stale.discard(frame)
                self._watch(frame)
                found.append(FrameLive(now, frame, known.newest, known.authority))
        while self._due and self._due[0][0] < now:
            due, frame = heappop(self._due)
            if self._live.get(frame) != due:
                continue
            del self._live[frame]
            known = self._known(frame)
            if known is None or known.newest is None:
                continue
            if known.newest + self._limit == due:
                self._stale.add(frame)
                found.append(FrameStale(now, frame, known.newest, known.authority))
            else:
                self._watch(frame)
        return found

    def due(self) -> int | None:
        """The first stamp at which there may be news if nothing arrives, in ns; None if there is none."""
        while self._due and self._live.get(self._due[0][1]) != self._due[0][0]:
            heappop(self._due)
        return self._due[0][0] + 1 if self._due else None

    def forget(self, frame: str) -> None:
        """Take note that a frame was removed."""
        self._live.pop(frame, None)
        self._stale.discard(frame)
        self._heard.pop(frame, None)

    def clear(self) -> None:
        """Forget every frame: the clock has jumped back."""
        self._live.clear()
        self._due.clear()
        self._stale.clear()
        self._heard.clear()

    def _watch(self, frame: str) -> bool:
        known = self._known(frame)
        if known is None or known.newest is None:
            return False
        due = known.newest + self._limit
        self._live[frame] = due
        heappush(self._due, (due, frame))
        if len(self._due) > 2 * len(self._live) + _SPARE:
            self._due = [(due, live) for live, due in self._live.items()]
            heapify(self._due)
        return True
