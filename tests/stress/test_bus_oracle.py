"""Random schedules of everything that can happen on a bus and to its buffers, against a slow and obvious model.

Buffers join late, with and without prefill and prefix, and leave; samples come late or from the future, reparent frames
in the past, turn static, or would close a loop; frames are removed, the clock jumps, lookups wait and are cancelled.
"""

import logging
import math
import os
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise, permutations, product
from random import Random
from typing import Any, NamedTuple

import anyio
import pytest
from anyio.abc import TaskGroup
from support.asking import Asked
from support.plain_tree import Answer, At, Blocked, PlainTree, Sample, check_answer, climb, compare, facts_of, pose

from tfbus import (
    LATEST,
    SECOND,
    Buffer,
    Bus,
    BusClosedError,
    ClockResetError,
    InvalidTransformError,
    LookupTimeoutError,
    SimulatedClock,
    TransformLookupError,
    TransformStamped,
    UnknownFrameError,
)

Run = Callable[[Callable[[], Awaitable[None]]], None]

# A model of a bus: what it gives each buffer


@dataclass(frozen=True)
class Newest:
    """The newest edge of a child: `stamp` is None if it is static."""

    parent: str
    stamp: int | None


def note(edges: dict[str, Newest], sample: Sample) -> None:
    """The last sample decides on the kind; among moving samples the newest one counts."""
    before = edges.get(sample.child)
    if sample.static:
        edges[sample.child] = Newest(sample.parent, None)
    elif before is None or before.stamp is None or sample.stamp >= before.stamp:
        edges[sample.child] = Newest(sample.parent, sample.stamp)


def has_loop(edges: dict[str, Newest]) -> bool:
    parents = {child: edge.parent for child, edge in edges.items()}
    return any(name in climb(parents, parents[name]) for name in parents)


@dataclass
class Held:
    """One buffer. `unseen` has the newest moving edges of the bus that it has not seen, because it joined later."""

    tree: PlainTree
    unseen: dict[str, Newest]
    counted: Counter[str] = field(default_factory=Counter)
    on_the_bus: bool = True

    def offer(self, sample: Sample) -> None:
        """Store a sample, unless it is late and would wrongly be taken for the newest."""
        unseen = self.unseen.get(sample.child)
        late = unseen is not None and unseen.stamp is not None and not sample.static and sample.stamp < unseen.stamp
        if unseen is not None and late and sample.parent != unseen.parent:
            self.counted.update(("superseded", "expired"))
            return
        if not late:
            self.unseen.pop(sample.child, None)
        self.counted[self.tree.store(sample).value] += 1

    def remove(self, frame: str) -> None:
        self.tree.remove(frame)
        self.unseen.pop(frame, None)

    def reset(self) -> None:
        self.tree.reset()
        self.unseen.clear()


class PlainBus:
    """The newest edge of each child, the latched samples, and every buffer that has ever joined."""

    def __init__(self) -> None:
        self.edges: dict[str, Newest] = {}
        self.latched: dict[str, Sample] = {}
        self.buffers: list[Held] = []

    @property
    def on_the_bus(self) -> list[int]:
        """The numbers of the buffers that have joined and not left."""
        return [number for number, held in enumerate(self.buffers) if held.on_the_bus]

    def refuses(self, batch: Sequence[Sample]) -> bool:
        """Whether the newest edges would form a loop after the batch."""
        edges = dict(self.edges)
        for sample in batch:
            note(edges, sample)
        return has_loop(edges)

    def knows(self, frame: str) -> bool:
        """Whether the bus or a buffer on it knows a frame."""
        return any(frame in (child, edge.parent) for child, edge in self.edges.items()) or any(
            frame in self.buffers[number].tree.names() for number in self.on_the_bus
        )

    def publish(self, batch: Sequence[Sample]) -> None:
        for sample in batch:
            note(self.edges, sample)
            self.latched.pop(sample.child, None)
            if sample.static:
                self.latched[sample.child] = sample
            for number in self.on_the_bus:
                self.buffers[number].offer(sample)

    def remove(self, frame: str) -> None:
        self.edges.pop(frame, None)
        self.latched.pop(frame, None)
        for number in self.on_the_bus:
            self.buffers[number].remove(frame)

    def reset(self) -> None:
        """Note that the clock has jumped back."""
        self.edges = {child: edge for child, edge in self.edges.items() if edge.stamp is None}
        for number in self.on_the_bus:
            self.buffers[number].reset()

    def join(self, keep: int | None, prefill: int | None) -> None:
        """A buffer with a window of `keep` ns joins: it has the history of another one, then the latched samples."""
        latched = list(self.latched.values())
        if prefill is None:
            moving = {child: edge for child, edge in self.edges.items() if edge.stamp is not None}
            late = Held(PlainTree(keep), moving)
        else:
            other = self.buffers[prefill]
            late = Held(other.tree.within(keep), dict(other.unseen))
            if other.tree.keep == keep:
                # The two share what the other one was given.
                latched = []
        for sample in latched:
            late.offer(sample)
        self.buffers.append(late)


