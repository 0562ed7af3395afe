"""The plain judgement of a batch, in Python: the definition of what ``tfbus/_kernel.c`` does in its place."""

from collections.abc import Mapping

from tfbus.geometry.stamped import Batch


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


def judge(edges: Mapping[str, Edge], batch: Batch, horizon: int, square: float) -> bool:
    """Whether a whole batch continues known edges; then the newest stamps are noted, else nothing.

    Parameters
    ----------
    edges : mapping of child to Edge
    batch : Batch
    horizon : int
        No stamp may be newer, in ns.
    square : float
        No translation may have a greater square, in m^2.
    """
    known = None
    for sample in batch:
        parent, child, stamp, (x, y, z, _, _, _, _), authority, static = sample._fields
        known = edges.get(child)
        if known is None or known.parent != parent or known.trusted != authority or static or stamp > horizon:
            return False
        # Not `>`, which is false for NaN.
        if not x * x + y * y + z * z <= square:
            return False
    if known is not None and len(batch) == 1:
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
