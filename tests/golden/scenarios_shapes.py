"""Trees of every shape, all pairs of frames: tf2's configurations and tf1's lists."""

import math
from collections.abc import Callable
from itertools import pairwise, permutations, product

from steps import LATEST, SECOND, Numbers, Scenario, Stamp, Step, can, chain, lookup, sample

Edges = dict[str, tuple[str, float]]

ONE_LINK: Edges = {"2": ("1", 1.0)}
I_SHAPE: Edges = {"b": ("a", 1.0), "c": ("b", 2.0)}
V_SHAPE: Edges = {"b": ("a", 1.0), "c": ("b", 2.0), "f": ("a", 4.0), "g": ("f", 8.0)}
Y_SHAPE: Edges = {"b": ("a", 1.0), "c": ("b", 2.0), "d": ("b", 4.0), "e": ("d", 8.0)}


def scenarios() -> list[Scenario]:
    """One or more for each configuration."""
    return [
        *_configurations("one link", ONE_LINK),
        *_configurations("i", I_SHAPE),
        *_configurations("v", V_SHAPE),
        *_configurations("y", Y_SHAPE),
        *_configurations("one link and v", {**ONE_LINK, **V_SHAPE}),
        _chains_in_a_v(),
        _ring_of_45_degrees(),
        *_lists(),
        _siblings_through_the_root(),
        _compound(),
    ]


def _names(edges: Edges) -> list[str]:
    return list(dict.fromkeys(name for child, (parent, _) in edges.items() for name in (parent, child)))


def _configurations(name: str, edges: Edges) -> list[Scenario]:
    """Two samples around each time, 1 ns to 4 s apart; asked in the middle and for the latest."""
    found = []
    for second, space in product((10, 100_000), (2, SECOND // 1_000, 4 * SECOND)):
        at = second * SECOND
        steps: list[Step] = []
        for child, (parent, distance) in edges.items():
            steps.append(sample(parent, child, at - space // 2, distance - 0.5))
            steps.append(sample(parent, child, at + space // 2, distance + 0.5))
        times: tuple[Stamp, ...] = (at, LATEST) if second == 10 else (at,)
        for target, source in product(_names(edges), repeat=2):
            steps += [*(lookup(target, source, time) for time in times), can(target, source, at)]
        found.append(Scenario(f"{name}, {space} ns round {second} s", steps))
    return found


def _chains_in_a_v() -> Scenario:
    steps = [sample(parent, child, SECOND, distance) for child, (parent, distance) in V_SHAPE.items()]
    names = _names(V_SHAPE)
    for target, source in permutations(names, 2):
        steps += [chain(target, source, SECOND), chain(target, source)]
    return Scenario("chains in a v", steps)


def _turned(angle: float) -> Numbers:
    return 0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2)


def _ring_of_45_degrees() -> Scenario:
    """A ring of eight frames, each 45 degrees round from the one before, and the same ring backwards from "a"."""
    forward, backward = "abcdefghi", "ajklmnopq"
    step = math.pi / 4
    there = (math.cos(step) - 1.0, math.sin(step), 0.0)
    back = (math.cos(-step) - 1.0, math.sin(-step), 0.0)
    steps: list[Step] = []
    for ring, place, turn in ((forward, there, _turned(step)), (backward, back, _turned(-step))):
        for parent, child in pairwise(ring):
            steps += [sample(parent, child, at, place, turn) for at in (SECOND, 3 * SECOND)]
    names = forward + backward[1:]
    steps += [lookup(target, source, 2 * SECOND) for target, source in product(names, names)]
    return Scenario("ring of 45 degrees", steps)


def _lists() -> list[Scenario]:
    """tf1's ListOneForward, ListOneInverse, ListTwoForward, ListTwoInverse: at each sample's own stamp."""
    stamps = [number * 7 * SECOND // 10 for number in range(1, 11)]
    numbers: list[Callable[[int], float]] = [lambda n: math.sin(n), lambda n: n / 3.0, lambda n: -n * n / 7.0]
    steps: list[Step] = []
    for number, at in enumerate(stamps):
        place = [number_of(number) for number_of in numbers]
        steps.append(sample("my_parent", "child", at, place))
        steps.append(sample("child", "grandchild", at, place[::-1]))
    one = [[lookup("my_parent", "child", at) for at in stamps], [lookup("child", "my_parent", at) for at in stamps]]
    two = [
        [lookup("my_parent", "grandchild", at) for at in stamps],
        [lookup("grandchild", "my_parent", at) for at in stamps],
    ]
    titles = ("list one forward", "list one inverse", "list two forward", "list two inverse")
    return [Scenario(title, steps + questions) for title, questions in zip(titles, one + two, strict=True)]


def _siblings_through_the_root() -> Scenario:
    """Also a second tree, which is reached from neither."""
    steps: list[Step] = []
    for number in range(1, 6):
        at = number * SECOND
        steps.append(sample("my_parent", "child a", at, (number, -number, 0.5)))
        steps.append(sample("my_parent", "child b", at, (0.0, number / 2, -1.0), _turned(number)))
        steps.append(sample("elsewhere", "disconnected", at, 1.0))
    for number in range(1, 6):
        for pair in (("child a", "child b"), ("child b", "child a"), ("child a", "disconnected")):
            steps += [lookup(*pair, number * SECOND), can(*pair, number * SECOND)]
    steps += [lookup("child a", "disconnected"), lookup("elsewhere", "my_parent", SECOND)]
    return Scenario("siblings through the root", steps)


def _compound() -> Scenario:
    """Turned links in two branches; the samples are 1 ns apart and asked at both."""
    links = {
        "a": ("root", (1.0, 2.0, 3.0), (0.1, -0.2, 0.3, 0.9)),
        "b": ("root", (-1.0, 0.0, 2.0), (-0.6, 0.2, 0.5, 0.4)),
        "c": ("b", (0.0, -3.0, 1.0), (0.7, -0.3, -0.4, -0.1)),
        "d": ("c", (4.0, 1.0, -2.0), (0.1, 0.6, 0.1, 0.2)),
    }
    steps: list[Step] = []
    for child, (parent, place, turn) in links.items():
        norm = math.hypot(*turn)
        unit = [part / norm for part in turn]
        steps += [sample(parent, child, at, place, unit) for at in (SECOND, SECOND + 1, SECOND + 3)]
    names = ["root", *links]
    for target, source in product(names, names):
        steps += [lookup(target, source, at) for at in (SECOND, SECOND + 1, SECOND + 2)]
    return Scenario("compound of turned links", steps)
