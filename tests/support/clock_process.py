"""A process whose bus has a clock that is off, and publishes a frame that goes along x with 1 m/s of the true time.

Its only argument is JSON: ``{"links": [{"domain": .., ..}, ..], "ahead": .., "drift": .., "frame": ..}``, with the
arguments of each `ZenohLink`. A line on its input is a number of s by which its clock is set. It ends with its input.
"""

import json
import sys
import time
from contextlib import AsyncExitStack

import anyio
import anyio.to_thread

from tfbus import Bus, SystemClock, Transform, TransformBroadcaster
from tfbus.links.zenoh import ZenohLink


class OffClock(SystemClock):
    def __init__(self, ahead: float, drift: float) -> None:
        self.ahead = round(ahead * 1e9)
        self.drift = drift
        self.began = time.monotonic_ns()

    def now(self) -> int:
        return time.time_ns() + self.ahead + round(self.drift * (time.monotonic_ns() - self.began))


async def main(links: list[dict[str, str]], ahead: float, drift: float, frame: str) -> None:
    clock = OffClock(ahead, drift)
    bus = Bus(clock)
    broadcaster = TransformBroadcaster(bus, frame)

    async def read() -> None:
        while line := await anyio.to_thread.run_sync(sys.stdin.readline, abandon_on_cancel=True):
            clock.ahead += round(float(line) * 1e9)
        tasks.cancel_scope.cancel()

    async with anyio.create_task_group() as tasks, AsyncExitStack() as stack:
        for link in links:
            await stack.enter_async_context(ZenohLink(bus, **link))  # type: ignore[arg-type]
        tasks.start_soon(read)
        async for _ in clock.ticks(100.0):
            at, true = clock.now(), time.time_ns()
            # The two readings are some hundred ns apart, unless the process was interrupted between them.
            if time.time_ns() - true < 100_000:
                broadcaster.send("map", frame, Transform((true % 10**12 / 1e9, 0.0, 0.0)), at=at)


anyio.run(lambda: main(**json.loads(sys.argv[1])))
