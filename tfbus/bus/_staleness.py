"""Finds the moving frames whose newest sample is too old.

There is no timer here: the caller asks for changes and for the time of the next one. A frame costs a few steps each
time that it may have become stale; a sample costs nothing but while some frame is stale.
"""

from collections.abc import Callable
from heapq import heapify, heappop, heappush

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
        # The last stamp at which each frame is surely live, the frames by these, and a heap of them; some are outdated.
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
        """The frames that have become stale or live since the last call, as of the stamp `now`."""
        found: list[FrameStale | FrameLive] = []
        noted, self._noted = self._noted, {}
        for frame in noted:
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
        while self._due and self._due[0] < now:
            due = heappop(self._due)
            for frame in sorted(self._due_at.pop(due, ())):
                known = self._newest_edge(frame)
                newest = None if known is None else known.newest
                if newest is not None and newest + self._limit != due:
                    # It was heard meanwhile, as nearly all are.
                    self._watch(frame, newest + self._limit)
                    continue
                del self._live[frame]
                if known is not None and newest is not None:
                    self._stale.add(frame)
                    found.append(FrameStale(now, frame, newest, known.authority))
        return found

    def due(self) -> int | None:
        """The first stamp, in ns, at which `changes` may have something new if no sample arrives; None if never.

        Call `changes` first: it looks at what was noted.
        """
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
