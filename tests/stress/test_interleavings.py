"""Random schedules of everything that can happen to waiting lookups, against a slow and obvious model.

A schedule is a list of bursts. What is in a burst happens without a task switch; then everything runs until it blocks,
and then some simulated time passes. Frames have fixed parents and no rotations, and are where their stamp says, so the
model can work an answer out by adding.
"""

import math
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass, field
from enum import Enum, auto
from functools import partial

import anyio
import pytest
from anyio.abc import TaskGroup
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st
from support.asking import Asked

from tfbus import (
    LATEST,
    SECOND,
    AheadError,
    Buffer,
    Bus,
    BusClosedError,
    ClockResetError,
    LookupTimeoutError,
    PastExtrapolationError,
    SimulatedClock,
    Transform,
    TransformStamped,
    UnknownFrameError,
)

Run = Callable[[Callable[[], Awaitable[None]]], None]

PARENT = {"map": "world", "odom": "map", "base": "odom", "laser": "base", "drone": "world"}
STATIC = "laser"
SPEED = {"map": 1.0, "odom": 10.0, "base": 100.0, "laser": 0.0, "drone": 1000.0}
FRAMES = sorted({*PARENT, *PARENT.values()})
START = 100


# What can happen; stamps and durations in s


@dataclass(frozen=True)
class Insert:
    samples: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class Remove:
    frame: str


@dataclass(frozen=True)
class Jump:
    by: int


@dataclass(frozen=True)
class CloseBuffer:
    buffer: int


@dataclass(frozen=True)
class CloseBus:
    pass


@dataclass(frozen=True)
class Ask:
    buffer: int
    target: str
    source: str
    at: int | None = None
    source_at: int | None = None
    fixed: str | None = None
    max_age: int | None = None
    timeout: float | None = None


Happening = Insert | Remove | Jump | CloseBuffer | CloseBus


@dataclass(frozen=True)
class Burst:
    """`cancelled_first` and `cancelled_last` are places in the list of those who wait when the burst begins."""

    cancelled_first: tuple[int, ...]
    happenings: tuple[Happening | Ask, ...]
    cancelled_last: tuple[int, ...]
    then: float


# The model


class State(Enum):
    """What a lookup would find now."""

    ANSWER = auto()
    FUTURE = auto()
    UNKNOWN = auto()
    PAST = auto()
    AHEAD = auto()


FAILURES = {State.PAST: PastExtrapolationError, State.AHEAD: AheadError}
"""The errors of lookups that no longer wait."""


@dataclass
class Model:
    """One buffer: for each child whose parent is known, the stamps that it has."""

    keep: int | None
    attached: bool = True
    closed: bool = False
    edges: dict[str, set[int]] = field(default_factory=dict)
    outcomes: list[str] = field(default_factory=list)

    def insert(self, child: str, stamp: int) -> None:
        fresh = child not in self.edges
        stamps = self.edges.setdefault(child, set())
        if child == STATIC:
            self.outcomes.append("inserted" if fresh else "replaced")
        elif self.keep is not None and stamps and stamp < max(stamps) - self.keep:
            self.outcomes.append("expired")
        else:
            self.outcomes.append("replaced" if stamp in stamps else "inserted")
            stamps.add(stamp)
            if self.keep is not None:
                stamps -= {old for old in stamps if old < max(stamps) - self.keep}

    def reset(self) -> None:
        for stamps in self.edges.values():
            stamps.clear()

    def climb(self, frame: str) -> list[str]:
        """The frame, its parent, and so on up to the root."""
        return [frame, *self.climb(PARENT[frame])] if frame in self.edges else [frame]

    def leg(
        self, target: str, source: str, at: int | None, not_before: float, not_after: float
    ) -> tuple[State, int, float]:
        """State, stamp and x of the source in the target."""
        ups, downs = self.climb(source), self.climb(target)
        if ups[-1] != downs[-1]:
            return State.UNKNOWN, 0, 0.0
        edges = set(ups[:-1]) ^ set(downs[:-1])
        moving = [self.edges[child] for child in edges if child != STATIC]
        if at is None:
            if not all(moving):
                return State.FUTURE, 0, 0.0
            at = min(map(max, moving), default=0)
            if moving and not not_before <= at <= not_after:
                return State.FUTURE if at < not_before else State.AHEAD, 0, 0.0
            if moving and at < max(map(min, moving)):
                return State.FUTURE, 0, 0.0
        if any(stamps and at < min(stamps) for stamps in moving):
            return State.PAST, 0, 0.0
        if any(not stamps or at > max(stamps) for stamps in moving):
            return State.FUTURE, 0, 0.0
        x = sum(at * SPEED[child] * (1 if child in ups else -1) for child in edges)
        return State.ANSWER, at, x

    def look(self, ask: Ask, now: float) -> tuple[State, int, float]:
        age = float("inf") if ask.max_age is None else ask.max_age
        bounds = now - age, now + age
        if not all(named(frame, self.edges) for frame in (ask.target, ask.source, ask.fixed or ask.target)):
            return State.UNKNOWN, 0, 0.0
        if ask.fixed is None:
            return self.leg(ask.target, ask.source, ask.at, *bounds)
        first = self.leg(ask.target, ask.fixed, ask.at, *bounds)
        second = self.leg(ask.fixed, ask.source, ask.source_at, *bounds)
        if first[0] is State.ANSWER or second[0] is State.PAST:
            # Of a leg on which nothing moves, no stamp is the latest.
            by_source = ask.at is None and not self.moves(ask.target, ask.fixed) and self.moves(ask.fixed, ask.source)
            return second[0], (second if by_source else first)[1], first[2] + second[2]
        return first

    def moves(self, target: str, source: str) -> bool:
        """Whether anything on the way can move."""
        return bool((set(self.climb(target)[:-1]) ^ set(self.climb(source)[:-1])) - {STATIC})


