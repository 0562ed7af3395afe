"""Links between processes: delay, rates, many peers, late joiners, memory, lookups; and fleets behind a router.

The built-in link of one machine, but for the last three tests. All takes some seven minutes on two quiet cores.
"""

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import anyio
import pytest
from beside import Table
from start_together import measure
from support.namespaces import Network, absent
from support.peer_process import as_sample, link_of
from support.processes import Crowd, PeerProcess, Place, crowd, free_address, new_domain, until
from support.samples import moving, static

from tfbus import Buffer, Bus
from tfbus.links import BufferServer

pytest_plugins = ["side_by_side"]

BACKENDS = pytest.mark.parametrize("backend", ["asyncio", "asyncio+uvloop", "trio"])
SECONDS = 2.0
# Until links sign as rarely as they ever do, and then for two signs of each.
SETTLE, RESTED = 16.0, 24.0
OBSERVED = 10.0
MESSAGES = 300
ASKED = 1_000
STEPS = 5
DEMOS = Path(__file__).parents[2] / "demos"

HEADER = """
import gc, json, os, sys, time
from contextlib import AsyncExitStack
import anyio, anyio.to_thread
from support.peer_process import as_sample, link_of
from tfbus import Buffer, Bus
"""

# A process with a bus, a buffer and a link: its memory in MB, its threads, the seconds until the link has met another,
# and the kB that are left when one is opened and closed.
PROCESS = """
def megabytes():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

async def main(options, times):
    with Bus() as bus, Buffer(bus) as buffer:
        bus.publish(as_sample("map", "base", bus.clock.now()))
        await buffer.lookup("map", "base")
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
    print(json.dumps([linked, threads, met, left]))
"""

# Links of the same options, each with a bus of its own.
LINKS = """
async def main(options, count):
    async with AsyncExitStack() as stack:
        for _ in range(count):
            await stack.enter_async_context(link_of(stack.enter_context(Bus()), options))
        print("ready", flush=True)
        await anyio.to_thread.run_sync(sys.stdin.read)
"""

# A process that joins late some times, and tells the seconds until its bus has so many frames.
LATE = """
async def main(options, frames, times):
    took = []
    for _ in range(times):
        with Bus() as bus:
            began = time.perf_counter()
            async with link_of(bus, options):
                while bus.statistics().frames < frames:
                    await anyio.sleep(0.005)
                took.append(time.perf_counter() - began)
    print(json.dumps(took))
"""

# A robot's own buffer.
SERVER = """
from tfbus.links import BufferServer

async def main(options):
    with Bus() as bus, Buffer(bus, keep=None) as buffer:
        bus.publish([as_sample("map", "base", stamp) for stamp in (5, 9)])
        bus.publish(as_sample("base", "lidar", 0, static=True))
        async with link_of(bus, options) as link, BufferServer(buffer, link):
            print("ready", flush=True)
            await anyio.to_thread.run_sync(sys.stdin.read)
"""

# A process that asks for a stamp, from its input, many times at once.
ASKER = """
async def main(options, count):
    async with link_of(Bus(), options) as client, anyio.create_task_group() as tasks:
        print("ready", flush=True)
        stamp = int(await anyio.to_thread.run_sync(sys.stdin.readline))
        for _ in range(count):
            tasks.start_soon(client.lookup, "map", "base", stamp)
        await anyio.sleep_forever()
"""

# A router that tells its CPU time for each line of input.
ROUTER = """
async def main(address):
    from tfbus.links.zenoh import ZenohRouter
    async with ZenohRouter(address):
        print("ready", flush=True)
        async for _ in anyio.wrap_file(sys.stdin):
            print(time.process_time(), flush=True)
"""

# Many robots; the first publishes, the others are only there.
ROBOTS = """
async def main(options, robots, frames, rate):
    async with AsyncExitStack() as stack:
        buses = [stack.enter_context(Bus()) for _ in range(robots)]
        for number, bus in enumerate(buses):
            await stack.enter_async_context(link_of(bus, options | {"robot": f"r{number}", "robots": []}))
        print("ready", flush=True)
        async for _ in buses[0].clock.ticks(rate):
            buses[0].publish([as_sample("map", f"f{frame}", buses[0].clock.now()) for frame in range(frames)])
"""

