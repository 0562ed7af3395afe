"""Which frames are known: those that a sample in some window names."""


class KnownFrames:
    """Counts who names whom, so that a frame is forgotten with the last sample that names it."""

    __slots__ = ("_mentions", "_named", "_sorted")

    def __init__(self) -> None:
        self._named: dict[str, tuple[str, ...]] = {}
        self._mentions: dict[str, int] = {}
        self._sorted: tuple[str, ...] | None = None

    def __contains__(self, frame: object) -> bool:
        return frame in self._named or frame in self._mentions

    def update(self, child: str, parents: tuple[str, ...]) -> None:
        """Take note that the samples of `child` name these parents, and no others."""
        before = self._named.get(child)
        if before == parents:
            return
        for parent in parents:
            self._mentions[parent] = self._mentions.get(parent, 0) + 1
        self._forget(before or ())
        self._named[child] = parents
        self._sorted = None

    def remove(self, child: str) -> None:
        """Take note that no sample of `child` is left."""
        self._forget(self._named.pop(child))
        self._sorted = None

    def sorted(self) -> tuple[str, ...]:
        """All of them, in order."""
        if self._sorted is None:
            self._sorted = tuple(sorted({*self._named, *self._mentions}))
        return self._sorted

    def copy(self) -> "KnownFrames":
        """An independent copy."""
        twin = KnownFrames()
        twin._named = self._named.copy()
        twin._mentions = self._mentions.copy()
        return twin

    def _forget(self, parents: tuple[str, ...]) -> None:
        for parent in parents:
            self._mentions[parent] -= 1
            if not self._mentions[parent]:
                del self._mentions[parent]
