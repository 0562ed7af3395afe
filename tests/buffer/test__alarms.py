"""Alarms on a loop whose time stands still until the test moves it, and on the loops that there are."""

import random
from functools import partial
from typing import Any

import anyio
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.asking import HandClock

from tfbus import SimulatedClock, SystemClock
from tfbus.buffer.lookups import LoopAlarms, SimulatedAlarms, _AlarmHeap, alarms_of


class HandLoop:
    """The part of an asyncio loop that a timer uses."""

    def __init__(self) -> None:
        self.now = 0.0
        self.handles: list[Handle] = []
        self.set = 0

    def time(self) -> float:
        return self.now

    def call_at(self, due: float, callback: Any) -> "Handle":
        self.set += 1
        self.handles.append(Handle(self, due, callback))
        return self.handles[-1]

    def move(self, seconds: float) -> None:
        end = self.now + seconds
        while due := [handle for handle in self.handles if handle.due <= end]:
            first = min(due, key=lambda handle: handle.due)
            self.handles.remove(first)
            self.now = max(self.now, first.due)
            first.callback()
        self.now = end


class Handle:
    def __init__(self, loop: HandLoop, due: float, callback: Any) -> None:
        self.loop, self.due, self.callback = loop, due, callback

    def cancel(self) -> None:
        self.loop.handles.remove(self)


SECONDS = st.integers(0, 8).map(float)
STEPS = st.one_of(
    st.tuples(st.just("add"), SECONDS), st.tuples(st.just("close"), SECONDS), st.tuples(st.just("move"), SECONDS)
)


@given(st.lists(STEPS))
def test_each_alarm_that_is_not_closed_rings_at_its_time_and_in_order(steps: list[tuple[str, float]]) -> None:
    loop = HandLoop()
    heap = _AlarmHeap(loop)
    rung: list[tuple[float, int]] = []
    alarms: list[Any] = []
    waiting: dict[int, float] = {}
    for step, number in steps:
        if step == "add":
            place = len(alarms)
            waiting[place] = loop.now + number
            alarms.append(heap.add(number, partial(lambda place: rung.append((loop.now, place)), place)))
        elif step == "close" and alarms:
            place = int(number) % len(alarms)
            alarms[place]()
            alarms[place]()
            waiting.pop(place, None)
        elif step == "move":
            due = sorted((at, place) for place, at in waiting.items() if at <= loop.now + number)
            before = len(rung)
            loop.move(number)
            assert rung[before:] == due
            waiting = {place: at for place, at in waiting.items() if at > loop.now}
        assert len(loop.handles) <= 1


def test_one_timer_serves_all_alarms_that_follow_each_other() -> None:
    loop = HandLoop()
    heap = _AlarmHeap(loop)
    for _ in range(10_000):
        heap.add(60.0, list)()
        heap.add(60.0, list)()
        loop.move(0.001)
    assert loop.set == 1
    assert len(heap._alarms) < 200


def test_alarms_ring_in_order_when_most_others_were_cancelled() -> None:
    loop = HandLoop()
    heap = _AlarmHeap(loop)
    rung: list[int] = []
    times = random.Random(1).sample(range(1_000), 500)
    cancels = {time: heap.add(time, partial(rung.append, time)) for time in times}
    kept = times[::10]
    for time in cancels.keys() - set(kept):
        cancels[time]()
    heap.add(1_000.0, list)
    assert len(heap._alarms) < 100
    loop.move(1_000.0)
    assert rung == sorted(kept)


def test_an_alarm_that_raises_is_logged_and_keeps_the_later_ones(caplog: pytest.LogCaptureFixture) -> None:
    loop = HandLoop()
    heap = _AlarmHeap(loop)
    rung: list[str] = []

    def fail() -> None:
        raise ValueError("broken")

    heap.add(1.0, fail)
    heap.add(2.0, partial(rung.append, "later"))
    loop.move(1.0)
    assert rung == []
    loop.move(1.0)
    assert rung == ["later"]
    assert caplog.messages == ["a timer raised"]


@pytest.mark.parametrize(
    ("clock", "kind"),
    [(SystemClock(), LoopAlarms), (SimulatedClock(), SimulatedAlarms), (HandClock(), type(None))],
)
def test_only_clocks_whose_time_is_known_have_alarms(clock: Any, kind: type) -> None:
    assert type(alarms_of(clock)) is kind


def test_alarms_on_one_loop_ring_although_another_one_ran_meanwhile() -> None:
    alarms = LoopAlarms()
    rung: list[str] = []

    async def on_the_first() -> None:
        done = anyio.Event()

        def ring() -> None:
            rung.append("first")
            done.set()

        alarms.call_after(0.001, ring)
        await anyio.to_thread.run_sync(anyio.run, on_the_other)
        await done.wait()

    async def on_the_other() -> None:
        there = anyio.Event()
        alarms.call_after(60.0, partial(rung.append, "never"))()
        alarms.call_after(0.001, there.set)
        with anyio.fail_after(10.0):
            await there.wait()

    anyio.run(on_the_first)
    assert rung == ["first"]
