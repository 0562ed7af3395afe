"""A whole recording in a tree, for analysis without an event loop."""

import logging
import os
from collections import Counter
from collections.abc import Iterable, Mapping

from tfbus.geometry.stamped import Batch
from tfbus.recording.recording import RecordedMessage, open_recording
from tfbus.tree.cycles import NewestEdge, admit
from tfbus.tree.tree import TransformTree


def load(
    path: str | os.PathLike[str],
    since: int | None = None,
    until: int | None = None,
    *,
    problems: Counter[str] | None = None,
) -> TransformTree:
    """A tree with all transforms of a recording, or of a part of it, however old they are.

    Transforms that are wrong, or would close a loop of parents, are left out and counted, as is what is lost of a
    damaged file.

    Parameters
    ----------
    path : str or path-like
        As `open_recording`.
    since, until : int, optional
        The first and the last log time, in ns. What was static before `since` is in the tree as well.
    problems : Counter, optional
        Where to count what was left out, by reason. If there is none, it is logged as a warning.

    Returns
    -------
    TransformTree
        With ``keep=None``.

    Raises
    ------
    RecordingError
        If it cannot be read at all.
    """
    counted: Counter[str] = Counter() if problems is None else problems
    tree = TransformTree(keep=None)
    with open_recording(path) as recording:
        fill(tree, recording.messages(since, until), counted)
    if problems is None and counted:
        reasons = ", ".join(f"{count} x {reason}" for reason, count in counted.most_common())
        logging.getLogger("tfbus").warning("left out of %s: %s", os.fspath(path), reasons)
    return tree


def fill(tree: TransformTree, messages: Iterable[RecordedMessage], problems: Counter[str]) -> None:
    """Put the samples of some messages into a tree; what is wrong with them is counted by reason."""
    for _, batch, errors in messages:
        if errors:
            problems.update(error.reason for error in errors)
        tree.commit(sift(tree.forest.frames, batch, problems))
    tree.forest.forget_changes()


def sift(edges: Mapping[str, NewestEdge], batch: Batch, problems: Counter[str]) -> Batch:
    """The batch without the samples that would close a loop of parents; those are counted.

    Parameters
    ----------
    edges : mapping of child to its newest edge
        Each with a sample, as long as nothing is ever removed.
    batch : tuple of TransformStamped
    problems : Counter
    """
    for sample in batch:
        parent, child, _, _, _, _ = sample._fields
        edge = edges.get(child)
        if edge is None or edge.parent != parent:
            accepted, refused = admit(edges, batch)
            problems.update(error.reason for error in refused)
            return accepted
    # Nearly always: no other parent, so no new loop.
    return batch
