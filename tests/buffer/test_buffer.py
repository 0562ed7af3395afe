import logging
import math
import re
from collections.abc import Callable
from functools import partial
from typing import Any

import anyio
import anyio.lowlevel
import numpy as np
import pytest
from support.asking import Asked, HandClock, driving, settle
from support.samples import moving, static

from tfbus import (
    LATEST,
    SECOND,
    Buffer,
    Bus,
    BusClosedError,
    ClockResetError,
    DisconnectedError,
    FutureExtrapolationError,
    LaserScan,
    LookupTimeoutError,
    PastExtrapolationError,
    PointStamped,
    Question,
    SimulatedClock,
    TransformStamped,
    UnknownFrameError,
    do_transform,
)

pytestmark = pytest.mark.anyio


def make(start: int = 0, keep: float | None = 10.0) -> tuple[SimulatedClock, Bus, Buffer]:
    clock = SimulatedClock(start)
    bus = Bus(clock)
    return clock, bus, Buffer(bus, keep)


# Answers at once


@pytest.mark.every_loop
async def test_an_available_answer_is_returned_after_one_checkpoint(bus: Bus, buffer: Buffer) -> None:
    bus.publish([driving("map", "a", 1.0), driving("map", "a", 2.0)])
    turns = 0

    async def count() -> None:
        nonlocal turns
        while True:
            turns += 1
            await anyio.lowlevel.checkpoint()

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(count)
        await anyio.lowlevel.checkpoint()
        before = turns
        found = await buffer.lookup("map", "a", 1_500_000_000)
        # In one turn of the loop the other task runs once; a shuffled turn may put it on either side of this one.
        assert turns - before <= 2
        tasks.cancel_scope.cancel()
    assert found.transform.translation == (1.5, 0.0, 0.0)
    assert (found.parent, found.child, found.stamp) == ("map", "a", 1_500_000_000)


async def test_an_available_answer_passes_a_checkpoint(bus: Bus, buffer: Buffer) -> None:
    bus.publish(static("map", "a"))
    with anyio.CancelScope() as scope:
        scope.cancel()
        await buffer.lookup("map", "a")
    assert scope.cancelled_caught


@pytest.mark.parametrize("bad", ["", "/a"])
@pytest.mark.parametrize("ask", [lambda bad: (bad, "a"), lambda bad: ("nowhere", bad)], ids=["target", "source"])
async def test_an_invalid_name_raises_at_once(bad: str, ask: Callable[[str], tuple[str, str]]) -> None:
    _, bus, buffer = make()
    bus.publish(moving("map", "a", 1))
    with pytest.raises(UnknownFrameError) as caught:
        await buffer.lookup(*ask(bad))
    assert caught.value.frame == bad


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        pytest.param({"at": 1.5}, TypeError, id="float stamp"),
        pytest.param({"at": None}, TypeError, id="no stamp"),
        pytest.param({"at": 2**63}, ValueError, id="stamp beyond int64"),
        pytest.param({"source": 5}, TypeError, id="number for a name"),
        pytest.param({"source_at": 1}, TypeError, id="source_at without fixed"),
        pytest.param({"fixed": "map"}, TypeError, id="fixed without source_at"),
        pytest.param({"source_at": 1.5, "fixed": "map"}, TypeError, id="float source_at"),
        pytest.param({"at": 1, "max_age": 1.0}, TypeError, id="max_age without LATEST"),
        pytest.param({"max_age": -1.0}, ValueError, id="negative max_age"),
        pytest.param({"max_age": math.nan}, ValueError, id="NaN max_age"),
        pytest.param({"timeout": -1.0}, ValueError, id="negative timeout"),
        pytest.param({"timeout": math.nan}, ValueError, id="NaN timeout"),
        pytest.param({"timeout": 10**400}, ValueError, id="timeout that no float holds"),
        pytest.param({"timeout": "1"}, TypeError, id="text for a timeout"),
    ],
)
@pytest.mark.parametrize("target", ["map", "nowhere"])
async def test_wrong_arguments_raise_at_once_for_known_and_unknown_frames(
    bus: Bus, buffer: Buffer, target: str, arguments: dict[str, Any], error: type[Exception]
) -> None:
    bus.publish(moving("map", "a", 1))
    with pytest.raises(error):
        await buffer.lookup(target, **{"source": "a", **arguments})
    assert buffer.pending() == ()