# The fleet of the guide: for each view, what it costs and how old the poses are.
FLEET = """
async def main(robots, frames, rate):
    import fleet
    found = await anyio.to_thread.run_sync(fleet.main, robots, frames, rate, 2, 10.0)
    print(json.dumps(found["ten in full"]))
"""


@pytest.fixture
def processes() -> Iterator[Crowd]:
    with crowd() as together:
        yield together


@pytest.fixture
def place() -> Place:
    """A new domain on this machine."""
    return Place("one machine")


def command(program: str, *arguments: Any) -> list[str]:
    paths = f"import sys; sys.path[:0] = {[*sys.path, str(DEMOS)]!r}\n"
    return [sys.executable, "-P", "-c", f"{paths}{HEADER}{program}\nanyio.run(main, *{arguments!r})"]


def printed(program: str, *arguments: Any) -> Any:
    """The JSON of the last line that a process prints."""
    done = subprocess.run(command(program, *arguments), capture_output=True, text=True, check=True, timeout=200)
    return json.loads(done.stdout.splitlines()[-1])


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


def meet(*processes: PeerProcess) -> None:
    for process in processes:
        process.ask("until", peers=len(processes) - 1)


def show_delay(table: Table, label: str, here: PeerProcess, there: PeerProcess, rate: int, wanted: str) -> None:
    """Measure the delay from one process to another, and the CPU time less that of their rest."""

    def spent() -> list[float]:
        return [process.ask("facts")["cpu"] for process in (here, there)]

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
    costs = [(end - start - (rest - begin)) / messages for begin, rest, _, start, end in zip(*times, strict=True)]
    cpu = " / ".join(f"{cost * 1e6:.0f}" for cost in costs) + " us CPU a message"
    table.add(f"{label}, {rate} Hz: p50, p99, p99.9", " / ".join(worst) + " ms", cpu, "", wanted)


@BACKENDS
@pytest.mark.parametrize(("rate", "wanted"), [(100, "p50 <= 0.35 ms"), (1_000, "p50 <= 0.25 ms")])
def test_delay(backend: str, rate: int, wanted: str, table: Table, place: Place, processes: Crowd) -> None:
    here, there = (processes.add(place.first(), backend=backend) for _ in range(2))
    meet(here, there)
    show_delay(table, f"delay, {backend}", here, there, rate, wanted)


@BACKENDS
@pytest.mark.parametrize(("size", "wanted"), [(1, ">= 30,000/s"), (20, ">= 160,000/s")])
def test_rate(backend: str, size: int, wanted: str, table: Table, place: Place, processes: Crowd) -> None:
    here, there = (processes.add(place.first(), backend=backend) for _ in range(2))
    meet(here, there)
    asked, best, limit = (12_000.0 if size == 1 else 60_000.0), 0.0, f"in {STEPS} steps"
    for _ in range(STEPS):
        name, batches = f"at {asked:.0f}", round(asked / size * SECONDS)
        sent = here.ask("stream", authority=name, batches=batches, rate=asked / size, size=size)
        here.ask("stream", authority=f"after {name}", batches=1, rate=10.0)
        there.ask("until", last={f"after {name}": 0})
        reached = batches * size / sent["seconds"]
        lost = batches - there.ask("facts")["tallies"].get(name, {"batches": 0})["batches"]
        if lost:
            limit = f"at {reached:.0f}/s {lost} of {batches} batches lost"
            break
        best = max(best, reached)
        if reached < 0.9 * asked:
            limit = "the publisher is no faster"
            break
        asked *= 1.5
    table.add(f"{backend}: samples by {size}, none lost", f"{best:.0f}/s", limit, "", wanted)


