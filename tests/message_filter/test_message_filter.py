"""tf2's own tests of its message filter, and what an event loop adds: orders, bounds, time, errors and cancellation."""

import asyncio
import gc
import logging
import threading
import weakref
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass
from inspect import signature
from typing import Any, NamedTuple, get_overloads

import anyio
import pytest
from anyio.streams.memory import MemoryObjectReceiveStream, MemoryObjectSendStream
from support.asking import Asked, HandClock, driving, settle
from support.samples import moving, static

from tfbus import (
    LATEST,
    SECOND,
    Buffer,
    Bus,
    DisconnectedError,
    FutureExtrapolationError,
    LookupTimeoutError,
    MessageFilter,
    PointStamped,
    SimulatedClock,
    TransformStamped,
    UnknownFrameError,
)
from tfbus.errors import TransformError
from tfbus.message_filter.message_filter import DropReason

pytestmark = pytest.mark.anyio

PATIENCE = 30.0
"""Real seconds after which a test that hangs is given up."""


@dataclass(frozen=True)
class Scan:
    """A message; its frame is where it was taken."""

    stamp: Any
    frame: str = "laser"


Pair = tuple[Scan, TransformStamped]
Drop = tuple[Scan, DropReason, TransformError | None]


class Streams(NamedTuple):
    """The two ends of a stream of scans."""

    send: MemoryObjectSendStream[Scan]
    receive: MemoryObjectReceiveStream[Scan]


@pytest.fixture
def streams() -> Iterator[Streams]:
    send, receive = anyio.create_memory_object_stream[Scan](1_000)
    with send, receive:
        yield Streams(send, receive)


class DroppedMessages:
    """The calls of `on_drop`."""

    def __init__(self) -> None:
        self.all: list[Drop] = []

    def __call__(self, message: Scan, reason: DropReason, error: TransformError | None) -> None:
        self.all.append((message, reason, error))

    @property
    def told(self) -> list[tuple[Scan, str]]:
        return [(message, reason) for message, reason, _ in self.all]


async def read(pairs: MessageFilter[Scan, Any], got: list[Any]) -> None:
    async for pair in pairs:
        got.append(pair)  # noqa: PERF401 - the test looks at them meanwhile


def stamps(got: list[Any]) -> list[int]:
    return [message.stamp for message, _ in got]


def balanced(pairs: MessageFilter[Any, Any]) -> bool:
    return pairs.arrived == pairs.delivered + sum(pairs.dropped.values()) + pairs.pending


def put(streams: Streams, *messages: Scan) -> None:
    for message in messages:
        streams.send.send_nowait(message)


# The tests of tf2's own filter


@pytest.mark.every_loop
async def test_a_message_with_an_available_transform_is_delivered(bus: Bus, buffer: Buffer, streams: Streams) -> None:
    bus.publish([moving("map", "laser", 4, x=4.0), moving("map", "laser", 6, x=6.0)])
    put(streams, Scan(5))
    async with MessageFilter(streams.receive, buffer, "map") as pairs:
        message, found = await anext(pairs)
    assert message == Scan(5)
    assert (found.parent, found.child, found.stamp) == ("map", "laser", 5)
    assert found.transform.translation == (5.0, 0.0, 0.0)


def test_the_defaults_that_type_checkers_and_pages_show_are_those_of_the_filter() -> None:
    def defaults(function: Callable[..., object]) -> dict[str, object]:
        return {name: parameter.default for name, parameter in signature(function).parameters.items()}

    shown = [defaults(overload) for overload in get_overloads(MessageFilter.__init__)]
    assert shown == [defaults(MessageFilter.__init__)] * 2
    assert shown[0]["capacity"] == 100