# Schedules: stamps are offsets, in s, from a stamp that goes on by one second from burst to burst; durations are in s

FRAMES = ("map", "r/odom", "r/base", "s/base", "tool")
PREFIX = "r/"
SHARED = frozenset({"map"})
START = 100


class Edge(NamedTuple):
    """A sample to publish; `stamp` is None for a static one."""

    parent: str
    child: str
    stamp: int | None


class Ask(NamedTuple):
    """`buffer` is a place in the list of all buffers; `at` and `source_at` are None for the latest."""

    buffer: int
    target: str
    source: str
    at: int | None
    timeout: float | None
    max_age: int | None = None
    fixed: str | None = None
    source_at: int | None = None


Happening = tuple[Any, ...]
"""The name of a method of `Game`, and its arguments."""


class Burst(NamedTuple):
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
    *(("publish", *(Edge(*ends, stamp) for ends in CHAIN)) for stamp in OFFSETS),
    ("publish", *(Edge(*ends, None) for ends in CHAIN[2:])),
]
BUFFERS = range(4)
PAIRS = tuple(permutations(FRAMES, 2))
ASKS = [
    ("ask", Ask(buffer, *pair, at, timeout))
    for buffer, pair, at, timeout in product(
        BUFFERS, PAIRS, (*OFFSETS, None, None, None), (None, None, None, 0.0, 0.5, 5.0)
    )
]
ASKS_FOR_NO_OLD_ANSWER = [
    ("ask", Ask(buffer, *pair, None, timeout, max_age))
    for buffer, pair, timeout, max_age in product(BUFFERS, PAIRS, (None, 2.0, 8.0), range(6))
]
ASKS_IN_TIME_TRAVEL = [
    ("ask", Ask(buffer, *pair, at, timeout, None, fixed, source_at))
    for buffer, pair, at, timeout, fixed, source_at in product(
        BUFFERS, PAIRS, (-1, 1, None), (None, 5.0), FRAMES, (-2, 0, None)
    )
]

RARE: list[Happening] = [
    *(("remove", frame) for frame in FRAMES * 2),
    *(("jump", by) for by in (-9, -5, -1, 1, 4, 9)),
    *(("join", keep, prefix) for keep, prefix in product((None, 2, 4), (False, True))),
    *(("join", keep, False, prefill) for keep, prefill in product((None, 2), (0, 1, 2))),
    *(("leave", 0), ("leave", 1), ("close",)),
]
PLACES: list[tuple[int, ...]] = [(), (), (), (), (), (0,), (1,), (2, 0)]


def random_schedule(seed: int) -> list[Burst]:
    """One of as many schedules as there are numbers, always the same for a number."""
    random = Random(seed)
    # The weights differ from schedule to schedule, so that each kind is frequent in some.
    weights = [random.choice((1, 2, 5)) for _ in range(6)]
    # Changes of parents wake all lookups, which would hide a missing wake-up: some schedules have none.
    edges = random.choice((EDGES, STEADY_EDGES))

    def happening() -> Happening:
        kind = random.choices(range(6), weights)[0]
        if kind == 0:
            return "publish", *(random.choice(edges) for _ in range(random.randint(1, 4)))
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
            yield [*before, Burst(burst.cancelled_first, happenings, burst.cancelled_last, burst.then), *after]


