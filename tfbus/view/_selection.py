"""The facts about the selected frame, as texts."""

import math
from collections.abc import Iterable

from tfbus.errors import TransformLookupError
from tfbus.stamps import SECOND, Latest, format_age, format_duration, format_stamp
from tfbus.tree.history import Edge
from tfbus.tree.rendering import format_rate
from tfbus.tree.tree import TransformTree, forest_of


def selection_facts(
    tree: TransformTree, fixed: str | None, frame: str, at: int | Latest, now: int, delay: float | None = None
) -> dict[str, str]:
    """The pose of a frame in the fixed frame, and what is known of the edge above it.

    Parameters
    ----------
    tree : TransformTree
    fixed : str or None
        The fixed frame, if there is one.
    frame : str
        The selected frame.
    at : int or LATEST
        The stamp of the pose, in ns.
    now : int
        The stamp (ns) that the age is counted from.
    delay : float, optional
        The mean time from the stamp of a sample to its arrival, in s.

    Returns
    -------
    dict of str to str
        By label, in the order in which people want to read them.
    """
    forest = forest_of(tree)
    with forest.lock:
        history = forest.frames.get(frame)
        edge = None if history is None else history.edge()
    return {"frame": frame, **_pose_facts(tree, fixed, frame, at), **_edge_facts(edge, now, delay)}


def _pose_facts(tree: TransformTree, fixed: str | None, frame: str, at: int | Latest) -> dict[str, str]:
    if fixed is None:
        return {"pose": "there is no fixed frame"}
    try:
        found = tree.lookup(fixed, frame, at)
    except TransformLookupError as error:
        return {"pose": f"none: {error}"}
    transform = found.transform
    return {
        "in": fixed,
        "xyz": f"{_join(transform.translation)} m",
        "rpy": f"{_join(map(math.degrees, transform.as_rpy()))} deg",
        "quaternion": f"{_join(transform.rotation)} (x y z w)",
        "at": "any time" if found.static else format_stamp(found.stamp),
        "chain": " → ".join(reversed(tree.chain(fixed, frame, at))),
    }


def _edge_facts(edge: Edge | None, now: int, delay: float | None) -> dict[str, str]:
    if edge is None:
        return {"parent": "none, it is a root"}
    known = {"parent": edge.parent, "rate": format_rate(edge.static, edge.newest, edge.rate)}
    if edge.newest is not None:
        known["age"] = format_age(edge.newest, now).removeprefix("age ")
    if delay is not None:
        known["delay"] = format_duration(round(delay * SECOND))
    return {**known, "authority": edge.authority or "not known"}


def _join(numbers: Iterable[float]) -> str:
    return " ".join(f"{number:z.6f}" for number in numbers)
