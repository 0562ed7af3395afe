"""Sets of messages with nearly the same stamps: beside all sets that there are, and streams that fail and stop."""

import asyncio
from collections.abc import AsyncIterator, Sequence
from itertools import product
from random import Random
from typing import Any

import anyio
import pytest
from anyio.lowlevel import checkpoint
from hypothesis import given
from hypothesis import strategies as st

from tfbus import (
    Buffer,
    Bus,
    PointStamped,
    SimulatedClock,
    SynchronizedSet,
    Synchronizer,
    Transform,
    TransformBroadcaster,
    from_seconds,
)
from tfbus.testing import simulate

pytestmark = pytest.mark.anyio

Stamps = Sequence[int]


def narrowest_sets(streams: Sequence[Stamps], within: int) -> list[tuple[int, ...]]:
    """The sets of whole streams, by their definition: each time the narrowest of all sets with the pivot."""
    left, found = [list(stream) for stream in streams], []
    while all(left):
        pivot = max(stream[0] for stream in left)
        # A stream with a message at the pivot gives that one: it makes no set wider.
        sets = list(product(*([pivot] if pivot in stream else stream for stream in left)))
        best = min(sets, key=lambda each: (max(each) - min(each), max(each), [(abs(s - pivot), s) for s in each]))
        if max(best) - min(best) > within:
            oldest = min(left, key=lambda stream: stream[0])
            oldest.pop(0)
            continue
        found.append(best)
        left = [[stamp for stamp in stream if stamp > taken] for stream, taken in zip(left, best, strict=True)]
    return found


class Message:
    """A message of a stream with a stamp."""

    def __init__(self, stamp: int) -> None:
        self.stamp = stamp


async def replay(stamps: Stamps) -> AsyncIterator[Message]:
    for stamp in stamps:
        yield Message(stamp)


streams_of_stamps = st.lists(
    st.lists(st.integers(0, 60), min_size=1, max_size=8, unique=True).map(sorted), min_size=2, max_size=3
)


@given(streams_of_stamps, st.integers(0, 30), st.integers(0, 2**32))
async def test_each_set_is_the_narrowest_with_its_pivot_in_whatever_order_messages_come(
    streams: list[list[int]], within: int, seed: int
) -> None:
    senders, receivers = zip(*(anyio.create_memory_object_stream[Message](100) for _ in streams), strict=True)
    arrivals = [number for number, stamps in enumerate(streams) for _ in stamps]
    Random(seed).shuffle(arrivals)
    ahead = [iter(stamps) for stamps in streams]
    found = []
    async with Synchronizer(*receivers, within=within / 1e9) as sets, anyio.create_task_group() as tasks:

        async def send() -> None:
            for number in arrivals:
                await senders[number].send(Message(next(ahead[number])))
                for _ in range(4):
                    await checkpoint()
            for sender in senders:
                sender.close()

        tasks.start_soon(send)
        found = [tuple(message.stamp for message in messages) async for messages in sets]
    for receiver in receivers:
        receiver.close()
    assert found == narrowest_sets(streams, within)
    dropped = sum(sum(counts.values()) for counts in sets.dropped)
    assert dropped + len(streams) * sets.delivered == sum(map(len, streams))


async def test_a_set_waits_for_a_message_that_may_be_nearer_unless_the_spacing_rules_it_out() -> None:
    for spacing, waits in ((0.0, True), (8e-9, False)):
        (to_a, a), (to_b, b) = (anyio.create_memory_object_stream[Message](9) for _ in range(2))
        async with Synchronizer(a, b, within=5e-9, spacing=spacing) as sets:
            got: list[Any] = []

            async def read(sets: Synchronizer = sets, got: list[Any] = got) -> None:
                got.append(await anext(sets))

            async with anyio.create_task_group() as tasks:
                tasks.start_soon(read)
                await to_a.send(Message(100))
                await to_b.send(Message(103))
                await anyio.wait_all_tasks_blocked()
                assert bool(got) is not waits
                await to_a.send(Message(110))
            assert [message.stamp for message in got[0]] == [100, 103]
        for stream in (to_a, a, to_b, b):
            stream.close()


async def test_offsets_move_the_stamps_of_a_stream_and_leave_its_messages_alone() -> None:
    async with Synchronizer(replay([100, 200]), replay([140, 240]), within=1e-9, offsets=(0.0, -40e-9)) as sets:
        assert [tuple(message.stamp for message in messages) async for messages in sets] == [(100, 140), (200, 240)]


async def test_every_drop_is_counted_by_its_stream_and_reason() -> None:
    told: list[tuple[int, int, str]] = []

    def tell(number: int, message: Message, reason: str) -> None:
        told.append((number, message.stamp, reason))

    to_a, a = anyio.create_memory_object_stream[Message](9)
    async with Synchronizer(a, replay([100, 50, 200, 205]), within=4e-9, capacity=2, on_drop=tell) as sets:
        await anyio.wait_all_tasks_blocked()
        await to_a.send(Message(203))
        await anyio.wait_all_tasks_blocked()
    assert told == [
        (1, 50, "out of order"),
        (1, 100, "queue full"),
        (1, 200, "no partner"),
        (0, 203, "closed"),
        (1, 205, "closed"),
    ]
    assert [dict(counts) for counts in sets.dropped] == [
        {"closed": 1},
        {"out of order": 1, "queue full": 1, "no partner": 1, "closed": 1},
    ]
    to_a.close()
    a.close()


