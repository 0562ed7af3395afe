"""Names that hold from one stamp on until the next, as the parents of one frame's samples."""

from bisect import bisect_right
from operator import itemgetter

import numpy as np

from tfbus.stamps import STAMP_MIN, Stamps

_begin_of = itemgetter(0)


class Runs:
    """The names that the samples of a history carry, kept once for each run of samples with the same.

    It is empty, and false, while all samples agree; the history itself holds the name of its newest sample.
    """

    __slots__ = ("_runs",)

    def __init__(self) -> None:
        # The stamp from which each name holds, in order. The first one holds from any earlier stamp as well.
        self._runs: list[tuple[int, str]] = []

    def __bool__(self) -> bool:
        return bool(self._runs)

    def at(self, stamp: int) -> str:
        """The name that holds at a stamp; there are several."""
        return self._runs[max(bisect_right(self._runs, stamp, key=_begin_of) - 1, 0)][1]

    def at_all(self, stamps: Stamps) -> list[str]:
        """The names that hold at many stamps."""
        begins = np.array([begin for begin, _ in self._runs], np.int64)
        numbers = np.maximum(begins.searchsorted(stamps, "right") - 1, 0)
        return [self._runs[number][1] for number in numbers]

    def names(self) -> tuple[str, ...]:
        """Each name once, in the order in which they first hold."""
        return tuple(dict.fromkeys(name for _, name in self._runs))

    def changes(self) -> list[int]:
        """The stamps at which another name begins to hold."""
        return [begin for begin, _ in self._runs[1:]]

    def push(self, stamp: int, name: str, newest: str) -> None:
        """Note the name of a sample that is newer than all others, the newest of which has the name `newest`."""
        if name != newest:
            if not self._runs:
                self._runs.append((STAMP_MIN, newest))
            self._runs.append((stamp, name))

    def put(self, stamp: int, name: str, before: int | None, after: int | None, newest: str) -> None:
        """Note the name of a sample between those at two stamps, of which there may be none; `newest` as in `push`."""
        if not self._runs:
            if name == newest:
                return
            self._runs.append((STAMP_MIN, newest))
        runs = self._runs
        low = 0 if before is None else bisect_right(runs, before, key=_begin_of)
        high = len(runs) if after is None else bisect_right(runs, after, key=_begin_of)
        fresh = [] if low and runs[low - 1][1] == name else [(stamp, name)]
        if after is not None and runs[high - 1][1] != name:
            fresh.append((after, runs[high - 1][1]))
        runs[low:high] = fresh
        self._close()

    def forget_before(self, oldest: int) -> bool:
        """Forget the names that no sample from a stamp on carries; returns whether there were any."""
        runs = self._runs
        old = 0
        while old + 1 < len(runs) and runs[old + 1][0] <= oldest:
            old += 1
        del runs[:old]
        self._close()
        return old > 0

    def clear(self) -> None:
        """Forget all names."""
        self._runs.clear()

    def copy(self) -> "Runs":
        """An independent copy."""
        twin = Runs()
        twin._runs = self._runs.copy()
        return twin

    def _close(self) -> None:
        if len(self._runs) == 1:
            self._runs.clear()
