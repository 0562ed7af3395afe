"""The promises of tfbus about errors and stamps, in the most obvious way: for questions that nobody wrote by hand.

Where tf2's recorded answer is another one, the step gets the deviation that explains it. No transform is predicted.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from bags import transforms_in
from deviations import DEVIATIONS
from steps import LATEST, SECOND, Stamp, Step, verb_of

UNKNOWN, DISCONNECTED = "UnknownFrameError", "DisconnectedError"
FUTURE, PAST = "FutureExtrapolationError", "PastExtrapolationError"


@dataclass
class Edge:
    """The parents that a child's samples name, by stamp; of a static child, only the newest."""

    parent: str
    static: bool
    static_stamp: int = 0
    parents: dict[int, str] = field(default_factory=dict)

    def parent_at(self, at: Stamp) -> str:
        """The parent that holds: of the newest sample up to `at`, or else of the oldest."""
        if at == LATEST or not self.parents:
            return self.parent
        before = [stamp for stamp in self.parents if stamp <= int(at)]
        return self.parents[max(before) if before else min(self.parents)]

    def error_at(self, at: int) -> str | None:
        """The error of a question without an answer, else None."""
        if self.static:
            return None
        if not self.parents or at > max(self.parents):
            return FUTURE
        return PAST if at < min(self.parents) else None


Edges = dict[str, Edge]


def annotated(recorded: Step, answers: dict[str, str]) -> Step:
    """A recorded scenario with its deviations; `answers` translates tf2's words."""
    edges: Edges = {}
    keep = round(recorded["keep"] * SECOND)
    steps = [_annotate(edges, keep, step, answers) for step in recorded["steps"]]
    return {**recorded, "steps": steps}


def _annotate(edges: Edges, keep: int, step: Step, answers: dict[str, str]) -> Step:
    verb, by_tf2 = verb_of(step), step["tf2"]
    arguments = step[verb]
    if verb in ("insert", "insert static"):
        _insert(edges, keep, verb == "insert static", *arguments[:3])
        return step
    if verb == "bag":
        name, shift = arguments
        for is_static, parent, child, stamp, _, _ in transforms_in(name):
            _insert(edges, keep, is_static, parent, child, stamp - shift * SECOND)
        return step
    if verb == "clear":
        for edge in edges.values():
            edge.parents.clear()
        return step
    if isinstance(by_tf2, str):
        by_tf2 = answers.get(by_tf2, by_tf2)
    ruled = latest_stamp(edges, *arguments) if verb == "latest" else stamp_of_answer(edges, *arguments)
    expected = _expected(verb, ruled, by_tf2)
    if expected == by_tf2:
        return step
    tf2_alone_raises = isinstance(by_tf2, str) and not isinstance(expected, str)
    if tf2_alone_raises:
        raise RuntimeError(f"tf2 raises where the design has an answer, {expected}: {step}")
    name = _explanation(edges, verb, arguments, by_tf2, expected)
    deviation = DEVIATIONS[name]
    stated = {"tfbus": expected, "deviation": name, "expected_by": deviation.expected_by, "reason": deviation.reason}
    return {**step, **stated}


def _expected(verb: str, ruled: int | str | None, by_tf2: Any) -> Any:
    if verb == "can":
        return isinstance(ruled, int)
    if verb == "lookup" and isinstance(ruled, int):
        return [ruled, *by_tf2[1:]] if isinstance(by_tf2, list) else [ruled]
    return ruled


def _explanation(edges: Edges, verb: str, arguments: list[Any], by_tf2: Any, expected: Any) -> str:
    if verb == "latest" and expected is None:
        return "latest of itself" if arguments[0] == arguments[1] else "static stamp"
    if isinstance(expected, list):
        return "stamp of a leg" if _any_leg_moves(edges, *arguments) else "static stamp"
    if expected in (UNKNOWN, False):
        return "forgotten name" if isinstance(by_tf2, str) else "unknown in itself"
    if expected == DISCONNECTED:
        return "disconnected first"
    if expected == PAST and by_tf2 == DISCONNECTED:
        return "leg that is over"
    if any(not edge.static and not edge.parents for edge in edges.values()) and by_tf2 == DISCONNECTED:
        return "empty history"
    if expected == FUTURE and LATEST in arguments:
        return "latest lags"
    return "which edge" if by_tf2 in _errors(edges, *arguments) else "needless edge"


