"""Our side of tests against a real ROS, in which each side needs the frames of the other."""

import json
import os
import statistics
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Any

import anyio
import anyio.to_thread

from tfbus import Buffer, Bus, Transform, TransformBroadcaster
from tfbus.geometry.stamped import Batch
from tfbus.links.ros import RosLink

SECONDS = 10.0
MOST_FAILED = 0.01


def seconds(stamp: int) -> float:
    """Seconds since some day: between two samples the answer is exact, however late the second one is."""
    return (stamp - 1_750_000_000 * 10**9) / 1e9


class Program:
    """Our side: it broadcasts ``base:arm``, x = 2 t, and the static ``arm:tool``, and asks for ``odom:tool``."""

    def __init__(self, bus: Bus, buffer: Buffer) -> None:
        self.bus = bus
        self.buffer = buffer
        self.latencies: list[float] = []
        self.authorities: set[str] = set()
        self.answered = self.failed = self.wrong = 0
        bus.subscribe(self._hear)
        self._broadcaster = TransformBroadcaster(bus, authority="here")
        self._broadcaster.send_static("arm", "tool", Transform((0.1, 0.0, 0.0)))

    def _hear(self, batch: Batch) -> None:
        for sample in batch:
            if sample.child in ("base", "laser"):
                self.authorities.add(sample.authority)
                if not sample.static:
                    self.latencies.append((time.time_ns() - sample.stamp) / 1e6)

    async def send(self) -> None:
        async for _ in self.bus.clock.ticks(100.0):
            stamp = time.time_ns()
            self._broadcaster.send("base", "arm", Transform((2 * seconds(stamp), 0.0, 0.0)), at=stamp)

    async def ask(self) -> None:
        """Wait for the transform of the present, again and again."""
        async for _ in self.bus.clock.ticks(100.0):
            stamp = time.time_ns()
            try:
                found = await self.buffer.lookup("odom", "tool", stamp, timeout=1.0)
            except TimeoutError:
                self.failed += 1
                continue
            self.answered += 1
            self.wrong += abs(found.transform.translation[0] - (3 * seconds(stamp) + 0.1)) > 1e-6


class Node:
    """The other side: a process that does what `ros_driver.py` says."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    async def next_line(self) -> dict[str, Any]:
        """The next line of JSON that it prints."""
        assert self._process.stdout is not None
        return dict(json.loads(await anyio.to_thread.run_sync(self._process.stdout.readline)))


@contextmanager
def node(
    command: Sequence[str], environment: Mapping[str, str], seconds: float = SECONDS, x: float = 0.5
) -> Iterator[Node]:
    """Such a process, killed at the end; `x` is that of the static ``base:laser``."""
    options = "--seconds", f"{seconds}", "--x", f"{x}"
    process = subprocess.Popen(
        [*command, *options], env={**os.environ, **environment}, stdout=subprocess.PIPE, text=True
    )
    try:
        yield Node(process)
    finally:
        process.kill()
        process.communicate()


async def meet(link: RosLink, bus: Bus, *nodes: AbstractContextManager[Node]) -> set[str]:
    """Have all sides broadcast and ask for ten seconds, and check the answers; returns the authorities here.

    The nodes start when the link has joined, so each side has the static frames of one that came later or earlier.
    """
    with Buffer(bus) as buffer:
        program = Program(bus, buffer)
        async with link, anyio.create_task_group() as tasks:
            tasks.start_soon(program.send)
            with ExitStack() as stack:
                others = [stack.enter_context(each) for each in nodes]
                for other in others:
                    assert (await other.next_line())["event"] == "up"
                await buffer.lookup("odom", "tool", timeout=20.0)
                laser = await buffer.lookup("base", "laser", timeout=20.0)
                assert laser.transform.translation == (0.5, 0.0, 0.0)
                # What waited for the other side is late.
                program.latencies.clear()
                # The nodes end first, and nobody answers then.
                with anyio.move_on_after(SECONDS - 4.0):
                    await program.ask()
                figures = [await other.next_line() for other in others]
            tasks.cancel_scope.cancel()
    asked = program.answered + program.failed
    print({"in_ms": statistics.median(program.latencies), "asked": asked, "failed": program.failed}, *figures)
    assert program.answered > 50
    assert program.wrong == 0
    assert program.failed <= MOST_FAILED * asked
    for facts in figures:
        assert facts["answered"] > 300
        assert facts["wrong"] == 0
        assert facts["failed"] <= MOST_FAILED * (facts["answered"] + facts["failed"])
    assert link.statistics().rejected == {}
    return program.authorities
