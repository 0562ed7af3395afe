"""Delay, throughput, memory and cost of a link between processes, over either carrier."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from statistics import median
from typing import Any

import anyio
import pytest
from beside import Table
from start_together import measure
from support.peer_process import as_sample, link_of
from support.processes import Crowd, PeerProcess, Place, crowd, until

from tfbus import Bus

pytest_plugins = ["side_by_side"]

BACKENDS = pytest.mark.parametrize("backend", ["asyncio", "asyncio+uvloop", "trio"])
SECONDS = 2.0
PATHS = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
SETTLE, RESTED = 5.0, 10.0
MESSAGES = 300
STATICS = [f"fixed {number}" for number in range(50)]

# A process with a bus, a buffer and a link: its memory in MB before and with a link, its threads, the seconds until the
# link has met another, and the kB that are left when one is opened and closed.
PROCESS = """
import gc, json, os, sys, time
import anyio
from tfbus import Buffer, Bus, Transform, TransformBroadcaster

def megabytes():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

async def main(options, times):
    with Bus() as bus, Buffer(bus) as buffer:
        TransformBroadcaster(bus).send("map", "base", Transform())
        await buffer.lookup("map", "base")
        before = megabytes()
        from support.peer_process import link_of
        link = link_of(bus, options)
        began = time.perf_counter()
        async with link:
            while not link.peers:
                await anyio.sleep(0.001)
            met = time.perf_counter() - began
            await buffer.lookup("map", "fixed 49")
            await anyio.sleep(1.0)
            linked, threads = megabytes(), len(os.listdir("/proc/self/task"))
        for count in (times // 5, times):
            gc.collect()
            start = megabytes()
            for _ in range(count):
                async with link_of(bus, options):
                    pass
            gc.collect()
            left = (megabytes() - start) / count * 1e3
    print(json.dumps([before, linked, threads, met, left]))

anyio.run(main, *json.loads(sys.argv[1]))
"""

# Links of the same options, each with a bus of its own.
MANY = """
import json, sys
from contextlib import AsyncExitStack
import anyio
from tfbus import Bus
from support.peer_process import link_of

async def main(options, count):
    async with AsyncExitStack() as stack:
        for _ in range(count):
            await stack.enter_async_context(link_of(stack.enter_context(Bus()), options))
        await anyio.to_thread.run_sync(sys.stdin.read)

anyio.run(main, *json.loads(sys.argv[1]))
"""


@pytest.fixture
def processes() -> Iterator[Crowd]:
    with crowd() as together:
        yield together


def program(text: str, *arguments: Any) -> list[str]:
    return [sys.executable, "-P", "-c", text, json.dumps(arguments)]


def pair(processes: Crowd, place: Place, backend: str) -> tuple[PeerProcess, PeerProcess]:
    """Two processes that know each other."""
    here = processes.add(place.first(), backend=backend)
    there = processes.add(place.other(), backend=backend)
    for process in (here, there):
        process.ask("until", peers=1)
    return here, there


@BACKENDS
@pytest.mark.parametrize(("rate", "wanted"), [(100, "p50 <= 0.35 ms"), (1_000, "p50 <= 0.25 ms")])
def test_delay(backend: str, rate: int, wanted: str, table: Table, place: Place, processes: Crowd) -> None:
    both = pair(processes, place, backend)
    here, there = both

    def spent() -> list[float]:
        return [process.ask("facts")["cpu"] for process in both]

    worst: list[str] = []
    times = [spent()]
    time.sleep(SECONDS)
    times.append(spent())
    for messages in (rate, round(rate * SECONDS)):  # The first ones only warm up.
        times.append(spent())
        listening = there.start("delays", authority=f"a{messages}", messages=messages)
        there.wait(event="noting")
        here.ask("stamp", authority=f"a{messages}", messages=messages, rate=rate)
        delays = sorted(there.finish(listening)["delays"])
        worst = [f"{delays[int(part * len(delays))] / 1e6:.2f}" for part in (0.5, 0.99, 0.999)]
    times.append(spent())
    # Less what the processes of this test do at rest.
    costs = [(end - start - (rest - begin)) / messages for begin, rest, _, start, end in zip(*times, strict=True)]
    cpu = " / ".join(f"{cost * 1e6:.0f}" for cost in costs) + " us CPU a message"
    table.add(f"{place.carrier}, {backend}, {rate} Hz: p50, p99, p99.9", " / ".join(worst) + " ms", cpu, "", wanted)


@BACKENDS
@pytest.mark.parametrize(("size", "wanted"), [(1, ">= 30,000/s"), (20, ">= 160,000/s")])
def test_rate(backend: str, size: int, wanted: str, table: Table, place: Place, processes: Crowd) -> None:
    here, there = pair(processes, place, backend)
    asked, best, limit = 8_000.0 * min(size, 5), 0.0, ""
    while not limit:
        name, batches = f"at {asked:.0f}", round(asked / size * SECONDS)
        sent = here.ask("stream", authority=name, batches=batches, rate=asked / size, size=size)
        here.ask("stream", authority=f"after {name}", batches=1, rate=10.0)
        there.ask("until", last={f"after {name}": 0})
        reached = batches * size / sent["seconds"]
        lost = batches - there.ask("facts")["tallies"].get(name, {"batches": 0})["batches"]
        if lost:
            limit = f"at {reached:.0f}/s {lost} of {batches} batches lost"
        else:
            best = max(best, reached)
            if reached < 0.9 * asked:
                limit = "the publisher is no faster"
        asked *= 1.5
    table.add(f"{place.carrier}, {backend}: samples by {size}, none lost", f"{best:.0f}/s", limit, "", wanted)


def test_process(table: Table, place: Place, processes: Crowd) -> None:
    processes.add(place.first()).ask("statics", names=STATICS)
    done = subprocess.run(
        program(PROCESS, place.other(), 500), capture_output=True, text=True, check=True, timeout=200, env=PATHS
    )
    before, linked, threads, met, left = json.loads(done.stdout)
    memory = f"{linked:.1f} MB", f"{before:.1f} without; {threads} threads"
    table.add(f"{place.carrier}: a process with a link", *memory, "", "<= 45 MB, <= 3 threads")
    table.add(f"{place.carrier}: a link, from its start to met", f"{met * 1e3:.1f} ms", wanted="<= 40 ms")
    table.add(f"{place.carrier}: a link opened and closed", f"{left:.1f} kB", wanted="<= 2 kB")


@pytest.mark.parametrize("peers", [0, 50])
def test_peers(table: Table, place: Place, peers: int) -> None:
    """The cost of knowing peers that do nothing, and of each message to them. They do not hear each other."""
    others = program(MANY, place.other(robot="other", robots=["one"]), peers // 2)

    async def main() -> list[float]:
        with Bus() as bus:
            async with link_of(bus, place.first(robot="one")) as link:
                await until(lambda: len(link.peers) == peers)
                await anyio.sleep(SETTLE)
                times = [time.process_time()]
                await anyio.sleep(RESTED)
                times.append(time.process_time())
                for _ in range(MESSAGES):
                    bus.publish(as_sample("map", "base", bus.clock.now()))
                    await anyio.sleep(0.01)
                assert len(link.peers) == peers
                return [*times, time.process_time()]

    with ExitStack() as stack:
        for _ in range(2 if peers else 0):
            process = stack.enter_context(subprocess.Popen(others, stdin=subprocess.PIPE, env=PATHS))
            assert process.stdin is not None
            stack.callback(process.stdin.close)
        start, rested, end = anyio.run(main)
    message = f"{(end - rested) / MESSAGES * 1e6:.0f} us a message"
    table.add(
        f"{place.carrier}: {peers} peers", f"{(rested - start) / RESTED:.2%} at rest", message, "", "0.2 %, 500 us"
    )


@pytest.mark.parametrize(("count", "wanted"), [(5, "<= 0.2 s"), (30, "p50 <= 150 ms"), (50, "<= 12 s")])
def test_start(table: Table, place: Place, count: int, wanted: str) -> None:
    found = measure(count, place, 5.0)
    met, delays = max(facts.met for facts in found), sorted(facts.delay * 1e3 for facts in found)
    spread = f"then p50 {median(delays):.1f} ms, {delays[-1]:.1f} at worst"
    table.add(f"{place.carrier}: {count} processes start, all meet", f"{met:.2f} s", spread, "", wanted)


def test_death(table: Table, place: Place, processes: Crowd) -> None:
    others = [processes.add(options) for options in (place.first(), *[place.other()] * 4)]
    times = []
    for _ in range(10):
        victim = processes.add(place.other())
        for process in others:
            process.ask("until", peers=len(others))
        killed = time.perf_counter()
        victim.kill()
        for process in others:
            process.wait(event="PeerLost")
        times.append((time.perf_counter() - killed) * 1e3)
    worst = f"{max(times):.1f} ms at worst"
    table.add(f"{place.carrier}: SIGKILL to 5 PeerLost", f"{median(times):.1f} ms", worst, "", "<= 20 ms")