def _insert(edges: Edges, keep: int, is_static: bool, parent: str, child: str, stamp: int) -> None:
    edge = edges.setdefault(child, Edge(parent, is_static))
    if edge.static != is_static:
        raise ValueError(f"no rule for {child}, which is both static and moving")
    if is_static:
        edge.parent, edge.static_stamp = parent, stamp
        return
    edge.parents[stamp] = parent
    newest = max(edge.parents)
    edge.parents = {stamp: parent for stamp, parent in edge.parents.items() if stamp >= newest - keep}
    edge.parent = edge.parents[newest]


# The rules


def stamp_of_answer(
    edges: Edges, target: str, source: str, at: Stamp, source_at: Stamp | None = None, fixed: str | None = None
) -> int | str:
    """The stamp of a lookup's answer, or the error."""
    if source_at is None or fixed is None:
        return _leg(edges, target, source, at)
    if not all(_is_known(edges, name) for name in (target, source, fixed)):
        return UNKNOWN
    legs = _leg(edges, target, fixed, at), _leg(edges, fixed, source, source_at)
    for error in (PAST, DISCONNECTED, FUTURE):
        if error in legs:
            return error
    still = [not _moving(edges, *ends) for ends in ((target, fixed, at), (fixed, source, source_at))]
    return legs[1] if at == LATEST and still == [True, False] else legs[0]


def latest_stamp(edges: Edges, target: str, source: str) -> int | str | None:
    """The stamp that LATEST means for two frames; None where nothing moves, or the error."""
    if not (_is_known(edges, target) and _is_known(edges, source)):
        return UNKNOWN
    if _path(edges, target, source, LATEST) is None:
        return DISCONNECTED
    moving = _moving(edges, target, source, LATEST)
    if not all(edge.parents for edge in moving):
        return FUTURE
    return min((max(edge.parents) for edge in moving), default=None)


def _leg(edges: Edges, target: str, source: str, at: Stamp) -> int | str:
    if at == LATEST:
        latest = latest_stamp(edges, target, source)
        if latest is None:
            still = edges.get(target) if target == source else None
            if still is not None and not still.static:
                return max(still.parents, default=0)
            path = [still] if still else _path(edges, target, source, at) or []
            return max((edge.static_stamp for edge in path), default=0)
        if isinstance(latest, str):
            return latest
        return FUTURE if isinstance(_leg(edges, target, source, latest), str) else latest
    if not (_is_known(edges, target) and _is_known(edges, source)):
        return UNKNOWN
    if _path(edges, target, source, at) is None:
        return DISCONNECTED
    errors = _errors(edges, target, source, at)
    return PAST if PAST in errors else FUTURE if FUTURE in errors else int(at)


def _errors(edges: Edges, target: str, source: str, at: Stamp, *travel: Any) -> set[str | None]:
    """Of all edges that are needed."""
    if travel:
        source_at, fixed = travel
        return _errors(edges, target, fixed, at) | _errors(edges, fixed, source, source_at)
    if at == LATEST:
        return {FUTURE if isinstance(_leg(edges, target, source, at), str) else None}
    return {edge.error_at(int(at)) for edge in _path(edges, target, source, at) or ()}


def _is_known(edges: Edges, name: str) -> bool:
    return name in edges or any(name == edge.parent or name in edge.parents.values() for edge in edges.values())


def _path(edges: Edges, target: str, source: str, at: Stamp) -> list[Edge] | None:
    """The edges up to the lowest common ancestor; None if there is none."""
    ups, downs = _climb(edges, source, at), _climb(edges, target, at)
    for frame in ups:
        if frame in downs:
            return [edges[name] for name in (*_until(ups, frame), *_until(downs, frame))]
    return None


def _moving(edges: Edges, target: str, source: str, at: Stamp) -> list[Edge]:
    return [edge for edge in _path(edges, target, source, at) or () if not edge.static]


def _any_leg_moves(edges: Edges, target: str, source: str, at: Stamp, *travel: Any) -> bool:
    if not travel:
        return bool(_moving(edges, target, source, at))
    source_at, fixed = travel
    return bool(_moving(edges, target, fixed, at) or _moving(edges, fixed, source, source_at))


def _climb(edges: Edges, frame: str, at: Stamp) -> list[str]:
    names = [frame]
    while names[-1] in edges:
        names.append(edges[names[-1]].parent_at(at))
    return names


def _until(names: list[str], last: str) -> Iterable[str]:
    return names[: names.index(last)]