# The bus and its model, side by side


@dataclass
class Real:
    """A buffer under test."""

    buffer: Buffer
    prefix: bool

    def has_name(self, frame: str) -> bool:
        """Whether a frame of the bus can be asked for here."""
        return not self.prefix or frame in SHARED or frame.startswith(PREFIX)

    def name(self, frame: str) -> str:
        return frame if not self.prefix or frame in SHARED else frame.removeprefix(PREFIX)


@dataclass
class Waiting:
    """A lookup that has not ended as far as the model knows."""

    ask: Ask
    at: At
    source_at: At
    place: int
    asked: Asked[TransformStamped]
    deadline: float
    fresh: bool = True
    reset: bool = False
    cancelled_first: bool = False
    cancelled_last: bool = False


class Game:
    def __init__(self, tasks: TaskGroup) -> None:
        self.tasks = tasks
        self.clock = SimulatedClock(START * SECOND)
        self.bus = Bus(self.clock)
        self.plain = PlainBus()
        self.reals: list[Real] = []
        self.elapsed = 0.0
        self.middle = START
        self.waiting: list[Waiting] = []
        self.published = 0

    async def play(self, bursts: list[Burst]) -> None:
        self.join(None)
        self.join(2)
        for burst in bursts:
            self.middle += 1
            waiting = list(self.waiting)
            for place in burst.cancelled_first[: len(waiting)]:
                self.cancel(waiting[place % len(waiting)]).cancelled_first = True
            for happening in burst.happenings:
                self.happen(*happening)
            for place in burst.cancelled_last[: len(waiting)]:
                self.cancel(waiting[place % len(waiting)]).cancelled_last = True
            await self.clock.advance(0)
            self.waiting = [waiting for waiting in self.waiting if self.still_waits(waiting)]
            self.check()
            # An answer must not depend on earlier questions, so there are some.
            self.ask_every_buffer(40)
            await self.clock.advance(burst.then)
            self.elapsed += burst.then
            self.waiting = [waiting for waiting in self.waiting if self.still_waits_as_time_passes(waiting)]
        if not self.bus.closed:
            self.join(None)
            self.join(4, False, 0)
        self.bus.close()
        await self.clock.advance(0)
        self.waiting = [waiting for waiting in self.waiting if self.still_waits(waiting)]
        assert self.waiting == []
        self.check()
        self.ask_every_buffer(9)

    # Happenings

    def happen(self, kind: str, *what: Any) -> None:
        if self.bus.closed and kind in ("publish", "remove", "join"):
            with pytest.raises(BusClosedError):
                self.bus.publish(()) if kind == "publish" else self.bus.remove_frame("map")
        else:
            getattr(self, kind)(*what)

    def close(self) -> None:
        self.bus.close()

    def sample(self, edge: Edge) -> Sample:
        self.published += 1
        stamp = (self.middle + (edge.stamp or 0)) * SECOND
        return Sample(edge.parent, edge.child, stamp, pose(self.published), edge.stamp is None)

    def publish(self, *edges: Edge) -> None:
        batch = [self.sample(edge) for edge in edges]
        stamped = [sample.stamped() for sample in batch]
        if self.plain.refuses(batch):
            with pytest.raises(InvalidTransformError, match="loop"):
                self.bus.publish(stamped)
        else:
            self.bus.publish(stamped)
            self.plain.publish(batch)

    def remove(self, frame: str) -> None:
        if self.plain.knows(frame):
            self.bus.remove_frame(frame)
            self.plain.remove(frame)
        else:
            with pytest.raises(UnknownFrameError):
                self.bus.remove_frame(frame)

    def jump(self, by: int) -> None:
        self.clock.set(self.clock.now() + by * SECOND)
        if by < 0 and not self.bus.closed:
            self.plain.reset()
            for waiting in self.waiting:
                waiting.reset |= not waiting.fresh and waiting.place in self.plain.on_the_bus

    def join(self, seconds: int | None, has_prefix: bool = False, place: int | None = None) -> None:
        """Make a buffer with a window of some seconds, and the history of the buffer at a place on the bus."""
        on_the_bus = self.plain.on_the_bus
        prefill = on_the_bus[place % len(on_the_bus)] if place is not None and on_the_bus else None
        other = None if prefill is None else self.reals[prefill].buffer
        names: dict[str, Any] = {"prefix": PREFIX, "shared": SHARED} if has_prefix else {}
        self.reals.append(Real(Buffer(self.bus, seconds, **names, prefill=other), has_prefix))
        self.plain.join(None if seconds is None else seconds * SECOND, prefill)

    def leave(self, place: int) -> None:
        on_the_bus = self.plain.on_the_bus
        if on_the_bus:
            chosen = on_the_bus[place % len(on_the_bus)]
            self.reals[chosen].buffer.close()
            self.plain.buffers[chosen].on_the_bus = False

    def ask(self, ask: Ask) -> None:
        place = ask.buffer % len(self.reals)
        real = self.reals[place]
        if not all(real.has_name(frame) for frame in (ask.target, ask.source, ask.fixed or ask.target)):
            return
        at, source_at = self.stamp_of(ask.at), self.stamp_of(ask.source_at)
        lookup = partial(
            real.buffer.lookup,
            real.name(ask.target),
            real.name(ask.source),
            at,
            source_at=None if ask.fixed is None else source_at,
            fixed=None if ask.fixed is None else real.name(ask.fixed),
            max_age=ask.max_age,
            timeout=ask.timeout,
        )
        deadline = self.elapsed + (math.inf if ask.timeout is None else ask.timeout)
        self.waiting.append(Waiting(ask, at, source_at, place, Asked(self.tasks, lookup), deadline))

    def stamp_of(self, offset: int | None) -> At:
        return LATEST if offset is None else (self.middle + offset) * SECOND

    def cancel(self, waiting: Waiting) -> Waiting:
        waiting.asked.cancel()
        return waiting

    # Checks

    def expected(self, waiting: Waiting) -> Answer | Blocked:
        ask, tree = waiting.ask, self.plain.buffers[waiting.place].tree
        now, age = self.clock.now(), (ask.max_age or 0) * SECOND
        within = None if ask.max_age is None else (now - age, now + age)
        try:
            if ask.fixed is None:
                return tree.lookup(ask.target, ask.source, waiting.at, within)
            return tree.travel(ask.target, ask.source, waiting.at, waiting.source_at, ask.fixed, within)
        except Blocked as blocked:
            return blocked

    def still_waits(self, waiting: Waiting) -> bool:
        """Check how a lookup has ended after a burst; whether it has not."""
        asked, real = waiting.asked, self.reals[waiting.place]
        expected = self.expected(waiting)
        waiting.fresh = False
        closed = self.bus.closed or not self.plain.buffers[waiting.place].on_the_bus
        if waiting.cancelled_first:
            assert asked.cancelled
        elif waiting.reset:
            assert isinstance(asked.error, ClockResetError)
        elif isinstance(expected, Answer):
            check_answer(asked.answer, expected)
            named = (real.name(waiting.ask.target), real.name(waiting.ask.source))
            assert (asked.answer.parent, asked.answer.child) == named
        elif expected.for_good:
            assert isinstance(asked.error, TransformLookupError)
            assert facts_of(asked.error) in expected.acceptable
        elif closed:
            assert isinstance(asked.error, BusClosedError)
        elif waiting.cancelled_last:
            assert asked.cancelled
        elif waiting.deadline <= self.elapsed:
            assert isinstance(asked.error, LookupTimeoutError)
        else:
            assert not asked.ended
            return True
        return False

    def still_waits_as_time_passes(self, waiting: Waiting) -> bool:
        expected = self.expected(waiting)
        assert isinstance(expected, Blocked)
        assert not expected.for_good
        if waiting.deadline > self.elapsed:
            assert not waiting.asked.ended
            return True
        error = waiting.asked.error
        assert isinstance(error, LookupTimeoutError)
        assert isinstance(error.__cause__, TransformLookupError)
        # With a bound on the age, the stamp that was asked for went on with the time.
        asked = [facts[:2] + facts[3:] if waiting.ask.max_age is not None else facts for facts in expected.acceptable]
        found = facts_of(error.__cause__)
        assert (found[:2] + found[3:] if waiting.ask.max_age is not None else found) in asked
        return False

    def check(self) -> None:
        """Compare what is quick to compare."""
        for place, (real, held) in enumerate(zip(self.reals, self.plain.buffers, strict=True)):
            asked = [pending.question for pending in real.buffer.pending()]
            waiting = [waiting.ask for waiting in self.waiting if waiting.place == place]
            assert sorted((question.target, question.source) for question in asked) == sorted(
                (real.name(ask.target), real.name(ask.source)) for ask in waiting
            )
            tree = held.tree
            edges = [
                (name, child.parent, child.static, len(child.samples), min(child.stamps, default=None))
                for name, child in sorted(tree.children.items())
            ]
            found = real.buffer.tree.edges()
            assert [(edge.child, edge.parent, edge.static, edge.samples, edge.oldest) for edge in found] == edges
            assert real.buffer.tree.frames() == sorted(tree.names())
        on_the_bus = [held for held in self.plain.buffers if held.on_the_bus]
        statistics = self.bus.statistics()
        assert statistics.frames == len(self.plain.edges)
        for held, counted in zip(on_the_bus, statistics.buffers, strict=True):
            kinds = ("inserted", "replaced", "expired", "superseded")
            assert [getattr(counted, kind) for kind in kinds] == [held.counted[kind] for kind in kinds]
            assert counted.offered == counted.inserted + counted.replaced + counted.expired

    def ask_every_buffer(self, every: int) -> None:
        """Ask for every so many of the pairs of frames that it knows, at some stamps."""
        for real, held in zip(self.reals, self.plain.buffers, strict=True):
            frames = [frame for frame in sorted(held.tree.names()) if real.has_name(frame)]
            for target, source in list(product(frames, frames))[self.published % every :: every]:
                latest = partial(real.buffer.lookup_nowait, real.name(target), real.name(source))
                compare(latest, partial(held.tree.lookup, target, source, LATEST))
                for stamp in range(START + OFFSETS[0] + self.published % 8, self.middle + OFFSETS[-1], 8):
                    at = stamp * SECOND + self.published % 3 - 1
                    compare(partial(latest, at), partial(held.tree.lookup, target, source, at))