async def test_a_message_needs_the_transforms_of_all_targets(bus: Bus, buffer: Buffer, streams: Streams) -> None:
    got: list[tuple[Scan, tuple[TransformStamped, ...]]] = []
    pairs = MessageFilter(streams.receive, buffer, ["world", "odom", "laser"])
    async with anyio.create_task_group() as tasks, pairs:
        tasks.start_soon(read, pairs, got)
        put(streams, Scan(5))
        bus.publish(moving("odom", "laser", 5, x=1.0))
        await settle()
        assert got == []
        bus.publish(moving("world", "odom", 5, x=10.0))
        await settle()
        ((message, found),) = got
        assert message == Scan(5)
        assert [t.parent for t in found] == ["world", "odom", "laser"]
        assert [t.transform.translation[0] for t in found] == [11.0, 1.0, 0.0]
        pairs.set_target(["map"])
        put(streams, Scan(5))
        bus.publish(static("world", "map", x=1.0))
        await settle()
        assert [t.transform.translation[0] for t in got[1][1]] == [10.0]
        tasks.cancel_scope.cancel()


@pytest.mark.parametrize(
    ("order", "before", "after"), [("ready", [7, 3], [5]), ("stamp", [3], [5, 7]), ("arrival", [], [5, 7, 3])]
)
async def test_a_message_that_waits_holds_back_the_others_that_the_order_says(
    bus: Bus, buffer: Buffer, streams: Streams, order: Any, before: list[int], after: list[int]
) -> None:
    bus.publish(static("map", "lidar"))
    got: list[Any] = []
    pairs = MessageFilter(streams.receive, buffer, "map", order=order)
    async with pairs, anyio.create_task_group() as tasks:
        tasks.start_soon(read, pairs, got)
        put(streams, Scan(5), Scan(7, "lidar"), Scan(3, "lidar"))
        await settle()
        assert stamps(got) == before
        bus.publish(moving("map", "laser", 5))
        await settle()
        assert stamps(got) == before + after
        tasks.cancel_scope.cancel()


async def test_a_margin_requires_the_transform_after_the_stamp_too(bus: Bus, buffer: Buffer, streams: Streams) -> None:
    got: list[Pair] = []
    async with (
        anyio.create_task_group() as tasks,
        MessageFilter(streams.receive, buffer, "map", margin=0.2) as pairs,
    ):
        tasks.start_soon(read, pairs, got)
        put(streams, Scan(SECOND))
        for seconds in (1.0, 1.1, 1.2 - 1e-9):
            bus.publish(driving("map", "laser", seconds))
            await settle()
            assert got == []
        bus.publish(driving("map", "laser", 1.2))
        await settle()
        ((_, found),) = got
        assert (found.stamp, found.transform.translation[0]) == (SECOND, 1.0)
        # And a message is not delivered because of what comes after it alone.
        put(streams, Scan(SECOND - 1))
        await settle()
        assert pairs.dropped == {"too old": 1}
        tasks.cancel_scope.cancel()


# Frames and stamps


async def test_frame_and_stamp_may_come_from_callables(bus: Bus, buffer: Buffer) -> None:
    bus.publish(moving("map", "laser", 5, x=2.0))

    async def headers() -> AsyncIterator[dict[str, Any]]:
        yield {"frame_id": "laser", "stamp": (0, 5)}

    async with MessageFilter(
        headers(),
        buffer,
        "map",
        frame=lambda message: str(message["frame_id"]),
        stamp=lambda message: int(message["stamp"][0]) * SECOND + int(message["stamp"][1]),
    ) as pairs:
        _, found = await anext(pairs)
    assert (found.stamp, found.transform.translation[0]) == (5, 2.0)


async def test_stamped_data_are_messages_and_may_be_stamped_latest(bus: Bus, buffer: Buffer) -> None:
    bus.publish([moving("map", "laser", 5), moving("map", "laser", 7)])
    point = PointStamped("laser", LATEST, (1.0, 0.0, 0.0))

    async def points() -> AsyncIterator[PointStamped]:
        yield point

    async with MessageFilter(points(), buffer, "map", margin=5.0) as pairs:
        message, found = await anext(pairs)
    assert (message, found.stamp) == (point, 7)


# Orders


# Time


