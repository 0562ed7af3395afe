"""Random schedules of everything that can happen to a message filter, against a slow and obvious model.

After each step of a schedule everything runs until it blocks. Frames are where their stamp says, so the model can work
an answer out by adding. Where several things happen in one turn of the loop, only what must always hold is checked.
"""

from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import Any, NamedTuple

import anyio
import anyio.lowlevel
import pytest
from anyio.abc import TaskGroup
from anyio.streams.memory import MemoryObjectReceiveStream
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st
from support.asking import Asked

from tfbus import SECOND, Buffer, Bus, MessageFilter, SimulatedClock, Transform, TransformStamped, UnknownFrameError
from tfbus.errors import ClockResetError, LookupTimeoutError, PastExtrapolationError, TransformError
from tfbus.message_filter.message_filter import DropReason, MessageOverflow, Order

Run = Callable[[Callable[[], Awaitable[None]]], None]

SPEED = {"laser": 1.0, "camera": 10.0}
ODOM_IN_MAP = 1_000.0
START, KEEP = 100, 4
ERRORS: dict[str, type[TransformError]] = {
    "too old": PastExtrapolationError,
    "timed out": LookupTimeoutError,
    "unknown frame": LookupTimeoutError,
    "clock reset": ClockResetError,
}
"""The errors of what is dropped; a message that was ready has none."""


class Message(NamedTuple):
    number: int
    frame: str
    stamp: int


Step = tuple[Any, ...]
"""The name of a method of `Game`, and its arguments; stamps and durations in s."""


class Options(NamedTuple):
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
        if self.closed:
            return
        window = sorted({*self.windows.get(frame, []), stamp})
        self.windows[frame] = [old for old in window if old >= window[-1] - KEEP]

    def remove(self, frame: str) -> None:
        if not self.closed:
            self.windows.pop(frame, None)

    def reset(self) -> None:
        for pending in [pending for pending in self.pending if not pending.target]:
            self.drop(pending, "clock reset")
        if not self.closed:
            self.windows = {frame: [] for frame in self.windows}

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

    def __init__(self, options: Options, tasks: TaskGroup) -> None:
        self.tasks = tasks
        self.model = Model(options)
        self.clock = SimulatedClock(START * SECOND)
        self.bus = Bus(self.clock)
        self.buffer = Buffer(self.bus, float(KEEP))
        self.bus.publish(TransformStamped("map", "odom", 0, Transform((ODOM_IN_MAP, 0.0, 0.0)), static=True))
        self.source, self.receive = anyio.create_memory_object_stream[Message | str](1_000)
        self.numbers = count()
        self.dropped: list[tuple[Message, str]] = []
        self.asked: list[Asked[tuple[Message, TransformStamped]]] = []
        self.inserted: dict[str, list[int]] = {frame: [] for frame in SPEED}
        self.pairs = MessageFilter(
            source_of(self.receive),
            self.buffer,
            "map",
            stamp=lambda message: message.stamp * SECOND,
            timeout=options.timeout,
            capacity=options.capacity,
            overflow=options.overflow,
            order=options.order,
            on_drop=self.note,
        )

    async def advance(self, seconds: float) -> None:
        # On asyncio, an advance that finds something still running sleeps a real 0.1 s.
        for _ in range(30):
            await anyio.lowlevel.checkpoint()
        await self.clock.advance(seconds)

    def note(self, message: Message, reason: DropReason, error: TransformError | None) -> None:
        assert isinstance(error, ERRORS.get(reason, TransformError)) or (error is None and reason not in ERRORS)
        self.dropped.append((message, reason))

    # Steps, for the filter and for the model

    def made(self, drawn: Iterable[tuple[str, int]]) -> list[Message]:
        return [Message(next(self.numbers), frame, stamp) for frame, stamp in drawn]

    def send(self, *messages: Message | str) -> None:
        self.model.source += messages
        for message in messages:
            self.source.send_nowait(message)

    def insert(self, frame: str, stamp: int) -> None:
        self.inserted[frame].append(stamp)
        if not self.bus.closed:
            x = stamp * SPEED[frame]
            self.bus.publish(TransformStamped("map", frame, stamp * SECOND, Transform((x, 0.0, 0.0))))
            self.model.insert(frame, stamp)

    def remove(self, frame: str) -> None:
        if not self.bus.closed:
            with suppress(UnknownFrameError):
                self.bus.remove_frame(frame)
            self.model.remove(frame)

    def jump(self, by: int) -> None:
        self.clock.set(self.clock.now() + by * SECOND)
        if by < 0:
            self.model.reset()

    def set_target(self, name: str) -> None:
        self.model.target = name
        self.pairs.set_target(name)

    def read(self) -> None:
        self.model.reading = True
        if not self.asked or self.asked[-1].ended:
            self.asked.append(Asked(self.tasks, self.pairs.__anext__))

    def cancel(self) -> None:
        if self.model.reading:
            self.model.reading = False
            self.model.read.append("cancelled")
        if self.asked:
            self.asked[-1].cancel()

    def close_bus(self) -> None:
        self.model.closed = True
        self.bus.close()

    def close_buffer(self) -> None:
        self.model.closed = True
        self.buffer.close()

    # Step by step, and what must be then

    async def play(self, steps: list[Step]) -> None:
        model = self.model
        for kind, *what in steps:
            if kind == "wait":
                model.wait(*what)
                await self.advance(*what)
                continue
            turns: list[Callable[[], None]]
            if kind == "messages":
                made = self.made(*what)
                # A reader that waits may or may not take the first before the last is there.
                turns = [partial(self.send, *part) for part in ([[one] for one in made] if model.reading else [made])]
            else:
                turns = [partial(getattr(self, kind), *what)]
            for turn in turns:
                turn()
                model.settle()
                await self.advance(0)
            self.compare()

    def compare(self) -> None:
        model, pairs = self.model, self.pairs
        assert Counter(self.dropped) == Counter(model.dropped)
        assert pairs.dropped == Counter(reason for _, reason in model.dropped)
        assert (pairs.arrived, pairs.pending) == (model.arrived, len(model.pending))
        assert pairs.arrived == pairs.delivered + sum(pairs.dropped.values()) + pairs.pending
        waiting = Counter(pending.message.frame for pending in model.pending if not pending.target)
        assert Counter(lookup.question.source for lookup in self.buffer.pending()) == waiting
        assert [outcome_of(asked) for asked in self.asked if asked.ended] == model.read
        assert self.asked[-1:] == [] or self.asked[-1].ended is not model.reading

    # Many steps in one turn, and what must hold in any case

    async def play_wildly(self, bursts: list[list[Step]]) -> None:
        pairs = self.pairs
        for burst in bursts:
            seconds = 0.0
            for kind, *what in burst:
                if kind == "wait":
                    seconds += what[0]
                elif kind == "messages":
                    self.send(*self.made(*what))
                else:
                    getattr(self, kind)(*what)
            assert pairs.arrived == pairs.delivered + sum(pairs.dropped.values()) + pairs.pending
            await self.advance(seconds)
            assert pairs.pending <= self.model.options.capacity
            assert len(self.buffer.pending()) <= pairs.pending

    def check_outcomes(self) -> None:
        answered = [asked for asked in self.asked if asked.ended and not asked.cancelled and asked.error is None]
        assert len(answered) == self.pairs.delivered
        every = Counter([*(asked.answer[0] for asked in answered), *(message for message, _ in self.dropped)])
        assert (max(every.values(), default=1), sum(every.values())) == (1, self.pairs.arrived)
        for asked in answered:
            message = asked.answer[0]
            assert outcome_of(asked) in ((message, "map"), (message, "odom"))
            if message.frame in SPEED:
                assert min(self.inserted[message.frame]) <= message.stamp <= max(self.inserted[message.frame])

    def check_that_nothing_is_left(self) -> None:
        assert self.pairs.pending == 0
        assert self.pairs.arrived == self.pairs.delivered + sum(self.pairs.dropped.values())
        assert self.pairs.dropped == Counter(reason for _, reason in self.dropped)
        assert self.buffer.pending() == ()
        assert self.pairs.callbacks_failed == 0


