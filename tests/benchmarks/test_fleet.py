"""The cost of thousands of static frames, robots and remote lookups for a link over zenoh."""

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from statistics import median
from typing import IO, Any

import anyio
import anyio.lowlevel
import pytest
import zenoh
from beside import Table
from support.processes import crowd, free_ports, new_domain
from support.samples import moving, static

from tfbus import Buffer, Bus, TransformStamped
from tfbus._aio.loops import LoopWaker
from tfbus.links.zenoh import BufferClient, BufferServer, ZenohLink

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

# A robot's own buffer, and beside it a bare queryable.
SERVER = """
from test_fleet import answer_at_once

async def main(domain, address):
    with Bus() as bus, Buffer(bus, keep=None) as buffer:
        bus.publish([static("base", "lidar", x=2.0), moving("map", "base", 5, x=1.0), moving("map", "base", 9, x=5.0)])
        async with BufferServer(buffer, domain, listen=address) as server:
            declared = answer_at_once(server, domain, lambda: None)
            print("ready", flush=True)
            await anyio.to_thread.run_sync(sys.stdin.read)
            del declared
"""

# A process that asks for a stamp, from its input, many times at once.
ASKER = """
async def main(domain, address, count):
    async with BufferClient(domain, connect=address) as client, anyio.create_task_group() as tasks:
        await client.lookup("map", "base", 0)
        print("ready", flush=True)
        stamp = int(await anyio.to_thread.run_sync(sys.stdin.readline))
        for _ in range(count):
            tasks.start_soon(client.lookup, "map", "base", stamp)
        await anyio.sleep_forever()
"""

# The same without tfbus.
BARE_ASKER = """
async def main(domain, address, count):
    session = zenoh.open(settings([], address, None, None))
    while not list(session.get(f"bare/{domain}", timeout=0.2)):
        pass
    print("ready", flush=True)
    sys.stdin.readline()
    take = zenoh.handlers.Callback(lambda reply: None, indirect=False)
    for _ in range(count):
        session.get(f"bare/{domain}", take, payload=bytes(300), express=True)
    await anyio.sleep_forever()
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
    config = settings([], address, {"mode": "client"}, None)
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
from tfbus.links.zenoh import BufferClient, BufferServer, ZenohLink, ZenohRouter
from tfbus.links.zenoh._keys import Keys
from tfbus.links.zenoh._settings import settings
"""


def answer_at_once(server: BufferServer, domain: str, note: Callable[[], object]) -> object:
    """Declare a bare queryable whose answers are as long as those of a server, for as long as the result is held."""

    def answer(query: zenoh.Query) -> None:
        query.reply(query.key_expr, bytes(400), express=True)
        query.drop()
        note()

    callback: Any = zenoh.handlers.Callback(answer, indirect=False)
    return server._session._opened().declare_queryable(f"bare/{domain}", callback)


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
                while link._endpoint.outbox.pending:
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
                take: zenoh.handlers.Callback[zenoh.Reply] = zenoh.handlers.Callback(
                    lambda _: None, ended.set, indirect=False
                )
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


def test_what_nobody_hears(table: Table) -> None:
    """The cost of a link whose samples nobody subscribes to, for batches of 20 frames."""
    turns, frames = 2_000, 20

    async def main() -> float:
        with Bus() as bus:
            async with ZenohLink(bus, new_domain(), listen=f"tcp/127.0.0.1:{free_ports(1)[0]}"):
                before = time.process_time()
                for turn in range(turns):
                    bus.publish([moving("map", f"f{frame}", turn) for frame in range(frames)])
                    await anyio.lowlevel.checkpoint()
                return (time.process_time() - before) / turns / frames

    costs = [anyio.run(main) for _ in range(5)]
    table.add("a sample that nobody hears", f"{median(costs) * 1e6:.2f} us", f"{max(costs) * 1e6:.2f} at worst", "", "")


