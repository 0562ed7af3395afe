"""Delay, throughput and memory of a link over zenoh between two processes."""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from statistics import median
from typing import Any

import anyio
import pytest
from beside import Table
from support.processes import Crowd, PeerProcess, crowd, free_address, new_domain, until

from tfbus import Bus
from tfbus.links.zenoh import ZenohLink

pytest_plugins = ["side_by_side"]

BACKENDS = ("asyncio", "asyncio+uvloop", "trio")
SECONDS = 5.0
SETTLE, RESTED = 30.0, 30.0
BATCH = 20
STATICS = [f"fixed {number}" for number in range(50)]

# The memory of a process with a bus and a buffer, in MB: alone, with zenoh's library, and with a link.
MEMORY = """
import json, os, sys
import anyio
from tfbus import Buffer, Bus, Transform, TransformBroadcaster

def megabytes():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

async def main():
    with Bus() as bus:
        buffer = Buffer(bus)
        TransformBroadcaster(bus).send("map", "base", Transform())
        await buffer.lookup("map", "base")
        figures = [megabytes()]
        from tfbus.links.zenoh import ZenohLink
        figures.append(megabytes())
        async with ZenohLink(bus, **json.loads(sys.argv[1])):
            await buffer.lookup("map", "fixed 49")
            await anyio.sleep(1.0)
            figures.append(megabytes())
    print(json.dumps(figures))

anyio.run(main)
"""


@pytest.fixture
def processes() -> Iterator[Crowd]:
    with crowd() as together:
        yield together


def pair(processes: Crowd, backend: str, **options: Any) -> tuple[PeerProcess, PeerProcess]:
    """Two processes that know each other."""
    domain, address = new_domain(), free_address()
    here = processes.add({"domain": domain, "listen": address, **options}, backend=backend)
    there = processes.add({"domain": domain, "connect": address, **options}, backend=backend)
    for process in (here, there):
        process.ask("until", peers=1)
    return here, there


def add_times(table: Table, label: str, times: list[float], wanted: str) -> None:
    table.add(label, f"{median(times) * 1e3:.0f} ms", f"at worst {max(times) * 1e3:.0f} ms", "", wanted)


@pytest.mark.parametrize("backend", BACKENDS)
def test_delay(backend: str, table: Table, processes: Crowd) -> None:
    here, there = pair(processes, backend)
    rate, parts = 1_000, (0.5, 0.99, 0.999)
    worst: list[str] = []
    for messages in (rate, round(rate * SECONDS)):  # The first ones only warm up.
        listening = there.start("delays", authority=f"a{messages}", messages=messages)
        there.wait(event="noting")
        here.ask("stamp", authority=f"a{messages}", messages=messages, rate=rate)
        delays = sorted(there.finish(listening)["delays"])
        worst = [f"{delays[int(part * len(delays))] / 1e6:.2f}" for part in parts]
    label = f"publish to inserted, {backend}, p50 / p99 / p99.9"
    table.add(label, " / ".join(worst) + " ms", f"{rate} messages/s for {SECONDS:.0f} s", "", "p50 <= 0.6, p99 <= 3 ms")


@pytest.mark.parametrize("backend", BACKENDS)
def test_rate(backend: str, table: Table, processes: Crowd) -> None:
    here, there = pair(processes, backend)
    asked, best, limit = 20_000.0, 0.0, ""
    while not limit:
        name, batches = f"at {asked:.0f}", round(asked / BATCH * SECONDS)
        sent = here.ask("stream", authority=name, batches=batches, rate=asked / BATCH, size=BATCH)
        here.ask("stream", authority=f"after {name}", batches=1, rate=10.0)
        there.ask("until", last={f"after {name}": 0})
        tally = there.ask("facts")["tallies"].get(name, {"batches": 0})
        reached = batches * BATCH / sent["seconds"]
        lost = batches - tally["batches"]
        if lost:
            limit = f"at {reached:.0f}/s {lost} of {batches} batches lost"
        else:
            best = reached
            if reached < 0.9 * asked:
                limit = "the publisher is no faster"
        asked *= 2
    table.add(f"samples in batches of {BATCH} without loss, {backend}", f"{best:.0f}/s", limit, "", ">= 20000/s")


def test_memory(table: Table, processes: Crowd) -> None:
    domain, address = new_domain(), free_address()
    processes.add({"domain": domain, "listen": address}).ask("statics", names=STATICS)
    link = json.dumps({"domain": domain, "connect": address})
    done = subprocess.run([sys.executable, "-c", MEMORY, link], capture_output=True, text=True, check=True, timeout=60)
    before, imported, linked = json.loads(done.stdout)
    parts = f"{imported - before:.1f} for its modules, {linked - imported:.1f} for itself; before {before:.1f}"
    table.add("memory that a link adds", f"{linked - before:.1f} MB", parts, "", "<= 15 MB")


@pytest.mark.parametrize("peers", [0, 50])
def test_presence_at_rest(table: Table, processes: Crowd, peers: int) -> None:
    """The cost of knowing peers that do nothing. They know the measured link, but not each other."""
    domain, address = new_domain(), free_address()
    alone = {"scouting/gossip/enabled": False}
    other = {"domain": domain, "connect": address, "robot": "other", "robots": ["one"], "config": alone}

    async def main() -> float:
        with Bus() as bus:
            async with ZenohLink(bus, domain, robot="one", listen=address) as link:
                for _ in range(2 if peers else 0):
                    processes.begin(*[other] * (peers // 2))
                await until(lambda: len(link.peers) == peers)
                await anyio.sleep(SETTLE)
                before, began = time.process_time(), time.monotonic()
                await anyio.sleep(RESTED)
                assert len(link.peers) == peers
                return (time.process_time() - before) / (time.monotonic() - began)

    table.add(f"of a core for {peers} peers that rest", f"{anyio.run(main):.2%}")


def test_late_joiner(table: Table, processes: Crowd) -> None:
    domain, address = new_domain(), free_address()
    first = processes.add({"domain": domain, "listen": address})
    first.ask("statics", names=STATICS)
    # Until they are cached, and not only on their way.
    processes.add({"domain": domain, "connect": address}).ask("until", static=STATICS)
    times = []
    for _ in range(10):
        late = processes.begin({"domain": domain, "connect": address})
        late.wait(event="joining")
        began = time.perf_counter()
        late.ask("until", static=STATICS)
        times.append(time.perf_counter() - began)
        late.end()
    add_times(table, "50 static frames at a late joiner", times, "<= 1 s")


def test_death(table: Table, processes: Crowd) -> None:
    domain, address = new_domain(), free_address()
    stays = processes.add({"domain": domain, "listen": address})
    times = []
    for _ in range(10):
        victim = processes.add({"domain": domain, "connect": address})
        stays.ask("until", peers=1)
        killed = time.perf_counter()
        victim.kill()
        stays.wait(event="PeerLost")
        times.append(time.perf_counter() - killed)
    add_times(table, "from SIGKILL to PeerLost", times, "well below 1 s")
