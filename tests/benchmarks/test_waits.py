"""The cost of waiting from the question to the answer, beside events and checkpoints of the same run.

A task asks, is parked, is woken by a publish, and takes the answer; then it asks again. The turns of the loop and the
publisher's checkpoints count on both sides. Times are of the processor.
"""

from collections.abc import AsyncIterator, Awaitable, Callable
from itertools import pairwise
from time import thread_time
from typing import Any

import anyio
import anyio.lowlevel
import cases
import pytest
from beside import Table, Turn, name_of, other_kernel, samples_of, show, take_turns
from cases import BASE, START

import tfbus

pytest_plugins = ["side_by_side"]

CYCLES = 200
ANSWERED = 500
MESSAGES = 200
PUBLISHED = 2_000
ROUNDS = 9

Backend = tuple[str, dict[str, Any]]
Run = Callable[[Callable[[], Awaitable[None]]], None]
AsyncTurn = Callable[[], Awaitable[float]]


def on_each_kernel(side: Callable[[Any], Any]) -> dict[str, Any]:
    """A side on the kernel of this process, and on the other one, by the ends of their labels."""
    return {"": side(tfbus)} | {f" ({name})": side(package) for name, package in other_kernel().items()}


async def take_async_turns(sides: dict[str, AsyncTurn]) -> dict[str, list[float]]:
    rounds: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(ROUNDS):
        for name, side in sides.items():
            rounds[name].append(await side())
    return rounds


async def cycle(wait: Callable[[int], Awaitable[object]], wake: Callable[[int], object]) -> float:
    """Seconds for each time that a task waits and is woken; `wait` and `wake` get the number of this time."""

    async def task() -> None:
        for number in range(CYCLES):
            await wait(number)

    checkpoint = anyio.lowlevel.checkpoint
    async with anyio.create_task_group() as group:
        group.start_soon(task)
        await checkpoint()
        start = thread_time()
        for number in range(CYCLES):
            # Woken, then at the checkpoint of the next question, then parked.
            await checkpoint()
            await checkpoint()
            await checkpoint()
            wake(number)
    return (thread_time() - start) / CYCLES


def lookup_cycle(package: Any, edges: int, timeout: float | None) -> AsyncTurn:
    """The deepest of the edges lags, the others have all samples."""

    async def turn() -> float:
        bus = package.Bus(max_behind=None)
        buffer = package.Buffer(bus)
        frames = [BASE, *(f"f{i}" for i in range(edges))]
        for parent, child in pairwise(frames[:-1]):
            bus.publish(samples_of(package, child, CYCLES + 1, parent=parent))
        lagging = samples_of(package, frames[-1], CYCLES + 1, parent=frames[-2])
        bus.publish(lagging[0])
        stamps = [sample.stamp for sample in lagging[1:]]
        lookup, source = buffer.lookup, frames[-1]
        return await cycle(
            lambda place: lookup(BASE, source, stamps[place], timeout=timeout),
            lambda place: bus.publish(lagging[place + 1]),
        )

    return turn


async def event_cycle() -> float:
    events = [anyio.Event() for _ in range(CYCLES)]
    return await cycle(lambda place: events[place].wait(), lambda place: events[place].set())


@pytest.mark.every_loop
@pytest.mark.parametrize(("edges", "timeout"), [(1, None), (3, None), (1, 60.0)])
def test_whole_cycle(table: Table, run: Run, anyio_backend: Backend, edges: int, timeout: float | None) -> None:
    async def measure() -> None:
        sides = on_each_kernel(lambda package: lookup_cycle(package, edges, timeout))
        rounds = await take_async_turns({**sides, "Event": event_cycle})
        peer = rounds.pop("Event")
        how = "with a timeout" if timeout else f"{edges} edge{'s' * (edges > 1)}"
        for kernel, ours in rounds.items():
            label = f"ask, wait, wake, {how}, {name_of(anyio_backend)}{kernel}"
            table.compare(label, ours, "Event", peer, "" if kernel else "<= 1.25")

    run(measure)


