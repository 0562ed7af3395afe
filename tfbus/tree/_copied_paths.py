"""Copies of the samples that a lookup at many stamps needs.

While the forest is locked, `copy_paths` finds the paths that hold between the first stamp and the last, and copies the
samples on them: as blocks of memory, or only those next to a stamp where there are many more samples than stamps. All
other work in numpy comes after that, on the copies. The compiled kernel copies nothing: its blocks can be held.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tfbus.errors import DisconnectedError
from tfbus.geometry.rows import Row
from tfbus.stamps import Stamps
from tfbus.tree.forest import Forest
from tfbus.tree.history import FrameHistory, Samples
from tfbus.tree.path import Path, Step

Places = slice | npt.NDArray[np.intp]
"""Indices into the stamps that were asked for."""


class Query(NamedTuple):
    """The question where `source` is, seen from `target`, at many stamps."""

    target: str
    source: str
    stamps: Stamps

    def span(self) -> tuple[int, int] | None:
        """The first and the last stamp, in ns; None if there are none."""
        return (int(self.stamps.min()), int(self.stamps.max())) if len(self.stamps) else None


class CopiedPath(NamedTuple):
    """A path with copies of the samples on its moving edges, and one row for each run of static edges."""

    up: tuple[Samples | Row, ...]
    down: tuple[Samples | Row, ...]

    @property
    def moving(self) -> list[Samples]:
        """The moving edges, those of `up` first."""
        return [step for step in (*self.up, *self.down) if isinstance(step, Samples)]

    def covers_all(self, stamps: Stamps) -> bool:
        """Whether each edge covers every one of the stamps."""
        low, high = stamps.min(), stamps.max()
        return all(len(edge.stamps) and edge.stamps[0] <= low and high <= edge.stamps[-1] for edge in self.moving)

    def covered(self, stamps: Stamps) -> npt.NDArray[np.bool_]:
        """A mask of the stamps that all edges cover, shape (n,)."""
        covered = np.ones(len(stamps), np.bool_)
        for samples in self.moving:
            if not len(samples.stamps):
                covered[:] = False
            else:
                covered &= (samples.stamps[0] <= stamps) & (stamps <= samples.stamps[-1])
        return covered


class PathsOverTime(NamedTuple):
    """The paths between two frames over some time.

    Attributes
    ----------
    changes : list of int
        The stamps, in ns, at which the path may change.
    paths : list of (CopiedPath or None)
        The path before the first change, and the one from each change on; None where the frames are not connected.
    """

    changes: list[int]
    paths: list[CopiedPath | None]

    def split(self, stamps: Stamps) -> list[tuple[Places, CopiedPath | None]]:
        """The places of the stamps that each path answers."""
        if not self.changes:
            return [(slice(len(stamps)), self.paths[0])]
        different = list({id(path): path for path in self.paths}.values())
        number = np.array([next(i for i, other in enumerate(different) if other is path) for path in self.paths])
        numbers = number[np.array(self.changes, np.int64).searchsorted(stamps, "right")]
        return [(np.flatnonzero(numbers == i), path) for i, path in enumerate(different)]


def copy_paths(forest: Forest, query: Query, span: tuple[int, int] | None) -> PathsOverTime:
    """Copy the paths from source to target that hold at the stamps of a query. The caller holds the lock.

    Parameters
    ----------
    forest : Forest
    query : Query
    span : (int, int) or None
        The first and the last of its stamps, in ns; None if there are none.

    Raises
    ------
    UnknownFrameError
    """
    target, source = query.target, query.source
    forest.check_known(target)
    forest.check_known(source)
    if span is None:
        return PathsOverTime([], [None])
    low, high = span
    paths: list[Path | None] = [_path_at(forest, target, source, low)]
    changes = _changes(forest, target, source, paths[0], low, high)
    paths += [_path_at(forest, target, source, stamp) for stamp in changes]
    copies: dict[tuple[tuple[Step, ...], tuple[Step, ...]], CopiedPath] = {}
    for path in paths:
        if path is not None and (path.up, path.down) not in copies:
            up = tuple(_copy(step, query, low, high) for step in path.up)
            down = tuple(_copy(step, query, low, high) for step in path.down)
            copies[path.up, path.down] = CopiedPath(up, down)
    return PathsOverTime(changes, [None if path is None else copies[path.up, path.down] for path in paths])


def _changes(forest: Forest, target: str, source: str, path: Path | None, low: int, high: int) -> list[int]:
    """The stamps after `low`, up to `high`, at which the path may change."""
    if path is not None and path.permanent and path.root not in forest.frames:
        return []
    edges = forest.edges_above(target, source)
    if not any(edge.mixed for edge in edges):
        return []
    # Of two ways round a loop of parents, the one whose samples cover the stamp counts.
    changes = {stamp for edge in edges for stamp in edge.beginnings()}
    changes.update(edge.newest + 1 for edge in edges if edge.newest is not None)
    return sorted(stamp for stamp in changes if low < stamp <= high)


def _path_at(forest: Forest, target: str, source: str, at: int) -> Path | None:
    try:
        return forest.find_path(target, source, at)
    except DisconnectedError:
        return None


def _copy(step: Step, query: Query, low: int, high: int) -> Samples | Row:
    if not isinstance(step, FrameHistory):
        return step
    return step.samples_between(low, high, query.stamps)
