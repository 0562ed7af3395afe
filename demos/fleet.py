"""A fleet on one machine: many robots behind a router, and a dashboard that hears ten in full and all once a second.

The robots are links of their own in a few processes; each has `--frames` moving frames at `--rate`. The dashboard looks
for some seconds with each of three views: no robot (the cost of a link at rest), ten in full, and all at 1 Hz. For each
view, the table has the cost for the dashboard and the router (cores), the received data (MB/s, samples/s), and the age
of the newest poses. If the machine is too slow, robots publish at less than `--rate`: the table shows that as well.

Run it with `python demos/fleet.py --robots 100`; a thousand robots are for a machine with many cores.
"""

import argparse
import math
import multiprocessing
import os
import random
import socket
import time
from collections.abc import Iterable
from contextlib import AsyncExitStack
from dataclasses import dataclass
from typing import Any

import anyio

import tfbus
from tfbus.links.zenoh import ZenohLink, ZenohRouter
from tfbus.tf_message import encode

DOMAIN = "fleet"
IN_FULL = 10
CONNECTING = 5


@dataclass(frozen=True)
class Fleet:
    address: str
    robots: int
    frames: int
    rate: float


async def drive(fleet: Fleet, number: int, connecting: anyio.Semaphore) -> None:
    """Publish the frames of one robot."""
    name = f"r{number}"
    async with AsyncExitStack() as stack:
        bus = stack.enter_context(tfbus.Bus())
        link = ZenohLink(bus, DOMAIN, robot=name, robots=[], connect=fleet.address)
        async with connecting:
            await stack.enter_async_context(link)
        broadcaster = tfbus.TransformBroadcaster(bus, authority=name)
        # Not all in one moment.
        await anyio.sleep(random.random() / fleet.rate)
        async for _ in bus.clock.ticks(fleet.rate):
            pose = tfbus.Transform((math.sin(time.monotonic()), 0.0, 0.0))
            broadcaster.send_all([("map", f"{name}/frame{frame}", pose) for frame in range(fleet.frames)])


def run_robots(fleet: Fleet, numbers: Iterable[int]) -> None:
    async def drive_all() -> None:
        # A router has no time for hundreds that connect at once, and a client gives up at once.
        connecting = anyio.Semaphore(CONNECTING)
        async with anyio.create_task_group() as tasks:
            for number in numbers:
                tasks.start_soon(drive, fleet, number, connecting)

    anyio.run(drive_all)


def run_router(address: str, cpu: Any) -> None:
    async def route() -> None:
        async with ZenohRouter(address):
            while True:
                cpu.value = time.process_time()
                await anyio.sleep(0.1)

    anyio.run(route)


async def look(fleet: Fleet, robots: Any, seconds: float, router_cpu: Any) -> dict[str, float]:
    """Look at some robots for a while; return what that costs and brings."""
    ages: list[float] = []
    sizes: list[float] = []
    async with AsyncExitStack() as stack:
        bus = stack.enter_context(tfbus.Bus())

        def note(batch: tuple[tfbus.TransformStamped, ...]) -> None:
            ages.append((bus.clock.now() - batch[0].stamp) / tfbus.SECOND)
            if not sizes:
                sizes.append(len(encode(batch)) / len(batch))

        link = ZenohLink(bus, DOMAIN, robots=robots, connect=fleet.address)
        await stack.enter_async_context(link)
        await anyio.sleep(2.0)
        registration = stack.enter_context(bus.subscribe(note))
        before, samples = time.process_time(), link.statistics().received_samples
        routed, began = router_cpu.value, time.monotonic()
        await anyio.sleep(seconds)
        took = time.monotonic() - began
        registration.close()
        received = link.statistics().received_samples - samples
        ages.sort()
        return {
            "peers": len(link.peers),
            "dashboard": (time.process_time() - before) / took,
            "router": (router_cpu.value - routed) / took,
            "samples": received / took,
            "megabytes": received / took * sum(sizes) / 1e6,
            "age": ages[len(ages) // 2] if ages else math.nan,
            "oldest": ages[-1] if ages else math.nan,
        }


def show(views: dict[str, dict[str, float]]) -> None:
    print("view         peers  dashboard    router    samples/s   MB/s  age (median, oldest)")
    for name, view in views.items():
        ages = f"{view['age'] * 1e3:.0f} ms, {view['oldest'] * 1e3:.0f} ms" if view["samples"] else "-"
        print(
            f"{name:<12} {view['peers']:5.0f} {view['dashboard']:6.3f} cores {view['router']:5.3f} cores "
            f"{view['samples']:9.0f} {view['megabytes']:6.2f}  {ages}"
        )


def main(robots: int, frames: int, rate: float, processes: int, seconds: float) -> dict[str, dict[str, float]]:
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    fleet = Fleet(address, robots, frames, rate)
    context = multiprocessing.get_context("spawn")
    router_cpu = context.Value("d", 0.0)
    started = [context.Process(target=run_router, args=(address, router_cpu), daemon=True)]
    started[0].start()
    while router_cpu.value == 0.0:
        time.sleep(0.05)
    for first in range(processes):
        numbers = range(first, robots, processes)
        started.append(context.Process(target=run_robots, args=(fleet, numbers), daemon=True))
        started[-1].start()
    print(f"{robots} robots x {frames} frames x {rate:g} Hz in {processes} processes, {os.cpu_count()} cores")
    full = [f"r{number}" for number in range(min(IN_FULL, robots))]
    # All robots are there when the dashboard has them as peers.
    try:
        anyio.run(meet_all, fleet)
        looked = {
            "nobody": anyio.run(look, fleet, [], seconds, router_cpu),
            "ten in full": anyio.run(look, fleet, full, seconds, router_cpu),
            "all at 1 Hz": anyio.run(look, fleet, {"r*": 1.0}, seconds, router_cpu),
        }
    finally:
        for process in started:
            process.kill()
            process.join()
    show(looked)
    wanted = len(full) * frames * rate
    print(f"the ten publish {looked['ten in full']['samples'] / wanted:.0%} of what they should")
    return looked


async def meet_all(fleet: Fleet) -> None:
    with tfbus.Bus() as bus:
        async with ZenohLink(bus, DOMAIN, robots={"r*": 0.001}, connect=fleet.address) as link:
            with bus.events() as events:
                while len(link.peers) < fleet.robots:
                    await anext(events)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=100)
    parser.add_argument("--frames", type=int, default=50)
    parser.add_argument("--rate", type=float, default=20.0, help="Hz")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=5.0, help="how long each view is looked at")
    main(**vars(parser.parse_args()))
