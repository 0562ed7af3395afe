"""Random trees with random histories and questions, and the questions to the recorded bags."""

import math
import random
from itertools import product
from operator import itemgetter

from bags import transforms_in
from steps import LATEST, SECOND, Scenario, Stamp, Step

BAGS = {"pr2_tf.bag": 1_795_275_600, "turtlesim.bag": 1_396_293_880}
"""Each with the whole seconds that are taken off: below four million of them a float holds every nanosecond."""

TINY_TURN = 5e-8
"""So close do two quaternions have to be that tf2's arc cosine may come out as zero; twice that are radians."""


def random_trees(first_seed: int, rounds: int) -> list[Scenario]:
    """One scenario a seed."""
    return [random_tree(seed) for seed in range(first_seed, first_seed + rounds)]


def random_tree(seed: int) -> Scenario:
    """Up to 14 frames: static and moving, with different windows, some with another parent later; asked twice."""
    rng = random.Random(seed)
    names = [f"f{number}" for number in range(rng.randint(3, 14))]
    samples: list[Step] = []
    for number in range(1, len(names)):
        # Parents have smaller numbers, so there is never a loop; a second root now and then.
        if number > 1 and rng.random() < 0.04:
            continue
        samples += _history(rng, names[:number], names[number])
    _disorder(rng, samples)
    cut = rng.randint((len(samples) + 1) // 2, len(samples))
    steps = samples[:cut]
    steps += _questions(rng, steps, 15)
    if rng.random() < 0.05:
        steps.append({"clear": []})
        steps += _questions(rng, samples[:cut], 6)
    steps += samples[cut:]
    steps += _questions(rng, samples, 20)
    return Scenario(f"random tree {seed}", steps, keep=rng.choice((2.0, 5.0, 10.0, 60.0)))


def _history(rng: random.Random, above: list[str], child: str) -> list[Step]:
    parent = rng.choice(above)
    if rng.random() < 0.3:
        return [{"insert static": [parent, child, 0, _vector(rng), _unit(rng)]}]
    first = 20 * SECOND + rng.choice((0, 0, rng.randrange(10 * SECOND)))
    stamps = {first + rng.randrange(12 * SECOND) for _ in range(rng.choice((0, 2, 3, 4, 5)))} | {first}
    switch = rng.choice(sorted(stamps)) if rng.random() < 0.15 else max(stamps) + 1
    other = rng.choice(above)
    return [
        {"insert": [other if at >= switch else parent, child, at, _vector(rng), _unit(rng)]} for at in sorted(stamps)
    ]


def _vector(rng: random.Random) -> list[float]:
    return [round(rng.uniform(-10.0, 10.0), 3) for _ in range(3)]


def _whole_quaternions(norm: int) -> list[tuple[int, int, int, int]]:
    """Every x, y, z, w of whole numbers with this sum of squares."""
    found = []
    limit = math.isqrt(norm)
    for x, y, z in product(range(-limit, limit + 1), repeat=3):
        rest = norm - x * x - y * y - z * z
        if rest >= 0 and math.isqrt(rest) ** 2 == rest:
            found += [(x, y, z, sign * math.isqrt(rest)) for sign in (1, -1)]
    return found


# The product of two of them is 125 times a unit quaternion, so three decimals hold that exactly.
_WHOLE = _whole_quaternions(125)


def _unit(rng: random.Random) -> list[float]:
    (ax, ay, az, aw), (bx, by, bz, bw) = rng.choice(_WHOLE), rng.choice(_WHOLE)
    return [
        (aw * bx + ax * bw + ay * bz - az * by) / 125,
        (aw * by - ax * bz + ay * bw + az * bx) / 125,
        (aw * bz + ax * by - ay * bx + az * bw) / 125,
        (aw * bw - ax * bx - ay * by - az * bz) / 125,
    ]


def _stamp_of(step: Step) -> int:
    stamp: int = next(iter(step.values()))[2]
    return stamp


def _disorder(rng: random.Random, samples: list[Step]) -> None:
    """In order of stamp, backwards, anyhow, or nearly in order."""
    order = rng.choice(("in order", "backwards", "shuffled", "late"))
    if order == "shuffled":
        rng.shuffle(samples)
    else:
        late = [(_stamp_of(step) + (rng.randrange(3 * SECOND) if order == "late" else 0), step) for step in samples]
        samples[:] = [step for _, step in sorted(late, key=itemgetter(0), reverse=order == "backwards")]


def _questions(rng: random.Random, samples: list[Step], count: int) -> list[Step]:
    names = sorted({name for step in samples for name in next(iter(step.values()))[:2]})
    stamps = sorted({_stamp_of(step) for step in samples} - {0}) or [SECOND]
    questions: list[Step] = []
    for _ in range(count):
        ends = [rng.choice(names), rng.choice(names)]
        if rng.random() < 0.02:
            ends[rng.randrange(2)] = "unknown"
        target, source = ends
        kind = rng.random()
        if kind < 0.65:
            questions.append({"lookup": [target, source, _instant(rng, stamps)]})
        elif kind < 0.85:
            verb = "can" if kind < 0.68 else "lookup"
            instants = _instant(rng, stamps), _instant(rng, stamps)
            questions.append({verb: [target, source, *instants, rng.choice(names)]})
        elif kind < 0.93:
            questions.append({"can": [target, source, _instant(rng, stamps)]})
        else:
            questions.append({"latest": [target, source]})
    return questions


def _instant(rng: random.Random, stamps: list[int]) -> Stamp:
    """Of some sample, between the first and the last, most often in the middle, near an end, or the latest."""
    kind = rng.random()
    low, high = stamps[0], stamps[-1]
    if kind < 0.2:
        return LATEST
    if kind < 0.4:
        return rng.choice(stamps)
    if kind < 0.5:
        return rng.choice(stamps) + rng.choice((-1, 1))
    if kind < 0.6:
        return rng.randint(low - SECOND, high + SECOND)
    third = (high - low) // 3
    return rng.randint(low + third, high - third)


def bag_scenarios(name: str) -> list[Scenario]:
    """A recorded bag, whole and with a short window."""
    return [_bag_scenario(name, keep, count) for keep, count in ((100.0, 450), (2.0, 150))]


def _bag_scenario(name: str, keep: float, count: int) -> Scenario:
    """Random pairs at samples' stamps, between them, at the latest, and out of range, some through a fixed frame."""
    rng = random.Random(f"{name} {keep}")
    shift = BAGS[name]
    names: set[str] = set()
    last: dict[str, tuple[int, list[float]]] = {}
    moving: set[int] = set()
    inexact: list[tuple[int, int]] = []
    for is_static, parent, child, stamp, _, rotation in transforms_in(name):
        names |= {parent, child}
        if is_static:
            continue
        at = stamp - shift * SECOND
        moving.add(at)
        if child in last and 0 < math.dist(last[child][1], rotation) < TINY_TURN:
            inexact.append((last[child][0], at))
        last[child] = at, rotation
    frames, stamps = sorted(names), sorted(moving)
    steps: list[Step] = [{"bag": [name, shift]}]
    for number in range(count):
        target, source, fixed = rng.choice(frames), rng.choice(frames), rng.choice(frames)
        instant, source_instant = (_recorded_instant(rng, stamps, inexact) for _ in range(2))
        if number % 6 == 0:
            steps.append({"lookup": [target, source, instant, source_instant, fixed]})
        else:
            steps.append({"lookup": [target, source, instant]})
    return Scenario(f"{name}, {keep:g} s kept", steps, keep=keep)


def _recorded_instant(rng: random.Random, stamps: list[int], inexact: list[tuple[int, int]]) -> Stamp:
    """Not where some frame makes a tiny turn: see that deviation."""
    while True:
        at = _any_instant(rng, stamps)
        if at == LATEST or not any(start < int(at) < end for start, end in inexact):
            return at


def _any_instant(rng: random.Random, stamps: list[int]) -> Stamp:
    kind = rng.random()
    if kind < 0.1:
        return LATEST
    if kind < 0.3:
        return rng.choice(stamps)
    if kind < 0.4:
        return rng.randint(stamps[0] - SECOND, stamps[-1] + SECOND)
    return rng.randint(stamps[0], stamps[-1])