# Waiting


async def test_a_timeout_raises_with_the_last_error_as_its_cause() -> None:
    clock, bus, buffer = make()
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, partial(buffer.lookup, "map", "a", 5 * SECOND, timeout=2.0))
        for _ in range(3):
            await clock.advance(0.5)
            bus.publish([driving("map", "a", 1), driving("map", "b", 5), driving("a", "c", 5)])
        await clock.advance(0.5)
        assert clock.now() == 2 * SECOND
        error = asked.error
        assert isinstance(error, LookupTimeoutError)
        assert (error.target, error.source, error.timeout) == ("map", "a", 2.0)
        cause = error.__cause__
        assert isinstance(cause, FutureExtrapolationError)
        assert (cause.child, cause.stamp, cause.newest) == ("a", 5 * SECOND, 1 * SECOND)


@pytest.mark.parametrize("phase", ["before the report", "after the report", "at the timeout"])
@pytest.mark.parametrize("data_first", [True, False])
@pytest.mark.parametrize("timeout", [None, 2.0, 7.0])
async def test_a_sample_in_the_turn_in_which_the_timeout_expires_still_answers(
    timeout: float | None, data_first: bool, phase: str
) -> None:
    clock = HandClock()
    bus = Bus(clock)
    buffer = Buffer(bus)
    bus.publish(moving("map", "a", 1))
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, partial(buffer.lookup, "map", "a", 5, timeout=timeout))
        await settle()
        if phase == "after the report" and timeout != 2.0:
            clock.scopes[0].cancel()
            await settle()
            assert len(buffer.pending()) == 1
        # The first scope is that of the report, and the next one that of the timeout; a report leads to another.
        place = {"before the report": 0, "after the report": -1, "at the timeout": 0 if timeout is None else 1}[phase]
        scope = clock.scopes[place]
        steps: list[Callable[[], object]] = [scope.cancel, lambda: bus.publish(moving("map", "a", 9))]
        for step in reversed(steps) if data_first else steps:
            step()
        await settle()
        assert asked.ended
        assert asked.answer.stamp == 5
    assert buffer.pending() == ()


async def test_a_sample_between_the_wake_up_of_a_lookup_and_its_turn_counts() -> None:
    _, bus, buffer = make()
    bus.publish([moving("map", "a", 0), moving("a", "b", 0)])
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, partial(buffer.lookup, "map", "a", 5))
        await settle()
        for sample in (moving("map", "a", 5, 1.0), moving("map", "a", 5, 2.0), moving("a", "b", 5)):
            bus.publish(sample)
    assert asked.answer.transform.translation == (2.0, 0.0, 0.0)


async def test_a_wait_keeps_its_beginning_when_its_cause_changes(
    clock: SimulatedClock, bus: Bus, buffer: Buffer
) -> None:
    bus.publish([moving("map", "a", 1), static("map", "b")])
    with pytest.raises(FutureExtrapolationError):
        buffer.lookup_nowait("map", "a", 9 * SECOND)
    async with anyio.create_task_group() as tasks:
        for source in ("a", "b", "c"):
            Asked(tasks, partial(buffer.lookup, "map", source, 9 * SECOND))
        await clock.advance(3.0)
        bus.publish(driving("moon", "a", 1))
        bus.publish(static("moon", "c"))
        await settle()
        assert [(waiting.since, type(waiting.blocked_by)) for waiting in buffer.pending()] == [
            (0, DisconnectedError),
            (0, DisconnectedError),
        ]
        tasks.cancel_scope.cancel()