async def test_a_message_times_out_on_the_clock_of_the_bus(
    clock: SimulatedClock, bus: Bus, buffer: Buffer, streams: Streams
) -> None:
    drops = DroppedMessages()
    bus.publish([moving("map", "laser", 1), static("moon", "rover")])
    async with MessageFilter(streams.receive, buffer, "map", timeout=2.0, on_drop=drops) as pairs:
        put(streams, Scan(5), Scan(5, "nobody"))
        await clock.advance(1.0)
        put(streams, Scan(5, "rover"))
        await clock.advance(0.9)
        assert (drops.all, pairs.pending) == ([], 3)
        await clock.advance(0.1)
        assert Counter(drops.told) == {(Scan(5), "timed out"): 1, (Scan(5, "nobody"), "unknown frame"): 1}
        await clock.advance(1.0)
        assert pairs.dropped == {"timed out": 2, "unknown frame": 1}
        causes = {message.frame: error.__cause__ for message, _, error in drops.all if error is not None}
        assert {frame: type(cause) for frame, cause in causes.items()} == {
            "laser": FutureExtrapolationError,
            "nobody": UnknownFrameError,
            "rover": DisconnectedError,
        }
        for _, _, error in drops.all:
            assert isinstance(error, LookupTimeoutError)
            assert (error.target, error.timeout) == ("map", 2.0)


async def test_the_timeout_error_names_the_missing_target(
    clock: SimulatedClock, bus: Bus, buffer: Buffer, streams: Streams
) -> None:
    drops = DroppedMessages()
    bus.publish(moving("odom", "laser", 5))
    async with MessageFilter(streams.receive, buffer, ["odom", "map"], timeout=1.0, on_drop=drops):
        put(streams, Scan(5))
        await clock.advance(1.0)
        ((_, _, error),) = drops.all
        assert isinstance(error, LookupTimeoutError)
        assert (error.target, error.source) == ("map", "laser")


async def test_a_transform_in_the_turn_in_which_the_timeout_expires_delivers_the_message(streams: Streams) -> None:
    clock = HandClock()
    bus = Bus(clock)
    buffer = Buffer(bus)
    put(streams, Scan(5))
    async with MessageFilter(streams.receive, buffer, "map", timeout=1.0) as pairs:
        await settle()
        clock.scopes[-1].cancel()
        bus.publish(moving("map", "laser", 5))
        assert (await anext(pairs))[0] == Scan(5)
        assert dict(pairs.dropped) == {}


# The callback


async def test_an_exception_of_the_callback_is_isolated_and_logged_once(
    bus: Bus, buffer: Buffer, streams: Streams, caplog: pytest.LogCaptureFixture
) -> None:
    def clumsy(_message: Scan, _reason: DropReason, _error: TransformError | None) -> None:
        raise ValueError("spilt the coffee")

    bus.publish(moving("map", "laser", 10))
    put(streams, Scan(1), Scan(2), Scan(10))
    async with MessageFilter(streams.receive, buffer, "map", on_drop=clumsy) as pairs:
        assert (await anext(pairs))[0] == Scan(10)
        assert (pairs.dropped, pairs.callbacks_failed) == ({"too old": 2}, 2)
    (record,) = caplog.records
    assert (record.name, record.levelno) == ("tfbus", logging.WARNING)
    assert "clumsy" in record.getMessage()


# How it ends


async def test_a_filter_belongs_to_the_loop_of_its_bus(buffer: Buffer) -> None:
    errors: list[Exception] = []

    async def enter() -> None:
        async with MessageFilter(Source(OSError()), buffer, "map"):
            pass

    def run() -> None:
        try:
            asyncio.run(enter())
        except Exception as error:  # noqa: BLE001 - the test looks at it
            errors.append(error)

    async with MessageFilter(Source(StopAsyncIteration()), buffer, "map"):
        thread = threading.Thread(target=run)
        thread.start()
        thread.join(PATIENCE)
    assert [type(error) for error in errors] == [RuntimeError]


