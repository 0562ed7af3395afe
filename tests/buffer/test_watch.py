import asyncio
import gc
import logging
import math
import weakref
from itertools import pairwise
from typing import Any

import anyio
import anyio.lowlevel
import pytest
from anyio.abc import TaskGroup
from support.asking import Asked, HandClock, driving, settle
from support.samples import moving, static

from tfbus import (
    SECOND,
    Buffer,
    Bus,
    ClockResetError,
    Hold,
    SimulatedClock,
    Transform,
    TransformStamped,
    UnknownFrameError,
    Watch,
)

pytestmark = pytest.mark.anyio


def make(start: int = 0, keep: float | None = 10.0) -> tuple[SimulatedClock, Bus, Buffer]:
    clock = SimulatedClock(start)
    bus = Bus(clock)
    return clock, bus, Buffer(bus, keep)


def turned(angle: float, stamp: int, sign: float = 1.0, x: float = 0.0) -> TransformStamped:
    """The frame a in map, turned about the third axis by `angle` rad; `sign` is that of the quaternion."""
    half = angle / 2.0
    rotation = (0.0, 0.0, sign * math.sin(half), sign * math.cos(half))
    return TransformStamped("map", "a", stamp, Transform((x, 0.0, 0.0), rotation))


def x_of(answer: TransformStamped) -> float:
    return answer.transform.translation[0]


class Reader:
    """Reads a watch to its end in a task of its own, and notes each answer and when it came."""

    def __init__(self, tasks: TaskGroup, watch: Watch, clock: SimulatedClock | None = None) -> None:
        self.answers: list[TransformStamped] = []
        self.times: list[float] = []
        self._clock = clock
        self._watch = watch
        self.asked = Asked(tasks, self._read)

    @property
    def xs(self) -> list[float]:
        return [x_of(answer) for answer in self.answers]

    @property
    def stamps(self) -> list[int]:
        return [answer.stamp for answer in self.answers]

    async def _read(self) -> None:
        async for answer in self._watch:
            self.answers.append(answer)
            if self._clock is not None:
                self.times.append(self._clock.now() / SECOND)


async def read_along(
    watch: Watch, bus: Bus, samples: list[TransformStamped], tasks: TaskGroup
) -> list[TransformStamped]:
    """The answers of a reader that keeps up with samples published one by one."""
    reader = Reader(tasks, watch)
    await settle()
    for sample in samples:
        bus.publish(sample)
        await settle()
    watch.close()
    await settle()
    assert reader.asked.answer is None
    return reader.answers


# Changes


