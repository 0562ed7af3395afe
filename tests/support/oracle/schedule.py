"""Random schedules of what can happen on a bus.

Stamps are offsets, in s, from a stamp that goes on by one second from burst to burst. Durations are in s.
"""

from dataclasses import dataclass
from itertools import pairwise, permutations, product

from hypothesis import strategies as st

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
    """What happens without a task switch, and how long the clock then goes on.

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
CHAINS = [
    *(Publish(tuple(Edge(*ends, stamp) for ends in CHAIN)) for stamp in OFFSETS),
    Publish(tuple(Edge(*ends, None) for ends in CHAIN[2:])),
]
BUFFERS = range(4)
PAIRS = tuple(permutations(FRAMES, 2))
# Lists of all that can be asked, because a single draw is quick.
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

publishes = st.lists(st.sampled_from(EDGES), min_size=1, max_size=4).map(tuple).map(Publish)
chains = st.sampled_from(CHAINS)
asks = st.sampled_from(ASKS)
other_asks = st.sampled_from(ASKS_FOR_NO_OLD_ANSWER) | st.sampled_from(ASKS_IN_TIME_TRAVEL)
rare: list[Happening] = [
    *(Remove(frame) for frame in FRAMES * 2),
    *(Jump(by) for by in (-9, -5, -1, 1, 4, 9)),
    *(Join(keep, prefix) for keep, prefix in product((None, 2, 4), (False, True))),
    *(Join(keep, False, prefill) for keep, prefill in product((None, 2), (0, 1, 2))),
    *(Leave(0), Leave(1), CloseBus()),
]
rarely = st.sampled_from(rare)
happenings: st.SearchStrategy[Happening] = st.one_of(
    *[publishes] * 3, *[chains] * 3, *[asks] * 3, other_asks, *[rarely] * 2
)
PLACES: list[tuple[int, ...]] = [(), (), (), (), (), (0,), (1,), (2, 0)]
AROUND = list(product(PLACES, PLACES, (0.0, 0.5, 1.5, 5.0)))
bursts = st.builds(
    lambda around, happenings: Burst(around[0], happenings, around[1], around[2]),
    st.sampled_from(AROUND),
    st.lists(happenings, min_size=2, max_size=5).map(tuple),
)
schedules = st.lists(bursts, min_size=3, max_size=7)