@dataclass
class Waiting:
    """A lookup that has not ended as far as the model knows."""

    ask: Ask
    asked: Asked[TransformStamped]
    deadline: float
    fresh: bool = True
    reset: bool = False
    cancelled_first: bool = False
    cancelled_last: bool = False


class Game:
    """The bus and its model, side by side."""

    def __init__(self) -> None:
        self.clock = SimulatedClock(START * SECOND)
        self.bus = Bus(self.clock)
        self.buffers = [Buffer(self.bus, None), Buffer(self.bus, 4.0)]
        self.models = [Model(None), Model(4)]
        self.children: set[str] = set()
        self.elapsed = 0.0
        self.waiting: list[Waiting] = []

    async def play(self, bursts: list[Burst]) -> None:
        async with anyio.create_task_group() as tasks:
            for burst in bursts:
                before = list(self.waiting)
                for place in burst.cancelled_first[: len(before)]:
                    before[place % len(before)].asked.cancel()
                    before[place % len(before)].cancelled_first = True
                for happening in burst.happenings:
                    if isinstance(happening, Ask):
                        self.waiting.append(self.ask(happening, tasks))
                    else:
                        self.happen(happening)
                for place in burst.cancelled_last[: len(before)]:
                    before[place % len(before)].asked.cancel()
                    before[place % len(before)].cancelled_last = True
                await self.clock.advance(0)
                self.waiting = [waiting for waiting in self.waiting if self.still_waits(waiting)]
                self.check_pending()
                await self.clock.advance(burst.then)
                self.elapsed += burst.then
                self.waiting = [waiting for waiting in self.waiting if self.still_waits_as_time_passes(waiting)]
                self.check_pending()
            self.happen(CloseBus())
            await self.clock.advance(0)
            self.waiting = [waiting for waiting in self.waiting if self.still_waits(waiting)]
            assert self.waiting == []
        self.check_pending()
        self.check_statistics()

    def ask(self, ask: Ask, tasks: TaskGroup) -> Waiting:
        at, source_at = (LATEST if seconds is None else seconds * SECOND for seconds in (ask.at, ask.source_at))
        lookup = partial(
            self.buffers[ask.buffer].lookup,
            ask.target,
            ask.source,
            at,
            source_at=None if ask.fixed is None else source_at,
            fixed=ask.fixed,
            max_age=ask.max_age,
            timeout=ask.timeout,
        )
        return Waiting(ask, Asked(tasks, lookup), self.elapsed + (math.inf if ask.timeout is None else ask.timeout))

    def happen(self, happening: Happening) -> None:
        attached = [model for model in self.models if model.attached]
        if isinstance(happening, Jump):
            self.clock.set(self.clock.now() + happening.by * SECOND)
            if happening.by < 0 and not self.bus.closed:
                self.children &= {STATIC}
                for model in attached:
                    model.reset()
                for waiting in self.waiting:
                    waiting.reset |= not waiting.fresh and self.models[waiting.ask.buffer].attached
        elif isinstance(happening, CloseBuffer):
            self.buffers[happening.buffer].close()
            self.models[happening.buffer].attached = False
            self.models[happening.buffer].closed = True
        elif isinstance(happening, CloseBus):
            self.bus.close()
            for model in self.models:
                model.closed = True
        elif self.bus.closed:
            with pytest.raises(BusClosedError):
                self.send(happening)
        elif isinstance(happening, Remove) and not named(
            happening.frame, self.children.union(*(model.edges for model in attached))
        ):
            with pytest.raises(UnknownFrameError):
                self.send(happening)
        elif isinstance(happening, Remove):
            self.send(happening)
            self.children.discard(happening.frame)
            for model in attached:
                model.edges.pop(happening.frame, None)
        else:
            self.send(happening)
            self.children.update(child for child, _ in happening.samples)
            for model in attached:
                for child, stamp in happening.samples:
                    model.insert(child, stamp)

    def send(self, happening: Insert | Remove) -> None:
        if isinstance(happening, Remove):
            self.bus.remove_frame(happening.frame)
        else:
            self.bus.publish([sample(child, stamp) for child, stamp in happening.samples])

    def still_waits(self, waiting: Waiting) -> bool:
        """Check how a lookup has ended after a burst; whether it has not."""
        ask, asked = waiting.ask, waiting.asked
        model = self.models[ask.buffer]
        state, stamp, x = model.look(ask, self.clock.now() / SECOND)
        waiting.fresh = False
        if waiting.cancelled_first:
            assert asked.cancelled
        elif waiting.reset:
            assert isinstance(asked.error, ClockResetError)
        elif state is State.ANSWER:
            assert (asked.answer.parent, asked.answer.child) == (ask.target, ask.source)
            assert asked.answer.stamp == stamp * SECOND
            assert asked.answer.transform.translation == pytest.approx((x, 0.0, 0.0))
        elif state in FAILURES:
            assert isinstance(asked.error, FAILURES[state])
        elif model.closed:
            assert isinstance(asked.error, BusClosedError)
        elif waiting.cancelled_last:
            assert asked.cancelled
        elif waiting.deadline <= self.elapsed:
            assert isinstance(asked.error, LookupTimeoutError)
        else:
            assert not asked.ended
            return True
        event(f"{state.name}: {'cancelled' if asked.cancelled else type(asked.error).__name__}")
        return False

    def still_waits_as_time_passes(self, waiting: Waiting) -> bool:
        state, _, _ = self.models[waiting.ask.buffer].look(waiting.ask, self.clock.now() / SECOND)
        assert state is not State.ANSWER
        assert state not in FAILURES
        if waiting.deadline <= self.elapsed:
            assert isinstance(waiting.asked.error, LookupTimeoutError)
            assert waiting.asked.error.__cause__ is not None
        else:
            assert not waiting.asked.ended
        return not waiting.asked.ended

    def check_pending(self) -> None:
        for buffer, real in enumerate(self.buffers):
            expected = [waiting.ask for waiting in self.waiting if waiting.ask.buffer == buffer]
            questions = [pending.question for pending in real.pending()]
            assert sorted((q.target, q.source) for q in questions) == sorted((a.target, a.source) for a in expected)

    def check_statistics(self) -> None:
        attached = [model for model in self.models if model.attached]
        for model, real in zip(attached, self.bus.statistics().buffers, strict=True):
            counted = Counter(model.outcomes)
            assert (real.inserted, real.replaced, real.expired) == tuple(
                counted[outcome] for outcome in ("inserted", "replaced", "expired")
            )
            assert real.offered == real.inserted + real.replaced + real.expired
            assert real.waiting == 0


