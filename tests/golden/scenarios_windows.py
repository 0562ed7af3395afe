"""The stamps that each edge covers: extrapolation, cache length, order of insertion, repeated stamps."""

import random

from steps import LATEST, SECOND, Scenario, Step, can, deviates, frames, known, latest, lookup, placed, sample

FUTURE, PAST = "FutureExtrapolationError", "PastExtrapolationError"


def scenarios() -> list[Scenario]:
    """All of them."""
    return [
        _nothing(),
        _one_sample(),
        _from_one_value_to_two(),
        _both_ends_both_directions(),
        _needless_ancestors(),
        _which_edge(),
        *(_cache_length(seconds) for seconds in (1, 3, 98)),
        _edge_of_the_window(),
        _keeps_nothing(),
        _late_samples_and_their_names(),
        *_repeatability(),
        _repeated_times(),
        _repeated_elements(),
        _zero_at_front(),
        _nanoseconds_today(),
        _stamp_zero(),
    ]


def _nothing() -> Scenario:
    return Scenario(
        "nothing exists",
        [
            lookup("a", "b", SECOND),
            lookup("a", "b"),
            can("a", "b", SECOND),
            can("a", "b"),
            latest("a", "b"),
            known("a"),
            frames(),
        ],
    )


def _one_sample() -> Scenario:
    steps = [sample("a", "b", 10 * SECOND, 1.0), lookup("a", "zz", 10 * SECOND), lookup("zz", "a"), can("a", "zz")]
    for target, source in (("a", "b"), ("b", "a")):
        for at in (10 * SECOND, 10 * SECOND - 1, 10 * SECOND + 1, 1, 99 * SECOND):
            steps += [lookup(target, source, at), can(target, source, at)]
        steps.append(lookup(target, source))
    return Scenario("one sample exists", steps)


def _from_one_value_to_two() -> Scenario:
    """tf1's ExtrapolationFromOneValue: past and future, through one link and two; then a second sample comes."""
    steps = [sample("my_parent", "child", 10 * SECOND, (1.0, 2.0, 3.0))]
    steps.append(sample("grandparent", "my_parent", 10 * SECOND, (-1.0, 0.0, 7.0)))
    ends = (("my_parent", "child"), ("child", "my_parent"), ("grandparent", "child"), ("child", "grandparent"))
    outside = (1, 10 * SECOND - 1, 10 * SECOND + 1, 10 * SECOND + SECOND, 12 * SECOND)
    steps += [lookup(*pair, at) for pair in ends for at in (10 * SECOND, *outside)]
    steps.append(sample("my_parent", "child", 12 * SECOND, (1.0, 2.0, 4.0)))
    steps += [lookup(*pair, at) for pair in ends for at in outside]
    steps.append(sample("grandparent", "my_parent", 12 * SECOND, (-1.0, 0.0, 8.0)))
    steps += [lookup(*pair, at) for pair in ends for at in outside]
    return Scenario("from one value to two", steps)


def _both_ends_both_directions() -> Scenario:
    steps: list[Step] = []
    for at in (10 * SECOND, 12 * SECOND):
        steps += [sample("a", "b", at, at / SECOND), sample("b", "c", at, 1.0), sample("a", "d", at, 2.0)]
    inside = (10 * SECOND, 10 * SECOND + 1, 11 * SECOND, 12 * SECOND - 1, 12 * SECOND)
    for pair in (("a", "b"), ("b", "a"), ("a", "c"), ("c", "a"), ("c", "d"), ("d", "c")):
        for at in (*inside, 10 * SECOND - 1, 12 * SECOND + 1, SECOND, 99 * SECOND):
            steps += [lookup(*pair, at), can(*pair, at)]
        steps += [lookup(*pair), can(*pair), latest(*pair)]
    return Scenario("both ends, both directions", steps)


def _needless_ancestors() -> Scenario:
    """tf1's NoExtrapolationExceptionFromParent: what is above the common ancestor has other windows."""
    steps = [sample("parent", child, at, at / SECOND) for child in "ab" for at in (SECOND, 10 * SECOND)]
    steps += [
        sample("parent's parent", "parent", SECOND, 1.0),
        sample("parent's parent's parent", "parent's parent", 4),
    ]
    for at in (SECOND, 2 * SECOND, 10 * SECOND, LATEST):
        steps += [lookup("a", "b", at), lookup("b", "a", at), lookup("parent", "a", at), can("a", "b", at)]
    steps += [latest("a", "b"), lookup("parent's parent", "a", 2 * SECOND)]
    return Scenario("needless ancestors", steps)