# The tests

SCHEDULES = int(os.environ.get("ORACLE_SCHEDULES", "300"))
"""On each loop, in the thorough suite."""

PARTS = 4
"""Tests that share them, so that they can run in several processes."""


@pytest.fixture(autouse=True)
def quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Log nothing, because formatting the lines takes a good part of the time."""
    monkeypatch.setattr(logging.getLogger("tfbus"), "disabled", True)


def failure_of(run: Run, bursts: list[Burst]) -> BaseException | None:
    async def play_here() -> None:
        async with anyio.create_task_group() as tasks:
            await Game(tasks).play(bursts)

    try:
        run(play_here)
    except (Exception, pytest.fail.Exception) as failure:  # noqa: BLE001
        return failure
    return None


def play(run: Run, seeds: range) -> None:
    """Play a schedule for each seed; of one that fails, leave out all that it fails without."""
    for seed in seeds:
        bursts = random_schedule(seed)
        failure = failure_of(run, bursts)
        if failure is not None:
            while (less := next((other for other in smaller(bursts) if failure_of(run, other)), None)) is not None:
                bursts = less
            raise AssertionError(f"seed {seed}; this is enough: {bursts}") from failure_of(run, bursts)


@pytest.mark.every_loop
def test_every_buffer_answers_as_the_model_says_whatever_happens(run: Run) -> None:
    play(run, range(15))


@pytest.mark.thorough
@pytest.mark.parametrize("part", range(PARTS))
def test_every_buffer_answers_as_the_model_says_in_many_schedules(run: Run, part: int) -> None:
    play(run, range(part, SCHEDULES, PARTS))