async def test_fail_after_around_a_lookup_leaves_no_waiter() -> None:
    buffer = Buffer(Bus())
    with pytest.raises(TimeoutError) as caught, anyio.fail_after(0.001):
        await buffer.lookup("map", "a", timeout=3600.0)
    assert not isinstance(caught.value, LookupTimeoutError)
    assert buffer.pending() == ()


# LATEST and max_age


async def test_max_age_refuses_the_last_sample_of_a_dead_broadcaster() -> None:
    clock, bus, buffer = make()
    bus.publish(driving("map", "a", 0))
    await clock.advance(1.0)
    assert (await buffer.lookup("map", "a", max_age=1.0)).stamp == 0
    await clock.advance(0.001)
    assert (await buffer.lookup("map", "a")).stamp == 0
    assert buffer.can_transform("map", "a")
    assert not buffer.can_transform("map", "a", max_age=1.0)
    with pytest.raises(FutureExtrapolationError) as caught:
        buffer.lookup_nowait("map", "a", max_age=1.0)
    assert (caught.value.child, caught.value.stamp, caught.value.newest) == ("a", 1_000_000, 0)


# Pending lookups and the log


async def test_pending_lists_questions_with_their_start_and_their_error() -> None:
    clock, bus, buffer = make()
    bus.publish([driving("map", "a", 1), driving("moon", "b", 1)])
    async with anyio.create_task_group() as tasks:
        await clock.advance(2.0)
        tasks.start_soon(buffer.lookup, "map", "a", 3 * SECOND)
        await settle()
        await clock.advance(1.0)
        tasks.start_soon(buffer.lookup, "map", "b")
        await settle()
        tasks.start_soon(partial(buffer.lookup, "map", "c", LATEST, source_at=LATEST, fixed="map"))
        await settle()
        edge, trees, unknown = buffer.pending()
        text = buffer.describe()
        tasks.cancel_scope.cancel()
    assert edge.question == Question("map", "a", 3 * SECOND)
    assert (edge.since, trees.since) == (2 * SECOND, 3 * SECOND)
    assert isinstance(edge.blocked_by, FutureExtrapolationError)
    assert edge.blocked_by.child == "a"
    assert isinstance(trees.blocked_by, DisconnectedError)
    assert set(trees.blocked_by.roots) == {"map", "moon"}
    assert unknown.question == Question("map", "c", LATEST, LATEST, "map")
    assert isinstance(unknown.blocked_by, UnknownFrameError)
    assert unknown.blocked_by.frame == "c"
    for pending in (edge, trees, unknown):
        assert f"waiting: {pending}" in text.splitlines()


async def test_a_long_wait_is_logged_once_for_each_cause(caplog: pytest.LogCaptureFixture) -> None:
    clock, bus, buffer = make()
    bus.publish(driving("map", "base", 0))
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(buffer.lookup, "map", "basse")
        await clock.advance(0.5)
        tasks.start_soon(buffer.lookup, "base", "basse", SECOND)
        tasks.start_soon(buffer.lookup, "map", "base", 60 * SECOND)
        # Every sample wakes this lookup, and each is too old.
        tasks.start_soon(partial(buffer.lookup, "map", "base", max_age=0.4))
        await clock.advance(4.499)
        assert caplog.messages == []
        await clock.advance(0.001)
        (misspelt,) = caplog.messages
        assert "'basse'" in misspelt
        assert "did you mean 'base'" in misspelt
        for second in range(5, 30):
            bus.publish(driving("map", "base", second - 0.5))
            await clock.advance(1.0)
        assert len(caplog.messages) == 2
        assert "newest sample is" in caplog.messages[1]
        assert {(record.name, record.levelno) for record in caplog.records} == {("tfbus", logging.WARNING)}
        assert len(buffer.pending()) == 4
        tasks.cancel_scope.cancel()