def _which_edge() -> Scenario:
    """Of two edges that do not cover the stamp, tf2 tells of the one on target's side."""
    steps = [sample("a", "old", at) for at in (SECOND, 2 * SECOND)]
    steps += [sample("a", "new", at) for at in (8 * SECOND, 9 * SECOND)]
    steps += [
        deviates(lookup("old", "new", 5 * SECOND), "which edge", PAST),
        lookup("new", "old", 5 * SECOND),
        can("new", "old", 5 * SECOND),
        lookup("old", "new", SECOND),
        lookup("new", "old", 9 * SECOND),
        lookup("old", "new", 9 * SECOND),
        sample("b", "c", 10 * SECOND),
        sample("b", "c", 11 * SECOND),
        sample("a", "b", 20 * SECOND),
        sample("a", "b", 21 * SECOND),
        deviates(lookup("b", "c", 15 * SECOND), "needless edge", FUTURE),
        lookup("c", "b", 15 * SECOND),
    ]
    return Scenario("which edge is told of", steps)


def _cache_length(seconds: int) -> Scenario:
    """tf1's cache_time test: of a hundred samples, a second apart, just the last of them can be asked."""
    steps = [sample("root", "frame", at * SECOND, float(at)) for at in range(1, 101)]
    steps += [can("root", "frame", at * SECOND) for at in range(1, 101)]
    steps += [lookup("root", "frame", (100 - seconds) * SECOND + shift) for shift in (-1, 0, 1)]
    return Scenario(f"cache of {seconds} s", steps, keep=float(seconds))


def _edge_of_the_window() -> Scenario:
    now = 12 * SECOND
    steps = [sample("a", "b", now, 12.0)]
    steps += [
        sample("a", "b", now - 2 * SECOND - 1, 1.0),
        can("a", "b", now - 2 * SECOND - 1),
        sample("a", "b", now - 2 * SECOND, 2.0),
        lookup("a", "b", now - 2 * SECOND),
        lookup("a", "b", now - 2 * SECOND - 1),
        lookup("a", "b", now - SECOND),
        sample("a", "b", now + 1, 12.0),
        lookup("a", "b", now - 2 * SECOND),
        lookup("a", "b", now - SECOND),
        lookup("a", "b", now),
        sample("a", "b", now - 2 * SECOND, 2.0),
        sample("a", "b", now - 2 * SECOND + 1, 3.0),
        lookup("a", "b", now - 2 * SECOND + 1),
        sample("a", "b", now + 60 * SECOND, 3.0),
        lookup("a", "b", now),
        lookup("a", "b"),
    ]
    return Scenario("exactly at the window's edge and 1 ns beyond", steps, keep=2.0)