async def test_leaving_the_filter_drops_the_remaining_messages_and_ends_its_tasks(
    clock: SimulatedClock, bus: Bus, buffer: Buffer, streams: Streams
) -> None:
    drops = DroppedMessages()
    bus.publish(moving("map", "laser", 5))
    async with MessageFilter(streams.receive, buffer, "map", timeout=9.0, on_drop=drops) as pairs:
        put(streams, Scan(5), Scan(6), Scan(6, "nobody"))
        await settle()
        assert len(buffer.pending()) == 2
    assert buffer.pending() == ()
    assert (pairs.arrived, pairs.pending, pairs.dropped) == (3, 0, {"closed": 3})
    assert [type(error) for _, _, error in drops.all] == [type(None), FutureExtrapolationError, UnknownFrameError]
    with pytest.raises(StopAsyncIteration):
        await anext(pairs)
    # Neither the clock nor the buffer nor the source has anything to do with it any more.
    clock.set(-1)
    bus.close()
    streams.send.send_nowait(Scan(7))
    assert streams.receive.receive_nowait() == Scan(7)
    assert pairs.arrived == 3


async def test_a_message_that_has_waited_is_freed_with_its_reader_before_its_time_is_up(
    bus: Bus, buffer: Buffer, streams: Streams
) -> None:
    async with MessageFilter(streams.receive, buffer, "map", timeout=60.0) as pairs:
        put(streams, Scan(5), Scan(6))
        await settle()
        bus.publish(moving("map", "laser", 5))
        message, _ = await anext(pairs)
        held = weakref.ref(message)
        del message
        gc.collect()
        assert held() is None


async def test_a_filter_that_was_left_is_freed(buffer: Buffer, streams: Streams) -> None:
    async def enter_and_leave(entered: MessageFilter[Scan, TransformStamped]) -> None:
        async with entered:
            await settle()

    pairs = MessageFilter(streams.receive, buffer, "map")
    # In another task, because asyncio's keep their last cancellation with its frames (Python 3.12).
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(enter_and_leave, pairs)
    held = weakref.ref(pairs)
    del pairs
    gc.collect()
    assert held() is None


async def test_a_generator_is_closed_in_the_task_that_read_it(buffer: Buffer) -> None:
    closed: list[anyio.TaskInfo] = []
    read_in: list[anyio.TaskInfo] = []

    async def endless() -> AsyncIterator[Scan]:
        try:
            while True:
                read_in.append(anyio.get_current_task())
                yield Scan(5)
        finally:
            closed.append(anyio.get_current_task())

    for overflow in ("block", "drop_newest"):
        async with MessageFilter(endless(), buffer, "map", capacity=1, overflow=overflow):
            for _ in range(20):
                await anyio.lowlevel.checkpoint()
        assert [task.id for task in closed] == [read_in[-1].id]
        closed.clear()


# Errors


class Source:
    """Yields messages, then raises."""

    def __init__(self, error: BaseException, *messages: Scan) -> None:
        self._error = error
        self._messages = list(messages)

    def __aiter__(self) -> "Source":
        return self

    async def __anext__(self) -> Scan:
        await anyio.lowlevel.checkpoint()
        if self._messages:
            return self._messages.pop(0)
        raise self._error


async def test_an_error_of_the_source_is_raised_at_the_end_if_it_was_not_read(buffer: Buffer) -> None:
    with pytest.raises(OSError, match="unplugged"):
        async with MessageFilter(Source(OSError("unplugged")), buffer, "map"):
            await settle()


async def test_an_error_of_the_body_is_raised_instead_of_one_of_the_source(buffer: Buffer) -> None:
    with pytest.raises(ZeroDivisionError):
        async with MessageFilter(Source(OSError("unplugged")), buffer, "map"):
            await settle()
            _ = 1 / 0


