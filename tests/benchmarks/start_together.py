"""Many processes with a link each that start at once: how long until every bus has every static frame, and what then.

Each has some static frames, and as many moving ones, which it publishes all the while.
"""

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from threading import Timer
from typing import Any, NamedTuple

import anyio
from support.peer_process import link_of
from support.processes import Place

from tfbus import SECOND, Bus, Transform, TransformBroadcaster, TransformStamped

PATIENCE = 60.0
"""Seconds from the last start; a process that has not all frames by then counts as one without them."""
FRAMES, RATE = 20, 20.0


class Facts(NamedTuple):
    """The findings of one process."""

    met: float
    """Seconds from the last start until it had all static frames; infinite if it never had."""
    linked: float
    """The same from the moment when the last process, with all its imports, began its link."""
    delay: float
    """The median of the seconds from the stamp of a sample until it was here, later; infinite if it has ended."""


async def live(number: int, processes: int, link: dict[str, Any], seconds: float) -> None:
    """Be one of the processes; print when all static frames were there, and then the delay of samples again and again.

    The first line has the time of the link's beginning, and that at which all static frames were there; each other line
    the beginning of a period of some `seconds`, and the median delay in it.
    """
    wanted = processes * FRAMES
    held: set[str] = set()
    delays: list[float] = []
    met = math.inf

    def note(batch: tuple[TransformStamped, ...]) -> None:
        nonlocal met
        now = time.time_ns()
        if len(held) < wanted:
            held.update(sample.child for sample in batch if sample.static)
            met = time.monotonic() if len(held) == wanted else met
        elif not batch[0].static and batch[0].authority != f"p{number}":
            delays.append((now - batch[0].stamp) / SECOND)

    with Bus() as bus:
        bus.subscribe(note)
        broadcaster = TransformBroadcaster(bus, authority=f"p{number}")
        for frame in range(FRAMES):
            broadcaster.send_static("map", f"static {number} {frame}", Transform())
        began = time.monotonic()
        async with link_of(bus, link):
            await bus.clock.sleep(number / processes / RATE)
            period = math.inf
            async for _ in bus.clock.ticks(RATE):
                broadcaster.send_all([("map", f"moving {number} {frame}", Transform()) for frame in range(FRAMES)])
                now = time.monotonic()
                if period == math.inf and met < now:
                    print(json.dumps([began, met]), flush=True)
                elif now < period + seconds:
                    continue
                else:
                    print(json.dumps([period, median(delays or [math.inf])]), flush=True)
                delays.clear()
                period = now


def measure(processes: int, place: Place, seconds: float = 0.0, *, stay: int | None = None) -> list[Facts]:
    """Start them; when each has all static frames, end all but so many, and measure the delay for some `seconds`."""
    started: list[subprocess.Popen[str]] = []

    def end_all() -> None:
        for process in started:
            process.kill()

    with tempfile.TemporaryDirectory() as folder:
        # As of a package that is installed: else each process compiles all modules where no bytecode may be written.
        paths = os.pathsep.join(sys.path)
        compiled = os.environ | {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": folder, "PYTHONPATH": paths}
        modules = ["start_together", *["tfbus.links.zenoh"] * (place.carrier == "router")]
        imports = [sys.executable, "-P", "-c", f"import {', '.join(modules)}"]
        subprocess.run(imports, env=compiled, cwd=Path(__file__).parent, check=True)
        try:
            for number in range(processes):
                task: dict[str, Any] = {"number": number, "processes": processes, "seconds": seconds}
                task["link"] = place.other() if number else place.first()
                command = [sys.executable, __file__, json.dumps(task)]
                started.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=compiled))
            last = time.monotonic()
            patience = Timer(PATIENCE, end_all)
            patience.start()
            firsts = [_read(process) for process in started]
            patience.cancel()
            for process in started[stay:] if stay else ():
                process.kill()
            calm = time.monotonic() + seconds / 2
            delays = [_delay_after(process, calm) if seconds else math.inf for process in started[:stay]]
        finally:
            end_all()
            for process in started:
                process.communicate()
    found = [first or (0.0, math.inf) for first in firsts]
    linked = max(began for began, _ in found)
    delays += [math.inf] * (processes - len(delays))
    return [Facts(met - last, met - linked, delay) for (_, met), delay in zip(found, delays, strict=True)]


def _read(process: "subprocess.Popen[str]") -> tuple[float, float] | None:
    """The next line that a process prints; None if it has ended."""
    assert process.stdout is not None
    line = process.stdout.readline()
    return json.loads(line) if line else None


def _delay_after(process: "subprocess.Popen[str]", time: float) -> float:
    """The delay in the first period of a process that begins after a time."""
    while (period := _read(process)) is not None:
        if period[0] >= time:
            return period[1]
    return math.inf


if __name__ == "__main__":
    anyio.run(lambda: live(**json.loads(sys.argv[1])))
