"""Random schedules of everything that can happen to a message filter, against a slow and obvious model.

After each step of a schedule everything runs until it blocks. Frames are where their stamp says, so the model can work
an answer out by adding. Where several things happen in one turn of the loop, only what must always hold is checked.
"""

from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import anyio
import anyio.lowlevel
import pytest
from anyio.abc import TaskGroup
from anyio.streams.memory import MemoryObjectReceiveStream
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st
from support.asking import Asked

from tfbus import SECOND, Buffer, Bus, MessageFilter, SimulatedClock, Transform, TransformStamped, UnknownFrameError
from tfbus.errors import TransformError
from tfbus.message_filter.message_filter import DropReason, MessageOverflow, Order

Run = Callable[[Callable[[], Awaitable[None]]], None]

SPEED = {"laser": 1.0, "camera": 10.0}
ODOM_IN_MAP = 1_000.0
START, KEEP = 100, 4


@dataclass(frozen=True)
class Message:
    number: int
    frame: str
    stamp: int


# What can happen; stamps and durations in s


@dataclass(frozen=True)
class Send:
    messages: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class Insert:
    frame: str
    stamp: int


@dataclass(frozen=True)
class Remove:
    frame: str


@dataclass(frozen=True)
class Jump:
    by: int


@dataclass(frozen=True)
class Wait:
    seconds: float


@dataclass(frozen=True)
class Target:
    name: str


@dataclass(frozen=True)
class Simple:
    what: str


Step = Send | Insert | Remove | Jump | Wait | Target | Simple
READ, CANCEL = Simple("read"), Simple("cancel the reader")
END, FAIL = Simple("end the source"), Simple("fail in the source")
CLOSE_BUS, CLOSE_BUFFER = Simple("close the bus"), Simple("close the buffer")


@dataclass(frozen=True)
class Options:
    capacity: int
    overflow: MessageOverflow
    order: Order
    timeout: float | None


# The model


@dataclass
class Pending:
    message: Message
    deadline: float
    target: str = ""
    moment: int = 0


@dataclass
class Model:
    """The outcome of each message, when everything has run until it blocks."""

    options: Options
    windows: dict[str, list[int]] = field(default_factory=dict)
    target: str = "map"
    closed: bool = False
    elapsed: float = 0.0
    moment: int = 0
    source: list[Message | str] = field(default_factory=list)
    exhausted: bool = False
    error: bool = False
    pending: list[Pending] = field(default_factory=list)
    arrived: int = 0
    reading: bool = False
    read: list[Any] = field(default_factory=list)
    dropped: list[tuple[Message, str]] = field(default_factory=list)

    def look(self, message: Message) -> str:
        """The transform that a lookup would find."""
        if message.frame in (self.target, "odom"):
            return "answer"
        window = self.windows.get(message.frame)
        if not window:
            return "unknown" if window is None else "future"
        if message.stamp < window[0]:
            return "past"
        return "answer" if message.stamp <= window[-1] else "future"

    def insert(self, frame: str, stamp: int) -> None:
        window = sorted({*self.windows.get(frame, []), stamp})
        self.windows[frame] = [old for old in window if old >= window[-1] - KEEP]

    def next_out(self) -> Pending | None:
        if self.options.order == "ready":
            ready = [pending for pending in self.pending if pending.target]
            return min(ready, key=lambda pending: (pending.moment, pending.message.number), default=None)
        by_stamp = self.options.order == "stamp"
        first = min(
            self.pending,
            key=lambda pending: (pending.message.stamp if by_stamp else 0, pending.message.number),
            default=None,
        )
        return first if first is not None and first.target else None

    def drop(self, pending: Pending, reason: str) -> None:
        self.pending.remove(pending)
        self.dropped.append((pending.message, reason))

    def settle(self) -> None:
        self.moment += 1
        for pending in [pending for pending in self.pending if not pending.target]:
            found = self.look(pending.message)
            if found == "answer":
                pending.target, pending.moment = self.target, self.moment
            elif found == "past":
                self.drop(pending, "too old")
            elif self.closed:
                self.drop(pending, "closed")
        self.deliver()
        while self.source and not self.exhausted and not self.closed and not self.blocked():
            self.arrive(self.source.pop(0))
            self.deliver()
        self.exhausted |= self.closed
        self.deliver()

    def blocked(self) -> bool:
        return self.options.overflow == "block" and len(self.pending) >= self.options.capacity

    def arrive(self, message: Message | str) -> None:
        if isinstance(message, str):
            self.exhausted = True
            self.error = message == "fail"
            return
        self.arrived += 1
        found = self.look(message)
        if found == "past":
            self.dropped.append((message, "too old"))
            return
        if found != "answer" and self.options.timeout == 0:
            self.dropped.append((message, "unknown frame" if found == "unknown" else "timed out"))
            return
        if len(self.pending) == self.options.capacity:
            if self.options.overflow == "drop_newest":
                self.dropped.append((message, "queue full"))
                return
            self.drop(self.pending[0], "queue full")
        timeout = self.options.timeout
        pending = Pending(message, float("inf") if timeout is None else self.elapsed + timeout)
        if found == "answer":
            pending.target, pending.moment = self.target, self.moment
        self.pending.append(pending)

    def deliver(self) -> None:
        """Give a reader that waits what there is."""
        if not self.reading:
            return
        pending = self.next_out()
        if pending is not None:
            self.pending.remove(pending)
            self.read.append((pending.message, pending.target))
        elif self.error:
            self.error = False
            self.read.append(OSError)
        elif self.exhausted and all(pending.target for pending in self.pending):
            self.read.append(StopAsyncIteration)
        else:
            return
        self.reading = False

    def wait(self, seconds: float) -> None:
        end = self.elapsed + seconds
        while True:
            waiting = [pending for pending in self.pending if not pending.target and pending.deadline <= end]
            if not waiting:
                break
            first = min(waiting, key=lambda pending: pending.deadline)
            self.elapsed = first.deadline
            self.drop(first, "unknown frame" if self.look(first.message) == "unknown" else "timed out")
            self.settle()
        self.elapsed = end