def _keeps_nothing() -> Scenario:
    steps = [sample("a", "b", 1 * SECOND, 1.0), sample("a", "b", 2 * SECOND, 2.0), sample("a", "b", 1 * SECOND, 1.0)]
    steps += [lookup("a", "b", at) for at in (SECOND, 3 * SECOND // 2, 2 * SECOND)]
    return Scenario("a window of no length", [*steps, lookup("a", "b")], keep=0.0)


def _late_samples_and_their_names() -> Scenario:
    """tf2 knows a parent by the sample that it has refused, or that has long left the window."""
    steps = [sample("a", "b", 100 * SECOND), sample("late", "b", SECOND), lookup("a", "b", 100 * SECOND)]
    steps += [
        deviates(known("late"), "forgotten name", tfbus=False),
        deviates(lookup("late", "b", 100 * SECOND), "forgotten name", "UnknownFrameError"),
        deviates(frames(), "forgotten name", ["a", "b"]),
        sample("c", "b", 200 * SECOND),
        deviates(known("a"), "forgotten name", tfbus=False),
        deviates(lookup("a", "b", 200 * SECOND), "forgotten name", "UnknownFrameError"),
        lookup("c", "b", 200 * SECOND),
    ]
    return Scenario("late samples and their names", steps)


def _repeatability() -> list[Scenario]:
    """tf2's cache test: 99 samples in order, backwards and shuffled, each with a parent of its own."""
    stamps = list(range(1, 100))
    shuffled = stamps[:]
    random.Random(7).shuffle(shuffled)
    found = []
    for order, name in ((stamps, "in order"), (stamps[::-1], "backwards"), (shuffled, "shuffled")):
        steps = [sample(f"parent {at}", "frame", at, float(at)) for at in order]
        steps += [lookup(f"parent {at}", "frame", at) for at in stamps]
        steps.append(lookup("parent 99", "frame"))
        found.append(Scenario(f"repeatability, inserted {name}", steps))
        one = [sample("a", "frame", at, (at, at * at, 1 / at)) for at in order]
        one += [lookup("a", "frame", at) for at in (1, 2, 50, 98, 99)] + [can("a", "frame", at) for at in (1, 100)]
        found.append(Scenario(f"one parent, inserted {name}", [*one, latest("a", "frame"), lookup("a", "frame")]))
        apart = [sample("a", "frame", at * SECOND // 10, (at, at * at, 1 / at)) for at in order]
        apart += [lookup("a", "frame", at * SECOND // 20) for at in range(2, 199, 13)]
        found.append(Scenario(f"between samples, inserted {name}", apart))
    return found


def _repeated_times() -> Scenario:
    """tf1's RepeatedTimes; which of the two is kept differs between tf1, ROS 1 and ROS 2."""
    first, second = sample("a", "b", 4 * SECOND, (1.0, 0.0, 0.0)), sample("a", "b", 4 * SECOND, (0.0, 2.0, 0.0))
    steps = [
        first,
        deviates(second, "same stamp", "replaced"),
        deviates(lookup("a", "b", 4 * SECOND), "same stamp", placed(4 * SECOND, (0.0, 2.0, 0.0))),
        deviates(lookup("a", "b"), "same stamp", placed(4 * SECOND, (0.0, 2.0, 0.0))),
        sample("a", "b", 6 * SECOND),
        sample("a", "b", 2 * SECOND),
        deviates(lookup("a", "b", 5 * SECOND), "same stamp", placed(5 * SECOND, (0.0, 1.0, 0.0))),
        deviates(lookup("a", "b", 3 * SECOND), "same stamp", placed(3 * SECOND, (0.0, 1.0, 0.0))),
        deviates(sample("z", "b", 6 * SECOND, 3.0), "same stamp", "replaced"),
        deviates(lookup("z", "b", 6 * SECOND), "same stamp", placed(6 * SECOND, 3.0)),
        deviates(lookup("a", "b", 6 * SECOND), "same stamp", "DisconnectedError"),
    ]
    return Scenario("repeated times", steps)


def _repeated_elements() -> Scenario:
    steps = [sample("a", "b", 4 * SECOND, 1.0)]
    steps += [deviates(sample("a", "b", 4 * SECOND, 1.0), "same stamp", "replaced") for _ in range(10)]
    steps += [lookup("a", "b", 4 * SECOND), lookup("a", "b", 4 * SECOND + 1), sample("a", "b", 5 * SECOND, 1.0)]
    return Scenario("repeated elements", [*steps, lookup("a", "b", 9 * SECOND // 2)])


def _zero_at_front() -> Scenario:
    steps = [sample("a", "b", at * SECOND, float(at)) for at in (1, 2, 3)]
    steps += [lookup("a", "b"), sample("a", "b", 8 * SECOND, 8.0), lookup("a", "b")]
    steps += [sample("a", "b", 5 * SECOND, 5.0), lookup("a", "b"), latest("a", "b")]
    return Scenario("the latest is the newest", steps)


def _nanoseconds_today() -> Scenario:
    """At 1.7e9 s a float of seconds has steps of 238 ns."""
    now = 1_700_000_000 * SECOND
    steps = [
        sample("a", "b", now, 0.0),
        deviates(sample("a", "b", now + 10, 10.0), "nanoseconds", "stored"),
        deviates(lookup("a", "b", now + 3), "nanoseconds", placed(now + 3, 3.0)),
        deviates(lookup("a", "b", now + 11), "nanoseconds", FUTURE),
        deviates(lookup("a", "b"), "nanoseconds", placed(now + 10, 10.0)),
        deviates(lookup("a", "b", now - 1), "nanoseconds", PAST),
        lookup("a", "b", now),
    ]
    return Scenario("nanoseconds of today", steps)


def _stamp_zero() -> Scenario:
    steps = [
        sample("a", "b", 0, 0.0),
        sample("a", "b", 2 * SECOND, 2.0),
        sample("b", "c", 0, 5.0),
        deviates(lookup("a", "b", 0), "stamp zero", placed(0, 0.0)),
        lookup("a", "b", SECOND),
        lookup("a", "b"),
        lookup("b", "c"),
        lookup("b", "c", SECOND),
        deviates(latest("a", "c"), "stamp zero", 0),
        deviates(lookup("a", "c"), "stamp zero", placed(0, 5.0)),
        deviates(can("a", "c"), "stamp zero", tfbus=True),
    ]
    return Scenario("stamp zero", steps)
