"""Lookups that wait, between changes of the tree: several in one turn of the loop, and then the loop runs.

Whatever happened, a lookup that has ended gave the answer of the tree as it is now, because nothing has changed it
since the lookup's task ran; and one that still waits has no answer. So no wake-up is lost, and no answer is an old one.
"""

from collections.abc import Awaitable, Callable
from contextlib import suppress
from functools import partial
from itertools import count

import anyio
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.asking import Asked, HandClock, settle

from tfbus import (
    LATEST,
    SECOND,
    Buffer,
    Bus,
    BusClosedError,
    ClockResetError,
    LookupTimeoutError,
    PastExtrapolationError,
    SimulatedClock,
    SystemClock,
    Transform,
    TransformStamped,
    UnknownFrameError,
)
from tfbus.clock import Clock
from tfbus.errors import MAY_COME, TransformLookupError

Run = Callable[[Callable[[], Awaitable[None]]], None]

EDGES = st.sampled_from([("map", "base"), ("map", "odom"), ("odom", "base")])
STAMPS = st.integers(0, 6)
STEPS = st.one_of(
    st.tuples(st.just("publish"), EDGES, STAMPS),
    st.tuples(st.just("replace"), EDGES, STAMPS),
    st.tuples(st.just("ask"), st.just("base"), STAMPS | st.none(), st.sampled_from([None, 0, 1, 3]), st.booleans()),
    st.tuples(st.just("cancel"), st.integers(0, 9)),
    st.tuples(st.just("remove"), st.sampled_from(["odom", "base"])),
    st.tuples(st.just("jump"), STAMPS),
    st.tuples(st.just("run")),
    st.tuples(st.just("advance"), st.integers(0, 3)),
    st.tuples(st.just("close")),
)


class Play:
    """A buffer, and the lookups that were asked with the number of simulated seconds that each may wait."""

    def __init__(self, clock: Clock, tasks: anyio.abc.TaskGroup) -> None:
        self.clock = clock
        self.bus = Bus(clock)
        self.buffer = Buffer(self.bus, keep=6.0)
        self.tasks = tasks
        self.numbers = count()
        self.waiting: list[tuple[Asked[TransformStamped], Callable[[], TransformStamped]]] = []

    def publish(self, edge: tuple[str, str], seconds: int) -> None:
        # Each sample has another value, so that an answer shows which ones it was made of.
        transform = Transform((float(next(self.numbers)), 0.0, 0.0))
        self.bus.publish(TransformStamped(*edge, seconds * SECOND, transform, "sender"), "drop")

    def replace(self, edge: tuple[str, str], seconds: int) -> None:
        self.publish(edge, seconds)
        self.publish(edge, seconds)

    async def ask(self, source: str, seconds: int | None, timeout: float | None, parked: bool) -> None:
        at = LATEST if seconds is None else seconds * SECOND
        asked = Asked[TransformStamped](self.tasks, partial(self.buffer.lookup, "map", source, at, timeout=timeout))
        self.waiting.append((asked, partial(self.buffer.lookup_nowait, "map", source, at)))
        if parked:
            await self.run()

    def cancel(self, number: int) -> None:
        if self.waiting:
            self.waiting.pop(number % len(self.waiting))[0].cancel()

    def remove(self, frame: str) -> None:
        with suppress(UnknownFrameError):
            self.bus.remove_frame(frame)

    def jump(self, seconds: int) -> None:
        if isinstance(self.clock, SimulatedClock):
            self.clock.set(seconds * SECOND)

    def close(self) -> None:
        self.buffer.close()

    async def run(self) -> None:
        await settle()
        self.check()

    async def advance(self, seconds: int) -> None:
        # What happened in this turn comes first, because a timeout alone does not change the tree.
        await self.run()
        if isinstance(self.clock, SimulatedClock):
            await self.clock.advance(float(seconds))
            self.check()

    def check(self) -> None:
        for asked, look_up in self.waiting[:]:
            if asked.ended:
                self.waiting.remove((asked, look_up))
            try:
                answer = look_up()
            except TransformLookupError as error:
                if not asked.ended:
                    assert isinstance(error, MAY_COME)
                elif isinstance(error, MAY_COME):
                    assert isinstance(asked.error, LookupTimeoutError | ClockResetError | BusClosedError)
                else:
                    assert isinstance(asked.error, ClockResetError | PastExtrapolationError | type(error))
            else:
                assert asked.ended
                assert isinstance(asked.error, ClockResetError) or asked.answer == answer
        assert len(self.buffer.pending()) == len(self.waiting)


@pytest.mark.parametrize("make", [SimulatedClock, SystemClock, HandClock])
@pytest.mark.thorough
@given(steps=st.lists(STEPS, max_size=60))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
def test_no_wake_up_is_lost_and_no_answer_is_an_old_one(
    run: Run, make: Callable[[], Clock], steps: list[tuple[object, ...]]
) -> None:
    async def play() -> None:
        async with anyio.create_task_group() as tasks:
            stage = Play(make(), tasks)
            for name, *arguments in steps:
                done = getattr(stage, str(name))(*arguments)
                if done is not None:
                    await done
            await stage.run()
            tasks.cancel_scope.cancel()
        assert not stage.buffer.pending()

    run(play)
