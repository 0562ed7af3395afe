"""The names of all frames that a sample in some window names."""

from collections.abc import Collection
from itertools import chain, islice

from tfbus.errors import MOST_NAMES


class KnownFrames:
    """Counts the samples that name each frame, so that a frame is forgotten with the last sample that names it."""

    __slots__ = ("_mentions", "_parents_of", "_some", "_sorted")

    def __init__(self) -> None:
        self._parents_of: dict[str, tuple[str, ...]] = {}
        self._mentions: dict[str, int] = {}
        self._sorted: tuple[str, ...] | None = None
        self._some: tuple[str, ...] | None = None

    def __contains__(self, frame: object) -> bool:
        return frame in self._parents_of or frame in self._mentions

    @property
    def parents(self) -> Collection[str]:
        """The frames that a sample names as a parent."""
        return self._mentions.keys()

    def update(self, child: str, parents: tuple[str, ...]) -> None:
        """Note that the samples of `child` name exactly these parents."""
        before = self._parents_of.get(child)
        if before == parents:
            return
        for parent in parents:
            self._mentions[parent] = self._mentions.get(parent, 0) + 1
        self._forget_mentions(before or ())
        self._parents_of[child] = parents
        self._sorted = self._some = None

    def remove(self, child: str) -> None:
        """Note that no sample of `child` is left."""
        self._forget_mentions(self._parents_of.pop(child))
        self._sorted = self._some = None

    def sorted(self) -> tuple[str, ...]:
        """All names in alphabetical order."""
        if self._sorted is None:
            self._sorted = tuple(sorted({*self._parents_of, *self._mentions}))
        return self._sorted

    def some(self) -> tuple[str, ...]:
        """The names for an error, unsorted; of more than `MOST_NAMES`, so many."""
        if self._some is None:
            names = chain(self._mentions, self._parents_of)
            self._some = tuple(dict.fromkeys(islice(names, MOST_NAMES)))
        return self._some

    def copy(self) -> "KnownFrames":
        """An independent copy."""
        twin = KnownFrames()
        twin._parents_of = self._parents_of.copy()
        twin._mentions = self._mentions.copy()
        return twin

    def _forget_mentions(self, parents: tuple[str, ...]) -> None:
        for parent in parents:
            self._mentions[parent] -= 1
            if not self._mentions[parent]:
                del self._mentions[parent]