async def test_it_ends_when_the_last_message_of_a_stream_that_has_ended_finds_no_partner() -> None:
    to_a, a = anyio.create_memory_object_stream[Message](9)
    async with Synchronizer(a, replay([100]), within=1e-9) as sets:
        await anyio.wait_all_tasks_blocked()
        async with anyio.create_task_group() as tasks:
            with anyio.fail_after(30.0):
                tasks.start_soon(to_a.send, Message(500))
                assert [messages async for messages in sets] == []
    to_a.close()
    a.close()


@pytest.mark.parametrize("capacity", [1, 3])
async def test_a_recording_with_a_slow_stream_is_read_to_its_end(capacity: int) -> None:
    rare = [500, 900]
    async with Synchronizer(replay(range(1_000)), replay(rare), within=1e-9, capacity=capacity, block=True) as sets:
        with anyio.fail_after(30.0):
            found = [tuple(message.stamp for message in messages) async for messages in sets]
    assert found == [(500, 500), (900, 900)]
    assert sets.dropped[0]["no partner"] == 899


async def test_a_recording_is_not_read_faster_than_its_sets() -> None:
    read = 0

    async def counted() -> AsyncIterator[Message]:
        nonlocal read
        async for message in replay(range(500)):
            read += 1
            yield message

    async with Synchronizer(counted(), replay(range(500)), within=0.0, capacity=3, block=True) as sets:
        await anyio.wait_all_tasks_blocked()
        assert read <= 2 * 3
        assert [messages[0].stamp async for messages in sets] == list(range(500))
    assert not any(sum(counts.values()) for counts in sets.dropped)


async def test_an_error_of_a_stream_is_raised_after_the_sets_that_are_ready() -> None:
    async def broken() -> AsyncIterator[Message]:
        yield Message(1)
        raise OSError("unplugged")

    got = []
    with pytest.raises(OSError, match="unplugged"):
        async with Synchronizer(broken(), replay([1, 2]), within=0.0) as sets:
            got.append(await anext(sets))
            await anext(sets)
    assert len(got) == 1


def test_a_stream_that_is_cancelled_by_itself_ends_the_sets_but_not_the_body() -> None:
    async def cancelled() -> AsyncIterator[Message]:
        yield Message(5)
        raise asyncio.CancelledError

    async def main() -> None:
        async with Synchronizer(replay([5, 9]), cancelled(), within=1.0) as sets:
            assert [each.stamp for each in await anext(sets)] == [5, 5]
            with pytest.raises(asyncio.CancelledError):
                await anext(sets)
            await asyncio.sleep(0)

    asyncio.run(main())


async def test_a_set_comes_with_its_transforms_or_is_dropped_and_a_cancelled_reader_loses_none() -> None:
    async def points(frame: str, *seconds: float) -> AsyncIterator[PointStamped]:
        for second in seconds:
            yield PointStamped(frame, from_seconds(second), (0.0, 0.0, 0.0))

    clock = SimulatedClock(start=from_seconds(100))
    with Bus(clock) as bus, Buffer(bus) as buffer:
        robot = TransformBroadcaster(bus)
        robot.send_static("base", "camera", Transform((1.0, 0.0, 0.0)))
        robot.send("odom", "base", Transform(), at=0)
        robot.send("odom", "base", Transform((2.0, 0.0, 0.0)), at=from_seconds(2))
        streams = points("camera", 0.5, 3.0, 3.5), points("base", 0.6, 3.1, 3.6)
        async with Synchronizer(*streams, within=0.2, buffer=buffer, target="odom", timeout=1.0) as sets:
            found = await anext(sets)
            assert isinstance(found, SynchronizedSet)
            assert [transform.transform.translation[0] for transform in found.transforms] == [1.5, 0.6]
            with anyio.move_on_after(0.0):
                await anext(sets)
            robot.send("odom", "base", Transform((3.0, 0.0, 0.0)), at=from_seconds(3.05))

            async def read_on() -> None:
                assert [each async for each in sets] == []

            await simulate(clock, read_on)
        assert [dict(counts) for counts in sets.dropped] == [{"no transform": 2}] * 2
        # Each of the two sets has waited for a second.
        assert clock.now() == from_seconds(102)


async def test_it_is_entered_once_before_it_is_read() -> None:
    sets = Synchronizer(replay([]), replay([]), within=1.0)
    with pytest.raises(RuntimeError, match="enter the synchronizer first: async with"):
        await anext(sets)
    async with sets:
        pass
    with pytest.raises(RuntimeError, match="entered once: make another one"):
        await sets.__aenter__()


async def test_arguments_that_do_not_fit_the_streams_are_refused() -> None:
    one, two = replay([]), replay([])
    with pytest.raises(ValueError, match="at least two streams, got 1"):
        Synchronizer(one, within=1.0)
    with pytest.raises(ValueError, match="offsets must have one number for each of 2 streams, got 1"):
        Synchronizer(one, two, within=1.0, offsets=[0.0])
    with pytest.raises(TypeError, match="an async iterable, not 5"):
        Synchronizer(one, 5, within=1.0)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="both buffer and target"):
        Synchronizer(one, two, within=1.0, target="map")
    with pytest.raises(TypeError, match="async with"), Synchronizer(one, two, within=1.0):  # type: ignore[attr-defined]
        pass
