"""Streams of batches, and the queues behind them."""

import copy
from collections.abc import Callable, Iterable

import anyio
import anyio.lowlevel
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.asking import settle
from support.samples import moving, static

from tfbus import Bus, SimulatedClock, Stream, TransformStamped
from tfbus.bus.queues import Overflow, SampleQueue

pytestmark = pytest.mark.anyio

Batches = list[tuple[TransformStamped, ...]]
OVERFLOWS: list[Overflow] = ["conflate", "drop_oldest"]


async def read(stream: Stream, batches: Batches) -> None:
    async for batch in stream:
        batches.append(batch)


@pytest.mark.every_loop
async def test_a_stream_gives_whole_batches_in_order(bus: Bus) -> None:
    sent = [(moving("map", "a", k), moving("a", "b", k)) for k in range(20)]
    got: Batches = []
    async with anyio.create_task_group() as tasks:
        with bus.stream(overflow="drop_oldest") as stream:
            tasks.start_soon(read, stream, got)
            await settle()
            for batch in sent[:10]:
                bus.publish(batch)
                await settle()
            for batch in sent[10:]:
                bus.publish(batch)
            await settle()
            assert got == sent


@pytest.mark.parametrize("overflow", OVERFLOWS)
async def test_a_late_stream_gives_the_latched_static_samples_first(bus: Bus, overflow: Overflow) -> None:
    bus.publish([static("map", "a"), static("map", "b", x=1.0), moving("map", "c", 1)])
    bus.publish(static("map", "b", x=2.0))
    with bus.stream(overflow=overflow) as stream:
        assert set(await anext(stream)) == {static("map", "a"), static("map", "b", x=2.0)}
        bus.publish(moving("map", "c", 2))
        assert await anext(stream) == (moving("map", "c", 2),)


@pytest.mark.parametrize("overflow", OVERFLOWS)
@pytest.mark.parametrize("end", [lambda bus, _: bus.close(), lambda _, stream: stream.close()])
async def test_a_closed_stream_ends_after_the_pending_batches(
    bus: Bus, end: Callable[[Bus, Stream], None], overflow: Overflow
) -> None:
    stream = bus.stream(overflow=overflow)
    bus.publish(moving("map", "a", 1))
    end(bus, stream)
    got: Batches = []
    await read(stream, got)
    assert got == [(moving("map", "a", 1),)]
    with pytest.raises(StopAsyncIteration):
        await anext(stream)


async def test_a_stream_may_be_closed_in_a_callback_of_the_bus(bus: Bus) -> None:
    with bus.stream() as closing, bus.stream() as staying, bus.subscribe(lambda _: closing.close()):
        bus.publish(moving("map", "a", 1))
        bus.publish(moving("map", "b", 2))
        assert set(await anext(staying)) == {moving("map", "a", 1), moving("map", "b", 2)}
        assert [batch async for batch in closing] == [(moving("map", "a", 1),)]
    assert bus.statistics().callbacks_failed == 0


@pytest.mark.parametrize("overflow", OVERFLOWS)
async def test_a_jump_back_discards_pending_moving_samples(overflow: Overflow) -> None:
    clock = SimulatedClock(start=10)
    bus = Bus(clock)
    with bus.stream(overflow=overflow) as stream:
        bus.publish([static("map", "a"), moving("map", "b", 10)])
        clock.set(5)
        bus.publish(moving("map", "b", 5))
        bus.close()
        got = [sample async for batch in stream for sample in batch]
        assert got == [static("map", "a"), moving("map", "b", 5)]
        assert stream.dropped == 1


@pytest.mark.parametrize(
    ("capacity", "overflow", "error"),
    [
        (0, "conflate", ValueError),
        (10, "block", ValueError),
        (True, "conflate", TypeError),
        (1.5, "conflate", TypeError),
    ],
)
def test_a_stream_with_a_bad_capacity_or_overflow_is_not_registered(
    bus: Bus, capacity: int, overflow: Overflow, error: type[Exception]
) -> None:
    with pytest.raises(error, match=r"capacity|overflow"):
        bus.stream(capacity, overflow)
    bus.publish(moving("map", "a", 1))
    assert bus.statistics().queues == ()


def emptied(queue: SampleQueue) -> Batches:
    batches = []
    while (batch := queue.get()) is not None:
        batches.append(batch)
    return batches


def test_kept_static_samples_come_in_the_order_of_their_last_publication() -> None:
    queue = SampleQueue(1, "drop_oldest")
    for sample in (static("map", "a", x=1.0), static("map", "b"), static("map", "a", x=2.0), moving("map", "c", 1)):
        queue.put((sample,))
    assert emptied(queue) == [(static("map", "b"), static("map", "a", x=2.0)), (moving("map", "c", 1),)]


def test_repeated_static_samples_do_not_fill_the_queue() -> None:
    queue = SampleQueue(10, "drop_oldest")
    for time in range(1_000):
        queue.put((static("map", "a", stamp=time),))
    assert len(queue) <= 11
    assert emptied(queue)[-1] == (static("map", "a", stamp=999),)
    assert (queue.dropped, queue.conflated, len(queue)) == (0, 0, 0)


