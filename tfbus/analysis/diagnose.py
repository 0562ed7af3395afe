"""`diagnose`, which tells what is wrong with a tree."""

from collections.abc import Iterator
from itertools import repeat
from typing import NamedTuple

from tfbus.analysis.examiner import Examiner
from tfbus.analysis.finding import Finding
from tfbus.analysis.limits import Limits
from tfbus.geometry.stamped import TransformStamped
from tfbus.rows import Row
from tfbus.stamps import STAMP_MAX, STAMP_MIN
from tfbus.tree.history import Edge, FrameHistory, Samples
from tfbus.tree.tree import TransformTree, forest_of


def diagnose(tree: TransformTree, limits: Limits | None = None) -> list[Finding]:
    """Examine a tree: translations and speeds that cannot be, gaps, rates that break down, senders that disagree.

    A tree keeps the samples of a frame in the order of their stamps, one for each stamp, and its last static value. So
    duplicates, changes of statics and stamps that go back are found only while samples arrive: see
    `tfbus.analysis.Examiner`, and ``tfbus check``.

    Parameters
    ----------
    tree : TransformTree
    limits : Limits, optional

    Returns
    -------
    list of Finding
        Empty if nothing is wrong.
    """
    examiner = Examiner(limits)
    forest = forest_of(tree)
    with forest.lock:
        frames = [_Frame.of(history) for history in forest.frames.values()]
    examiner.add([sample for frame in frames for sample in frame.samples()])
    return examiner.findings()


class _Frame(NamedTuple):
    """The samples of one frame as they were at one moment."""

    edge: Edge
    static: TransformStamped | None
    moving: Samples

    @classmethod
    def of(cls, history: FrameHistory) -> "_Frame":
        """The samples as they are now; nothing is copied that numpy can copy later."""
        edge, static = history.edge(), None
        if edge.static and history.static_stamp is not None:
            row = history.static_row
            static = _sample(edge.parent, edge.child, history.static_stamp, row, edge.authority, static=True)
        return cls(edge, static, history.samples_between(STAMP_MIN, STAMP_MAX))

    def samples(self) -> Iterator[TransformStamped]:
        """The static sample, or the moving ones in the order of their stamps."""
        if self.static is not None:
            yield self.static
        moving = self.moving
        parents = repeat(self.edge.parent) if moving.parents is None else moving.parents
        authorities = repeat(self.edge.authority) if moving.authorities is None else moving.authorities
        columns = zip(moving.stamps.tolist(), moving.rows.tolist(), parents, authorities, strict=False)
        for stamp, (x, y, z, i, j, k, w), parent, authority in columns:
            yield _sample(parent, self.edge.child, stamp, (x, y, z, i, j, k, w), authority, static=False)


def _sample(parent: str, child: str, stamp: int, row: Row, authority: str, static: bool) -> TransformStamped:
    # The samples of a tree are valid.
    sample = TransformStamped.__new__(TransformStamped)
    sample._fields = parent, child, stamp, row, authority, static
    return sample
