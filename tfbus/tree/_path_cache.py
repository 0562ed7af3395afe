"""The paths that were found, to be found again."""

from contextlib import AbstractContextManager
from typing import Any

from tfbus.geometry.stamped import TransformStamped
from tfbus.stamps import LATEST
from tfbus.tree._kernel import Paths
from tfbus.tree.path import Path

_GENERATION = 10_000


class PathCache(Paths):
    """The permanent paths that were asked for lately.

    When a generation of 10,000 is complete, those of the one before it that nobody has asked for since are forgotten:
    so up to 10,000 pairs in use stay known, and at most 20,000 are kept.

    Parameters
    ----------
    lock : threading.Lock
        That of the forest.
    """

    __slots__ = ("_count", "_older")

    def __init__(self, lock: AbstractContextManager[Any]) -> None:
        super().__init__(lock, LATEST, TransformStamped)
        self._count = 0
        self._older: dict[str, dict[str, Path]] = {}

    def __len__(self) -> int:
        return sum(len(by_source) for paths in (self.recent, self._older) for by_source in paths.values())

    def find(self, target: str, source: str) -> Path | None:
        """The path between two frames, if it is kept."""
        for paths in (self.recent, self._older):
            by_source = paths.get(target)
            path = None if by_source is None else by_source.get(source)
            if isinstance(path, Path):
                if paths is not self.recent:
                    self.keep(target, source, path)
                return path
        return None

    def holds(self, target: str, source: str) -> bool:
        """Whether the path between two frames is kept. May be asked without the lock."""
        return any(source in paths.get(target, ()) for paths in (self.recent, self._older))

    def keep(self, target: str, source: str, path: Path) -> None:
        """Keep a permanent path."""
        if type(target) is not str or type(source) is not str:
            # A comparison of names must run no code of others.
            return
        if self._count >= _GENERATION:
            self._older, self.recent, self._count = self.recent, {}, 0  # type: ignore[assignment]
        self.recent.setdefault(target, {})[source] = path
        self._count += 1

    def clear(self) -> None:
        """Forget all paths."""
        self.recent = {}
        self._older = {}
        self._count = 0
