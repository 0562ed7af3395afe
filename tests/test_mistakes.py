"""The mistakes of newcomers, most of them habits of tf2, and what a program that makes one is told."""

import inspect
import logging
import re
import threading
from collections.abc import AsyncIterator, Callable
from types import SimpleNamespace
from typing import Any

import anyio
import anyio.lowlevel
import anyio.to_thread
import pytest
from support.samples import moving, static

import tfbus
from tfbus import (
    SECOND,
    Buffer,
    Bus,
    FutureExtrapolationError,
    LocalLink,
    LookupTimeoutError,
    MessageFilter,
    PastExtrapolationError,
    PointStamped,
    SimulatedClock,
    Transform,
    TransformBroadcaster,
    TransformTree,
    UnknownFrameError,
    do_transform,
    from_seconds,
)
from tfbus.errors import AheadError
from tfbus.links.rosbridge import RosbridgeLink
from tfbus.recording import Recorder

NOW = 1_700_000_000 * SECOND
POINT = PointStamped("laser", NOW, (1.0, 2.0, 3.0))
MAP_FROM_LASER = moving("map", "laser", NOW)


def told(mistake: Callable[[], object], kind: type[Exception]) -> str:
    """The message that a mistake is answered with."""
    with pytest.raises(kind) as caught:
        mistake()
    return str(caught.value)


@pytest.fixture
def late() -> tuple[Bus, Buffer]:
    """A bus at wall time with a sample that is 2.4 s old, and its buffer."""
    bus = Bus(SimulatedClock(NOW))
    buffer = Buffer(bus)
    bus.publish(moving("map", "base_link", NOW - from_seconds(2.4)))
    return bus, buffer


# Instants and durations


def test_an_answer_beyond_max_age_is_told_by_its_age(late: tuple[Bus, Buffer]) -> None:
    _, buffer = late
    with pytest.raises(FutureExtrapolationError) as caught:
        buffer.lookup_nowait("map", "base_link", max_age=1.0)
    assert str(caught.value) == "frame 'base_link': newest sample is 2.4 s old, and may be 1 s old (max_age)"
    assert caught.value.max_age == SECOND
    explained = buffer.explain("map", "base_link", max_age=1.0)
    assert "2.4 s old, and may be 1 s old" in str(explained.errors[0])
    again = tfbus.TransformError.from_dict(caught.value.to_dict())
    assert str(again) == str(caught.value)


def test_an_answer_too_far_ahead_is_told_by_how_far(late: tuple[Bus, Buffer]) -> None:
    bus, buffer = late
    bus.publish(moving("map", "base_link", NOW + from_seconds(0.9)))
    assert told(lambda: buffer.lookup_nowait("map", "base_link", max_age=0.5), AheadError) == (
        "frame 'base_link': newest sample is 900 ms ahead of the clock, and may be 500 ms ahead (max_age)"
    )


