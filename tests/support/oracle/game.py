"""The bus and its model, side by side."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product

import anyio
import pytest
from anyio.abc import TaskGroup
from support.asking import Asked
from support.oracle.model import (
    Answer,
    At,
    Blocked,
    Facts,
    Held,
    Joined,
    Left,
    PlainBus,
    Published,
    Removed,
    Reset,
    Sample,
    facts_of,
    pose,
)
from support.oracle.schedule import (
    OFFSETS,
    PREFIX,
    SHARED,
    START,
    Ask,
    Burst,
    CloseBus,
    Edge,
    Happening,
    Join,
    Jump,
    Leave,
    Publish,
    Remove,
)

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


@dataclass
class Real:
    """A buffer under test."""

    buffer: Buffer
    prefix: bool
    keep: int | None

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
    def __init__(self) -> None:
        self.clock = SimulatedClock(START * SECOND)
        self.bus = Bus(self.clock)
        self.plain = PlainBus()
        self.reals: list[Real] = []
        self.held: dict[int, Held] = {}
        self.elapsed = 0.0
        self.middle = START
        self.waiting: list[Waiting] = []
        self.published = 0

    async def play(self, bursts: list[Burst]) -> None:
        self.join(Join(None))
        self.join(Join(2))
        async with anyio.create_task_group() as tasks:
            for burst in bursts:
                self.middle += 1
                waiting = list(self.waiting)
                for place in burst.cancelled_first[: len(waiting)]:
                    self.cancel(waiting[place % len(waiting)]).cancelled_first = True
                for happening in burst.happenings:
                    self.happen(happening, tasks)
                for place in burst.cancelled_last[: len(waiting)]:
                    self.cancel(waiting[place % len(waiting)]).cancelled_last = True
                await self.clock.advance(0)
                self.held = self.plain.buffers()
                self.waiting = [waiting for waiting in self.waiting if self.still_waits(waiting)]
                self.check()
                # An answer must not depend on earlier questions, so there are some.
                self.ask_every_buffer(40)
                await self.clock.advance(burst.then)
                self.elapsed += burst.then
                self.waiting = [waiting for waiting in self.waiting if self.still_waits_as_time_passes(waiting)]
            if not self.bus.closed:
                self.join(Join(None))
                self.join(Join(4, prefill=0))
                self.held = self.plain.buffers()
            self.bus.close()
            await self.clock.advance(0)
            self.waiting = [waiting for waiting in self.waiting if self.still_waits(waiting)]
            assert self.waiting == []
        self.check()
        self.ask_every_buffer(9)

    # What happens

    def happen(self, happening: Happening, tasks: TaskGroup) -> None:
        if isinstance(happening, Ask):
            self.ask(happening, tasks)
        elif isinstance(happening, Jump):
            self.jump(happening.by)
        elif isinstance(happening, CloseBus):
            self.bus.close()
        elif isinstance(happening, Leave):
            self.leave(happening.place)
        elif self.bus.closed:
            with pytest.raises(BusClosedError):
                self.bus.publish(()) if isinstance(happening, Publish) else self.bus.remove_frame("map")
        elif isinstance(happening, Publish):
            self.publish([self.sample(edge) for edge in happening.edges])
        elif isinstance(happening, Remove):
            self.remove(happening.frame)
        else:
            self.join(happening)

    def sample(self, edge: Edge) -> Sample:
        self.published += 1
        stamp = (self.middle + (edge.stamp or 0)) * SECOND
        return Sample(edge.parent, edge.child, stamp, pose(self.published), edge.stamp is None)

    def publish(self, batch: list[Sample]) -> None:
        stamped = [
            TransformStamped(sample.parent, sample.child, sample.stamp, sample.pose.transform(), "", sample.static)
            for sample in batch
        ]
        if self.plain.refuses(batch):
            with pytest.raises(InvalidTransformError, match="loop"):
                self.bus.publish(stamped)
        else:
            self.bus.publish(stamped)
            self.plain.record.append(Published(tuple(batch)))

    def remove(self, frame: str) -> None:
        if self.plain.knows(frame):
            self.bus.remove_frame(frame)
            self.plain.record.append(Removed(frame))
        else:
            with pytest.raises(UnknownFrameError):
                self.bus.remove_frame(frame)

    def jump(self, by: int) -> None:
        self.clock.set(self.clock.now() + by * SECOND)
        if by < 0 and not self.bus.closed:
            self.plain.record.append(Reset())
            on_the_bus = self.plain.on_the_bus()
            for waiting in self.waiting:
                waiting.reset |= not waiting.fresh and waiting.place in on_the_bus

    def join(self, joining: Join) -> None:
        on_the_bus = self.plain.on_the_bus()
        prefill = None
        if joining.prefill is not None and on_the_bus:
            prefill = on_the_bus[joining.prefill % len(on_the_bus)]
        other = None if prefill is None else self.reals[prefill].buffer
        prefix: dict[str, str] = {"prefix": PREFIX} if joining.prefix else {}
        shared = SHARED if joining.prefix else ()
        buffer = Buffer(self.bus, joining.keep, **prefix, shared=shared, prefill=other)
        keep = None if joining.keep is None else joining.keep * SECOND
        self.plain.record.append(Joined(len(self.reals), keep, prefill))
        self.reals.append(Real(buffer, joining.prefix, keep))

    def leave(self, place: int) -> None:
        on_the_bus = self.plain.on_the_bus()
        if on_the_bus:
            chosen = on_the_bus[place % len(on_the_bus)]
            self.reals[chosen].buffer.close()
            self.plain.record.append(Left(chosen))

    def ask(self, ask: Ask, tasks: TaskGroup) -> None:
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
        self.waiting.append(Waiting(ask, at, source_at, place, Asked(tasks, lookup), deadline))

    def stamp_of(self, offset: int | None) -> At:
        return LATEST if offset is None else (self.middle + offset) * SECOND

    def cancel(self, waiting: Waiting) -> Waiting:
        waiting.asked.cancel()
        return waiting

    # What must be

    def expected(self, waiting: Waiting) -> Answer | Blocked:
        ask, tree = waiting.ask, self.held[waiting.place].tree
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
        closed = self.bus.closed or not self.held[waiting.place].on_the_bus
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
        assert facts_of(error.__cause__) in expected.acceptable
        return False

    def check(self) -> None:
        """Compare what is quick to compare."""
        for place, (real, held) in enumerate(zip(self.reals, self.held.values(), strict=True)):
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
        on_the_bus = [held for held in self.held.values() if held.on_the_bus]
        statistics = self.bus.statistics()
        assert statistics.frames == len(self.plain.newest())
        for held, counted in zip(on_the_bus, statistics.buffers, strict=True):
            kinds = ("inserted", "replaced", "expired", "superseded")
            assert [getattr(counted, kind) for kind in kinds] == [held.counted[kind] for kind in kinds]
            assert counted.offered == counted.inserted + counted.replaced + counted.expired

    def ask_every_buffer(self, every: int) -> None:
        """Ask for every so many of the pairs of frames that it knows, at some stamps."""
        for real, held in zip(self.reals, self.held.values(), strict=True):
            frames = [frame for frame in sorted(held.tree.names()) if real.has_name(frame)]
            for target, source in list(product(frames, frames))[self.published % every :: every]:
                latest = partial(real.buffer.lookup_nowait, real.name(target), real.name(source))
                compare(latest, partial(held.tree.lookup, target, source, LATEST))
                for stamp in range(START + OFFSETS[0] + self.published % 8, self.middle + OFFSETS[-1], 8):
                    at = stamp * SECOND + self.published % 3 - 1
                    compare(partial(latest, at), partial(held.tree.lookup, target, source, at))


def compare(question: Callable[[], TransformStamped], model: Callable[[], Answer]) -> None:
    """Ask both."""
    try:
        expected = model()
    except Blocked as blocked:
        assert facts_raised(question) in blocked.acceptable
    else:
        check_answer(question(), expected)


def facts_raised(question: Callable[[], TransformStamped]) -> Facts:
    try:
        found = question()
    except TransformLookupError as error:
        return facts_of(error)
    raise AssertionError(f"there is an answer: {found}")


def check_answer(found: TransformStamped, expected: Answer) -> None:
    assert (found.stamp, found.static) == (expected.stamp, expected.static)
    assert expected.pose.is_close(found.transform)
