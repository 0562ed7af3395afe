"""Many processes with a link each that start at once: how long until every bus has every static frame.

Each has some static frames, and as many moving ones, which it publishes all the while.
"""

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any
from uuid import uuid4

import anyio

from tfbus import Bus, Transform, TransformBroadcaster, TransformStamped
from tfbus.links.zenoh import ZenohLink

IMPORTS = "import start_together"
PATIENCE = 120.0
"""Seconds from the last start; who has not all frames by then is counted as without them."""


async def live(
    number: int, processes: int, frames: int, rate: float, lease: float | None, domain: str, address: str
) -> None:
    """Be one of the processes."""
    wanted = processes * frames
    held: set[str] = set()
    side = {"listen": address} if number == 0 else {"connect": address}

    def note(batch: tuple[TransformStamped, ...]) -> None:
        before = len(held)
        held.update(sample.child for sample in batch if sample.static)
        if before < len(held) == wanted:
            print("all", flush=True)

    with Bus() as bus:
        bus.subscribe(note)
        broadcaster = TransformBroadcaster(bus, authority=f"p{number}")
        for frame in range(frames):
            broadcaster.send_static("map", f"static {number} {frame}", Transform())
        async with ZenohLink(bus, domain, lease=lease, **side):  # type: ignore[arg-type]
            async for _ in bus.clock.ticks(rate):
                broadcaster.send_all([("map", f"moving {number} {frame}", Transform()) for frame in range(frames)])


def measure(processes: int, frames: int = 20, rate: float = 20.0, lease: float | None = None) -> list[float]:
    """Seconds from the last start until each process has all static frames; infinite for one that has not."""
    # The other processes do not find it.
    from support.processes import free_address

    task: dict[str, Any] = {
        "processes": processes,
        "frames": frames,
        "rate": rate,
        "lease": lease,
        "domain": f"start-{uuid4().hex}",
        "address": free_address(),
    }
    with tempfile.TemporaryDirectory() as folder:
        # As of a package that is installed: else each process compiles all modules where no bytecode may be written.
        compiled = os.environ | {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": folder}
        subprocess.run([sys.executable, "-c", IMPORTS], env=compiled, cwd=Path(__file__).parent, check=True)
        return _measure(task, [float("inf")] * processes, compiled)


def _measure(task: dict[str, Any], ends: list[float], environment: dict[str, str]) -> list[float]:
    started: list[subprocess.Popen[str]] = []

    def read(number: int, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        if process.stdout.readline():
            ends[number] = time.monotonic()

    readers = []
    try:
        for number in range(len(ends)):
            command = [sys.executable, __file__, json.dumps(task | {"number": number})]
            started.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment))
            readers.append(threading.Thread(target=read, args=(number, started[-1])))
            readers[-1].start()
        last = time.monotonic()
        for reader in readers:
            reader.join(max(0.0, last + PATIENCE - time.monotonic()))
    finally:
        for process in started:
            process.kill()
        for process in started:
            process.wait()
        for reader in readers:
            reader.join()
        for process in started:
            assert process.stdout is not None
            process.stdout.close()
    return [end - last for end in ends]


if __name__ == "__main__":
    anyio.run(lambda: live(**json.loads(sys.argv[1])))
