"""`PassedSamples`, the memory by which a bus knows what it has passed on already, in a world without origins."""

from tfbus.geometry.stamped import TransformStamped
from tfbus.rows import Row

PER_CHILD = 256
GONE_CHILDREN = 1_000

_Key = tuple[str, int, Row | None]


class PassedSamples:
    """Remembers the newest samples of each child that went over a bus, whichever way.

    A sample is known by its child, parent, stamp and kind; a static one by its value as well, for many are stamped
    zero. A moving one with another value is the same sample, as it is for tf2.

    Parameters
    ----------
    per_child : int
        How many samples of a child are remembered; then the oldest are forgotten.
    gone_children : int
        How many children that have left the bus are remembered.
    """

    def __init__(self, per_child: int = PER_CHILD, gone_children: int = GONE_CHILDREN) -> None:
        self._per_child = per_child
        self._gone_children = gone_children
        self._keys: dict[str, dict[_Key, None]] = {}
        self._gone: dict[str, None] = {}

    def __contains__(self, sample: TransformStamped) -> bool:
        parent, child, stamp, row, _, static = sample._fields
        known = self._keys.get(child)
        return known is not None and (parent, stamp, row if static else None) in known

    def add(self, sample: TransformStamped) -> None:
        """Remember a sample."""
        parent, child, stamp, row, _, static = sample._fields
        known = self._keys.get(child)
        if known is None:
            known = self._keys[child] = {}
        elif child in self._gone:
            del self._gone[child]
        key = parent, stamp, row if static else None
        # A sample that passes again is as new as any.
        known.pop(key, None)
        known[key] = None
        if len(known) > self._per_child:
            del known[next(iter(known))]

    def forget(self, child: str) -> None:
        """Forget all samples of a child."""
        self._keys.pop(child, None)
        self._gone.pop(child, None)

    def retire(self, child: str) -> None:
        """Remember a child that has left the bus only while few others leave: copies of its samples may be late."""
        if child not in self._keys:
            return
        self._gone.pop(child, None)
        self._gone[child] = None
        if len(self._gone) > self._gone_children:
            self.forget(next(iter(self._gone)))

    def forget_moving(self) -> None:
        """Forget all moving samples, because the clock has jumped back and their stamps may come once more."""
        for child, known in list(self._keys.items()):
            kept = {key: None for key in known if key[2] is not None}
            if kept:
                self._keys[child] = kept
            else:
                self.forget(child)