@pytest.mark.parametrize(
    ("message", "options", "error"),
    [
        (Scan(1.5), {}, TypeError),
        (Scan(None), {}, TypeError),
        (Scan(2**63), {}, ValueError),
        (Scan(5, None), {}, TypeError),  # type: ignore[arg-type]
        ("no header", {}, AttributeError),
        (Scan(LATEST), {"order": "stamp"}, TypeError),
        (Scan(0), {"stamp": lambda message: 1 // message.stamp}, ZeroDivisionError),
    ],
)
async def test_a_message_without_frame_and_stamp_is_an_error(
    message: Any, options: dict[str, Any], error: type[Exception], buffer: Buffer
) -> None:
    async def one() -> AsyncIterator[Any]:
        yield message

    with pytest.raises(error):
        async with MessageFilter(one(), buffer, "map", **options) as pairs:
            await anext(pairs)
    assert (pairs.arrived, balanced(pairs)) == (0, True)


async def test_an_error_of_closing_the_generator_is_raised(buffer: Buffer) -> None:
    async def fragile() -> AsyncIterator[Scan]:
        try:
            yield Scan(5)
            await anyio.sleep_forever()
        finally:
            raise OSError("torn")

    with pytest.raises(OSError, match="torn"):
        async with MessageFilter(fragile(), buffer, "map"):
            await settle()


class Alarm(BaseException):
    """No `Exception`, like Ctrl-C, but no event loop knows it."""


def ring(*_: object) -> str:
    try:
        raise KeyError("while this")
    except KeyError:
        raise Alarm from ValueError("because of that")


async def ringing() -> AsyncIterator[Scan]:
    yield Scan(5, "map")
    ring()


@pytest.mark.parametrize("where", ["source", "frame", "stamp", "on_drop", "on_drop of one that waits"])
@pytest.mark.parametrize("reading", [True, False])
async def test_a_base_exception_stops_the_body_and_is_raised_as_it_is(
    where: str, reading: bool, clock: SimulatedClock, buffer: Buffer
) -> None:
    options: dict[str, dict[str, Any]] = {
        "source": {},
        "frame": {"frame": ring},
        "stamp": {"stamp": ring},
        "on_drop": {"on_drop": ring, "timeout": 0.0},
        "on_drop of one that waits": {"on_drop": ring, "timeout": 1.0},
    }
    source = ringing() if where == "source" else Source(StopAsyncIteration(), Scan(5))
    with anyio.fail_after(PATIENCE):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(clock.advance, 2.0)
            with pytest.raises(Alarm) as caught:
                async with MessageFilter(source, buffer, "map", **options[where]) as pairs:
                    if reading:
                        await anext(pairs)
                    await anyio.sleep_forever()
            await anyio.lowlevel.checkpoint()
    assert repr(caught.value.__context__) == "KeyError('while this')"
    assert repr(caught.value.__cause__) == "ValueError('because of that')"
    assert (buffer.pending(), balanced(pairs)) == ((), True)


async def test_an_exception_group_of_the_source_stays_a_group(buffer: Buffer) -> None:
    alarm = Alarm()
    with pytest.raises(BaseExceptionGroup, match="two or more") as caught:
        async with MessageFilter(Source(BaseExceptionGroup("two or more", [alarm])), buffer, "map") as pairs:
            await anext(pairs)
    assert caught.value.exceptions == (alarm,)


def test_a_keyboard_interrupt_in_the_source_is_raised_as_it_is(
    run: Callable[[Callable[[], Any]], Any], buffer: Buffer
) -> None:
    seen: list[str] = []

    async def main() -> None:
        try:
            async with MessageFilter(Source(KeyboardInterrupt()), buffer, "map") as pairs:
                await anext(pairs)
        except BaseException as error:
            seen.append(type(error).__name__)
            raise

    with pytest.raises(KeyboardInterrupt):
        run(main)
    assert seen == ["KeyboardInterrupt"]


# Cancellation


async def test_cancelling_the_body_ends_the_filter(buffer: Buffer, streams: Streams) -> None:
    put(streams, Scan(5), Scan(6))
    with anyio.CancelScope() as scope:
        async with MessageFilter(streams.receive, buffer, "map") as pairs:
            await settle()
            scope.cancel()
            await anext(pairs)
    assert scope.cancelled_caught
    assert (buffer.pending(), pairs.dropped) == ((), {"closed": 2})


async def test_a_second_reader_is_busy_and_the_first_continues(buffer: Buffer, streams: Streams) -> None:
    async with anyio.create_task_group() as tasks, MessageFilter(streams.receive, buffer, "map") as pairs:
        first = Asked(tasks, pairs.__anext__)
        await settle()
        with pytest.raises(anyio.BusyResourceError):
            await anext(pairs)
        put(streams, Scan(5, "map"))
        await settle()
        assert first.answer[0] == Scan(5, "map")


async def test_a_filter_is_entered_once_and_read_inside(buffer: Buffer, streams: Streams) -> None:
    pairs = MessageFilter(streams.receive, buffer, "map")
    with pytest.raises(RuntimeError, match="enter"):
        await anext(pairs)
    async with pairs:
        pass
    with pytest.raises(RuntimeError, match="once"):
        await pairs.__aenter__()


async def no_callback(_message: Scan, _reason: DropReason, _error: TransformError | None) -> None:
    """An async function cannot be called when a message is dropped."""


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ({"target": ""}, UnknownFrameError),
        ({"target": ["map", "/odom"]}, UnknownFrameError),
        ({"target": []}, ValueError),
        ({"target": 5}, TypeError),
        ({"margin": -1.0}, ValueError),
        ({"margin": "much"}, TypeError),
        ({"timeout": -1.0}, ValueError),
        ({"capacity": 0}, ValueError),
        ({"capacity": 1.5}, TypeError),
        ({"overflow": "conflate"}, ValueError),
        ({"order": "random"}, ValueError),
        ({"on_drop": no_callback}, TypeError),
        ({"on_drop": "print"}, TypeError),
        ({"frame": "laser"}, TypeError),
        ({"stamp": 5}, TypeError),
        ({"messages": [Scan(1)]}, TypeError),
    ],
)
def test_a_wrong_argument_is_an_error(arguments: dict[str, Any], error: type[Exception], buffer: Buffer) -> None:
    with pytest.raises(error):
        MessageFilter(**{"messages": Source(OSError()), "buffer": buffer, "target": "map", **arguments})