@pytest.mark.parametrize(
    ("before", "after", "angle"),
    [
        (0.0, 0.2, 0.2),
        (0.3, 0.1, 0.2),
        (math.pi - 0.1, -math.pi + 0.1, 0.2),
        (0.0, math.pi, math.pi),
        (0.1, 0.1 + 2 * math.pi, 0.0),
        (0.0, 1e-6, 1e-6),
        (-2.0, 2.0, 2 * math.pi - 4.0),
    ],
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
async def test_min_rotation_is_the_angle_for_any_quaternion_signs(
    bus: Bus, buffer: Buffer, before: float, after: float, angle: float, sign: float
) -> None:
    bus.publish(turned(before, 1))
    with (
        buffer.watch("map", "a", min_rotation=max(angle * (1 - 1e-6), 1e-9)) as reached,
        buffer.watch("map", "a", min_rotation=min(angle * (1 + 1e-6) + 1e-9, math.pi)) as missed,
    ):
        for watch in (reached, missed):
            assert (await anext(watch)).stamp == 1
        bus.publish(turned(after, 2, sign))
        for watch in (reached, missed):
            watch.close()
        came = [[answer.stamp async for answer in watch] for watch in (reached, missed)]
    assert came[0] == ([2] if angle > 0.0 else [])
    assert came[1] == ([] if angle < math.pi else [2])


# Rates


@pytest.mark.parametrize("hz", [10.0, 4.0, 3.0])
async def test_max_rate_gives_the_newest_answer_once_a_period(hz: float) -> None:
    clock, bus, buffer = make()
    async with anyio.create_task_group() as tasks:
        with buffer.watch("map", "a", max_rate=hz) as changes:
            reader = Reader(tasks, changes, clock)
            for tick in range(200):
                bus.publish(driving("map", "a", tick / 100))
                await clock.advance(0.01)
            times, xs, skipped = list(reader.times), reader.xs, changes.skipped
    period = math.ceil(SECOND / hz) / SECOND
    assert times == pytest.approx([period * k for k in range(math.floor(2.0 / period) + 1)], abs=1e-9)
    for time, x in zip(times, xs, strict=True):
        assert time - 0.01 - 1e-9 <= x <= time + 1e-9
    # All updates in between are counted as skipped.
    assert skipped == sum(round(after * 100) - round(before * 100) - 1 for before, after in pairwise(xs))


@pytest.mark.parametrize("resting", [True, False])
async def test_a_jump_forward_delays_an_answer_by_at_most_one_period(resting: bool) -> None:
    clock, bus, buffer = make()
    bus.publish(moving("map", "a", 1))
    async with anyio.create_task_group() as tasks:
        with buffer.watch("map", "a", max_rate=1.0) as changes:
            await anext(changes)
            if not resting:
                clock.set(100 * SECOND)
            bus.publish(moving("map", "a", 2))
            asked = Asked(tasks, changes.__anext__)
            await clock.advance(0.5)
            assert asked.ended is not resting
            clock.set(200 * SECOND)
            await clock.advance(0.5)
            assert asked.answer.stamp == 2


class BackwardClock(SimulatedClock):
    """A clock whose stamps can be set back without a jump callback, as those of the machine."""

    behind = 0

    def now(self) -> int:
        return super().now() - self.behind


async def test_a_clock_set_back_without_a_jump_delays_an_answer_by_at_most_one_period() -> None:
    clock = BackwardClock()
    bus = Bus(clock)
    bus.publish(moving("map", "a", 1))
    async with anyio.create_task_group() as tasks:
        with Buffer(bus) as buffer, buffer.watch("map", "a", max_rate=1.0) as changes:
            bus.publish(moving("map", "a", 2))
            await anext(changes)
            clock.behind = 3600 * SECOND
            bus.publish(moving("map", "a", 3))
            asked = Asked(tasks, changes.__anext__)
            await clock.advance(0.9)
            assert not asked.ended
            clock.behind = 7200 * SECOND
            await clock.advance(0.1)
            assert asked.answer.stamp == 3


# Slow readers


async def test_a_slow_reader_gets_the_newest_answer_and_skipped_updates_are_counted(bus: Bus, buffer: Buffer) -> None:
    bus.publish(moving("map", "a", 0))
    with buffer.watch("map", "a") as changes:
        for stamp in range(1, 11):
            bus.publish(moving("map", "a", stamp))
        assert ((await anext(changes)).stamp, changes.skipped) == (10, 9)
        for stamp in range(11, 14):
            bus.publish([moving("map", "a", stamp), moving("map", "b", stamp)])
            bus.publish(moving("map", "b", stamp))
        assert ((await anext(changes)).stamp, changes.skipped) == (13, 11)


# Waking


def hand_made() -> tuple[HandClock, Bus, Buffer]:
    """A bus and a buffer on a clock that counts waits, and so wake-ups without an answer."""
    clock = HandClock()
    bus = Bus(clock)
    return clock, bus, Buffer(bus)


ELSEWHERE = [
    pytest.param([moving("map", "other", 3)], id="a sibling"),
    pytest.param([moving("base", "tool", 3)], id="a child below"),
    pytest.param([moving("world", "map", 3)], id="above the common ancestor"),
    pytest.param([moving("mars", "map", 3)], id="another parent above the common ancestor"),
    pytest.param([static("base", "laser")], id="a new static below"),
    pytest.param([moving("sea", "ship", 3)], id="another tree"),
]


@pytest.mark.parametrize("elsewhere", ELSEWHERE)
async def test_samples_off_the_path_do_not_wake_a_watch(elsewhere: list[TransformStamped]) -> None:
    clock, bus, buffer = hand_made()
    bus.publish([moving("world", "map", 1), moving("map", "odom", 1), moving("odom", "base", 1)])
    async with anyio.create_task_group() as tasks:
        with buffer.watch("map", "base") as changes:
            reader = Reader(tasks, changes)
            await settle()
            waits = len(clock.scopes)
            for _ in range(3):
                bus.publish(elsewhere)
                await settle()
            bus.remove_frame(elsewhere[0].child)
            await settle()
            assert len(clock.scopes) == waits
            # A sample on the path wakes the reader, even without a new answer.
            bus.publish(moving("map", "odom", 2))
            await settle()
            assert len(clock.scopes) == waits + 1
            assert (len(reader.answers), changes.skipped) == (1, 0)


# While there is no answer


async def test_a_watch_gives_answers_again_after_one_that_was_too_old() -> None:
    clock, bus, buffer = make()
    bus.publish([driving("map", "a", 0.0), driving("a", "b", 0.0)])
    async with anyio.create_task_group() as tasks:
        with buffer.watch("map", "b", max_age=1.0) as changes:
            reader = Reader(tasks, changes)
            await clock.advance(2.0)
            for second in (1.0, 1.5, 2.0):
                bus.publish(driving("a", "b", second))
                await settle()
                assert len(buffer.pending()) == 1
            for second in (1.0, 2.0):
                bus.publish(driving("map", "a", second))
                await settle()
    assert reader.xs == [0.0, 2.0, 4.0]
    # Updates without an answer do not count as skipped.
    assert changes.skipped == 0


async def test_a_gap_delays_answers_until_the_lagging_edge_is_past_it(bus: Bus, buffer: Buffer) -> None:
    samples = [moving("map", "a", 10), moving("a", "b", 10), moving("a", "b", 20), moving("a", "b", 30)]
    with buffer.watch("map", "b", max_gap=10e-9) as strict, buffer.watch("map", "b", max_gap=9e-9) as stricter:
        async with anyio.create_task_group() as tasks:
            readers = [Reader(tasks, strict), Reader(tasks, stricter)]
            for sample in [*samples, *(moving("map", "a", stamp) for stamp in range(11, 22))]:
                bus.publish(sample)
                await settle()
            assert readers[0].stamps == [*range(10, 22)]
            assert readers[1].stamps == [10, 20]
            for reader in readers:
                reader.asked.cancel()
    assert [answer.gap for answer in readers[0].answers] == [0, *[10] * 9, 0, 10]


# The end


# Jumps


async def test_a_jump_back_gives_a_static_answer_again_and_a_jump_forward_does_not() -> None:
    clock, bus, buffer = make(start=10)
    bus.publish(static("map", "a", 1.0))
    with buffer.watch("map", "a", min_translation=1.0) as changes:
        assert x_of(await anext(changes)) == 1.0
        clock.set(20)
        clock.set(5)
        clock.set(3)
        with pytest.raises(ClockResetError) as caught:
            await anext(changes)
        assert caught.value.after == 3
        assert x_of(await anext(changes)) == 1.0
        bus.close()
        with pytest.raises(StopAsyncIteration):
            await anext(changes)


# Cancellation, readers and threads


async def test_a_second_reader_is_busy_and_the_first_continues(bus: Bus, buffer: Buffer) -> None:
    async with anyio.create_task_group() as tasks:
        with buffer.watch("map", "a") as changes:
            first = Asked(tasks, changes.__anext__)
            await settle()
            with pytest.raises(anyio.BusyResourceError):
                await anext(changes)
            with pytest.raises(RuntimeError, match=r"anyio\.from_thread\.run"):
                await anyio.to_thread.run_sync(changes.close)
            bus.publish(moving("map", "a", 1))
            await settle()
            assert first.answer.stamp == 1


async def test_an_available_answer_passes_a_checkpoint(bus: Bus, buffer: Buffer) -> None:
    bus.publish(moving("map", "a", 1))
    with buffer.watch("map", "a") as changes:
        with anyio.CancelScope() as scope:
            scope.cancel()
            await anext(changes)
        assert scope.cancelled_caught
        assert (await anext(changes)).stamp == 1


def test_timeouts_and_cancellation_of_asyncio_work_with_a_watch(bus: Bus, buffer: Buffer) -> None:
    async def main() -> None:
        with buffer.watch("map", "a") as changes:
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(0.0):
                    await anext(changes)
            task = asyncio.ensure_future(anext(changes))
            await settle()
            task.cancel()
            bus.publish(moving("map", "a", 1))
            with pytest.raises(asyncio.CancelledError):
                await task
            assert (await asyncio.wait_for(anext(changes), 10)).stamp == 1
        assert buffer.pending() == ()

    asyncio.run(main())


# Arguments


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"min_translation": -1.0}, ValueError, "min_translation must be from 0 to inf m, got -1.0"),
        ({"min_translation": "1"}, TypeError, "min_translation must be a number in m, not '1'"),
        ({"min_rotation": -0.1}, ValueError, "min_rotation"),
        ({"min_rotation": 5.0}, ValueError, "min_rotation must be from 0 to 3.142 rad, got 5.0"),
        ({"min_rotation": None}, TypeError, "min_rotation"),
        ({"max_rate": 0.0}, ValueError, "max_rate"),
        ({"max_rate": math.inf}, ValueError, "max_rate"),
        ({"max_rate": math.nan}, ValueError, "max_rate"),
        ({"max_rate": "10"}, TypeError, "max_rate must be a number in Hz, not '10'"),
        ({"max_age": -1.0}, ValueError, "max_age"),
        ({"tolerance": -1.0}, ValueError, "tolerance"),
        ({"max_gap": "1"}, TypeError, "max_gap"),
        ({"extrapolate": 1.0}, TypeError, "extrapolate"),
        ({"source": "/a"}, UnknownFrameError, "'/a'"),
        ({"target": ""}, UnknownFrameError, "''"),
        ({"target": 5}, TypeError, "5"),
    ],
)
def test_a_wrong_argument_raises_when_the_watch_is_made(
    buffer: Buffer, arguments: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        buffer.watch(**{"target": "map", "source": "a", **arguments})
    assert buffer.pending() == ()


async def test_of_two_thresholds_one_is_enough_and_zero_means_no_threshold(bus: Bus, buffer: Buffer) -> None:
    samples = [
        turned(0.0, 0),
        turned(0.9, 1, x=0.9),
        turned(0.9, 2, x=1.0),
        turned(1.8, 3, x=1.0),
        turned(2.0, 4, x=1.0),
        turned(2.0, 5, x=3.0),
    ]
    expected = {(1.0, 1.0): [0, 2, 4, 5], (1.0, 0.0): [0, 2, 5], (0.0, 1.0): [0, 3]}
    for (translation, rotation), stamps in expected.items():
        async with anyio.create_task_group() as tasks:
            with buffer.watch("map", "a", min_translation=translation, min_rotation=rotation) as changes:
                got = await read_along(changes, bus, samples, tasks)
        assert [answer.stamp for answer in got] == stamps
        bus.remove_frame("a")


async def test_a_watch_without_an_answer_waits_and_is_pending() -> None:
    clock, bus, buffer = make(start=7)
    async with anyio.create_task_group() as tasks:
        with buffer.watch("map", "base", max_age=100.0) as changes:
            reader = Reader(tasks, changes)
            await settle()
            (pending,) = buffer.pending()
            assert (pending.question.target, pending.question.source, pending.since) == ("map", "base", 7)
            assert isinstance(pending.blocked_by, UnknownFrameError)
            await clock.advance(1.0)
            bus.publish([moving("map", "odom", 1), moving("odom", "base", 2)])
            await settle()
            # The same wait, with another error.
            assert [(pending.since, str(pending.blocked_by)[:12]) for pending in buffer.pending()] == [
                (7, "frame 'odom'")
            ]
            bus.publish(moving("map", "odom", 3))
            await settle()
            assert (reader.stamps, buffer.pending()) == ([2], ())


async def test_a_policy_allows_answers_with_their_extrapolation(bus: Bus, buffer: Buffer) -> None:
    bus.publish([moving("map", "a", 10, 1.0), moving("a", "b", 12, 2.0)])
    with (
        buffer.watch("map", "b", tolerance=2e-9) as near,
        buffer.watch("map", "b", tolerance=1e-9) as far,
        buffer.watch("map", "b", extrapolate=Hold(5e-9)) as held,
    ):
        answer = await anext(near)
        assert (answer.stamp, x_of(answer), answer.extrapolated_by) == (10, 3.0, 2)
        answer = await anext(held)
        assert (answer.stamp, x_of(answer), answer.extrapolated_by) == (12, 3.0, 2)
        far.close()
        assert [answer async for answer in far] == []


async def test_a_long_wait_for_the_first_answer_is_logged_once_for_each_cause(caplog: pytest.LogCaptureFixture) -> None:
    clock, bus, buffer = make()
    with caplog.at_level(logging.WARNING, "tfbus"), buffer.watch("map", "bse") as changes:
        async with anyio.create_task_group() as tasks:
            bus.publish(static("map", "base"))
            Asked(tasks, changes.__anext__)
            await clock.advance(4.9)
            assert caplog.messages == []
            for _ in range(4):
                await clock.advance(2.0)
                bus.remove_frame("base")
                bus.publish(static("map", "base"))
            (message,) = caplog.messages
            assert "'bse' in 'map' has waited for more than 5 s: frame 'bse' is not known" in message
            bus.publish(static("sea", "bse"))
            await settle()
            assert "different trees" in caplog.messages[1]
            tasks.cancel_scope.cancel()


async def test_an_unchanged_answer_is_not_logged_as_a_long_wait(caplog: pytest.LogCaptureFixture) -> None:
    clock, bus, buffer = make()
    bus.publish(moving("map", "a", 1))
    async with anyio.create_task_group() as tasks:
        with buffer.watch("map", "a") as changes:
            Reader(tasks, changes)
            await clock.advance(1000.0)
    assert caplog.messages == []


def test_a_closed_watch_is_freed() -> None:
    _, bus, buffer = make()
    bus.publish(moving("map", "a", 1))
    for source in ("a", "unknown"):
        watch = buffer.watch("map", source)
        watch.close()
        held = weakref.ref(watch)
        del watch
        gc.collect()
        assert held() is None
