"""The cost of thousands of static frames, robots and remote lookups for a link over zenoh."""

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from statistics import median
from typing import Any

import anyio
import anyio.lowlevel
import pytest
import zenoh
from beside import Table
from support.processes import free_ports, new_domain
from support.samples import static

from tfbus import Bus
from tfbus.links.zenoh import BufferClient, ZenohLink

pytest_plugins = ["side_by_side"]

ASKED = 1_000
FRAMES, RATE, SECONDS = 50, 20.0, 10.0

# A process that joins late, and tells the seconds until its bus has so many frames.
LATE = """
async def main(domain, address, frames):
    with Bus() as bus:
        began = time.perf_counter()
        async with ZenohLink(bus, domain, connect=address, max_frames=frames):
            while bus.statistics().frames < frames:
                await anyio.sleep(0.005)
            print(time.perf_counter() - began)
"""

# A robot's own buffer, and beside it a bare queryable whose answer is as long.
SERVER = """
async def main(domain, address):
    with Bus() as bus, Buffer(bus, keep=None) as buffer:
        bus.publish([static("base", "lidar", x=2.0), moving("map", "base", 5, x=1.0), moving("map", "base", 9, x=5.0)])
        async with BufferServer(buffer, domain, listen=address) as server:
            answer = zenoh.handlers.Callback(
                lambda query: (query.reply(query.key_expr, bytes(400), express=True), query.drop()), indirect=False
            )
            declared = server._session._opened().declare_queryable(f"bare/{domain}", answer)
            print("ready", flush=True)
            await anyio.to_thread.run_sync(sys.stdin.read)
            del declared
"""

# A router that tells its CPU time for each line of input.
ROUTER = """
async def main(address):
    async with ZenohRouter(address):
        print("ready", flush=True)
        async for _ in anyio.wrap_file(sys.stdin):
            print(time.process_time(), flush=True)
"""

# Many robots, as what their links declare; the first publishes, the others are only there.
ROBOTS = """
async def main(domain, address, robots, frames, rate):
    config = settings([], address, {"mode": "client"}, 2.0)
    sessions = [zenoh.open(config) for _ in range(4)]
    declared = []
    for number in range(1, robots):
        keys = Keys(domain, f"{number:032x}", f"r{number}")
        session = sessions[number % len(sessions)]
        declared += [session.declare_publisher(keys.own(kind)) for kind in ("live", "slow")]
        declared += [
            session.declare_queryable(keys.own(kind), lambda query: None) for kind in ("state", "history", "hears")
        ]
        declared.append(session.liveliness().declare_token(keys.token("0")))
    with Bus() as bus:
        async with ZenohLink(bus, domain, robot="r0", robots=[], connect=address, config={"mode": "client"}):
            print("ready", flush=True)
            async for _ in bus.clock.ticks(rate):
                bus.publish([moving("map", f"f{frame}", bus.clock.now()) for frame in range(frames)])
"""

HEADER = """
import json, sys, time
import anyio, anyio.to_thread
import zenoh
from support.samples import moving, static
from tfbus import Buffer, Bus
from tfbus.links.zenoh import BufferServer, ZenohLink, ZenohRouter
from tfbus.links.zenoh._keys import Keys
from tfbus.links.zenoh._settings import settings
"""


def command(program: str, *arguments: Any) -> list[str]:
    paths = f"import sys; sys.path[:0] = {sys.path!r}\n"
    return [sys.executable, "-c", f"{paths}{HEADER}{program}\nanyio.run(main, *{arguments!r})"]


@contextmanager
def running(program: str, *arguments: Any) -> Iterator[subprocess.Popen[str]]:
    """A process that is ready, and is killed at the end."""
    pipe = subprocess.PIPE
    with subprocess.Popen(command(program, *arguments), stdin=pipe, stdout=pipe, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize(("frames", "wanted"), [(10_000, "<= 0.2 s CPU, <= 1 s"), (50_000, "<= 4 s")])
def test_statics(frames: int, wanted: str, table: Table) -> None:
    domain, address = new_domain(), f"tcp/127.0.0.1:{free_ports(1)[0]}"
    batches = [[static("map", f"f{group} {frame}") for frame in range(1_000)] for group in range(frames // 1_000)]

    async def main() -> tuple[float, list[float]]:
        with Bus() as bus:
            async with ZenohLink(bus, domain, listen=address, max_frames=frames) as link:
                before = time.process_time()
                for batch in batches:
                    bus.publish(batch)
                while link.statistics().sent_samples < frames:
                    await anyio.lowlevel.checkpoint()
                declared = time.process_time() - before
                late = [float((await anyio.run_process(command(LATE, domain, address, frames))).stdout) for _ in "123"]
                return declared, late

    declared, late = anyio.run(main)
    times = f"at a late joiner in {median(late):.2f} s, {max(late):.2f}"
    table.add(f"{frames} static frames declared", f"{declared:.2f} s CPU", times, "", wanted)


def test_remote_lookup(table: Table) -> None:
    domain, address = new_domain(), f"tcp/127.0.0.1:{free_ports(1)[0]}"
    ours: list[float] = []
    bare: list[float] = []

    async def main() -> None:
        async with BufferClient(domain, connect=address) as client:
            await client.lookup("map", "lidar", timeout=10)
            for _ in range(ASKED):
                began = time.perf_counter()
                await client.lookup("map", "lidar", 7)
                ours.append(time.perf_counter() - began)
                ended = threading.Event()
                began = time.perf_counter()
                take = zenoh.handlers.Callback(lambda _: None, ended.set, indirect=False)
                client._session._opened().get(f"bare/{domain}", take, payload=bytes(300), express=True)
                assert ended.wait(10)
                bare.append(time.perf_counter() - began)

    with running(SERVER, domain, address):
        anyio.run(main)
    label = f"{median(bare) * 1e3:.2f} ms for a bare query"
    table.add(
        "remote lookup, p50", f"{median(ours) * 1e3:.2f} ms", label, f"{median(ours) / median(bare):.2f}", "<= 1 ms"
    )


def test_one_robot_of_many(table: Table) -> None:
    """A subscription costs, and not what exists: user and system time with it less that without."""

    def measure(robots: int) -> tuple[float, float]:
        domain, address = new_domain(), f"tcp/127.0.0.1:{free_ports(1)[0]}"

        async def look(heard: list[str]) -> tuple[float, float]:
            with Bus() as bus:
                async with ZenohLink(bus, domain, robots=heard, connect=address, config={"mode": "client"}):
                    await anyio.sleep(2.0)
                    own, routed = time.process_time(), told()
                    await anyio.sleep(SECONDS)
                    return time.process_time() - own, told() - routed

        with running(ROUTER, address) as router, running(ROBOTS, domain, address, robots, FRAMES, RATE):

            def told() -> float:
                assert router.stdin is not None
                assert router.stdout is not None
                router.stdin.write("\n")
                router.stdin.flush()
                return float(router.stdout.readline())

            nobody, one = anyio.run(look, []), anyio.run(look, ["r0"])
        return (one[0] - nobody[0]) / SECONDS, (one[1] - nobody[1]) / SECONDS

    few, many = measure(10), measure(1_000)
    for place, name in enumerate(("subscriber", "router")):
        label = f"one robot of 1,000, the {name}"
        table.add(
            label, f"{many[place]:.3f} cores", f"of 10: {few[place]:.3f}", f"{many[place] / few[place]:.2f}", "<= 1.2"
        )
