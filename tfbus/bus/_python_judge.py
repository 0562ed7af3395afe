"""The plain judgement of a batch, in Python: the definition of what ``tfbus/_kernel.c`` does in its place."""

from collections.abc import Mapping

from tfbus.geometry.stamped import Batch
from tfbus.stamps import STAMP_MIN


class Edge:
    """The part of a frame's newest edge by which its samples are judged.

    Attributes
    ----------
    parent : str
    trusted : str or None
        The authority whose moving samples under this parent need no judgement; None if there is none.
    newest : int or None
        The newest stamp, in ns.
    """

    __slots__ = ("newest", "parent", "trusted")
    parent: str
    trusted: str | None
    newest: int | None


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
    horizon : int
        No stamp may be newer, in ns. At first the least stamp.
    """

    __slots__ = ("_edges", "_square", "horizon")

    def __init__(self, edges: Mapping[str, Edge], square: float) -> None:
        self._edges = edges
        self._square = square
        self.horizon = STAMP_MIN

    def accepts(self, batch: Batch) -> bool:
        """Whether a whole batch continues known edges; then the newest stamps are noted, else nothing."""
        edges, square, horizon = self._edges, self._square, self.horizon
        for sample in batch:
            parent, child, stamp, row, authority, static = sample._fields
            if child not in edges:
                return False
            known = edges[child]
            if known.parent != parent or known.trusted != authority or static or stamp > horizon:
                return False
            # Three picks take less than an unpacking of all seven. Not `>`, which is false for NaN.
            x, y, z = row[0], row[1], row[2]
            if not x * x + y * y + z * z <= square:
                return False
        if len(batch) == 1:
            # Nearly always so, and a second look costs a quarter of the first.
            if known.newest is None or stamp > known.newest:
                known.newest = stamp
            return True
        for sample in batch:
            fields = sample._fields
            known = edges[fields[1]]
            if known.newest is None or fields[2] > known.newest:
                known.newest = fields[2]
        return True