async def test_the_error_of_a_leading_slash_names_the_similar_frame(bus: Bus, buffer: Buffer, streams: Streams) -> None:
    bus.publish(static("map", "laser"))
    pairs = MessageFilter(streams.receive, buffer, "map", on_drop=(drops := DroppedMessages()))
    for target in ("/map", ["/map"]):
        with pytest.raises(UnknownFrameError, match=r"no leading slash, did you mean 'map'\?"):
            MessageFilter(streams.receive, buffer, target)
    with pytest.raises(UnknownFrameError, match="did you mean 'map'"):
        pairs.set_target("/map")
    async with pairs:
        put(streams, Scan(5, "/laser"))
        await settle()
    ((_, _, error),) = drops.all
    assert "no leading slash, did you mean 'laser'?" in str(error)


@pytest.mark.parametrize(
    ("target", "changed", "error"),
    [
        ("map", ["map"], TypeError),
        (["map"], "map", TypeError),
        ("map", "/map", UnknownFrameError),
        (["map"], [], ValueError),
    ],
)
def test_changing_to_a_wrong_target_is_an_error(
    target: Any, changed: Any, error: type[Exception], buffer: Buffer
) -> None:
    pairs: MessageFilter[Scan, Any] = MessageFilter(Source(OSError()), buffer, target)
    with pytest.raises(error):
        pairs.set_target(changed)


# Plain asyncio


@pytest.mark.parametrize("around", ["timeout", "wait_for"])
def test_an_asyncio_timeout_around_a_filter_raises_a_timeout_error(around: str) -> None:
    buffer = Buffer(Bus())
    left: list[int] = []

    async def endless() -> None:
        send, receive = anyio.create_memory_object_stream[Scan](10)
        with send, receive:
            send.send_nowait(Scan(5))
            try:
                async with MessageFilter(receive, buffer, "map") as pairs:
                    await read(pairs, [])
            finally:
                left.append(pairs.dropped["closed"])

    async def main() -> None:
        with pytest.raises(TimeoutError):
            if around == "wait_for":
                await asyncio.wait_for(endless(), 0.1)
            else:
                async with asyncio.timeout(0.1):
                    await endless()
        task = asyncio.current_task()
        assert task is not None
        assert task.cancelling() == 0
        assert (left, buffer.pending()) == ([1], ())
        assert asyncio.all_tasks() == {task}

    asyncio.run(main())


