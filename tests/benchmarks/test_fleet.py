"""The cost of thousands of static frames, of remote lookups and, over zenoh, of a fleet of robots."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from statistics import median
from typing import Any

import anyio
import anyio.lowlevel
import pytest
from beside import Table
from support.peer_process import link_of
from support.processes import Place, free_address, new_domain
from support.samples import static

from tfbus import Bus
from tfbus.links.zenoh import ZenohLink

pytest_plugins = ["side_by_side"]

ASKED = 1_000
FRAMES, RATE, SECONDS = 50, 20.0, 10.0
MANY = 100

# A process that joins late, and tells the seconds until its bus has so many frames.
LATE = """
async def main(options, frames):
    with Bus() as bus:
        began = time.perf_counter()
        async with link_of(bus, options):
            while bus.statistics().frames < frames:
                await anyio.sleep(0.005)
            print(time.perf_counter() - began)
"""

# A robot's own buffer.
SERVER = """
async def main(options):
    with Bus() as bus, Buffer(bus, keep=None) as buffer:
        bus.publish([static("base", "lidar", x=2.0), moving("map", "base", 5, x=1.0), moving("map", "base", 9, x=5.0)])
        async with link_of(bus, options) as link, BufferServer(buffer, link):
            print("ready", flush=True)
            await anyio.to_thread.run_sync(sys.stdin.read)
"""

# A router that tells its CPU time for each line of input.
ROUTER = """
async def main(address):
    async with ZenohRouter(address):
        print("ready", flush=True)
        async for _ in anyio.wrap_file(sys.stdin):
            print(time.process_time(), flush=True)
"""

# Many robots; the first publishes, the others are only there.
ROBOTS = """
async def main(domain, address, robots, frames, rate):
    async with AsyncExitStack() as stack:
        buses = [stack.enter_context(Bus()) for _ in range(robots)]
        for number, bus in enumerate(buses):
            link = ZenohLink(bus, domain, robot=f"r{number}", robots=[], connect=address)
            await stack.enter_async_context(link)
        print("ready", flush=True)
        async for _ in buses[0].clock.ticks(rate):
            buses[0].publish([moving("map", f"f{frame}", buses[0].clock.now()) for frame in range(frames)])
"""

HEADER = """
import json, sys, time
from contextlib import AsyncExitStack
import anyio, anyio.to_thread
from support.peer_process import link_of
from support.samples import moving, static
from tfbus import Buffer, Bus
from tfbus.links import BufferServer
from tfbus.links.zenoh import ZenohLink, ZenohRouter
"""


def command(program: str, *arguments: Any) -> list[str]:
    paths = f"import sys; sys.path[:0] = {sys.path!r}\n"
    return [sys.executable, "-P", "-c", f"{paths}{HEADER}{program}\nanyio.run(main, *{arguments!r})"]


@contextmanager
def running(program: str, *arguments: Any) -> Iterator[Callable[[object, bool], str]]:
    """A process that is ready, and is killed at the end: writes it a line, and reads the answer if it is awaited."""
    pipe = subprocess.PIPE
    with subprocess.Popen(command(program, *arguments), stdin=pipe, stdout=pipe, text=True) as process:
        to, of = process.stdin, process.stdout
        assert to is not None
        assert of is not None

        def tell(line: object, answered: bool) -> str:
            print(line, file=to, flush=True)
            return of.readline() if answered else ""

        try:
            assert of.readline() == "ready\n"
            yield tell
        finally:
            process.kill()


@pytest.mark.parametrize(("frames", "wanted"), [(10_000, "<= 0.3 s"), (50_000, "<= 1.3 s")])
def test_statics(frames: int, wanted: str, table: Table, place: Place) -> None:
    batches = [[static("map", f"f{group} {frame}") for frame in range(1_000)] for group in range(frames // 1_000)]

    async def main() -> tuple[float, list[float]]:
        with Bus() as bus:
            async with link_of(bus, place.first(max_frames=frames)):
                before = time.process_time()
                for batch in batches:
                    bus.publish(batch)
                joiner = command(LATE, place.other(max_frames=frames), frames)
                late = [float((await anyio.run_process(joiner)).stdout) for _ in range(5)]
                return time.process_time() - before, late

    spent, late = anyio.run(main)
    times = f"at a late joiner in {median(late):.2f} s, {max(late):.2f}"
    table.add(f"{place.carrier}: {frames} statics to 5 late joiners", f"{spent:.2f} s CPU", times, "", wanted)


def test_remote_lookup(table: Table, place: Place) -> None:
    times: list[float] = []

    async def main() -> None:
        async with link_of(Bus(), place.other(robots={"*": 0.0})) as client:
            await client.lookup("map", "lidar", timeout=10)
            for _ in range(ASKED):
                began = time.perf_counter()
                await client.lookup("map", "lidar", 7)
                times.append(time.perf_counter() - began)

    with running(SERVER, place.first()):
        anyio.run(main)
    table.add(f"{place.carrier}: remote lookup, p50", f"{median(times) * 1e3:.2f} ms", wanted="<= 0.25 ms")


def test_one_robot_of_many(table: Table) -> None:
    """A subscription costs, and not what exists: user and system time with it less that without."""

    def measure(robots: int) -> list[float]:
        domain, address = new_domain(), free_address()

        async def look(heard: list[str]) -> list[float]:
            with Bus() as bus:
                async with ZenohLink(bus, domain, robots=heard, connect=address):
                    await anyio.sleep(2.0)
                    before = [time.process_time(), float(router("", True))]
                    await anyio.sleep(SECONDS)
                    after = [time.process_time(), float(router("", True))]
                    return [end - start for start, end in zip(before, after, strict=True)]

        with running(ROUTER, address) as router, running(ROBOTS, domain, address, robots, FRAMES, RATE):
            nobody, one = anyio.run(look, []), anyio.run(look, ["r0"])
        return [(more - less) / SECONDS for more, less in zip(one, nobody, strict=True)]

    few, many = measure(5), measure(MANY)
    for name, cost, least in zip(("subscriber", "router"), many, few, strict=True):
        label = f"one robot of {MANY}, the {name}"
        table.add(label, f"{cost:.3f} cores", f"of 5: {least:.3f}", f"{cost / least:.2f}", "<= 1.2")
