"""The lag of the event loop: under the tasks of a whole robot, and while a busy bus is recorded, with and without."""

import math
import random
from collections.abc import Awaitable, Callable
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import anyio
import pytest
from beside import Table, name_of

from tfbus import SECOND, Buffer, Bus, RecorderStatistics, Transform, TransformBroadcaster
from tfbus.recording import Recorder

pytest_plugins = ["side_by_side"]

pytestmark = pytest.mark.every_loop

Run = Callable[[Callable[[], Awaitable[None]]], None]
Backend = tuple[str, dict[str, Any]]

PROBE = 0.001
BUFFERS = 20
FRAMES = 100
BROADCASTERS = 10
WAITERS = 1_000
AHEAD = SECOND
WATCHERS = 50
WARM_UP, SECONDS = 1.0, 8.0
TURNS, SECONDS_A_TURN = 11, 1.5


async def probe(lags: list[float], seconds: float) -> None:
    """Note for a while how many seconds too late a task that sleeps is woken."""
    end = perf_counter() + seconds
    while (due := perf_counter() + PROBE) < end:
        await anyio.sleep(PROBE)
        lags.append(perf_counter() - due)


def percentile(lags: list[float], part: float) -> float:
    """In ms."""
    return sorted(lags)[int(part * len(lags))] * 1e3


async def broadcast(bus: Bus, number: int, rate: float, at_once: bool, count: list[int]) -> None:
    """A tenth of all frames, each broadcaster at a time of its own; half of them hang on the other half."""
    broadcaster = TransformBroadcaster(bus, authority=f"broadcaster {number}")
    await bus.clock.sleep(number / BROADCASTERS / rate)
    async for _ in bus.clock.ticks(rate):
        angle = bus.clock.now() / SECOND % math.tau
        transform = Transform.from_axis_angle((0.0, 0.0, 1.0), angle, (math.cos(angle), math.sin(angle), 0.0))
        frames = range(number, FRAMES, BROADCASTERS)
        batch = [("base" if i < FRAMES // 2 else f"f{i - 50}", f"f{i}", transform) for i in frames]
        if at_once:
            broadcaster.send_all(batch)
        else:
            for sample in batch:
                broadcaster.send(*sample)
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


def test_lag_under_load(table: Table, run: Run, anyio_backend: Backend) -> None:
    sent, answered, seen = [0], [0], [0]
    lags: list[float] = []

    async def load() -> None:
        rng = random.Random(1)
        with Bus() as bus:
            buffers = [Buffer(bus) for _ in range(BUFFERS)]
            async with anyio.create_task_group() as tasks:
                for number in range(BROADCASTERS):
                    tasks.start_soon(broadcast, bus, number, 50.0, True, sent)
                # Not before there is something to ask for: a stamp older than all data would fail.
                await anyio.sleep(0.2)
                for number in range(WAITERS):
                    tasks.start_soon(wait, buffers[number % BUFFERS], rng, answered)
                for number in range(WATCHERS):
                    tasks.start_soon(watch, buffers[number % BUFFERS], number, seen)
                await anyio.sleep(WARM_UP)
                sent[0] = answered[0] = seen[0] = 0
                await probe(lags, SECONDS)
                tasks.cancel_scope.cancel()
            assert not any(buffer.pending() for buffer in buffers)

    run(load)
    worst = [f"{percentile(lags, part):.1f}" for part in (0.5, 0.99, 0.999)]
    counters = ((sent, "sent"), (answered, "answered"), (seen, "seen"))
    rates = ", ".join(f"{counter[0] / SECONDS:.0f}/s {what}" for counter, what in counters)
    label = f"lag under load, {name_of(anyio_backend)}, p50 / p99 / p99.9"
    table.add(label, " / ".join(worst) + " ms", rates, "", "p99 <= 10 ms")


def test_lag_while_recording(table: Table, run: Run, tmp_path: Path, anyio_backend: Backend) -> None:
    """Of 10,000 samples a second, each in a batch of its own."""
    sent = [0]
    lags: dict[bool, list[list[float]]] = {False: [], True: []}
    statistics: list[RecorderStatistics] = []

    async def measure(recording: bool) -> None:
        lags[recording].append([])
        await probe(lags[recording][-1], SECONDS_A_TURN)

    async def load() -> None:
        with Bus() as bus:
            async with anyio.create_task_group() as tasks:
                for number in range(BROADCASTERS):
                    tasks.start_soon(broadcast, bus, number, 100.0, False, sent)
                await anyio.sleep(0.5)
                sent[0] = 0
                for turn in range(TURNS):
                    await measure(recording=False)
                    async with Recorder(bus, tmp_path / f"{turn}.mcap") as recorder:
                        await measure(recording=True)
                    statistics.append(recorder.statistics())
                tasks.cancel_scope.cancel()

    run(load)
    assert all(each.queue.dropped == 0 for each in statistics)
    name = name_of(anyio_backend)
    for part, wanted in ((0.5, ""), (0.99, "<= 2 ms more"), (0.999, "")):
        without, recorded = ([percentile(turn, part) for turn in lags[kind]] for kind in (False, True))
        more = [mine - other for mine, other in zip(recorded, without, strict=True)]
        shown = f"+{median(more):.2f} ({min(more):.2f} to {max(more):.2f})"
        label = f"lag while recording, {name}, p{part * 100:g}"
        table.add(label, f"{median(recorded):.2f} ms", f"without {median(without):.2f} ms", shown, wanted)
    seconds = TURNS * SECONDS_A_TURN
    rate = sum(each.samples for each in statistics) / seconds
    table.add(f"recorded, {name}", f"{rate:.0f} samples/s", f"of {sent[0] / (2 * seconds):.0f}/s sent")