@pytest.mark.every_loop
def test_awaited_lookup_that_can_be_answered(table: Table, run: Run, anyio_backend: Backend) -> None:
    def answered(package: Any) -> AsyncTurn:
        bus = package.Bus(max_behind=None)
        buffer = package.Buffer(bus)
        bus.publish(samples_of(package, "a", 100))
        stamp = START + 50 * cases.PERIOD + 1

        async def turn() -> float:
            lookup = buffer.lookup
            start = thread_time()
            for _ in range(ANSWERED):
                await lookup(BASE, "a", stamp)
            return (thread_time() - start) / ANSWERED

        return turn

    async def checkpoints() -> float:
        checkpoint = anyio.lowlevel.checkpoint
        start = thread_time()
        for _ in range(ANSWERED):
            await checkpoint()
        return (thread_time() - start) / ANSWERED

    async def measure() -> None:
        rounds = await take_async_turns({**on_each_kernel(answered), "checkpoint": checkpoints})
        peer = rounds.pop("checkpoint")
        for kernel, ours in rounds.items():
            label = f"await an answer, {name_of(anyio_backend)}{kernel}"
            table.compare(label, ours, "checkpoint", peer, "" if kernel else "<= 1.0")

    run(measure)


@pytest.mark.parametrize("must_wait", [False, True])
def test_message_filter(table: Table, must_wait: bool) -> None:
    def filtered(package: Any) -> AsyncTurn:
        async def turn() -> float:
            bus = package.Bus(max_behind=None)
            buffer = package.Buffer(bus)
            samples = samples_of(package, "a", MESSAGES + 1)
            bus.publish(samples[: 1 if must_wait else None])
            messages = [package.PointStamped("a", sample.stamp, (0.0, 0.0, 0.0)) for sample in samples[1:]]

            async def source() -> AsyncIterator[Any]:
                for message in messages:
                    yield message

            start = thread_time()
            async with package.MessageFilter(source(), buffer, target=BASE, capacity=MESSAGES) as pairs:
                if must_wait:
                    while pairs.pending < MESSAGES:
                        await anyio.lowlevel.checkpoint()
                    await anyio.lowlevel.checkpoint()
                    await anyio.lowlevel.checkpoint()
                    for sample in samples[1:]:
                        bus.publish(sample)
                count = 0
                async for _ in pairs:
                    count += 1
            assert count == MESSAGES
            return (thread_time() - start) / MESSAGES

        return turn

    async def measure() -> None:
        for kernel, ours in (await take_async_turns(on_each_kernel(filtered))).items():
            how = "must wait" if must_wait else "can be answered"
            table.add(f"a message that {how}{kernel}", show(ours, "us"), wanted=["<= 8 us", "<= 20 us"][must_wait])

    anyio.run(measure)


@pytest.mark.parametrize("to", ["nobody", "a subscriber", "a stream", "events"])
def test_publishing_to(table: Table, to: str) -> None:
    def published(package: Any) -> Turn:
        def turn() -> float:
            bus = package.Bus(max_behind=None)
            package.Buffer(bus)
            samples = samples_of(package, "a", PUBLISHED + 1)
            bus.publish(samples[0])
            if to == "a subscriber":
                bus.subscribe(id)
            elif to == "a stream":
                bus.stream()
            elif to == "events":
                bus.events()
            publish = bus.publish
            start = thread_time()
            for sample in samples:
                publish(sample)
            return (thread_time() - start) / PUBLISHED

        return turn

    sides = on_each_kernel(published)
    for kernel, ours in zip(sides, take_turns(*sides.values(), rounds=ROUNDS), strict=True):
        table.add(
            f"publish 1 to {to}{kernel}", show(ours, "us"), wanted="" if kernel or to == "nobody" else "<= 0.35 us"
        )
