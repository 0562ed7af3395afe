"""Static edges, new parents, loops, clearing, and lookups through a fixed frame."""

import math
from itertools import product

from steps import (
    LATEST,
    SECOND,
    Numbers,
    Scenario,
    Stamp,
    Step,
    can,
    can_travel,
    chain,
    clear,
    deviates,
    frames,
    known,
    latest,
    lookup,
    parent,
    placed,
    sample,
    static,
    travel,
)

FUTURE, DISCONNECTED = "FutureExtrapolationError", "DisconnectedError"


def scenarios() -> list[Scenario]:
    """All of them."""
    return [
        _static_at_all_times(),
        _static_and_moving_chain(),
        _static_with_another_parent(),
        _static_said_again(),
        _static_becomes_moving(),
        _moving_becomes_static(),
        _new_parent_while_moving(),
        _new_parent_in_another_tree(),
        _two_publishers_in_turn(),
        _cycle(),
        _loop_in_the_past(),
        _disconnected_first(),
        _chain_needs_no_sample(),
        _clear(),
        _clear_and_static(),
        _fixed_frame_matrix(),
        _fixed_frame_of_static_legs(),
        _parents(),
    ]


def _static_at_all_times() -> Scenario:
    steps = [static("a", "b", 1.0), static("b", "c", (0.0, 1.0, 0.0))]
    for pair in (("a", "b"), ("a", "c"), ("c", "a")):
        for at in (LATEST, 1, SECOND // 2, 100 * SECOND, 1000 * SECOND):
            steps += [lookup(*pair, at), can(*pair, at)]
    return Scenario("static at all times", steps)


def _static_and_moving_chain() -> Scenario:
    """Two static links and a moving one: there only where that one has a sample."""
    steps = [static("a", "b", 1.0), static("b", "c", 1.0), sample("c", "d", 10 * SECOND, 1.0)]
    for at in (SECOND, 10 * SECOND, 100 * SECOND):
        steps += [lookup("a", "d", at), lookup("d", "a", at), can("a", "d", at), lookup("a", "c", at)]
    steps += [lookup("a", "d"), lookup("d", "b"), can("a", "d")]
    return Scenario("static and moving chain", steps)


def _static_with_another_parent() -> Scenario:
    steps = [static("a", "b", 1.0), static("b", "c", 1.0), sample("c", "d", 2 * SECOND, 1.0), lookup("a", "c", 5)]
    steps += [static("new", "b", 3.0), lookup("new", "c", 5), lookup("new", "d", 2 * SECOND), parent("b")]
    steps += [
        deviates(lookup("a", "c", 5), "forgotten name", "UnknownFrameError"),
        deviates(known("a"), "forgotten name", tfbus=False),
    ]
    steps += [static("a", "x", 0.0), lookup("a", "c", 5), can("a", "b"), lookup("x", "a", 5)]
    return Scenario("static with another parent", steps)


def _static_said_again() -> Scenario:
    steps: list[Step] = []
    for number in range(5):
        steps += [static("a", "b", float(number), stamp=number * SECOND), lookup("a", "b", 7), lookup("a", "b", SECOND)]
    return Scenario("static said again", [*steps, static("a", "b", 4.0), lookup("a", "b", 7)])


def _static_becomes_moving() -> Scenario:
    steps = [
        static("a", "b", 1.0),
        sample("a", "b", 5 * SECOND, 2.0),
        lookup("a", "b", 5 * SECOND),
        deviates(lookup("a", "b", 6 * SECOND), "last kind wins", FUTURE),
        deviates(lookup("a", "b", 4 * SECOND), "last kind wins", "PastExtrapolationError"),
        sample("a", "b", 7 * SECOND, 4.0),
        deviates(lookup("a", "b", 6 * SECOND), "last kind wins", placed(6 * SECOND, 3.0)),
        deviates(latest("a", "b"), "last kind wins", 7 * SECOND),
    ]
    return Scenario("static becomes moving", steps)


def _moving_becomes_static() -> Scenario:
    """tf2's LookUp_Static_Transfrom_Fail among them: moving, cleared, then static."""
    steps = [
        sample("a", "b", 5 * SECOND, 1.0),
        sample("a", "b", 6 * SECOND, 2.0),
        static("a", "b", 9.0, stamp=8 * SECOND),
        deviates(lookup("a", "b", 5 * SECOND), "last kind wins", placed(5 * SECOND, 9.0)),
        deviates(lookup("a", "b", SECOND), "last kind wins", placed(SECOND, 9.0)),
        lookup("a", "b", 8 * SECOND),
        deviates(lookup("a", "b", 99 * SECOND), "last kind wins", placed(99 * SECOND, 9.0)),
        sample("x", "y", 5 * SECOND),
        clear(),
        static("x", "y", 3.0),
        deviates(lookup("x", "y", 5 * SECOND), "last kind wins", placed(5 * SECOND, 3.0)),
    ]
    return Scenario("moving becomes static", steps)


def _new_parent_while_moving() -> Scenario:
    """The old value is held until the new parent's first sample."""
    steps = [static("root", "p", 100.0), static("root", "q", 200.0)]
    steps += [sample("p", "x", second * SECOND, float(second)) for second in (1, 2)]
    steps += [sample("q", "x", second * SECOND, float(second)) for second in (5, 6)]
    steps += [sample("x", "tip", at, (0.0, 1.0, 0.0)) for at in (1, 9 * SECOND)]
    for at in (SECOND, 3 * SECOND // 2, 2 * SECOND, 2 * SECOND + 1, 4 * SECOND, 5 * SECOND - 1, 5 * SECOND, 6 * SECOND):
        steps += [lookup("root", "x", at), lookup("p", "x", at), lookup("tip", "q", at), chain("root", "tip", at)]
    steps += [lookup("root", "x", SECOND - 1), lookup("root", "x", 6 * SECOND + 1), lookup("root", "x"), parent("x")]
    steps += [sample("p", "x", 3 * SECOND, 3.0), lookup("root", "x", 4 * SECOND), lookup("root", "x", 5 * SECOND // 2)]
    return Scenario("new parent while moving", steps)


def _new_parent_in_another_tree() -> Scenario:
    steps = [static("old", "old leaf", 1.0), static("new", "new leaf", 1.0)]
    steps += [sample("old", "x", second * SECOND, float(second)) for second in (1, 2)]
    steps += [sample("new", "x", second * SECOND, float(second)) for second in (4, 5)]
    for at in (SECOND, 2 * SECOND, 3 * SECOND, 4 * SECOND, 5 * SECOND, LATEST):
        steps += [lookup("old", "x", at), lookup("x", "new leaf", at), can("old leaf", "x", at), can("new", "x", at)]
    return Scenario("new parent in another tree", steps)


def _two_publishers_in_turn() -> Scenario:
    steps = [static("world", "p", 0.0), static("world", "q", 100.0)]
    steps += [sample("pq"[second % 2], "x", second * SECOND, float(second)) for second in range(1, 6)]
    steps += [lookup("world", "x", half * SECOND // 2) for half in range(2, 11)]
    return Scenario("two publishers in turn", [*steps, lookup("world", "x")])


def _cycle() -> Scenario:
    steps = [
        sample("a", "b", SECOND, 1.0),
        sample("b", "c", SECOND, 1.0),
        deviates(sample("c", "a", SECOND, 1.0), "cycle", "invalid"),
        lookup("a", "c", SECOND),
        lookup("a", "b", SECOND),
        deviates(parent("a"), "cycle", None),
        deviates(static("b", "a"), "cycle", "invalid"),
        static("z", "y"),
        deviates(lookup("z", "c", SECOND), "cycle", DISCONNECTED),
    ]
    return Scenario("cycle", steps)


def _loop_in_the_past() -> Scenario:
    """Late samples turn an old edge round; by the newest samples there is no loop."""
    steps = [
        sample("root", "a", 10 * SECOND, 1.0),
        sample("root", "b", 10 * SECOND, 2.0),
        sample("a", "b", 5 * SECOND, 3.0),
        sample("b", "a", 5 * SECOND, 4.0),
        lookup("root", "a", 10 * SECOND),
        deviates(lookup("root", "a", 5 * SECOND), "loop in the past", DISCONNECTED),
        lookup("a", "b", 10 * SECOND),
        lookup("b", "a"),
    ]
    return Scenario("loop in the past", steps)


def _disconnected_first() -> Scenario:
    steps = [sample("a", "b", at * SECOND) for at in (1, 2)] + [sample("x", "y", at * SECOND) for at in (1, 2)]
    steps += [lookup("b", "y", SECOND), lookup("a", "y", 2 * SECOND), lookup("b", "y")]
    for at in (3 * SECOND, SECOND // 2):
        for pair in (("b", "y"), ("y", "b"), ("a", "y"), ("y", "a")):
            steps.append(deviates(lookup(*pair, at), "disconnected first", DISCONNECTED))
        steps += [lookup("a", "x", at), can("b", "y", at)]
    return Scenario("disconnected whatever the windows", steps)


def _chain_needs_no_sample() -> Scenario:
    steps = [sample("a", "b", SECOND), sample("b", "c", SECOND), static("b", "d")]
    steps += [
        chain("a", "c", SECOND),
        deviates(chain("c", "d"), "chain too long", ["c", "b", "d"]),
        deviates(chain("d", "c"), "chain too long", ["d", "b", "c"]),
        deviates(chain("a", "a"), "chain", ["a"]),
        deviates(chain("c", "c", SECOND), "chain", ["c"]),
        deviates(chain("a", "c", 5 * SECOND), "chain", ["a", "b", "c"]),
        deviates(chain("d", "c", 1), "chain", ["d", "b", "c"]),
        deviates(chain("a", "d", 5 * SECOND), "chain", ["a", "b", "d"]),
        chain("a", "zz"),
        deviates(chain("zz", "a", SECOND), "root of nothing", "UnknownFrameError"),
        sample("x", "y", SECOND),
        chain("a", "y"),
        chain("a", "y", SECOND),
    ]
    return Scenario("a chain needs no sample", steps)


def _clear() -> Scenario:
    steps = [sample("map", "base", at * SECOND, float(at)) for at in (100, 101)]
    steps += [static("base", "camera", 1.0), static("camera", "lens", 1.0), lookup("map", "lens"), clear()]
    steps += [
        lookup("map", "base", 100 * SECOND),
        lookup("camera", "map", 100 * SECOND),
        deviates(lookup("map", "base"), "empty history", FUTURE),
        deviates(latest("map", "lens"), "empty history", FUTURE),
        can("map", "base"),
        lookup("base", "lens", 5),
        known("map"),
        frames(),
        deviates(parent("base"), "empty history", "map"),
        sample("map", "base", SECOND, 7.0),
        lookup("map", "lens"),
        lookup("map", "lens", SECOND),
        lookup("map", "lens", 100 * SECOND),
    ]
    return Scenario("clear", steps)


def _clear_and_static() -> Scenario:
    """tf2's LookUp_Static_Transfrom_Succeed."""
    steps = [sample("a", "b", SECOND), clear(), static("other", "b2", 2.0), lookup("other", "b2", 5 * SECOND)]
    return Scenario("clear, then static", [*steps, lookup("b2", "other", SECOND), frames()])


def _turned(angle: float) -> Numbers:
    return 0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2)


def _fixed_frame_matrix() -> Scenario:
    """tf1's canTransform and lookupTransform: any frames, times inside, outside and latest, any fixed frame."""
    steps: list[Step] = []
    for second in range(1, 6):
        steps.append(sample("parent", "child", second * SECOND, (second, 0.5, 0.0), _turned(0.3 * second)))
        steps.append(sample("parent", "other", second * SECOND + SECOND // 2, (0.0, second, -1.0), _turned(-0.2)))
    steps.append(static("child", "tip", (0.0, 0.0, 1.0), _turned(1.0)))
    steps.append(sample("island", "palm", 2 * SECOND))
    times: tuple[Stamp, ...] = (2 * SECOND, 7 * SECOND // 2, LATEST)
    pairs = (("tip", "other"), ("child", "child"), ("child", "parent"), ("other", "tip"))
    for pair, at, source_at, fixed in product(pairs, times, times, ("parent", "child", "other")):
        if at != LATEST or fixed not in (pair[0], "child" if pair[0] == "tip" else None):
            steps.append(travel(*pair, at, source_at, fixed))
    for at, source_at in product((SECOND // 2, 2 * SECOND, 9 * SECOND), repeat=2):
        steps.append(can_travel("tip", "other", at, source_at, "parent"))
        steps.append(can_travel("child", "parent", at, source_at, "child"))
        if SECOND // 2 not in (at, source_at) or at == source_at:
            steps.append(travel("tip", "other", at, source_at, "parent"))
    steps += [
        travel("tip", "palm", 2 * SECOND, 2 * SECOND, "parent"),
        travel("tip", "other", 2 * SECOND, 2 * SECOND, "palm"),
        travel("zz", "other", 2 * SECOND, 2 * SECOND, "parent"),
        travel("tip", "zz", 2 * SECOND, 2 * SECOND, "parent"),
        travel("tip", "other", 2 * SECOND, 2 * SECOND, "zz"),
        travel("zz", "zz", 2 * SECOND, 2 * SECOND, "zz"),
        can_travel("tip", "palm", 2 * SECOND, 2 * SECOND, "parent"),
        can_travel("zz", "zz", 2 * SECOND, 2 * SECOND, "zz"),
        deviates(travel("palm", "tip", 2 * SECOND, 9 * SECOND, "parent"), "disconnected first", DISCONNECTED),
        travel("tip", "palm", 9 * SECOND, 2 * SECOND, "parent"),
        deviates(
            travel("tip", "palm", SECOND // 2, 2 * SECOND, "parent"), "leg that is over", "PastExtrapolationError"
        ),
    ]
    return Scenario("fixed frame, all combinations", steps)


def _fixed_frame_of_static_legs() -> Scenario:
    """The latest of target's leg, where nothing moves on it."""
    steps = [static("map", "sign", 3.0), sample("map", "cart", 4 * SECOND, 4.0), sample("map", "cart", 6 * SECOND, 6.0)]
    steps += [
        travel("sign", "cart", 5 * SECOND, 4 * SECOND, "map"),
        travel("cart", "sign", LATEST, 1, "map"),
        deviates(travel("sign", "cart", LATEST, 5 * SECOND, "map"), "stamp of a leg", placed(5 * SECOND, 2.0)),
        deviates(travel("map", "cart", LATEST, 5 * SECOND, "map"), "stamp of a leg", placed(5 * SECOND, 5.0)),
        deviates(travel("sign", "cart", LATEST, LATEST, "map"), "stamp of a leg", placed(6 * SECOND, 3.0)),
        deviates(travel("cart", "map", LATEST, 5 * SECOND, "cart"), "stamp of a leg", placed(5 * SECOND, -5.0)),
        travel("cart", "cart", LATEST, 5 * SECOND, "cart"),
    ]
    return Scenario("fixed frame over static legs", steps)


def _parents() -> Scenario:
    """tf1's getParent: ten frames, the root and an unknown one. The parent of a stamp shows in the chains."""
    steps: list[Step] = []
    children = ("b", "c", "d", "e", "f", "g", "h", "i", "j")
    for number, child in enumerate(children):
        steps.append(sample("abcdefghi"[number // 2], child, SECOND + number, 1.0))
    steps += [parent(child) for child in children]
    steps += [parent("a"), deviates(parent("zz"), "root of nothing", "UnknownFrameError")]
    steps += [known(name) for name in ("a", "j", "zz", "", "/a", "A")]
    return Scenario("parents", [*steps, frames()])
