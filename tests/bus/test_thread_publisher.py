"""Publishing from threads, and what else threads may do with a bus."""

import asyncio
import math
import threading
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import anyio
import anyio.to_thread
import pytest
from support.asking import Asked, settle, threads_that
from support.samples import moving, static

from tfbus import (
    LATEST,
    Buffer,
    Bus,
    BusClosedError,
    InvalidTransformError,
    PointStamped,
    SimulatedClock,
    ThreadPublisher,
    Transform,
    TransformBroadcaster,
    TransformStamped,
)

pytestmark = [pytest.mark.anyio, pytest.mark.every_loop]

Run = Callable[[Callable[[], Awaitable[None]]], None]

PATIENCE = 30.0
"""Real seconds after which a test that hangs is given up."""


@pytest.fixture
def bus() -> Bus:
    """On the clock of the machine."""
    return Bus()


def in_thread(function: Callable[[], object]) -> list[Exception]:
    """Run a function in a thread of its own while this one is blocked; give back what it raised."""
    errors: list[Exception] = []

    def call() -> None:
        try:
            function()
        except Exception as error:  # noqa: BLE001 - the test looks at it
            errors.append(error)

    thread = threading.Thread(target=call)
    thread.start()
    thread.join(PATIENCE)
    assert not thread.is_alive()
    return errors


@contextmanager
def threads_running(*functions: Callable[[], object]) -> Iterator[list[threading.Thread]]:
    threads = [threading.Thread(target=function) for function in functions]
    for thread in threads:
        thread.start()
    yield threads
    for thread in threads:
        thread.join(PATIENCE)
        assert not thread.is_alive()


async def test_a_thread_wakes_a_lookup_on_a_loop_that_has_nothing_else_to_do(bus: Bus, buffer: Buffer) -> None:
    with anyio.fail_after(PATIENCE), bus.threadsafe() as publish:
        async with anyio.create_task_group() as tasks:
            asked = Asked(tasks, partial(buffer.lookup, "map", "a", 5))
            await settle()
            assert in_thread(lambda: publish([moving("map", "a", 4, 4.0), moving("map", "a", 6, 6.0)])) == []
        assert asked.answer.transform.translation == (5.0, 0.0, 0.0)


