"""Many processes with a link each that start at once: how long until every bus has every static frame.

Each has some static frames, and as many moving ones, which it publishes all the while.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from threading import Timer
from typing import Any
from uuid import uuid4

import anyio

from tfbus import Bus, Transform, TransformBroadcaster, TransformStamped
from tfbus.links.zenoh import ZenohLink

PATIENCE = 120.0
"""Seconds from the last start; a process that has not all frames by then counts as one without them."""
FRAMES, RATE = 20, 20.0


async def live(number: int, processes: int, domain: str, address: str) -> None:
    """Be one of the processes; print the time at which all static frames were there."""
    wanted = processes * FRAMES
    held: set[str] = set()
    side: dict[str, Any] = {"connect" if number else "listen": address}

    def note(batch: tuple[TransformStamped, ...]) -> None:
        before = len(held)
        held.update(sample.child for sample in batch if sample.static)
        if before < len(held) == wanted:
            print(time.monotonic(), flush=True)

    with Bus() as bus:
        bus.subscribe(note)
        broadcaster = TransformBroadcaster(bus, authority=f"p{number}")
        for frame in range(FRAMES):
            broadcaster.send_static("map", f"static {number} {frame}", Transform())
        async with ZenohLink(bus, domain, **side):
            async for _ in bus.clock.ticks(RATE):
                broadcaster.send_all([("map", f"moving {number} {frame}", Transform()) for frame in range(FRAMES)])


def measure(processes: int) -> list[float]:
    """Seconds from the last start until each process has all static frames; infinite for one that has not."""
    # The other processes do not find it.
    from support.processes import free_address

    task = {"processes": processes, "domain": f"start-{uuid4().hex}", "address": free_address()}
    started: list[subprocess.Popen[str]] = []

    def end_all() -> None:
        for process in started:
            process.kill()

    with tempfile.TemporaryDirectory() as folder:
        # As of a package that is installed: else each process compiles all modules where no bytecode may be written.
        compiled = os.environ | {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": folder}
        imports = [sys.executable, "-c", "import start_together"]
        subprocess.run(imports, env=compiled, cwd=Path(__file__).parent, check=True)
        try:
            for number in range(processes):
                command = [sys.executable, __file__, json.dumps(task | {"number": number})]
                started.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=compiled))
            last = time.monotonic()
            patience = Timer(PATIENCE, end_all)
            patience.start()
            ends = [process.stdout.readline() for process in started if process.stdout is not None]
            patience.cancel()
        finally:
            end_all()
            for process in started:
                process.communicate()
    return [float(end or "inf") - last for end in ends]


if __name__ == "__main__":
    anyio.run(lambda: live(**json.loads(sys.argv[1])))