def named(frame: str, children: Iterable[str]) -> bool:
    return any(frame in (child, PARENT[child]) for child in children)


def sample(child: str, stamp: int) -> TransformStamped:
    if child == STATIC:
        return TransformStamped(PARENT[child], child, 0, Transform(), static=True)
    return TransformStamped(PARENT[child], child, stamp * SECOND, Transform((stamp * SPEED[child], 0.0, 0.0)))


# The schedules

STAMPS = st.integers(START - 3, START + 9)
PLACES = st.lists(st.integers(0, 9), max_size=2).map(tuple)
TIMEOUTS = st.sampled_from([None, None, 0.0, 0.5, 2.0, 5.0, 8.0])
EVERYTHING = STAMPS.map(lambda stamp: Insert(tuple((child, stamp) for child in PARENT)))
INSERTS = (
    st.lists(st.tuples(st.sampled_from(sorted(PARENT)), STAMPS), min_size=1, max_size=6).map(tuple).map(Insert)
    | EVERYTHING
)


@st.composite
def asks(draw: st.DrawFn) -> Ask:
    target, source = draw(st.permutations(FRAMES))[:2]
    buffer, timeout = draw(st.integers(0, 1)), draw(TIMEOUTS)
    kind = draw(st.sampled_from(["at", "at", "latest", "fresh", "travel"]))
    if kind == "at":
        return Ask(buffer, target, source, draw(STAMPS), timeout=timeout)
    if kind == "travel":
        fixed = draw(st.sampled_from(FRAMES))
        return Ask(buffer, target, source, draw(STAMPS), draw(STAMPS), fixed, timeout=timeout)
    return Ask(buffer, target, source, max_age=draw(st.integers(0, 5)) if kind == "fresh" else None, timeout=timeout)


HAPPENINGS: st.SearchStrategy[Happening | Ask] = st.one_of(
    INSERTS,
    asks(),
    INSERTS,
    asks(),
    st.builds(Remove, st.sampled_from(FRAMES)),
    st.builds(Jump, st.integers(-9, 9)),
    st.builds(CloseBuffer, st.integers(0, 1)) | st.builds(CloseBus) | INSERTS | asks(),
)
BURSTS = st.builds(
    Burst,
    PLACES,
    st.lists(HAPPENINGS, min_size=1, max_size=6).map(tuple),
    PLACES,
    st.sampled_from([0.0, 0.5, 1.5, 5.0]),
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(known=EVERYTHING | st.none(), bursts=st.lists(BURSTS, min_size=1, max_size=12))
def test_every_lookup_ends_as_the_model_says_and_leaves_nothing_behind(
    run: Run, known: Insert | None, bursts: list[Burst]
) -> None:
    async def play() -> None:
        game = Game()
        if known is not None:
            game.happen(known)
        await game.play(bursts)

    run(play)