# The game


class Game:
    """A filter and its model, side by side."""

    def __init__(self, options: Options) -> None:
        self.options = options
        self.clock = SimulatedClock(START * SECOND)
        self.bus = Bus(self.clock)
        self.buffer = Buffer(self.bus, float(KEEP))
        self.bus.publish(TransformStamped("map", "odom", 0, Transform((ODOM_IN_MAP, 0.0, 0.0)), static=True))
        self.send, self.receive = anyio.create_memory_object_stream[Message | str](1_000)
        self.numbers = 0
        self.dropped: list[tuple[Message, str]] = []
        self.asked: list[Asked[tuple[Message, TransformStamped]]] = []
        self.closed = False

    def make(self) -> MessageFilter[Message, TransformStamped]:
        return MessageFilter(
            source_of(self.receive),
            self.buffer,
            "map",
            stamp=lambda message: message.stamp * SECOND,
            timeout=self.options.timeout,
            capacity=self.options.capacity,
            overflow=self.options.overflow,
            order=self.options.order,
            on_drop=self.note,
        )

    async def advance(self, seconds: float) -> None:
        # On asyncio, an advance that finds something still running sleeps a real 0.1 s.
        for _ in range(30):
            await anyio.lowlevel.checkpoint()
        await self.clock.advance(seconds)

    def note(self, message: Message, reason: DropReason, error: TransformError | None) -> None:
        assert error is not None or reason in ("queue full", "closed")
        self.dropped.append((message, reason))

    def messages(self, step: Send) -> list[Message]:
        made = [Message(self.numbers + k, frame, stamp) for k, (frame, stamp) in enumerate(step.messages)]
        self.numbers += len(made)
        return made

    def happen(self, step: Step, pairs: MessageFilter[Message, TransformStamped], tasks: TaskGroup) -> None:
        """Do all of a step that needs no waiting."""
        if isinstance(step, Insert) and not self.bus.closed:
            x = step.stamp * SPEED[step.frame]
            self.bus.publish(TransformStamped("map", step.frame, step.stamp * SECOND, Transform((x, 0.0, 0.0))))
        elif isinstance(step, Remove) and not self.bus.closed:
            with suppress(UnknownFrameError):
                self.bus.remove_frame(step.frame)
        elif isinstance(step, Jump):
            self.clock.set(self.clock.now() + step.by * SECOND)
        elif isinstance(step, Target):
            pairs.set_target(step.name)
        elif step == READ and (not self.asked or self.asked[-1].ended):
            self.asked.append(Asked(tasks, pairs.__anext__))
        elif step == CANCEL and self.asked:
            self.asked[-1].cancel()
        elif step in (END, FAIL):
            self.send.send_nowait("end" if step == END else "fail")
        elif step == CLOSE_BUS:
            self.bus.close()
        elif step == CLOSE_BUFFER:
            self.buffer.close()

    async def play(self, steps: list[Step]) -> None:
        """Step by step, and compare."""
        model = Model(self.options)
        pairs = self.make()
        with self.send, self.receive:
            async with anyio.create_task_group() as tasks:
                try:
                    async with pairs:
                        for step in steps:
                            await self.step(step, model, pairs, tasks)
                            self.compare(model, pairs)
                except OSError:
                    assert model.error
                tasks.cancel_scope.cancel()
        left = [(pending.message, "closed") for pending in model.pending]
        assert Counter(self.dropped) == Counter(model.dropped + left)
        self.check_that_nothing_is_left(pairs)
        for reason in set(pairs.dropped):
            event(reason)

    async def step(
        self, step: Step, model: Model, pairs: MessageFilter[Message, TransformStamped], tasks: TaskGroup
    ) -> None:
        if isinstance(step, Send):
            made = self.messages(step)
            # One that waits to read may or may not take the first before the last is there.
            for part in [[message] for message in made] if model.reading else [made]:
                for message in part:
                    self.send.send_nowait(message)
                model.source += part
                model.settle()
                await self.advance(0)
            return
        if isinstance(step, Wait):
            model.wait(step.seconds)
            await self.advance(step.seconds)
            return
        if step == CANCEL and model.reading:
            model.reading = False
            model.read.append("cancelled")
        elif step == READ:
            model.reading = True
        elif isinstance(step, Insert) and not self.bus.closed and not self.closed:
            model.insert(step.frame, step.stamp)
        elif isinstance(step, Remove) and not self.bus.closed and not self.closed:
            model.windows.pop(step.frame, None)
        elif isinstance(step, Jump) and step.by < 0:
            for pending in [pending for pending in model.pending if not pending.target]:
                model.drop(pending, "clock reset")
            if not model.closed:
                model.windows = {frame: [] for frame in model.windows}
        elif isinstance(step, Target):
            model.target = step.name
        elif step in (END, FAIL):
            model.source.append("end" if step == END else "fail")
        elif step in (CLOSE_BUS, CLOSE_BUFFER):
            model.closed = True
            self.closed = True
        self.happen(step, pairs, tasks)
        model.settle()
        await self.advance(0)

    def compare(self, model: Model, pairs: MessageFilter[Message, TransformStamped]) -> None:
        assert Counter(self.dropped) == Counter(model.dropped)
        assert pairs.dropped == Counter(reason for _, reason in model.dropped)
        assert (pairs.arrived, pairs.pending) == (model.arrived, len(model.pending))
        assert pairs.arrived == pairs.delivered + sum(pairs.dropped.values()) + pairs.pending
        waiting = Counter(pending.message.frame for pending in model.pending if not pending.target)
        assert Counter(lookup.question.source for lookup in self.buffer.pending()) == waiting
        assert [outcome_of(asked) for asked in self.asked if asked.ended] == model.read
        assert self.asked[-1:] == [] or self.asked[-1].ended is not model.reading

    async def play_wildly(self, bursts: list[list[Step]]) -> None:
        """Burst by burst, without a task switch inside one; check what holds in any case."""
        pairs = self.make()
        stamps: dict[str, set[int]] = {frame: set() for frame in SPEED}
        with self.send, self.receive:
            async with anyio.create_task_group() as tasks:
                try:
                    async with pairs:
                        for burst in bursts:
                            await self.burst(burst, pairs, tasks, stamps)
                except OSError:
                    assert FAIL in [step for burst in bursts for step in burst]
                tasks.cancel_scope.cancel()
        read = [asked.answer[0] for asked in self.asked if is_answered(asked)]
        assert len(read) == pairs.delivered
        every = Counter([*read, *(message for message, _ in self.dropped)])
        assert (max(every.values(), default=1), sum(every.values())) == (1, pairs.arrived)
        for asked in self.asked:
            if is_answered(asked):
                message = asked.answer[0]
                if message.frame in SPEED:
                    assert min(stamps[message.frame]) <= message.stamp <= max(stamps[message.frame])
                assert outcome_of(asked) in ((message, "map"), (message, "odom"))
        self.check_that_nothing_is_left(pairs)

    async def burst(
        self,
        burst: list[Step],
        pairs: MessageFilter[Message, TransformStamped],
        tasks: TaskGroup,
        stamps: dict[str, set[int]],
    ) -> None:
        for step in burst:
            if isinstance(step, Send):
                for message in self.messages(step):
                    self.send.send_nowait(message)
            elif isinstance(step, Insert):
                stamps[step.frame].add(step.stamp)
            self.happen(step, pairs, tasks)
        assert pairs.arrived == pairs.delivered + sum(pairs.dropped.values()) + pairs.pending
        await self.advance(sum(step.seconds for step in burst if isinstance(step, Wait)))
        assert pairs.pending <= self.options.capacity
        assert len(self.buffer.pending()) <= pairs.pending

    def check_that_nothing_is_left(self, pairs: MessageFilter[Message, TransformStamped]) -> None:
        assert pairs.pending == 0
        assert pairs.arrived == pairs.delivered + sum(pairs.dropped.values())
        assert pairs.dropped == Counter(reason for _, reason in self.dropped)
        assert self.buffer.pending() == ()
        assert pairs.callbacks_failed == 0