def test_remote_waits(table: Table) -> None:
    """The server's CPU time for lookups that have to wait, and for what they need at least.

    That is as many local ones whose answers go to a queue, and as many bare questions that are answered at once.
    """
    domain, address = new_domain(), f"tcp/127.0.0.1:{free_ports(1)[0]}"
    figures: dict[str, list[float]] = {}

    async def spend_on_bare_questions(server: BufferServer) -> None:
        ended = anyio.Event()
        note = LoopWaker(ended.set)
        note.bind()
        answered = 0

        def count_answer() -> None:
            nonlocal answered
            answered += 1
            if answered == ASKED:
                note.wake()

        queryable = answer_at_once(server, domain, count_answer)
        with running(BARE_ASKER, domain, address, ASKED) as asker:
            assert asker.stdin is not None
            answered = 0
            before = time.process_time()
            asker.stdin.write("\n")
            asker.stdin.flush()
            await ended.wait()
            figures.setdefault("bare", []).append((time.process_time() - before) / ASKED * 1e6)
        del queryable

    async def main() -> None:
        with Bus() as bus, Buffer(bus, keep=None) as buffer:
            bus.publish(moving("map", "base", 0))

            async def spend(name: str, stamp: int, begin: Callable[[], object], *held: Callable[[], bool]) -> None:
                """Have lookups begin, publish what helps none of them, and then what answers all."""
                times = [time.process_time()]
                begin()
                for wait_is_over in held:
                    while not wait_is_over():  # noqa: ASYNC110 - zenoh's threads wake no event here
                        await anyio.sleep(0.02)
                    times.append(time.process_time())
                    if len(times) == 2:
                        for earlier in range(ASKED, 0, -1):
                            bus.publish(moving("map", "base", stamp - earlier))
                        times.append(time.process_time())
                        bus.publish(moving("map", "base", stamp))
                figures.setdefault(name, []).append((times[1] - times[0] + times[3] - times[2]) / ASKED * 1e6)
                figures.setdefault(f"{name}, publish", []).append((times[2] - times[1]) / ASKED * 1e6)

            send, receive = anyio.create_memory_object_stream[TransformStamped](ASKED)

            async def ask(stamp: int) -> None:
                send.send_nowait(await buffer.lookup("map", "base", stamp))

            async with BufferServer(buffer, domain, listen=address) as server, anyio.create_task_group() as tasks:
                with send, receive:
                    for turn in range(1, 4):
                        stamp = turn * 10**6

                        def begin_local(stamp: int = stamp) -> None:
                            for _ in range(ASKED):
                                tasks.start_soon(ask, stamp)

                        await spend(
                            "local",
                            stamp,
                            begin_local,
                            lambda: len(buffer.pending()) == ASKED,
                            lambda: receive.statistics().current_buffer_used == ASKED,
                        )
                        for _ in range(ASKED):
                            receive.receive_nowait()
                        await spend_on_bare_questions(server)
                        with running(ASKER, domain, address, ASKED) as asker:
                            pipe = asker.stdin
                            assert pipe is not None
                            whole = server.statistics().answered + ASKED

                            def begin_remote(pipe: IO[str] = pipe, stamp: int = stamp) -> None:
                                pipe.write(f"{stamp + 500_000}\n")
                                pipe.flush()

                            def all_answered(whole: int = whole) -> bool:
                                return server.statistics().answered == whole

                            await spend(
                                "remote",
                                stamp + 500_000,
                                begin_remote,
                                lambda: server.statistics().waiting == ASKED,
                                all_answered,
                            )

    anyio.run(main)
    medians = {name: median(values) for name, values in figures.items()}
    for what, unit in (("", "a wait"), (", publish", "a publish that wakes none")):
        remote, local = medians[f"remote{what}"], medians[f"local{what}"]
        label = f"{unit}, {ASKED} remote ones"
        parts = f"local {local:.0f} us"
        if not what:
            # Somebody else has to ask, and to be answered.
            parts += f", bare question {medians['bare']:.0f} us"
            local += medians["bare"]
        table.add(label, f"{remote:.0f} us CPU", parts, f"{remote / local:.2f}", "no more")


def test_frozen_peer(table: Table) -> None:
    """A peer that is stopped for a minute, while another removes static frames: what it holds after it goes on."""
    frozen, settled = 60.0, 3.0
    names = [f"s{number}" for number in range(20)]
    with crowd() as together:
        options = {"domain": new_domain(), "drop_lost": False}
        address = f"tcp/127.0.0.1:{free_ports(1)[0]}"
        source = together.add({**options, "listen": address})
        peer = together.add({**options, "connect": address})
        source.ask("statics", names=names)
        peer.ask("until", static=names)
        peer.signal(signal.SIGSTOP)
        time.sleep(frozen / 2)
        for name in names[5:]:
            source.ask("remove", frame=name)
        time.sleep(frozen / 2)
        peer.signal(signal.SIGCONT)
        began = time.perf_counter()
        whole = None
        while time.perf_counter() - began < settled:
            if set(peer.ask("facts")["static"]) == set(names[:5]):
                whole = whole or time.perf_counter() - began
        held = set(peer.ask("facts")["static"])
    ghosts = len(held - set(names[:5]))
    label = "no ghost" if whole is None else f"none after {whole:.2f} s"
    table.add(f"frozen for {frozen:.0f} s, ghosts {settled:.0f} s later", f"{ghosts} of 15", label, "", "0")