def test_process(table: Table, place: Place, processes: Crowd) -> None:
    processes.add(place.first()).ask("statics", names=[f"fixed {number}" for number in range(50)])
    linked, threads, met, left = printed(PROCESS, place.other(), 500)
    table.add("a process with a link", f"{linked:.1f} MB", f"{threads} threads", "", "<= 45 MB, <= 3 threads")
    table.add("a link, from its start to met", f"{met * 1e3:.1f} ms", wanted="<= 40 ms")
    table.add("a link opened and closed", f"{left:.1f} kB", wanted="<= 2 kB")


def test_peers(table: Table, place: Place) -> None:
    """The cost of knowing 50 peers that do nothing, and of each message to them. They do not hear each other."""
    others = place.other(robot="other", robots=["one"])

    async def main() -> list[float]:
        with Bus() as bus:
            async with link_of(bus, place.first(robot="one")) as link:
                await until(lambda: len(link.peers) == 50)
                await anyio.sleep(SETTLE)
                times = [time.process_time()]
                await anyio.sleep(RESTED)
                times.append(time.process_time())
                for _ in range(MESSAGES):
                    bus.publish(as_sample("map", "base", bus.clock.now()))
                    await anyio.sleep(0.01)
                assert len(link.peers) == 50
                return [*times, time.process_time()]

    with ExitStack() as stack:
        for _ in range(2):
            stack.enter_context(running(LINKS, others, 25))
        start, rested, end = anyio.run(main)
    table.add("50 peers at rest", f"{(rested - start) / RESTED:.2%} of a core", wanted="<= 0.2 %")
    table.add("a message to 50 peers", f"{(end - rested) / MESSAGES * 1e6:.0f} us CPU", wanted="<= 500 us")


@pytest.mark.parametrize(
    ("count", "stay", "wanted"), [(5, 5, "<= 0.2 s"), (30, 30, "p50 <= 150 ms"), (50, 20, "<= 12 s, no backlog")]
)
def test_start(table: Table, place: Place, count: int, stay: int, wanted: str) -> None:
    """The delay is that among so many processes, when the others have ended."""
    found = measure(count, place, 5.0, stay=stay)
    met, linked = max(facts.met for facts in found), max(facts.linked for facts in found)
    delays = sorted(facts.delay * 1e3 for facts in found[:stay])
    spread = f"then p50 {median(delays):.1f} ms, {delays[-1]:.1f} at worst of {stay}"
    label = f"{count} processes start, their links; all have all"
    table.add(label, f"{met:.2f}; {linked:.2f} s", spread, "", wanted)


def test_death(table: Table, place: Place, processes: Crowd) -> None:
    others = [processes.add(place.other()) for _ in range(5)]
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
    table.add("SIGKILL to 5 PeerLost", f"{median(times):.1f} ms", worst, "", "<= 20 ms")


