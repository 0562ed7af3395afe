"""The latest common time: tf1's getLatestCommonTime, and what pins it."""

from itertools import permutations

from steps import SECOND, Scenario, can, clear, deviates, latest, lookup, placed, sample, static

FUTURE = "FutureExtrapolationError"


def scenarios() -> list[Scenario]:
    """All of them."""
    return [
        _of_a_chain(),
        _of_siblings(),
        _disconnected(),
        *_in_any_order(),
        _of_a_frame_with_itself(),
        _of_static_edges(),
        _pinned_by_a_dead_edge(),
        _pinned_out_of_the_window(),
        _with_static_edges(),
        _after_a_new_parent(),
    ]


def _of_a_chain() -> Scenario:
    """The minimum along the chain, both ways, with the stamp of the answer; then one link after the other goes on."""
    steps = [sample("a", "b", SECOND), sample("b", "c", SECOND), latest("a", "c"), lookup("a", "c")]
    for parent, child, second in (("a", "b", 2), ("b", "c", 2), ("b", "c", 4), ("a", "b", 3)):
        steps.append(sample(parent, child, second * SECOND, float(second)))
        steps += [latest("a", "c"), latest("c", "a"), latest("a", "b"), latest("b", "c")]
        steps += [lookup("a", "c"), lookup("c", "a"), lookup("b", "c"), can("a", "c")]
    return Scenario("latest of a chain", steps)