@pytest.mark.parametrize(
    ("at", "hint"),
    [
        (0, "was this stamp never set? For the newest, ask at LATEST, not at 0"),
        (99, "for seconds write from_seconds(99)"),
        (NOW // SECOND, f"seconds passed as nanoseconds? from_seconds({NOW // SECOND}) is that stamp"),
    ],
)
def test_a_stamp_that_is_no_stamp_is_told_what_was_meant(at: int, hint: str, late: tuple[Bus, Buffer]) -> None:
    _, buffer = late
    message = told(lambda: buffer.lookup_nowait("map", "base_link", at), PastExtrapolationError)
    assert message.endswith(f": {hint}")
    assert hint in told(lambda: buffer.tree.lookup("map", "base_link", at), PastExtrapolationError)


def test_nanoseconds_in_place_of_seconds_are_doubted() -> None:
    with Bus() as bus:
        limit = "keep must be at most 100,000,000 s, or None for everything"
        message = told(lambda: Buffer(bus, keep=1_000_000_000), ValueError)
        assert message == f"{limit}, got 1000000000: nanoseconds passed as seconds?"
    assert told(lambda: TransformTree(keep=1e10), ValueError).endswith("nanoseconds passed as seconds?")
    assert TransformTree(keep=1e8).keep == 1e8


@pytest.mark.anyio
@pytest.mark.parametrize(("timeout", "doubted"), [(1e9, True), (60.0, False), (None, False)])
async def test_a_lookup_that_hangs_with_a_timeout_of_years_is_logged_with_a_doubt(
    timeout: float | None, doubted: bool, caplog: pytest.LogCaptureFixture
) -> None:
    clock = SimulatedClock(NOW)
    with Bus(clock) as bus, Buffer(bus) as buffer:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(lambda: buffer.lookup("map", "nowhere", timeout=timeout))
            await anyio.lowlevel.checkpoint()
            await clock.advance(6.0)
            tasks.cancel_scope.cancel()
    (line,) = [record.message for record in caplog.records if "has waited" in record.message]
    assert line.endswith("a timeout of 1,000,000,000 s, nanoseconds passed as seconds?") == doubted


# Buses, buffers and threads


@pytest.mark.anyio
async def test_a_buffer_that_was_made_after_the_publishing_says_so() -> None:
    clock = SimulatedClock(NOW)
    bus = Bus(clock)
    first = Buffer(bus)
    bus.publish([moving("map", "base_link", NOW), static("base_link", "laser")])
    buffer = Buffer(bus)
    why = "frame 'map' is not known: its samples came before this buffer was made, see prefill"
    with pytest.raises(UnknownFrameError) as caught:
        buffer.lookup_nowait("map", "laser")
    assert (str(caught.value), caught.value.missed) == (why, True)
    with pytest.raises(LookupTimeoutError, match=re.escape(why)):
        await buffer.lookup("map", "laser", timeout=0.0)
    assert Buffer(bus, prefill=first).can_transform("map", "laser")
    # Other names, and a buffer that was closed before the publishing, get the usual text.
    assert told(lambda: buffer.lookup_nowait("lasr", "laser"), UnknownFrameError).endswith("did you mean 'laser'?")
    bus.publish(moving("map", "base_link", NOW + SECOND))
    assert buffer.can_transform("map", "laser")
    buffer.close()
    bus.publish(moving("map", "arm", NOW))
    assert told(lambda: buffer.lookup_nowait("map", "arm"), UnknownFrameError) == "frame 'arm' is not known"


@pytest.mark.anyio
async def test_a_lookup_that_would_wait_in_another_thread_is_told_how() -> None:
    with Bus(SimulatedClock(NOW)) as bus, Buffer(bus) as buffer:
        bus.publish(moving("map", "base_link", NOW))
        # This loop takes the bus over.
        await buffer.lookup("map", "base_link")
        with bus.threadsafe():
            failures: list[BaseException] = []

            async def wait() -> None:
                await buffer.lookup("map", "base_link", NOW + SECOND, timeout=5.0)

            def in_a_thread() -> None:
                try:
                    anyio.run(wait)
                except RuntimeError as error:
                    failures.append(error)

            thread = threading.Thread(target=in_a_thread)
            thread.start()
            await anyio.to_thread.run_sync(thread.join)
    (failure,) = failures
    assert str(failure).startswith("the bus belongs to another thread: ask here with `lookup_nowait`, or wait on the ")
    assert "anyio.from_thread.run" in str(failure)


@pytest.mark.parametrize(("prefix", "lines"), [("robot1", 1), ("robot1/", 0), ("robot1_", 0)])
def test_a_prefix_without_its_slash_is_logged(prefix: str, lines: int, caplog: pytest.LogCaptureFixture) -> None:
    with Bus() as bus:
        TransformBroadcaster(bus, prefix=prefix)
    assert [record.message for record in caplog.records] == lines * [
        "the prefix 'robot1' makes the frame 'robot1base_link' of 'base_link': the slash is part of a prefix, as in "
        "'robot1/'"
    ]
    assert {record.levelno for record in caplog.records} <= {logging.WARNING}


# Data and messages


@pytest.mark.parametrize(
    ("mistake", "why"),
    [
        (lambda: do_transform(POINT, Transform()), "a Transform has no frames and no stamp: give do_transform a"),  # type: ignore[arg-type]
        (lambda: do_transform(MAP_FROM_LASER, POINT), "do_transform takes the data first"),  # type: ignore[arg-type]
        (lambda: do_transform(POINT, None), "do_transform takes a TransformStamped, not None"),  # type: ignore[arg-type]
        (lambda: do_transform({"header": {}}, MAP_FROM_LASER), "convert a ROS message with from_message first"),
        (lambda: do_transform(SimpleNamespace(header=1), MAP_FROM_LASER), "convert a ROS message with from_message"),
    ],
)
def test_wrong_arguments_of_do_transform_are_told_apart(mistake: Callable[[], object], why: str) -> None:
    assert why in told(mistake, TypeError)


@pytest.mark.parametrize(
    ("mistake", "why"),
    [
        (lambda: LocalLink(Bus(), robbot="arm"), "a link has no option 'robbot', did you mean 'robot'"),  # type: ignore[call-arg]
        (lambda: RosbridgeLink(Bus(), "ws://a:9090", framez=("a",)), "no option 'framez', did you mean 'frames'"),  # type: ignore[call-arg]
        (lambda: LocalLink(Bus(), zzz=1), "a link has no option 'zzz'; there are capacity, clock, correct_clocks"),  # type: ignore[call-arg]
    ],
)
def test_an_option_that_a_link_does_not_have_is_refused(mistake: Callable[[], object], why: str) -> None:
    assert why in told(mistake, TypeError)


def test_a_message_of_ros_is_sent_to_from_message() -> None:
    message = {"header": {}, "child_frame_id": "laser", "transform": {}}
    with Bus() as bus, Buffer(bus) as buffer:
        for wrong in (message, [message], SimpleNamespace(**message), [SimpleNamespace(**message)]):
            publish: Any = bus.publish
            assert told(lambda: publish(wrong), TypeError).endswith(": convert a ROS message with from_message first")  # noqa: B023
        whole = SimpleNamespace(transforms=[message])
        assert "each of a message's transforms" in told(lambda: bus.publish(whole), TypeError)
        assert "its frames and its stamp too" in told(lambda: bus.publish(Transform()), TypeError)  # type: ignore[arg-type]
        cloud: Any = SimpleNamespace(header=None, points=[])
        assert "from_message first" in told(lambda: buffer.transform_nowait(cloud, "map"), TypeError)


# Names of tf2


def test_names_of_tf2_are_told_in_the_names_of_tfbus() -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        things: dict[object, list[tuple[str, str]]] = {
            buffer: [("lookup_transform", "lookup_nowait"), ("lookupTransform", "lookup_nowait")],
            buffer.tree: [("allFramesAsYAML", "to_yaml"), ("lookupTwist", "twist")],
            TransformBroadcaster(bus): [("sendTransform", "send"), ("send_transform", "send_all")],
            bus: [("sendTransform", "TransformBroadcaster"), ("lookup_transform", "Buffer(bus)")],
            MAP_FROM_LASER: [("child_frame_id", "`child`"), ("header", "`stamp`")],
            tfbus: [("TransformListener", "Buffer"), ("ConnectivityException", "DisconnectedError")],
        }
        for thing, names in things.items():
            for theirs, ours in names:
                message = told(lambda: getattr(thing, theirs), AttributeError)  # noqa: B023
                assert theirs in message
                assert ours in message
                assert not hasattr(thing, theirs)
                assert theirs not in dir(thing)


def test_a_name_that_neither_has_is_an_ordinary_error() -> None:
    package: Any = tfbus
    assert told(lambda: package.listner, AttributeError) == "module 'tfbus' has no attribute 'listner'"


@pytest.mark.parametrize("kind", [Buffer, Bus, TransformTree, TransformBroadcaster])
def test_the_names_of_tf2_make_no_access_to_an_attribute_slower(kind: type) -> None:
    # A `__getattr__` would: the interpreter then takes the long way to every attribute.
    assert inspect.getattr_static(kind, "__getattr__", None) is None


async def no_messages() -> AsyncIterator[PointStamped]:
    for message in list[PointStamped]():
        yield message


@pytest.mark.anyio
async def test_the_tolerance_of_a_message_filter_is_its_margin_and_warns() -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        with pytest.warns(DeprecationWarning, match="the tolerance of a MessageFilter is called margin"):
            old = MessageFilter(no_messages(), buffer, "map", tolerance=0.2)
        with pytest.raises(ValueError, match="margin must not be negative"):
            MessageFilter(no_messages(), buffer, "map", margin=-1.0)
        async with old as pairs:
            assert [pair async for pair in pairs] == []


@pytest.mark.parametrize(
    "make",
    [
        LocalLink,
        lambda bus: Recorder(bus, "run.mcap"),
        lambda bus: MessageFilter(no_messages(), Buffer(bus), "map"),
    ],
)
def test_a_plain_with_of_something_that_owns_a_task_says_async_with(make: Callable[[Bus], Any]) -> None:
    with Bus() as bus:
        thing = make(bus)
        name = type(thing).__name__

        def enter() -> None:
            with thing:
                pass

        message = f"a {name} owns a task or a socket: write `async with {name}(...)`, not `with`"
        assert told(enter, TypeError) == message