@pytest.mark.parametrize("where", ["waiting", "in the body", "with an answer"])
def test_a_cancelled_asyncio_task_with_a_filter_is_cancelled(bus: Bus, buffer: Buffer, where: str) -> None:
    async def reading() -> None:
        async with MessageFilter(Source(StopAsyncIteration(), Scan(5)), buffer, "map") as pairs:
            async for _ in pairs:
                await asyncio.sleep(3_600.0)

    async def main() -> None:
        task = asyncio.create_task(reading())
        await settle()
        if where != "waiting":
            bus.publish(moving("map", "laser", 5))
        if where == "in the body":
            await settle()
        task.cancel("enough")
        with pytest.raises(asyncio.CancelledError):
            await task
        assert task.cancelled()
        assert (buffer.pending(), asyncio.all_tasks()) == ((), {asyncio.current_task()})

    asyncio.run(main())


def test_a_cancelled_error_of_the_source_itself_is_raised() -> None:
    buffer = Buffer(Bus(SimulatedClock()))

    async def main() -> None:
        async with MessageFilter(Source(asyncio.CancelledError()), buffer, "map") as pairs:
            with pytest.raises(asyncio.CancelledError):
                await anext(pairs)

    asyncio.run(main())


@pytest.mark.every_loop
async def test_a_message_is_dropped_when_a_target_that_it_does_not_wait_for_yet_loses_its_stamp(
    bus: Bus, buffer: Buffer, streams: Streams
) -> None:
    bus.publish([driving("map", "laser", 0), driving("laser", "arm", 0), driving("laser", "arm", 9)])
    async with MessageFilter(streams.receive, buffer, ["map", "arm"]) as pairs:
        await streams.send.send(Scan(5 * SECOND))
        await settle()
        bus.publish(driving("laser", "arm", 10))
        await settle()
        assert (pairs.pending, pairs.dropped) == (1, {})
        bus.publish(driving("laser", "arm", 11))
        await settle()
        assert (pairs.pending, pairs.dropped) == (0, {"too old": 1})


async def test_a_callback_may_call_the_filter_and_the_bus(bus: Bus, buffer: Buffer, streams: Streams) -> None:
    seen: list[int] = []

    def drop(message: Scan, _reason: DropReason, _error: TransformError | None) -> None:
        assert balanced(pairs)
        seen.append(message.stamp)
        pairs.set_target("odom")
        bus.publish(moving("odom", "laser", message.stamp + 2))

    async with MessageFilter(streams.receive, buffer, "map", capacity=2, on_drop=drop) as pairs:
        put(streams, Scan(1), Scan(2), Scan(3))
        await settle()
        assert (seen, pairs.callbacks_failed) == ([1, 2], 0)
        assert [(await anext(pairs))[1].parent] == ["odom"]
        assert pairs.dropped == {"queue full": 1, "too old": 1}


async def test_a_callback_may_change_the_target_while_the_filter_is_left(buffer: Buffer, streams: Streams) -> None:
    def drop(_message: Scan, _reason: DropReason, _error: TransformError | None) -> None:
        pairs.set_target("odom")

    async with MessageFilter(streams.receive, buffer, "map", on_drop=drop) as pairs:
        put(streams, Scan(1), Scan(2), Scan(3))
        await settle()
    assert (pairs.dropped, pairs.callbacks_failed, buffer.pending()) == ({"closed": 3}, 0, ())


async def test_a_changed_target_does_not_prolong_a_wait(
    clock: SimulatedClock, buffer: Buffer, streams: Streams
) -> None:
    async with MessageFilter(streams.receive, buffer, "map", timeout=2.0) as pairs:
        put(streams, Scan(1))
        await clock.advance(1.5)
        pairs.set_target("odom")
        await clock.advance(0.4)
        assert pairs.dropped == {}
        await clock.advance(0.1)
        assert pairs.dropped == {"unknown frame": 1}
