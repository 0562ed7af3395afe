"""The numbers: interpolation of translation and rotation, and a helix."""

import math
import random
from itertools import pairwise, product

from steps import LATEST, SECOND, Numbers, Scenario, Step, deviates, lookup, placed, sample, static, travel

HALF_TURNS = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def scenarios() -> list[Scenario]:
    """All of them."""
    return [
        _straight(),
        _held_over_a_new_parent(),
        *(_turning(sign) for sign in (1, -1)),
        _small_turns(),
        _tiny_turn(),
        _half_turns(),
        _signs_along_a_path(),
        _long_gap(),
        _helix(),
    ]


def _unit(rng: random.Random) -> Numbers:
    parts = [rng.gauss(0.0, 1.0) for _ in range(4)]
    norm = math.hypot(*parts)
    return [part / norm for part in parts]


def _vector(rng: random.Random, size: float = 10.0) -> Numbers:
    return [rng.uniform(-size, size) for _ in range(3)]


def _about_z(angle: float) -> Numbers:
    return 0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2)


def _straight() -> Scenario:
    """tf2's CartesianInterpolation."""
    rng = random.Random(1)
    steps: list[Step] = []
    for pair in range(20):
        start = (10 * pair + 1) * SECOND
        steps += [sample("a", "b", at, _vector(rng)) for at in (start, start + 100)]
        steps += [lookup("a", "b", start + part) for part in (0, 1, 13, 50, 77, 99, 100)]
    return Scenario("straight between samples", steps)


def _held_over_a_new_parent() -> Scenario:
    """tf2's ReparentingInterpolationProtection."""
    rng = random.Random(2)
    steps = [
        sample("p", "x", SECOND, _vector(rng), _unit(rng)),
        sample("q", "x", SECOND + 100, _vector(rng), _unit(rng)),
    ]
    steps += [lookup("p", "x", SECOND + part) for part in range(0, 100, 9)]
    return Scenario("held over a new parent", [*steps, lookup("q", "x", SECOND + 100), lookup("p", "x", SECOND + 100)])


def _turning(sign: int) -> Scenario:
    """tf2's AngularInterpolation; with the second quaternion's sign flipped it is the same turn."""
    rng = random.Random(3)
    steps: list[Step] = []
    for pair in range(20):
        start = (10 * pair + 1) * SECOND
        steps.append(sample("a", "b", start, _vector(rng), _unit(rng)))
        steps.append(sample("a", "b", start + SECOND, _vector(rng), [sign * part for part in _unit(rng)]))
        steps += [lookup("a", "b", start + part * SECOND // 10) for part in (1, 3, 5, 8, 10)]
    return Scenario(f"turning between samples, second sign {sign:+d}", steps)


def _small_turns() -> Scenario:
    steps: list[Step] = []
    for power in range(-7, 1):
        start = (10 * (power + 8)) * SECOND
        for part, sign in ((0, 1.0), (4, 1.0), (8, -1.0)):
            turn = [sign * number for number in _about_z(0.7 + part * 10.0**power)]
            steps.append(sample("a", "b", start + part * SECOND, 1.0, turn))
        steps += [lookup("a", "b", start + part * SECOND) for part in (1, 2, 3, 5, 7)]
        steps += [lookup("b", "a", start + SECOND)]
    return Scenario("small turns", steps)


def _tiny_turn() -> Scenario:
    """Ten nanoradians in four seconds; tf2 answers with the older sample where its arc cosine comes out as zero."""
    steps = [sample("a", "b", SECOND), sample("a", "b", 5 * SECOND, 4.0, _about_z(1e-8))]
    for part in (1, 2, 3):
        answer = placed(SECOND + part * SECOND, float(part), _about_z(part * 0.25e-8))
        steps.append(deviates(lookup("a", "b", SECOND + part * SECOND), "tiny turn", answer))
    return Scenario("tiny turn", [*steps, lookup("a", "b", SECOND), lookup("a", "b", 5 * SECOND)])


def _half_turns() -> Scenario:
    """Of the two ways round, that of the quaternions as they are given."""
    steps: list[Step] = []
    for number, (one, other) in enumerate(pairwise((*HALF_TURNS, HALF_TURNS[0], HALF_TURNS[2], HALF_TURNS[1]))):
        for flip in (1.0, -1.0):
            start = (20 * number + (10 if flip < 0 else 0) + 1) * SECOND
            steps.append(sample("a", "b", start, 0.0, one))
            steps.append(sample("a", "b", start + SECOND, 1.0, [flip * part for part in other]))
            steps += [lookup("a", "b", start + part * SECOND // 4) for part in range(5)]
    same = [0.6, 0.0, -0.8, 0.0]
    steps += [sample("a", "c", SECOND, 0.0, same), sample("a", "c", 2 * SECOND, 0.0, [-part for part in same])]
    return Scenario("half turns", [*steps, lookup("a", "c", 3 * SECOND // 2), lookup("c", "a", 2 * SECOND)])


def _signs_along_a_path() -> Scenario:
    rng = random.Random(4)
    steps: list[Step] = []
    for number in range(8):
        for at in (SECOND, 2 * SECOND, 3 * SECOND):
            flip = rng.choice((1.0, -1.0))
            turn = [flip * part for part in _unit(rng)]
            steps.append(sample(f"f{number // 2}", f"f{number + 1}", at, _vector(rng), turn))
    names = [f"f{number}" for number in range(9)]
    for target, source in product(names, names):
        steps.append(lookup(target, source, rng.randrange(SECOND, 3 * SECOND)))
    return Scenario("signs along a path", steps)


def _long_gap() -> Scenario:
    """The distance between two samples does not matter."""
    steps = [sample("a", "b", SECOND, 0.0), sample("a", "b", 10 * SECOND + 900_000_000, 99.0, _about_z(3.0))]
    return Scenario("long gap", [*steps, lookup("a", "b", 2 * SECOND), lookup("a", "b", 10 * SECOND)])


def _helix() -> Scenario:
    """A carriage climbs, on it an arm turns: every tenth of a second, and from each instant to each other."""
    steps: list[Step] = [static("hub", "tip", 2.0)]
    for second in range(1, 12):
        steps.append(sample("world", "carriage", second * SECOND, (0.0, 0.0, 0.5 * second)))
        steps.append(sample("carriage", "hub", second * SECOND, (0.1 * second, 0.0, 0.0), _about_z(0.6 * second)))
    for tenth in range(10, 111, 3):
        at = tenth * SECOND // 10
        steps += [lookup("world", "tip", at), lookup("tip", "world", at)]
        for fixed in ("world", "carriage", "hub"):
            steps.append(travel("tip", "tip", at, 5 * SECOND + 1, fixed))
            steps.append(travel("carriage", "tip", 6 * SECOND, at, fixed))
    steps += [lookup("world", "tip"), travel("tip", "tip", LATEST, 2 * SECOND, "world")]
    return Scenario("helix", steps)
