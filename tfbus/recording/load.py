"""`load`, which reads a whole recording into a tree, for analysis without an event loop."""

import logging
import math
import os
from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping
from operator import itemgetter

from tfbus.errors import InvalidTransformError
from tfbus.geometry.stamped import MAX_TRANSLATION, Batch, TransformStamped, is_within, not_physical
from tfbus.plain import printable
from tfbus.recording.formats.transforms import Columns
from tfbus.recording.recording import Block, DecodedBlock, Recording, Topics, open_recording
from tfbus.rows import Row
from tfbus.stamps import SECOND, is_real
from tfbus.tf_message import MalformedMessageError
from tfbus.tree.cycles import NewestEdge, admit
from tfbus.tree.forest import Forest
from tfbus.tree.tree import TransformTree, forest_of

_MAX_CANDIDATES = 16


class SpeedLimit:
    """Decides for each moving sample whether its frame can have moved there from the last one that was kept.

    Parameters
    ----------
    speed : float
        In m/s.

    Attributes
    ----------
    dropped : Counter
        The number of samples left out, under ``"speed"``.

    Raises
    ------
    TypeError, ValueError
        If the speed is not a number greater than zero.
    """

    def __init__(self, speed: float) -> None:
        if not is_real(speed):
            raise TypeError(f"max_speed must be a number of m/s, not {speed!r}")
        if not speed > 0:
            raise ValueError(f"max_speed must be greater than zero, got {speed!r}")
        self.dropped: Counter[str] = Counter()
        self._speed = float(speed)
        self._kept: dict[tuple[str, str], tuple[int, Row]] = {}
        self._candidates: dict[tuple[str, str], list[TransformStamped]] = {}

    def admit(self, batch: Batch) -> Batch:
        """The samples of a batch that are kept, with those from before that have become certain."""
        kept: list[TransformStamped] = []
        for sample in batch:
            if sample.static:
                kept.append(sample)
            else:
                kept += self._judge(sample)
        return tuple(kept)

    def undecided(self) -> Batch:
        """At the end of all samples: the first of each frame of which no two agree."""
        kept = []
        for candidates in self._candidates.values():
            kept.append(candidates[0])
            self._drop(len(candidates) - 1)
        self._candidates.clear()
        return tuple(kept)

    def _judge(self, sample: TransformStamped) -> list[TransformStamped]:
        parent, child, stamp, row, _, _ = sample._fields
        key = parent, child
        last = self._kept.get(key)
        if last is not None:
            if not self._reaches(*last, stamp, row):
                self._drop(1)
                return []
            self._kept[key] = stamp, row
            return [sample]
        candidates = self._candidates.setdefault(key, [])
        for candidate in candidates:
            if self._reaches(candidate.stamp, candidate._fields[3], stamp, row):
                del self._candidates[key]
                self._drop(len(candidates) - 1)
                self._kept[key] = stamp, row
                return [candidate, sample]
        candidates.append(sample)
        if len(candidates) > _MAX_CANDIDATES:
            del candidates[0]
            self._drop(1)
        return []

    def _reaches(self, stamp: int, row: Row, other_stamp: int, other: Row) -> bool:
        # Samples of one stamp replace each other: no speed is known.
        time = abs(other_stamp - stamp)
        return time == 0 or math.dist(row[:3], other[:3]) <= self._speed * time / SECOND

    def _drop(self, count: int) -> None:
        if count:
            self.dropped["speed"] += count


MAX_DETAILS = 20


class Problems(Counter[str]):
    """The number of transforms and messages that were left out, by reason.

    Attributes
    ----------
    details : list of str
        What was lost at the first damaged places; at most `MAX_DETAILS`.
    """

    def __init__(self) -> None:
        super().__init__()
        self.details: list[str] = []

    def note(self, errors: tuple[InvalidTransformError | MalformedMessageError, ...]) -> None:
        """Count the errors of a message."""
        for error in errors:
            self[error.reason] += 1
            if isinstance(error, MalformedMessageError) and len(self.details) < MAX_DETAILS:
                self.details.append(error.detail)


def load(
    path: str | os.PathLike[str],
    since: int | None = None,
    until: int | None = None,
    *,
    topics: Topics = None,
    prefix: str = "",
    namespaces: bool = False,
    max_speed: float | None = None,
    problems: Counter[str] | None = None,
    max_translation: float = MAX_TRANSLATION,
) -> TransformTree:
    """Read all transforms of a recording, or of a part of it, into a tree that keeps them all.

    Invalid transforms, those that would close a loop of parents, and those that are further than `max_translation`, are
    left out and counted, as are the damaged parts of a file.

    Parameters
    ----------
    path : str or path-like
        As `open_recording`.
    since, until : int, optional
        The first and the last log time, in ns. Static transforms from before `since` are in the tree as well.
    topics, prefix, namespaces
        As `open_recording`.
    max_speed : float, optional
        In m/s. A moving sample that is further from the last one of its frame that was kept, by stamp, than this speed
        allows, is left out and counted as ``"speed"``. If the first samples of a frame contradict each other, the first
        one that a later one agrees with is kept.
    problems : Counter, optional
        Gets the number of transforms and messages that were left out, by reason. Without it, they are logged as a
        warning, as is what was not read although it may hold transforms.
    max_translation : float
        The greatest magnitude of a translation, in m, at most 1e100.

    Returns
    -------
    TransformTree
        With ``keep=None``.

    Raises
    ------
    RecordingError
        If the recording cannot be read at all, or as `open_recording`.
    ValueError, TypeError
        If `max_speed` or `max_translation` is not greater than zero, or `max_translation` is greater than 1e100; or as
        `open_recording`.

    Examples
    --------
    >>> tree = load("small.bag")
    >>> tree.chain("map", "laser")
    ['map', 'odom', 'base_link', 'laser']
    """
    limit = None if max_speed is None else SpeedLimit(max_speed)
    found = Problems()
    tree = TransformTree(keep=None, max_translation=max_translation)
    with open_recording(path, topics=topics, prefix=prefix, namespaces=namespaces) as recording:
        fill(tree, recording, found, since, until, limit=limit)
        remarks = recording.remarks
    if problems is not None:
        problems.update(found)
        if isinstance(problems, Problems):
            problems.details += found.details
        return tree
    logger, file = logging.getLogger("tfbus"), printable(os.fspath(path))
    if found:
        reasons = ", ".join(f"{count} x {reason}" for reason, count in found.most_common())
        logger.warning("left out of %s: %s", file, printable("; ".join([reasons, *found.details])))
    for remark in remarks:
        logger.warning("%s: %s", file, printable(remark))
    return tree


