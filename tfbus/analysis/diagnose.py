"""`diagnose`, which tells what is wrong with a tree."""

from collections.abc import Iterator

from tfbus.analysis.examiner import Examiner
from tfbus.analysis.finding import Finding
from tfbus.analysis.limits import Limits
from tfbus.geometry.rows import Row
from tfbus.geometry.stamped import TransformStamped
from tfbus.tree.forest import Forest
from tfbus.tree.history import RECORD
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
        samples = list(_samples(forest))
    examiner.add(samples)
    return examiner.findings()


def _samples(forest: Forest) -> Iterator[TransformStamped]:
    for child, history in forest.frames.items():
        if history.static and history.static_stamp is not None:
            yield _sample(history.parent, child, history.static_stamp, history.row, history.authority, static=True)
        start = history.start
        records = RECORD.iter_unpack(bytes(history.records[start * RECORD.size :]))
        for (stamp, *row), (parent, authority) in zip(records, history.origins[start:], strict=True):
            x, y, z, i, j, k, w = row
            yield _sample(parent, child, stamp, (x, y, z, i, j, k, w), authority, static=False)


def _sample(parent: str, child: str, stamp: int, row: Row, authority: str, static: bool) -> TransformStamped:
    # The samples of a tree are valid.
    sample = TransformStamped.__new__(TransformStamped)
    sample._fields = parent, child, stamp, row, authority, static
    return sample
