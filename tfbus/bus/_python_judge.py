"""The plain judgement of a batch, in Python: the definition of what ``tfbus/_kernel.c`` does in its place."""

import time
from collections.abc import Mapping

from tfbus.geometry.stamped import Batch
from tfbus.stamps import STAMP_MAX, STAMP_MIN


class Edge:
    """The part of a frame's newest edge by which its samples are judged.

    Attributes
    ----------
    parent : str
    trusted : str or None
        The authority whose moving samples under this parent need no judgement; None if there is none.
    newest : int or None
        The newest stamp, in ns.
    late : bool
        Whether it was told that its stamps are behind the clock, so that they need no judgement.
    """

    __slots__ = ("late", "newest", "parent", "trusted")
    parent: str
    trusted: str | None
    newest: int | None
    late: bool


class Judge:
    """The plain judgement of batches by the newest edges of a bus.

    Parameters
    ----------
    edges : dict of str to Edge
        By child.
    square : float
        No translation may have a greater square, in m^2.

    Attributes
    ----------
    earliest, horizon : int
        No stamp may be older, but of late edges, or newer, in ns. At first both are the least stamp.
    behind : int
        Number of stamps that were older.
    """

    __slots__ = ("_edges", "_square", "_until", "behind", "earliest", "horizon")

    def __init__(self, edges: Mapping[str, Edge], square: float) -> None:
        self._edges = edges
        self._square = square
        self.earliest = self.horizon = STAMP_MIN
        self._until = STAMP_MAX
        self.behind = 0

    def allow(self, earliest: int, horizon: int, lasting: int, /) -> None:
        """Set `earliest` and `horizon` for so many ns of the machine's time; then no batch is plain."""
        self.earliest, self.horizon = earliest, horizon
        self._until = min(time.monotonic_ns() + lasting, STAMP_MAX)

    def accepts(self, batch: Batch) -> bool:
        """Whether a whole batch continues known edges; then the newest stamps are noted, else nothing."""
        if self._until != STAMP_MAX and time.monotonic_ns() >= self._until:
            return False
        edges, square, earliest, horizon = self._edges, self._square, self.earliest, self.horizon
        for sample in batch:
            parent, child, stamp, row, authority, static = sample._fields
            if child not in edges:
                return False
            known = edges[child]
            if known.parent != parent or known.trusted != authority or static or stamp > horizon:
                return False
            if stamp < earliest and not known.late:
                return False
            # Three picks take less than an unpacking of all seven. Not `>`, which is false for NaN.
            x, y, z = row[0], row[1], row[2]
            if not x * x + y * y + z * z <= square:
                return False
        if len(batch) == 1:
            # Nearly always so, and a second look costs a quarter of the first.
            self.behind += stamp < earliest
            if known.newest is None or stamp > known.newest:
                known.newest = stamp
            return True
        for sample in batch:
            fields = sample._fields
            known = edges[fields[1]]
            self.behind += fields[2] < earliest
            if known.newest is None or fields[2] > known.newest:
                known.newest = fields[2]
        return True
