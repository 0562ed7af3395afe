"""`load`, which reads a whole recording into a tree, for analysis without an event loop."""

import logging
import os
from collections import Counter
from collections.abc import Container, Iterable, Mapping

from tfbus.geometry.bounds import MAX_TRANSLATION, is_within, not_physical
from tfbus.geometry.stamped import Batch
from tfbus.recording.recording import RecordedMessage, open_recording
from tfbus.tree.cycles import NewestEdge, admit
from tfbus.tree.tree import TransformTree, forest_of


def load(
    path: str | os.PathLike[str],
    since: int | None = None,
    until: int | None = None,
    *,
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
    problems : Counter, optional
        Gets the number of transforms and messages that were left out, by reason. Without it, they are logged as a
        warning.
    max_translation : float
        The greatest magnitude of a translation, in m, at most 1e100.

    Returns
    -------
    TransformTree
        With ``keep=None``.

    Raises
    ------
    TypeError, ValueError
        If `max_translation` is not greater than zero and at most 1e100.
    RecordingError
        If the recording cannot be read at all.
    """
    counted: Counter[str] = Counter() if problems is None else problems
    tree = TransformTree(keep=None, max_translation=max_translation)
    with open_recording(path) as recording:
        fill(tree, recording.messages(since, until), counted)
    if problems is None and counted:
        reasons = ", ".join(f"{count} x {reason}" for reason, count in counted.most_common())
        logging.getLogger("tfbus").warning("left out of %s: %s", os.fspath(path), reasons)
    return tree


def fill(tree: TransformTree, messages: Iterable[RecordedMessage], problems: Counter[str]) -> None:
    """Insert the samples of some messages into a tree, and count by reason those that are left out."""
    forest = forest_of(tree)
    for _, batch, errors in messages:
        if errors:
            problems.update(error.reason for error in errors)
        forest.commit(sound_samples(forest.frames, batch, forest.names.parents, problems, tree.max_translation))
    forest.forget_changes()


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
    near = tuple(sample for sample in batch if is_within(sample, max_translation))
    if len(near) < len(batch):
        far = (sample for sample in batch if not is_within(sample, max_translation))
        problems.update(not_physical(sample, max_translation).reason for sample in far)
    accepted, refused = admit(edges, near, parents)
    problems.update(error.reason for error in refused)
    return accepted
