"""The names of all frames that a sample in some window names."""

from collections import Counter
from collections.abc import Collection, Mapping
from itertools import chain, islice

from tfbus.errors import MOST_NAMES


class KnownFrames:
    """Counts the samples that name each frame, so that a frame is forgotten with the last sample that names it."""

    __slots__ = ("_mentions", "_parents_of", "_roots", "_some", "_sorted")

    def __init__(self) -> None:
        self._parents_of: dict[str, tuple[str, ...]] = {}
        self._mentions: dict[str, int] = {}
        # The parents that are no child.
        self._roots: set[str] = set()
        self._sorted: tuple[str, ...] | None = None
        self._some: tuple[str, ...] | None = None

    def __len__(self) -> int:
        return len(self._parents_of) + len(self._roots)

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
            if parent not in self._parents_of:
                self._roots.add(parent)
        self._forget_mentions(before or ())
        self._parents_of[child] = parents
        self._roots.discard(child)
        self._sorted = self._some = None

    def remove(self, child: str) -> None:
        """Note that no sample of `child` is left."""
        parents = self._parents_of.pop(child)
        if child in self._mentions:
            self._roots.add(child)
        self._forget_mentions(parents)
        self._sorted = self._some = None

    def count_after(self, changes: Mapping[str, str]) -> int:
        """The number of names if the samples of each of these children named this parent, and no other."""
        more = Counter(changes.values())
        more.subtract(parent for child in changes for parent in self._parents_of.get(child, ()))
        new = [child for child in changes if child not in self._parents_of]
        count = len(self) + sum(child not in self._roots for child in new)
        for parent, difference in more.items():
            if parent not in self._parents_of and parent not in changes:
                before = self._mentions.get(parent, 0)
                count += (before + difference > 0) - (before > 0)
        return count

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
        twin._roots = self._roots.copy()
        return twin

    def _forget_mentions(self, parents: tuple[str, ...]) -> None:
        for parent in parents:
            self._mentions[parent] -= 1
            if not self._mentions[parent]:
                del self._mentions[parent]
                self._roots.discard(parent)