async def run_game(options: Options, play: Callable[[Game], Awaitable[None]]) -> tuple[Game, bool]:
    """Play a game to its end, and check that nothing is left; whether the filter has raised its source's error."""
    raised = False
    async with anyio.create_task_group() as tasks:
        game = Game(options, tasks)
        with game.source, game.receive:
            try:
                async with game.pairs:
                    await play(game)
            except OSError:
                raised = True
            tasks.cancel_scope.cancel()
    game.check_that_nothing_is_left()
    for reason in set(game.pairs.dropped):
        event(reason)
    return game, raised


async def source_of(receive: MemoryObjectReceiveStream[Message | str]) -> AsyncIterator[Message]:
    async for message in receive:
        if message == "end":
            return
        if isinstance(message, str):
            raise OSError(message)
        yield message


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
SENDS = st.tuples(st.just("messages"), st.lists(MESSAGES, min_size=1, max_size=4))
INSERTS = st.tuples(st.just("insert"), st.sampled_from(sorted(SPEED)), STAMPS)
READS = st.just(("read",))
ENDS = st.sampled_from([("send", "end"), ("send", "fail"), ("close_bus",), ("close_buffer",)])
RARE = st.one_of(
    st.tuples(st.just("remove"), st.sampled_from(sorted(SPEED))),
    st.tuples(st.just("jump"), st.integers(-9, 9)),
    st.tuples(st.just("set_target"), st.sampled_from(["map", "odom"])),
    st.just(("cancel",)),
    ENDS | SENDS | INSERTS,
)
WAITS = st.tuples(st.just("wait"), st.sampled_from([0.5, 1.5]))
STEPS: st.SearchStrategy[Step] = st.one_of(SENDS, INSERTS, READS, SENDS, INSERTS, READS, WAITS, RARE)
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
    async def play() -> None:
        game, raised = await run_game(options, lambda game: game.play(steps))
        assert game.model.error or not raised
        left = [(pending.message, "closed") for pending in game.model.pending]
        assert Counter(game.dropped) == Counter(game.model.dropped + left)

    run(play)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(options=OPTIONS, bursts=st.lists(st.lists(STEPS, min_size=1, max_size=6), min_size=1, max_size=8))
def test_whatever_happens_in_one_turn_no_message_is_lost(run: Run, options: Options, bursts: list[list[Step]]) -> None:
    async def play() -> None:
        game, raised = await run_game(options, lambda game: game.play_wildly(bursts))
        assert ("send", "fail") in [step for burst in bursts for step in burst] or not raised
        game.check_outcomes()

    run(play)