async def test_short_waits_are_not_logged(caplog: pytest.LogCaptureFixture) -> None:
    clock, bus, buffer = make()
    async with anyio.create_task_group() as tasks:
        timed_out = Asked(tasks, partial(buffer.lookup, "map", "a", 60 * SECOND, timeout=5.0))
        answered = Asked(tasks, partial(buffer.lookup, "map", "a"))
        await clock.advance(4.0)
        bus.publish(driving("map", "a", 1))
        await clock.advance(10.0)
        assert timed_out.ended
        assert answered.ended
    assert caplog.messages == []


# Clock jumps


async def test_a_jump_back_ends_every_wait_with_an_error_that_has_both_stamps() -> None:
    clock, bus, buffer = make(start=100 * SECOND)
    bus.publish(driving("map", "a", 100))
    async with anyio.create_task_group() as tasks:
        asked = [
            Asked(tasks, partial(buffer.lookup, "map", source, 101 * SECOND, timeout=timeout))
            for source in ("a", "nowhere")
            for timeout in (None, 1.0, 60.0)
        ]
        await settle()
        clock.set(90 * SECOND)
        await settle()
    for each in asked:
        assert isinstance(each.error, ClockResetError)
        assert (each.error.before, each.error.after) == (100 * SECOND, 90 * SECOND)
    assert len({id(each.error) for each in asked}) == len(asked)
    assert buffer.pending() == ()


# The end


@pytest.mark.parametrize(
    ("close", "message"),
    [
        pytest.param(lambda bus, _: bus.close(), "the bus is closed", id="bus"),
        pytest.param(lambda _, buffer: buffer.close(), "the buffer is closed", id="buffer"),
    ],
)
async def test_closing_ends_waits_and_buffered_samples_can_still_be_looked_up(
    bus: Bus, buffer: Buffer, close: Callable[[Bus, Buffer], None], message: str
) -> None:
    bus.publish(driving("map", "a", 1))
    async with anyio.create_task_group() as tasks:
        asked = [Asked(tasks, partial(buffer.lookup, "map", source, 2 * SECOND)) for source in ("a", "nowhere")]
        await settle()
        close(bus, buffer)
        close(bus, buffer)
        await settle()
    for each, cause in zip(asked, (FutureExtrapolationError, UnknownFrameError), strict=True):
        assert isinstance(each.error, BusClosedError)
        assert str(each.error) == message
        assert isinstance(each.error.__cause__, cause)
    assert (await buffer.lookup("map", "a")).stamp == 1 * SECOND
    with pytest.raises(BusClosedError):
        await buffer.lookup("map", "a", 2 * SECOND)
    with pytest.raises(PastExtrapolationError):
        await buffer.lookup("map", "a", 0)


@pytest.mark.parametrize("keep", [-1.0, math.nan])
def test_a_buffer_with_a_bad_window_is_an_error_and_not_attached(bus: Bus, keep: float) -> None:
    with pytest.raises(ValueError, match="keep"):
        Buffer(bus, keep)
    bus.publish(moving("map", "a", 1))
    assert bus.statistics().buffers == ()


# Data


async def test_transform_waits_for_the_stamp_of_the_data(bus: Bus, buffer: Buffer) -> None:
    bus.publish(static("base", "laser", x=1.0))
    point = PointStamped("laser", 5 * SECOND, (2.0, 0.0, 0.0))
    with pytest.raises(UnknownFrameError):
        buffer.transform_nowait(point, "map")
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, partial(buffer.transform, point, "map"))
        await settle()
        bus.publish([driving("map", "base", 4), driving("map", "base", 6)])
    assert asked.answer == PointStamped("map", 5 * SECOND, (8.0, 0.0, 0.0))
    assert buffer.transform_nowait(point, "map") == asked.answer