def test_conflate_drops_the_moving_children_that_have_waited_longest() -> None:
    queue = SampleQueue(2, "conflate")
    queue.put((static("map", "s"), moving("map", "a", 1), moving("map", "b", 1)))
    queue.put((moving("map", "a", 2), static("map", "t")))
    queue.put((moving("map", "c", 1),))
    (batch,) = emptied(queue)
    assert set(batch) == {static("map", "s"), static("map", "t"), moving("map", "a", 2), moving("map", "c", 1)}
    assert queue.dropped == 1


@pytest.mark.parametrize("overflow", ["conflate", "drop_oldest"])
def test_moving_samples_of_a_forgotten_child_count_as_dropped(overflow: Overflow) -> None:
    queue = SampleQueue(2, overflow)
    queue.put((moving("map", "a", 1), static("map", "s")))
    queue.put((moving("map", "b", 1),))
    for child, dropped in (("s", 0), ("a", 1), ("never heard of", 1)):
        queue.forget(child)
        assert queue.dropped == dropped
    assert emptied(queue) == [(moving("map", "b", 1),)]
    queue.put((moving("map", "c", 1), moving("map", "d", 1)))
    assert queue.dropped == 1, "there is room for two again"
    queue.put((moving("map", "e", 1),))
    assert queue.dropped == (2 if overflow == "conflate" else 3), "and for no more"


def test_conflated_moving_samples_are_counted_separately() -> None:
    queue = SampleQueue(1, "conflate")
    queue.put((moving("map", "a", 2), moving("map", "a", 3), moving("map", "a", 1)))
    queue.put((static("map", "a"), static("map", "a")))
    queue.put((moving("map", "a", 4), moving("map", "b", 4)))
    assert emptied(queue) == [(moving("map", "b", 4),)]
    # Offered 5: two gave way to newer ones, one to a static one, one was dropped for the capacity, one was read.
    assert (queue.conflated, queue.dropped) == (3, 1)
    assert queue.statistics("stream").conflated == 3


CHILDREN = st.sampled_from("abcd")
SAMPLES = st.builds(moving, st.just("map"), CHILDREN, st.integers(0, 9)) | st.builds(
    static, st.just("map"), CHILDREN, x=st.integers(0, 9).map(float)
)
BATCHES = st.lists(SAMPLES, min_size=1, max_size=4).map(tuple)


def count_moving(batch: Iterable[TransformStamped]) -> int:
    return sum(not sample.static for sample in batch)


@given(capacity=st.integers(1, 6), steps=st.lists(BATCHES | st.none(), max_size=40))
def test_drop_oldest_accounts_for_every_sample_and_loses_no_newest_static(
    capacity: int, steps: list[tuple[TransformStamped, ...] | None]
) -> None:
    queue = SampleQueue(capacity, "drop_oldest")
    got: list[TransformStamped] = []
    put: list[TransformStamped] = []
    for batch in steps:
        if batch is None:
            got.extend(queue.get() or ())
        else:
            queue.put(batch)
            put.extend(batch)
            newest_batch = count_moving(batch)
        assert count_moving(put) == count_moving(got) + queue.dropped + _pending_moving(queue)
        assert batch is None or _pending_moving(queue) <= max(capacity, newest_batch)
    got.extend(sample for batch in emptied(queue) for sample in batch)
    last_put = {sample.child: sample for sample in put if sample.static}
    last_got = {sample.child: sample for sample in got if sample.static}
    assert last_got == last_put
    came = iter(sample for sample in put if not sample.static)
    assert all(sample in came for sample in got if not sample.static), "samples came in another order"


def _pending_moving(queue: SampleQueue) -> int:
    twin = copy.deepcopy(queue)
    return sum(map(count_moving, emptied(twin)))


@given(steps=st.lists(BATCHES | st.none(), max_size=40))
def test_conflate_equals_a_dict_of_the_newest_samples(steps: list[tuple[TransformStamped, ...] | None]) -> None:
    queue = SampleQueue(4, "conflate")
    model: dict[str, TransformStamped] = {}
    for batch in steps:
        for sample in batch or ():
            had = model.get(sample.child)
            if had is None or sample.static or had.static or sample.stamp >= had.stamp:
                model[sample.child] = sample
        if batch is None:
            assert {sample.child: sample for sample in queue.get() or ()} == model
            model.clear()
        else:
            queue.put(batch)
            assert len(queue) == len(model)
    assert queue.dropped == 0


@given(capacity=st.integers(1, 3), batches=st.lists(BATCHES, max_size=20))
def test_conflate_never_holds_more_moving_children_than_its_capacity(
    capacity: int, batches: list[tuple[TransformStamped, ...]]
) -> None:
    queue = SampleQueue(capacity, "conflate")
    for batch in batches:
        queue.put(batch)
        assert _pending_moving(queue) <= capacity
    last_kinds = {sample.child: sample.static for batch in batches for sample in batch}
    pending = {sample.child for batch in emptied(queue) for sample in batch if sample.static}
    assert pending == {child for child, is_static in last_kinds.items() if is_static}