async def source_of(receive: MemoryObjectReceiveStream[Message | str]) -> AsyncIterator[Message]:
    async for message in receive:
        if message == "end":
            return
        if isinstance(message, str):
            raise OSError(message)
        yield message


def is_answered(asked: Asked[Any]) -> bool:
    return asked.ended and not asked.cancelled and asked.error is None


def outcome_of(asked: Asked[tuple[Message, TransformStamped]]) -> Any:
    """The outcome of a read, as the model writes it; or the transform, if it is wrong."""
    if asked.cancelled:
        return "cancelled"
    if asked.error is not None:
        return type(asked.error)
    message, found = asked.answer
    in_map = ODOM_IN_MAP if message.frame == "odom" else message.stamp * SPEED[message.frame]
    expected = in_map - (ODOM_IN_MAP if found.parent == "odom" else 0.0)
    at_its_stamp = (found.child, found.stamp) == (message.frame, message.stamp * SECOND)
    right = at_its_stamp and found.transform.translation[0] == pytest.approx(expected)
    return (message, found.parent) if right else found


# The schedules

STAMPS = st.integers(START - 1, START + 6)
MESSAGES = st.tuples(st.sampled_from(["laser", "laser", "camera", "odom"]), STAMPS)
SENDS = st.lists(MESSAGES, min_size=1, max_size=4).map(tuple).map(Send)
INSERTS = st.builds(Insert, st.sampled_from(sorted(SPEED)), STAMPS)
RARE = st.one_of(
    st.builds(Remove, st.sampled_from(sorted(SPEED))),
    st.builds(Jump, st.integers(-9, 9)),
    st.builds(Target, st.sampled_from(["map", "odom"])),
    st.just(CANCEL),
    st.sampled_from([END, FAIL, CLOSE_BUS, CLOSE_BUFFER]) | SENDS | INSERTS,
)
WAITS = st.builds(Wait, st.sampled_from([0.5, 1.5]))
STEPS: st.SearchStrategy[Step] = st.one_of(SENDS, INSERTS, st.just(READ), SENDS, INSERTS, st.just(READ), WAITS, RARE)
OPTIONS = st.builds(
    Options,
    st.integers(1, 4),
    st.sampled_from(["drop_oldest", "drop_newest", "block"]),
    st.sampled_from(["ready", "stamp", "arrival"]),
    st.sampled_from([None, 0.0, 1.0, 2.5]),
)
# By stamp, a reader that waits takes one thing or another as the source is read before it or behind it.
DEFINITE = OPTIONS.filter(lambda options: (options.overflow, options.order) != ("block", "stamp"))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(options=DEFINITE, steps=st.lists(STEPS, min_size=1, max_size=25))
def test_every_message_ends_as_the_model_says(run: Run, options: Options, steps: list[Step]) -> None:
    run(lambda: Game(options).play(steps))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(options=OPTIONS, bursts=st.lists(st.lists(STEPS, min_size=1, max_size=6), min_size=1, max_size=8))
def test_whatever_happens_in_one_turn_no_message_is_lost(run: Run, options: Options, bursts: list[list[Step]]) -> None:
    run(lambda: Game(options).play_wildly(bursts))