async def test_transform_passes_timeout_and_max_age_on_also_to_another_stamp(
    clock: SimulatedClock, bus: Bus, buffer: Buffer
) -> None:
    bus.publish([driving("map", "base", 0), driving("map", "base", 2)])
    await clock.advance(9.0)
    latest, past = (PointStamped("base", stamp, (0.0, 0.0, 0.0)) for stamp in (LATEST, SECOND))
    travel: dict[str, Any] = {"at": LATEST, "fixed": "map"}
    for point, target, question in ((latest, "map", {}), (past, "base", travel)):
        with pytest.raises(LookupTimeoutError):
            await buffer.transform(point, target, timeout=0, max_age=1.0, **question)
        with pytest.raises(FutureExtrapolationError):
            buffer.transform_nowait(point, target, max_age=1.0, **question)
    with pytest.raises(TypeError, match="max_age goes with LATEST"):
        await buffer.transform(past, "base", max_age=1.0, at=2 * SECOND, fixed="map")


async def test_transform_moves_data_to_another_stamp_through_a_fixed_frame(bus: Bus, buffer: Buffer) -> None:
    bus.publish([driving("map", "base", 1), driving("map", "base", 6), static("base", "laser", x=0.5)])
    # Seen at 2 s, at 3.5 m in map; at 5 s the base has driven 3 m on.
    point = PointStamped("laser", 2 * SECOND, (1.0, 0.0, 0.0))
    moved = await buffer.transform(point, "base", at=5 * SECOND, fixed="map")
    assert moved == PointStamped("base", 5 * SECOND, (-1.5, 0.0, 0.0))
    assert buffer.transform_nowait(point, "base", at=5 * SECOND, fixed="map") == moved
    back = PointStamped("laser", 5 * SECOND, (-2.0, 0.0, 0.0))
    assert buffer.transform_nowait(back, "laser", at=2 * SECOND, fixed="map").point == (1.0, 0.0, 0.0)


class Smell:
    """Data with a frame and a stamp, of a type that is not registered."""

    frame = "map"
    stamp = LATEST


class Message:
    """Registered data whose frame and stamp are in a header, as in a message of ROS."""

    header = ("base", 0)


class Note:
    """Registered data with a frame, but no stamp."""

    frame = "map"


@do_transform.register
def _(data: Note, transform: TransformStamped) -> Note:
    raise AssertionError(f"nothing moves {data!r} by {transform}")


@do_transform.register
def _(data: Message, transform: TransformStamped) -> Message:
    assert transform.child == "base"
    return data


POINT = PointStamped("laser", 0, (0.0, 0.0, 0.0))
SCAN = LaserScan("laser", 2, np.array([4.0]), angle_min=0.0, angle_increment=0.0)


@pytest.mark.parametrize(
    ("data", "arguments", "message"),
    [
        (Smell(), {}, "@do_transform.register(Smell)"),
        (("laser", 0), {}, "@do_transform.register(tuple)"),
        (SCAN, {}, "transform its to_points() instead"),
        (Message(), {}, "a Message has no frame and stamp of its own: look the transform up and call do_transform"),
        (Note(), {}, "a Note has no frame and stamp of its own"),
        (POINT, {"at": 5}, "at and fixed go together"),
        (POINT, {"at": LATEST}, "at and fixed go together"),
        (POINT, {"fixed": "map"}, "at and fixed go together"),
    ],
)
async def test_wrong_data_or_arguments_of_transform_raise_before_anything_is_awaited(
    buffer: Buffer, data: Any, arguments: dict[str, Any], message: str
) -> None:
    with anyio.CancelScope() as scope:
        scope.cancel()
        with pytest.raises(TypeError, match=re.escape(message)):
            await buffer.transform(data, "map", **arguments)
    with pytest.raises(TypeError, match=re.escape(message)):
        buffer.transform_nowait(data, "map", **arguments)


