"""Finds the moving frames whose newest sample is too old.

There is no timer here: the caller asks for changes and for the time of the next one. A frame costs a few steps each
time that it may have become stale, and nothing for each sample.
"""

from collections.abc import Callable
from heapq import heapify, heappop, heappush, heapreplace

from tfbus.events import FrameLive, FrameStale
from tfbus.geometry.stamped import Batch
from tfbus.tree.cycles import NewestEdge

_SPARE = 64


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
        # The last stamp at which each frame is surely live, and a heap of these, in which some are outdated.
        self._live: dict[str, int] = {}
        self._due: list[tuple[int, str]] = []
        self._stale: set[str] = set()
        self._noted: dict[str, None] = {}

    def __len__(self) -> int:
        return len(self._due) + len(self._stale)

    def arrived(self, batch: Batch) -> bool:
        """Note accepted samples; return whether `changes` may have something new."""
        live = self._live
        changed = False
        for sample in batch:
            _, child, _, _, _, static = sample._fields
            if static or child not in live:
                changed |= self.note(child)
        return changed

    def note(self, frame: str) -> bool:
        """Note a sample of a new, stale or static frame; return whether `changes` may have something new."""
        if frame in self._stale:
            self._noted[frame] = None
            return True
        self._live.pop(frame, None)
        return self._watch(frame)

    def changes(self, now: int) -> list[FrameStale | FrameLive]:
        """The frames that have become stale or live since the last call, as of the stamp `now`."""
        found: list[FrameStale | FrameLive] = []
        noted, self._noted = self._noted, {}
        for frame in noted:
            known = self._newest_edge(frame)
            if known is not None and (known.newest is None or known.newest + self._limit >= now):
                self._stale.discard(frame)
                self._watch(frame)
                found.append(FrameLive(now, frame, known.newest, known.authority))
        while self._due and self._due[0][0] < now:
            due, frame = self._due[0]
            if self._live.get(frame) != due:
                heappop(self._due)
                continue
            known = self._newest_edge(frame)
            newest = None if known is None else known.newest
            if newest is not None and newest + self._limit != due:
                # It was heard meanwhile, as nearly all are.
                self._live[frame] = newest + self._limit
                heapreplace(self._due, (newest + self._limit, frame))
                continue
            heappop(self._due)
            del self._live[frame]
            if known is not None and newest is not None:
                self._stale.add(frame)
                found.append(FrameStale(now, frame, newest, known.authority))
        return found

    def due(self) -> int | None:
        """The first stamp, in ns, at which `changes` may have something new if no sample arrives; None if never."""
        while self._due and self._live.get(self._due[0][1]) != self._due[0][0]:
            heappop(self._due)
        return self._due[0][0] + 1 if self._due else None

    def forget(self, frame: str) -> None:
        """Forget a frame that was removed."""
        self._live.pop(frame, None)
        self._stale.discard(frame)
        self._noted.pop(frame, None)

    def clear(self) -> None:
        """Forget every frame: the clock has jumped back."""
        self._live.clear()
        self._due.clear()
        self._stale.clear()
        self._noted.clear()

    def _watch(self, frame: str) -> bool:
        known = self._newest_edge(frame)
        if known is None or known.newest is None:
            return False
        due = known.newest + self._limit
        self._live[frame] = due
        heappush(self._due, (due, frame))
        if len(self._due) > 2 * len(self._live) + _SPARE:
            self._due = [(due, live) for live, due in self._live.items()]
            heapify(self._due)
        return True
