"""Asks tfbus what was asked of the real tf2, and says where the two differ."""

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

from bags import transforms_in
from steps import LATEST, SECOND, TRANSLATION, Step, verb_of

import tfbus
from tfbus import InvalidTransformError, Latest, Outcome, Transform, TransformLookupError, TransformStamped
from tfbus import TransformTree as Tree

TOLERANCE = 1e-9


def disagreements(recorded: Step) -> Iterator[str]:
    """Every step of a recorded scenario in which tfbus does not do what was recorded, or what is stated beside it."""
    tree = Tree(recorded["keep"])
    for number, step in enumerate(recorded["steps"]):
        verb = verb_of(step)
        where = f"{recorded['scenario']}, step {number}, {verb} {step[verb]}"
        by_tf2 = translated(step["tf2"])
        expected = step["tfbus"] if "deviation" in step else by_tf2
        if "deviation" in step and agree(by_tf2, step["tfbus"]):
            yield f"{where}: {step['deviation']!r} is no deviation, both answer {step['tf2']}"
        actual = ask(tree, verb, step[verb])
        if not agree(actual, expected):
            yield f"{where}: expected {expected}, tfbus answers {actual}"


def translated(answer: Any) -> Any:
    """tf2's answer in tfbus' words."""
    return TRANSLATION.get(answer, answer) if isinstance(answer, str) else answer


def agree(one: Any, other: Any) -> bool:
    """Whether two answers are the same: of a lookup, the stamp exactly and the transform to 1e-9 m and rad."""
    if not (_is_place(one) and _is_place(other)):
        return bool(one == other)
    (stamp, place, turn), (other_stamp, other_place, other_turn) = one, other
    same, flipped = (math.dist(turn, [sign * part for part in other_turn]) for sign in (1.0, -1.0))
    # Unit quaternions are half as far apart as the rotations.
    return stamp == other_stamp and math.dist(place, other_place) <= TOLERANCE and 2 * min(same, flipped) <= TOLERANCE


def _is_place(answer: Any) -> bool:
    return isinstance(answer, list) and len(answer) == 3 and isinstance(answer[1], list)


def ask(tree: Tree, verb: str, arguments: list[Any]) -> Any:
    """tfbus' answer, in the words of a recording."""
    if verb == "insert":
        return _insert(tree, False, arguments)
    if verb == "insert static":
        return _insert(tree, True, arguments)
    try:
        return _QUESTIONS[verb](tree, *arguments)
    except TransformLookupError as error:
        return type(error).__name__


def _insert(tree: Tree, is_static: bool, arguments: Any) -> str:
    parent, child, stamp, translation, rotation = arguments
    try:
        outcome = tree.insert(
            TransformStamped(parent, child, stamp, Transform(translation, rotation), "golden", is_static)
        )
    except InvalidTransformError:
        return "invalid"
    if outcome is Outcome.EXPIRED:
        return "expired"
    # A static sample always takes the place of the one before; of a moving one it is worth to be told.
    return "replaced" if outcome is Outcome.REPLACED and not is_static else "stored"


def _insert_bag(tree: Tree, name: str, shift: int) -> dict[str, int]:
    outcomes: Counter[str] = Counter()
    for is_static, parent, child, stamp, translation, rotation in transforms_in(name):
        outcomes[_insert(tree, is_static, (parent, child, stamp - shift * SECOND, translation, rotation))] += 1
    return dict(outcomes)


def _instant(at: Any) -> int | Latest:
    return tfbus.LATEST if at == LATEST else int(at)


def _question(at: Any, travel: tuple[Any, ...]) -> dict[str, Any]:
    if not travel:
        return {"at": _instant(at)}
    source_at, fixed = travel
    return {"at": _instant(at), "source_at": _instant(source_at), "fixed": fixed}


def _lookup(tree: Tree, target: str, source: str, at: Any, *travel: Any) -> Any:
    found = tree.lookup(target, source, **_question(at, travel))
    if (found.parent, found.child) != (target, source):
        return f"the answer is between {found.parent} and {found.child}"
    return [found.stamp, list(found.transform.translation), list(found.transform.rotation)]


def _can(tree: Tree, target: str, source: str, at: Any, *travel: Any) -> bool:
    return tree.can_transform(target, source, **_question(at, travel))


def _chain(tree: Tree, target: str, source: str, at: Any) -> list[str]:
    return tree.chain(target, source, _instant(at))


_QUESTIONS: dict[str, Any] = {
    "lookup": _lookup,
    "can": _can,
    "latest": Tree.latest_common_stamp,
    "chain": _chain,
    "parent": Tree.parent,
    "known": Tree.__contains__,
    "frames": Tree.frames,
    "clear": Tree.clear,
    "bag": _insert_bag,
}