async def test_registered_data_without_frame_and_stamp_are_transformed_by_an_answer_of_lookup() -> None:
    _, bus, buffer = make()
    bus.publish(static("map", "base"))
    message = Message()
    assert do_transform(message, await buffer.lookup("map", "base")) is message


async def test_the_repr_is_one_line_with_frames_window_and_waiting_lookups() -> None:
    with Bus(SimulatedClock()) as bus, Buffer(bus, keep=2.5) as buffer:
        assert repr(buffer) == "<Buffer of 0 frames, keeps 2.5 s, 0 lookups waiting>"
        bus.publish(moving("map", "base", 1))
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(buffer.lookup, "map", "base", 2)
            await anyio.wait_all_tasks_blocked()
            assert repr(buffer) == "<Buffer of 2 frames, keeps 2.5 s, 1 lookup waiting>"
            assert repr(bus) == "<Bus of 1 child frame, 1 buffers, 0 streams>"
            tasks.cancel_scope.cancel()
    assert repr(buffer) == "<Buffer of 2 frames, keeps 2.5 s, closed>"
    assert repr(bus) == "<Bus of 1 child frame, closed>"
    with Bus() as bus, Buffer(bus, keep=None) as buffer:
        assert "keeps everything" in repr(buffer)


async def test_data_in_the_target_already_stay_as_they_are_if_the_frame_is_not_known() -> None:
    point = PointStamped("camera", 5, (1.0, 2.0, 3.0))
    latest = PointStamped("camera", LATEST, (1.0, 2.0, 3.0))
    with Bus(SimulatedClock()) as bus, Buffer(bus) as buffer:
        for data in (point, latest):
            assert buffer.transform_nowait(data, "camera") is data
            assert await buffer.transform(data, "camera") is data
        with pytest.raises(UnknownFrameError):
            buffer.transform_nowait(point, "map")
        with pytest.raises(UnknownFrameError):
            buffer.transform_nowait(PointStamped("camera", 5, (1.0, 2.0, 3.0)), "camera", at=7, fixed="map")
        # A lookup between frames is none of data.
        with pytest.raises(UnknownFrameError):
            buffer.lookup_nowait("camera", "camera", 5)
        bus.publish(moving("map", "camera", 9))
        assert buffer.transform_nowait(latest, "camera").stamp == 9


async def test_whether_there_will_be_an_answer_can_be_awaited() -> None:
    clock = SimulatedClock()
    with Bus(clock) as bus, Buffer(bus) as buffer:
        assert not await buffer.can_transform_within("map", "base", 0.0)
        answers: dict[str, bool] = {}

        async def ask(name: str, timeout: float | None, at: int = 2) -> None:
            answers[name] = await buffer.can_transform_within("map", "base", timeout, at)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(ask, "in time", 2.0)
            tasks.start_soon(ask, "too short", 0.5)
            tasks.start_soon(ask, "for ever", None)
            await clock.advance(1.0)
            assert answers == {"too short": False}
            bus.publish([moving("map", "base", 1), moving("map", "base", 3)])
        assert answers == {"too short": False, "in time": True, "for ever": True}
        # Waiting cannot help.
        assert not await buffer.can_transform_within("map", "base", None, 0)
    with pytest.raises(BusClosedError):
        await buffer.can_transform_within("map", "base", None, 7)


async def test_an_infinite_timeout_never_expires(clock: SimulatedClock, bus: Bus, buffer: Buffer) -> None:
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, partial(buffer.lookup, "map", "a", timeout=math.inf))
        await clock.advance(1e6)
        assert not asked.ended
        bus.publish(moving("map", "a", 7))
        await settle()
        assert asked.answer.stamp == 7


async def test_an_infinite_max_age_refuses_nothing(clock: SimulatedClock, bus: Bus, buffer: Buffer) -> None:
    bus.publish(driving("map", "a", 0))
    await clock.advance(1e6)
    assert (await buffer.lookup("map", "a", max_age=math.inf)).stamp == 0