@pytest.mark.parametrize(("frames", "joins", "wanted"), [(10_000, 50, "<= 0.3 s"), (50_000, 10, "<= 1.3 s")])
def test_statics(frames: int, joins: int, wanted: str, table: Table, place: Place) -> None:
    batches = [[static("map", f"f{group} {frame}") for frame in range(1_000)] for group in range(frames // 1_000)]

    async def main() -> list[float]:
        with Bus() as bus:
            async with link_of(bus, place.first(max_frames=frames)):
                for batch in batches:
                    bus.publish(batch)
                options = place.other(max_frames=frames)
                late = [await anyio.to_thread.run_sync(printed, LATE, options, frames, joins // 5) for _ in range(5)]
                return [seconds for each in late for seconds in each]

    late = anyio.run(main)
    worst = f"{max(late):.2f} s at worst of {len(late)}"
    table.add(f"a late joiner has {frames} statics", f"{median(late):.2f} s", worst, "", wanted)


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
    times.sort()
    table.add("remote lookup, p50", f"{median(times) * 1e3:.2f} ms", f"p99 {times[-10] * 1e3:.2f}", "", "<= 0.25 ms")


def test_remote_waits(table: Table, place: Place) -> None:
    """The server's CPU time for lookups that wait, and for a publication that answers none of them."""
    spent: list[list[float]] = []

    async def main() -> None:
        with Bus() as bus, Buffer(bus, keep=None) as buffer:
            bus.publish(moving("map", "base", 0))
            async with link_of(bus, place.first()) as link, BufferServer(buffer, link) as server:
                for stamp in (10**6, 2 * 10**6, 3 * 10**6):
                    with running(ASKER, place.other(robots={"*": 0.0}), ASKED) as ask:
                        whole = server.statistics().answered + ASKED
                        times = [time.process_time()]
                        ask(stamp, False)
                        await until(lambda: server.statistics().waiting == ASKED)
                        times.append(time.process_time())
                        for earlier in range(ASKED, 0, -1):
                            bus.publish(moving("map", "base", stamp - earlier))
                        times.append(time.process_time())
                        bus.publish(moving("map", "base", stamp))
                        await until(lambda whole=whole: server.statistics().answered >= whole)  # type: ignore[misc]
                        times.append(time.process_time())
                        spent.append([(end - start) / ASKED * 1e6 for start, end in pairwise(times)])

    anyio.run(main)
    asked, published, replied = (median(part) for part in zip(*spent, strict=True))
    label = f"a wait of {ASKED} remote ones; its answer"
    table.add(label, f"{asked:.0f}; {replied:.0f} us CPU", f"a publish that wakes none {published:.1f} us")


def test_fleet(table: Table) -> None:
    """100 robots of 10 frames at 10 Hz, of which a dashboard hears ten."""
    pytest.importorskip("zenoh")
    view = printed(FLEET, 100, 10, 10.0)
    cores = f"{view['dashboard']:.1%} of a core, the router {view['router']:.1%}; {view['samples']:.0f} samples/s"
    table.add("a dashboard on 10 of 100 robots: p50", f"{view['age'] * 1e3:.2f} ms", cores, "", "1.8 ms, 4.7 %, 2 %")


def test_one_robot_of_many(table: Table) -> None:
    """A subscription costs, and not what exists: user and system time for each of its samples."""
    pytest.importorskip("zenoh")

    def costs(robots: int) -> list[float]:
        options = {"domain": new_domain(), "connect": free_address()}

        async def look(heard: list[str]) -> tuple[int, float, float]:
            """The samples of some seconds, and the time that they, or their absence, took here and in the router."""
            with Bus() as bus:
                async with link_of(bus, options | {"robots": heard}) as link:
                    await until(lambda: bus.statistics().frames >= 10 * len(heard))
                    await anyio.sleep(2.0)
                    before = link.statistics().received_samples, time.process_time(), float(router("", True))
                    await anyio.sleep(OBSERVED)
                    after = link.statistics().received_samples, time.process_time(), float(router("", True))
                    return after[0] - before[0], after[1] - before[1], after[2] - before[2]

        with running(ROUTER, options["connect"]) as router, running(ROBOTS, options, robots, 10, 200.0):
            # The signs of life of a thousand links are most of it.
            before, one, after = (anyio.run(look, heard) for heard in ([], ["r0"], []))
        rest = [(first + last) / 2 for first, last in zip(before, after, strict=True)]
        return [(more - less) / one[0] * 1e6 for more, less in zip(one[1:], rest[1:], strict=True)]

    few, many = costs(5), costs(1_000)
    for name, cost, least in zip(("subscriber", "router"), many, few, strict=True):
        label = f"one robot of 1,000, the {name}"
        table.add(label, f"{cost:.2f} us a sample", f"of 5: {least:.2f}", f"{cost / least:.2f}", "<= 1.2")


@pytest.mark.skipif(absent() is not None, reason=absent() or "")
def test_delay_between_namespaces(table: Table, processes: Crowd) -> None:
    pytest.importorskip("zenoh")
    with Network(2) as network:
        domain, address = new_domain(), f"tcp/{network.address(0)}:7447"
        sides = {"listen": address}, {"connect": address}
        both = [
            processes.add({"domain": domain, **side}, within=network.within(place)) for place, side in enumerate(sides)
        ]
        meet(*both)
        show_delay(table, "delay, two namespaces", both[0], both[1], 100, "p50 <= 0.8 ms")
        for process in both:
            process.end()