def _of_siblings() -> Scenario:
    """Only up to the shared parent: what is above it does not vote."""
    steps = [sample(parent, child, SECOND // 2, 1.0) for parent, child in ("ab", "bc", "bd", "de")]
    for parent, child, second in (("a", "b", 1), ("b", "c", 5), ("b", "d", 6), ("d", "e", 7), ("b", "c", 8)):
        steps.append(sample(parent, child, second * SECOND, float(second)))
        for pair in (("c", "d"), ("d", "c"), ("a", "d"), ("b", "c"), ("e", "c"), ("e", "a")):
            steps += [latest(*pair), lookup(*pair)]
    return Scenario("latest of siblings", steps)


def _disconnected() -> Scenario:
    steps = [sample("a", "b", SECOND), sample("x", "y", 2 * SECOND)]
    for pair in (("a", "x"), ("b", "y"), ("y", "b"), ("a", "zz"), ("zz", "a"), ("zz", "yy")):
        steps += [latest(*pair), lookup(*pair), can(*pair)]
    steps += [
        sample("b", "x", 3 * SECOND),
        latest("a", "y"),
        latest("y", "a"),
        deviates(lookup("x", "a"), "latest lags", FUTURE),
    ]
    return Scenario("latest of two trees", steps)


def _in_any_order() -> list[Scenario]:
    found = []
    links = (("a", "b", 3), ("b", "c", 1), ("c", "d", 2))
    for order in permutations(links):
        steps = [sample(parent, child, second * SECOND, float(second)) for parent, child, second in order]
        steps += [latest("a", "d"), latest("d", "a"), latest("b", "d"), latest("a", "b")]
        for parent, child, second in reversed(order):
            steps += [sample(parent, child, (second - 1) * SECOND + 7, 0.5), latest("a", "d")]
        title = " ".join(child for _, child, _ in order)
        found.append(
            Scenario(f"latest does not depend on order, {title}", [*steps, lookup("b", "c"), lookup("c", "d")])
        )
    return found


def _of_a_frame_with_itself() -> Scenario:
    steps = [sample("a", "b", 2 * SECOND, 1.0), static("b", "s", 1.0)]
    steps += [
        lookup("b", "b"),
        lookup("b", "b", 7 * SECOND),
        lookup("a", "a"),
        lookup("a", "a", 7 * SECOND),
        lookup("s", "s"),
        can("b", "b"),
        can("a", "a", 7 * SECOND),
        deviates(latest("b", "b"), "latest of itself", None),
        deviates(latest("a", "a"), "latest of itself", None),
        deviates(latest("s", "s"), "latest of itself", None),
    ]
    return Scenario("a frame in itself", steps)


def _of_static_edges() -> Scenario:
    steps = [
        static("a", "b", 1.0, stamp=5 * SECOND),
        static("b", "c", 2.0, stamp=9 * SECOND),
        static("a", "d", 4.0),
        deviates(latest("a", "c"), "static stamp", None),
        deviates(lookup("a", "c"), "static stamp", placed(9 * SECOND, 3.0)),
        deviates(lookup("b", "a"), "static stamp", placed(5 * SECOND, -1.0)),
        deviates(lookup("b", "b"), "static stamp", placed(5 * SECOND, 0.0)),
        lookup("a", "d"),
        lookup("a", "c", 7 * SECOND),
        lookup("d", "c", 1),
        can("a", "c"),
    ]
    return Scenario("latest of static edges", steps)


def _pinned_by_a_dead_edge() -> Scenario:
    """One edge that has stopped holds all answers back, as long as the others still remember its last stamp."""
    steps = [sample("a", "b", second * SECOND, float(second)) for second in range(1, 21)]
    steps += [sample("b", "c", second * SECOND, 1.0) for second in (10, 11, 12)]
    steps += [latest("a", "c"), lookup("a", "c"), lookup("c", "a"), lookup("a", "c", 15 * SECOND), lookup("a", "b")]
    steps += [sample("b", "c", 15 * SECOND, 4.0), latest("a", "c"), lookup("a", "c")]
    return Scenario("latest pinned by a dead edge", steps)


def _pinned_out_of_the_window() -> Scenario:
    """The edge stopped so long ago that the other one has forgotten."""
    steps = [sample("a", "b", second * SECOND, float(second)) for second in (20, 21, 22)]
    steps += [
        sample("b", "c", 2 * SECOND, 1.0),
        latest("a", "c"),
        deviates(lookup("a", "c"), "latest lags", FUTURE),
        deviates(lookup("c", "a"), "latest lags", FUTURE),
        can("a", "c"),
        lookup("a", "c", 2 * SECOND),
        sample("b", "c", 21 * SECOND, 1.0),
        lookup("a", "c"),
    ]
    return Scenario("latest pinned where the others have forgotten", steps)


def _with_static_edges() -> Scenario:
    steps = [static("a", "b", 1.0, stamp=50 * SECOND), static("c", "d", 2.0)]
    steps += [sample("b", "c", 2 * SECOND, 1.0), sample("b", "c", 4 * SECOND, 3.0), sample("d", "e", 3 * SECOND, 1.0)]
    for pair in (("a", "d"), ("d", "a"), ("a", "e"), ("c", "e")):
        steps += [latest(*pair), lookup(*pair)]
    return Scenario("static edges do not vote for the latest", steps)


def _after_a_new_parent() -> Scenario:
    """The latest path is that of the newest parents; what it answers is looked up where all of them have come to."""
    steps = [sample("root", frame, second * SECOND, 1.0) for frame in ("p", "q") for second in (1, 2)]
    steps += [
        sample("p", "x", SECOND, 5.0),
        sample("p", "x", 2 * SECOND, 6.0),
        latest("root", "x"),
        lookup("root", "x"),
    ]
    steps += [sample("q", "x", 4 * SECOND, 7.0), latest("root", "x"), latest("q", "x"), latest("p", "x")]
    steps += [lookup("q", "x"), lookup("root", "x"), lookup("p", "x"), lookup("p", "x", 2 * SECOND)]
    steps += [sample("root", "q", 5 * SECOND, 2.0), lookup("root", "x"), lookup("root", "x", 4 * SECOND)]
    steps += [
        clear(),
        sample("root", "x", SECOND),
        sample("island", "y", SECOND),
        sample("x", "y", 3 * SECOND),
        deviates(lookup("root", "y"), "latest lags", FUTURE),
        sample("root", "x", 4 * SECOND),
        lookup("root", "y"),
    ]
    return Scenario("latest after a new parent", steps)
