"""Random schedules of what can happen on a bus.

Stamps are offsets, in s, from a stamp that goes on by one second from burst to burst. Durations are in s.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise, permutations, product
from random import Random

FRAMES = ("map", "r/odom", "r/base", "s/base", "tool")
PREFIX = "r/"
SHARED = frozenset({"map"})
START = 100


@dataclass(frozen=True)
class Edge:
    """A sample to publish; `stamp` is None for a static one."""

    parent: str
    child: str
    stamp: int | None


@dataclass(frozen=True)
class Publish:
    edges: tuple[Edge, ...]


@dataclass(frozen=True)
class Remove:
    frame: str


@dataclass(frozen=True)
class Jump:
    by: int


@dataclass(frozen=True)
class Join:
    """`prefill` is a place in the list of the buffers that are on the bus."""

    keep: int | None
    prefix: bool = False
    prefill: int | None = None


@dataclass(frozen=True)
class Leave:
    place: int


@dataclass(frozen=True)
class CloseBus:
    pass


@dataclass(frozen=True)
class Ask:
    """`buffer` is a place in the list of all buffers; `at` and `source_at` are None for the latest."""

    buffer: int
    target: str
    source: str
    at: int | None
    timeout: float | None
    max_age: int | None = None
    fixed: str | None = None
    source_at: int | None = None


Happening = Publish | Remove | Jump | Join | Leave | CloseBus | Ask


@dataclass(frozen=True)
class Burst:
    """Actions without a task switch, and the time that the clock then goes on.

    `cancelled_first` and `cancelled_last` are places among the lookups that wait when the burst begins.
    """

    cancelled_first: tuple[int, ...]
    happenings: tuple[Happening, ...]
    cancelled_last: tuple[int, ...]
    then: float


OFFSETS = range(-4, 4)
CHAIN = tuple(pairwise(FRAMES))
# Half of the edges continue one chain, so that there often is an answer; the others reparent, or close a loop.
ENDS = [*permutations(FRAMES, 2), *CHAIN * 5]
EDGES = [Edge(*ends, stamp) for ends, stamp in product(ENDS, (*OFFSETS, None))]
STEADY_EDGES = [Edge(*ends, stamp) for ends, stamp in product(CHAIN, OFFSETS)]
CHAINS = [
    *(Publish(tuple(Edge(*ends, stamp) for ends in CHAIN)) for stamp in OFFSETS),
    Publish(tuple(Edge(*ends, None) for ends in CHAIN[2:])),
]
BUFFERS = range(4)
PAIRS = tuple(permutations(FRAMES, 2))
ASKS = [
    Ask(buffer, *pair, at, timeout)
    for buffer, pair, at, timeout in product(
        BUFFERS, PAIRS, (*OFFSETS, None, None, None), (None, None, None, 0.0, 0.5, 5.0)
    )
]
ASKS_FOR_NO_OLD_ANSWER = [
    Ask(buffer, *pair, None, timeout, max_age)
    for buffer, pair, timeout, max_age in product(BUFFERS, PAIRS, (None, 2.0, 8.0), range(6))
]
ASKS_IN_TIME_TRAVEL = [
    Ask(buffer, *pair, at, timeout, None, fixed, source_at)
    for buffer, pair, at, timeout, fixed, source_at in product(
        BUFFERS, PAIRS, (-1, 1, None), (None, 5.0), FRAMES, (-2, 0, None)
    )
]

RARE: list[Happening] = [
    *(Remove(frame) for frame in FRAMES * 2),
    *(Jump(by) for by in (-9, -5, -1, 1, 4, 9)),
    *(Join(keep, prefix) for keep, prefix in product((None, 2, 4), (False, True))),
    *(Join(keep, False, prefill) for keep, prefill in product((None, 2), (0, 1, 2))),
    *(Leave(0), Leave(1), CloseBus()),
]
PLACES: list[tuple[int, ...]] = [(), (), (), (), (), (0,), (1,), (2, 0)]


def random_schedule(seed: int) -> list[Burst]:
    """One of as many schedules as there are numbers, always the same for a number."""
    random = Random(seed)
    # What is frequent differs from schedule to schedule, so that each kind comes often somewhere.
    weights = [random.choice((1, 2, 5)) for _ in range(6)]
    # Where parents change all the time, lookups are woken all the time, and a wake-up that is missing is not missed.
    edges = random.choice((EDGES, STEADY_EDGES))

    def happening() -> Happening:
        kind = random.choices(range(6), weights)[0]
        if kind == 0:
            return Publish(tuple(random.choice(edges) for _ in range(random.randint(1, 4))))
        return random.choice((CHAINS, ASKS, ASKS_FOR_NO_OLD_ANSWER, ASKS_IN_TIME_TRAVEL, RARE)[kind - 1])

    def burst() -> Burst:
        happenings = tuple(happening() for _ in range(random.randint(2, 5)))
        return Burst(random.choice(PLACES), happenings, random.choice(PLACES), random.choice((0.0, 0.5, 1.5, 5.0)))

    return [burst() for _ in range(random.randint(2, 5))]


def smaller(bursts: list[Burst]) -> Iterator[list[Burst]]:
    """The schedules with one burst, or one happening, less."""
    for place, burst in enumerate(bursts):
        before, after = bursts[:place], bursts[place + 1 :]
        yield before + after
        for left_out in range(len(burst.happenings)):
            happenings = burst.happenings[:left_out] + burst.happenings[left_out + 1 :]
            yield [*before, replace(burst, happenings=happenings), *after]
