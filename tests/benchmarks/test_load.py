"""The lag of the event loop while the tasks of a whole robot run on it."""

import math
import random
from collections.abc import Awaitable, Callable
from typing import Any

import anyio
import pytest
from beside import Table
from lag import probe

from tfbus import SECOND, Buffer, Bus, Transform, TransformBroadcaster

pytest_plugins = ["side_by_side"]

Run = Callable[[Callable[[], Awaitable[None]]], None]

BUFFERS = 20
FRAMES = 100
BROADCASTERS = 10
RATE = 50.0
WAITERS = 1_000
AHEAD = SECOND
WATCHERS = 50
WARM_UP = 1.0
SECONDS = 8.0


async def broadcast(bus: Bus, number: int, count: list[int]) -> None:
    """A tenth of all frames at 50 Hz, each broadcaster at a time of its own; half of them hang on the other half."""
    broadcaster = TransformBroadcaster(bus, authority=f"broadcaster {number}")
    await bus.clock.sleep(number / BROADCASTERS / RATE)
    async for _ in bus.clock.ticks(RATE):
        angle = bus.clock.now() / SECOND % math.tau
        transform = Transform.from_axis_angle((0.0, 0.0, 1.0), angle, (math.cos(angle), math.sin(angle), 0.0))
        frames = range(number, FRAMES, BROADCASTERS)
        broadcaster.send_all([("base" if i < FRAMES // 2 else f"f{i - 50}", f"f{i}", transform) for i in frames])
        count[0] += len(frames)


async def wait(buffer: Buffer, rng: random.Random, count: list[int]) -> None:
    """Ask again and again for a stamp up to `AHEAD` from now."""
    while True:
        at = buffer.bus.clock.now() + rng.randrange(AHEAD)
        await buffer.lookup("base", f"f{rng.randrange(FRAMES)}", at, timeout=5.0)
        count[0] += 1


async def watch(buffer: Buffer, number: int, count: list[int]) -> None:
    with buffer.watch("base", f"f{number * 2}", max_rate=10.0) as changes:
        async for _ in changes:
            count[0] += 1


@pytest.mark.every_loop
def test_lag_under_load(table: Table, run: Run, anyio_backend: tuple[str, dict[str, Any]]) -> None:
    sent, answered, seen = [0], [0], [0]
    lags: list[float] = []

    async def load() -> None:
        rng = random.Random(1)
        with Bus() as bus:
            buffers = [Buffer(bus) for _ in range(BUFFERS)]
            async with anyio.create_task_group() as tasks:
                for number in range(BROADCASTERS):
                    tasks.start_soon(broadcast, bus, number, sent)
                # Not before there is something to ask for: what is older than all data would fail.
                await anyio.sleep(0.2)
                for number in range(WAITERS):
                    tasks.start_soon(wait, buffers[number % BUFFERS], rng, answered)
                for number in range(WATCHERS):
                    tasks.start_soon(watch, buffers[number % BUFFERS], number, seen)
                tasks.start_soon(probe, lags)
                await anyio.sleep(WARM_UP)
                for counter in (lags, sent, answered, seen):
                    counter[:] = [] if counter is lags else [0]
                await anyio.sleep(SECONDS)
                tasks.cancel_scope.cancel()
            assert not any(buffer.pending() for buffer in buffers)

    run(load)
    lags.sort()
    worst = [f"{lags[int(part * len(lags))] * 1e3:.1f}" for part in (0.5, 0.99, 0.999)]
    name = "uvloop" if anyio_backend[1] else anyio_backend[0]
    rates = ", ".join(
        f"{counter[0] / SECONDS:.0f}/s {what}"
        for counter, what in ((sent, "sent"), (answered, "answered"), (seen, "seen"))
    )
    table.add(f"lag under load, {name}, p50 / p99 / p99.9", " / ".join(worst) + " ms", rates, "", "p99 <= 10 ms")
