"""The lag of the event loop while a busy bus is recorded, with and without in turns."""

from collections.abc import Awaitable, Callable
from pathlib import Path
from statistics import median
from typing import Any

import anyio
import pytest
from beside import Table
from lag import probe

from tfbus import Bus, RecorderStatistics, Transform, TransformBroadcaster
from tfbus.recording import Recorder

pytest_plugins = ["side_by_side"]

Run = Callable[[Callable[[], Awaitable[None]]], None]

BROADCASTERS = 10
FRAMES = 10
RATE = 100.0
TURNS = 11
SECONDS = 1.5


async def broadcast(bus: Bus, number: int, count: list[int]) -> None:
    """A tenth of 10,000 samples a second, each in a batch of its own."""
    broadcaster = TransformBroadcaster(bus, authority=f"broadcaster {number}")
    await bus.clock.sleep(number / BROADCASTERS / RATE)
    async for tick in bus.clock.ticks(RATE):
        for frame in range(FRAMES):
            broadcaster.send("base", f"f{number}_{frame}", Transform((tick / 7, frame / 7, number / 7)))
        count[0] += FRAMES


def percentile(lags: list[float], part: float) -> float:
    return sorted(lags)[int(part * len(lags))] * 1e3


@pytest.mark.every_loop
def test_lag_while_recording(table: Table, run: Run, tmp_path: Path, anyio_backend: tuple[str, dict[str, Any]]) -> None:
    sent = [0]
    lags: dict[bool, list[list[float]]] = {False: [], True: []}
    statistics: list[RecorderStatistics] = []

    async def measure(recording: bool) -> None:
        found: list[float] = []
        lags[recording].append(found)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(probe, found)
            await anyio.sleep(SECONDS)
            tasks.cancel_scope.cancel()

    async def load() -> None:
        with Bus() as bus:
            async with anyio.create_task_group() as tasks:
                for number in range(BROADCASTERS):
                    tasks.start_soon(broadcast, bus, number, sent)
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
    name = "uvloop" if anyio_backend[1] else anyio_backend[0]
    for part, wanted in ((0.5, ""), (0.99, "<= 2 ms more"), (0.999, "")):
        without, recorded = ([percentile(turn, part) for turn in lags[kind]] for kind in (False, True))
        more = [mine - other for mine, other in zip(recorded, without, strict=True)]
        shown = f"+{median(more):.2f} ({min(more):.2f} to {max(more):.2f})"
        label = f"lag while recording, {name}, p{part * 100:g}"
        table.add(label, f"{median(recorded):.2f} ms", f"without {median(without):.2f} ms", shown, wanted)
    rate = sum(each.samples for each in statistics) / TURNS / SECONDS
    table.add(f"recorded, {name}", f"{rate:.0f} samples/s", f"of {sent[0] / (2 * TURNS * SECONDS):.0f}/s sent")