async def test_a_broadcaster_sends_from_a_thread_as_on_the_loop(bus: Bus, buffer: Buffer) -> None:
    got: list[TransformStamped] = []
    bus.subscribe(got.extend)
    with bus.threadsafe() as publish:
        driver = TransformBroadcaster(publish, "driver", prefix="r1/", shared={"map"})

        def drive() -> None:
            driver.send("map", "base", Transform((1.0, 0.0, 0.0)), at=5)
            driver.send_static("base", "laser", Transform())
            driver.send_all([("base", "arm", Transform()), ("base", "head", Transform())], at=6)
            driver.send_columns("map", "cart", [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [[0.0, 0.0, 0.0, 1.0]] * 2, [5, 6])
            # Only the bus knows that this one closes a loop.
            driver.send("laser", "map", Transform(), at=5)

        assert in_thread(drive) == []
        with anyio.fail_after(PATIENCE):
            await buffer.lookup("map", "r1/cart", 6)
        assert driver.bus is bus
    assert [(sample.child, sample.authority) for sample in got] == [
        (f"r1/{child}", "driver") for child in ("base", "laser", "arm", "head", "cart", "cart")
    ]
    assert bus.statistics().rejected == {"cycle": 1}
    wrong = in_thread(lambda: driver.send_columns("map", "cart", [[math.nan] * 3], [[0.0, 0.0, 0.0, 1.0]], 5))
    assert [type(error) for error in wrong] == [InvalidTransformError]


async def test_the_samples_of_each_thread_arrive_in_order_and_without_loss(bus: Bus) -> None:
    seen: dict[str, list[int]] = {"a": [], "b": [], "c": [], "d": []}
    everything = anyio.Event()

    def note(batch: tuple[TransformStamped, ...]) -> None:
        for sample in batch:
            seen[sample.child].append(sample.stamp)
        if sum(map(len, seen.values())) == 8_000:
            everything.set()

    def produce(child: str) -> None:
        for stamp in range(2_000):
            publish(moving("map", child, stamp))

    produce_all = [partial(produce, child) for child in seen]
    with anyio.fail_after(PATIENCE), bus.subscribe(note), bus.threadsafe() as publish, threads_running(*produce_all):
        # No more samples come that could wake the loop for one that it has overlooked.
        await everything.wait()
    assert all(stamps == list(range(2_000)) for stamps in seen.values())
    assert bus.statistics().samples == 8_000


async def test_samples_beyond_the_capacity_while_the_loop_is_blocked_are_dropped_and_counted(bus: Bus) -> None:
    got: list[int] = []

    def produce() -> None:
        for stamp in range(25):
            publish(moving("map", "a", stamp))

    with bus.subscribe(lambda batch: got.extend(s.stamp for s in batch)), bus.threadsafe(capacity=10) as publish:
        assert in_thread(produce) == []
        (queue,) = bus.statistics().queues
        assert (queue.kind, queue.pending, queue.dropped) == ("threadsafe", 10, 15)
        await settle()
        assert got == list(range(15, 25))


async def test_the_end_of_the_with_publishes_the_queued_samples(bus: Bus, buffer: Buffer) -> None:
    with bus.threadsafe() as publish:
        in_thread(lambda: publish(moving("map", "a", 1)))
        assert not buffer.can_transform("map", "a", 1)
    assert buffer.can_transform("map", "a", 1)
    assert bus.statistics().queues == ()


async def test_publishing_outside_of_the_with_raises_in_the_thread(bus: Bus) -> None:
    publish = bus.threadsafe()
    (early,) = in_thread(lambda: publish(moving("map", "a", 1)))
    assert isinstance(early, RuntimeError)
    assert "with" in str(early)
    with publish:
        pass
    (late,) = in_thread(lambda: publish(moving("map", "a", 1)))
    assert isinstance(late, BusClosedError)
    assert bus.statistics().samples == 0


def test_publishing_after_the_end_of_the_loop_raises(bus: Bus, run: Run) -> None:
    publishers: list[ThreadPublisher] = []

    async def leave_without_a_word() -> None:
        publishers.append(bus.threadsafe().__enter__())

    with pytest.raises(RuntimeError), bus.threadsafe():
        pytest.fail("there is no event loop yet")
    run(leave_without_a_word)
    for _ in range(2):
        (error,) = in_thread(lambda: publishers[0](moving("map", "a", 1)))
        assert isinstance(error, BusClosedError)
        assert len(publishers[0].queue) == 1, "after the first error it takes no more"


async def test_samples_that_close_a_loop_are_dropped_and_counted_on_the_bus(bus: Bus, buffer: Buffer) -> None:
    with bus.threadsafe() as publish:
        assert in_thread(lambda: publish(moving("map", "a", 1))) == []
        assert in_thread(lambda: publish([moving("a", "map", 1), moving("map", "b", 1)])) == []
        await settle()
    assert bus.statistics().rejected == {"cycle": 1}
    assert buffer.can_transform("a", "b", 1)


async def test_samples_queued_before_a_jump_back_are_discarded_and_statics_stay() -> None:
    clock = SimulatedClock(start=100)
    bus = Bus(clock)
    got: list[TransformStamped] = []
    with bus.subscribe(got.extend), bus.threadsafe() as publish:
        in_thread(lambda: publish([moving("map", "a", 100), static("map", "s")]))
        clock.set(50)
        in_thread(lambda: publish(moving("map", "a", 50)))
        await settle()
        assert got == [static("map", "s"), moving("map", "a", 50)]
        assert [queue.dropped for queue in bus.statistics().queues] == [1]


async def test_queued_samples_of_a_removed_frame_are_discarded(bus: Bus, buffer: Buffer) -> None:
    bus.publish(moving("map", "a", 1))
    with bus.threadsafe() as publish:
        in_thread(lambda: publish([moving("map", "a", 2), moving("map", "b", 2)]))
        bus.remove_frame("a")
    assert buffer.tree.frames() == ["b", "map"]


USES: list[Callable[[Bus, Buffer], object]] = [
    lambda bus, _: bus.publish(moving("map", "a", 1)),
    lambda bus, _: bus.threadsafe().__enter__(),
]


@pytest.mark.parametrize("use", USES, ids=["publish", "threadsafe"])
def test_a_bus_made_before_a_loop_belongs_to_the_thread_of_its_first_loop(
    bus: Bus, buffer: Buffer, run: Run, use: Callable[[Bus, Buffer], object]
) -> None:
    async def take_over() -> None:
        use(bus, buffer)

    assert in_thread(lambda: run(take_over)) == []
    with pytest.raises(RuntimeError, match=r"bus\.threadsafe"):
        bus.publish(moving("map", "a", 2))


async def test_a_bus_made_on_a_loop_belongs_to_the_thread_of_that_loop() -> None:
    bus = Bus()

    async def intrude() -> None:
        bus.publish(moving("map", "a", 1))

    (error,) = in_thread(lambda: anyio.run(intrude))
    assert isinstance(error, RuntimeError)
    bus.publish(moving("map", "a", 2))
    assert bus.statistics().samples == 1


@pytest.mark.parametrize("names", [{}, {"prefix": "robot/", "shared": {"map"}}], ids=["whole names", "prefix"])
async def test_threads_may_call_every_reading_method_while_lookups_wait_and_wake(names: Any) -> None:
    bus = Bus(SimulatedClock())
    buffer = Buffer(bus, keep=1e-6, **names)
    frame = names.get("prefix", "") + "a"
    bus.publish(moving("map", frame, 0))

    def ask() -> None:
        seen = buffer.lookup_nowait("map", "a", max_age=1.0)
        moved = buffer.transform_nowait(PointStamped("a", LATEST, (0.0, 0.0, 0.0)), "map")
        calls = buffer.explain("map", "a")
        assert seen.transform.translation[0] == seen.stamp
        assert moved.point[0] == moved.stamp
        assert calls.answerable
        assert buffer.can_transform("map", "a", tolerance=0.1)
        assert not buffer.can_transform("map", "b")
        waiting = buffer.pending()
        assert {pending.question.source for pending in waiting} <= {"a"}
        assert "a" in buffer.describe()

    with threads_that(ask):
        for stamp in range(1, 100):
            async with anyio.create_task_group() as tasks:
                for _ in range(3):
                    tasks.start_soon(buffer.lookup, "map", "a", stamp)
                await settle()
                bus.publish([moving("map", frame, stamp, float(stamp)), moving("map", f"other{stamp % 7}", stamp)])


@pytest.mark.parametrize("closes", ["buffer", "bus"])
async def test_closing_from_another_thread_is_an_error_while_an_on_close_callback_is_registered(closes: str) -> None:
    bus = Bus()
    buffer = Buffer(bus)
    calls: list[str] = []
    registration = buffer.on_close(lambda: calls.append("closed"))
    (error,) = in_thread(buffer.close if closes == "buffer" else bus.close)
    assert isinstance(error, RuntimeError)
    assert calls == []
    bus.publish(moving("map", "a", 1))
    assert buffer.can_transform("map", "a", 1)
    registration.close()
    assert in_thread(buffer.close if closes == "buffer" else bus.close) == []
    assert calls == []


async def test_a_thread_hears_of_a_wrong_type_or_length_and_a_stamp_ahead_is_counted() -> None:
    bus = Bus(SimulatedClock(1), max_translation=10.0, reject_ahead=True)
    with bus.threadsafe() as publish:

        def drive() -> None:
            publish(moving("a", "b", 1, 10.0))
            with pytest.raises(InvalidTransformError, match="not physical"):
                publish([moving("a", "b", 2), moving("a", "b", 3, 11.0)])
            with pytest.raises(TypeError):
                publish([moving("a", "b", 2), "b"])  # type: ignore[list-item]
            publish(moving("a", "b", 3_600_000_000_000))

        await anyio.to_thread.run_sync(drive)
    assert (bus.statistics().samples, bus.statistics().rejected) == (1, {"ahead": 1})


def test_a_loop_in_the_thread_that_made_the_bus_leaves_it_to_no_other_loop(bus: Bus, run: Run) -> None:
    async def use() -> None:
        bus.events().close()

    run(use)
    assert [type(error) for error in in_thread(lambda: run(use))] == [RuntimeError]
    bus.events().close()


async def test_a_closed_bus_takes_no_sample_of_a_thread_be_it_queued_or_new(bus: Bus) -> None:
    with bus.threadsafe() as publish:
        in_thread(lambda: publish(moving("map", "a", 1)))
        bus.close()
        (error,) = in_thread(lambda: publish(moving("map", "a", 2)))
        assert isinstance(error, BusClosedError)
        await settle()
    assert bus.statistics().samples == 0
    with pytest.raises(BusClosedError):
        bus.threadsafe()


def test_publishing_raises_once_the_loop_has_been_closed_without_an_answer_to_the_last_sample(bus: Bus) -> None:
    loop = asyncio.new_event_loop()

    async def enter() -> ThreadPublisher:
        return bus.threadsafe().__enter__()

    publish = loop.run_until_complete(enter())
    publish(moving("map", "a", 1))
    loop.close()
    for stamp in (2, 3):
        with pytest.raises(BusClosedError):
            publish(moving("map", "a", stamp))