def fill(
    tree: TransformTree,
    recording: Recording,
    problems: Problems,
    since: int | None = None,
    until: int | None = None,
    *,
    limit: SpeedLimit | None = None,
    progress: Callable[[int], object] | None = None,
) -> None:
    """Insert the samples of a recording into a tree, and count by reason those that are left out.

    Parameters
    ----------
    tree : TransformTree
    recording : Recording
    problems : Problems
    since, until : int, optional
        As `load`.
    limit : SpeedLimit, optional
    progress : callable, optional
        Called with the number of messages in each block that has been inserted.
    """
    forest = forest_of(tree)
    for block in recording.blocks(since, until):
        columns = block.columns() if limit is None else None
        if columns is None or not _append(forest, columns, tree.max_translation):
            _commit(forest, block, problems, tree.max_translation, limit)
        if progress is not None:
            progress(len(block))
    if limit is not None:
        forest.commit(
            sound_samples(forest.frames, limit.undecided(), forest.names.parents, problems, tree.max_translation)
        )
        problems.update(limit.dropped)
    forest.forget_changes()


def _append(forest: Forest, columns: list[Columns], max_translation: float) -> bool:
    """Insert the samples of a block, if no edge changes by them; returns whether that was so."""
    together: dict[str, list[Columns]] = {}
    for each in columns:
        x, y, z = each.rows[:, :3].T
        near = (x * x + y * y + z * z).max() <= max_translation**2
        history = forest.frames.get(each.child)
        if not near or history is None or (history.parent, history.static) != (each.parent, each.static):
            return False
        together.setdefault(each.child, []).append(each)
    for child, parts in together.items():
        first = parts[0]
        if len(parts) == 1 and forest.can_append(first.parent, child, first.authority, first.stamps):
            forest.append(child, first.stamps, first.rows)
        else:
            # Such as a stamp that comes again, or several authorities.
            samples = [
                (place, sample) for part in parts for place, sample in zip(part.order, _samples(part), strict=True)
            ]
            forest.commit(tuple(sample for _, sample in sorted(samples, key=itemgetter(0))))
    return True


def _samples(columns: Columns) -> Iterator[TransformStamped]:
    for stamp, row in zip(columns.stamps.tolist(), columns.rows.tolist(), strict=True):
        sample = TransformStamped.__new__(TransformStamped)
        sample._fields = columns.parent, columns.child, stamp, tuple(row), columns.authority, columns.static
        yield sample


def _commit(
    forest: Forest,
    block: Block | DecodedBlock,
    problems: Problems,
    max_translation: float,
    limit: SpeedLimit | None,
) -> None:
    for _, batch, errors in block.messages():
        if errors:
            problems.note(errors)
        if limit is not None:
            batch = limit.admit(_near(batch, problems, max_translation))
        forest.commit(sound_samples(forest.frames, batch, forest.names.parents, problems, max_translation))


def sound_samples(
    edges: Mapping[str, NewestEdge],
    batch: Batch,
    parents: Container[str],
    problems: Counter[str],
    max_translation: float = MAX_TRANSLATION,
) -> Batch:
    """Return the batch without the samples that are too far away or would close a loop of parents, and count those.

    Parameters
    ----------
    edges : mapping of child to its newest edge
        Every edge has a sample, because nothing is ever removed from a recording.
    batch : tuple of TransformStamped
    parents : container of str
        The frames that are a parent of one of the edges.
    problems : Counter
    max_translation : float
        In m.
    """
    square = max_translation**2
    for sample in batch:
        parent, child, _, row, _, _ = sample._fields
        edge = edges.get(child)
        x, y, z, _, _, _, _ = row
        # Not `>`, which is false for NaN.
        if edge is None or edge.parent != parent or not x * x + y * y + z * z <= square:
            break
    else:
        # The usual case: no child has got another parent, so there is no new loop.
        return batch
    accepted, refused = admit(edges, _near(batch, problems, max_translation), parents)
    problems.update(error.reason for error in refused)
    return accepted


def _near(batch: Batch, problems: Counter[str], max_translation: float) -> Batch:
    """The batch without the samples that are too far away, which are counted."""
    far = [sample for sample in batch if not is_within(sample, max_translation)]
    if not far:
        return batch
    problems.update(not_physical(sample, max_translation).reason for sample in far)
    return tuple(sample for sample in batch if is_within(sample, max_translation))
