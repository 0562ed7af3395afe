"""The speed at which a recording is read, and the time and memory of ``tfbus info`` on a large one."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import pytest
from beside import Table
from mcap.writer import Writer

from tfbus import Transform, TransformStamped
from tfbus.recording import load
from tfbus.tf_message import encode

pytest_plugins = ["side_by_side"]

TFBUS = str(Path(sys.executable).with_name("tfbus"))
FRAMES = 50
SENDERS = 5
START = 1_700_000_000_000_000_000
ROUNDS = 3
LOADED = 200_000
MILLION = 1_000_000

Write = Callable[[int, int], Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Writes a recording of so many transforms, some in each message, as a recorder does."""

    def write_recording(total: int, at_once: int) -> Path:
        path = tmp_path / f"{total}-{at_once}.mcap"
        with path.open("wb") as file:
            writer: Any = Writer(file, 32 * 1024)
            writer.start("ros2", "benchmark")
            kind = writer.register_schema("tf2_msgs/msg/TFMessage", "ros2msg", b"")
            senders = [json.dumps([[f"node {number}", 1]]) for number in range(SENDERS)]
            channels = [writer.register_channel("/tf", "cdr", kind, {"tfbus.authorities": its}) for its in senders]
            for first in range(0, total, at_once):
                samples = [sample(number) for number in range(first, first + at_once)]
                received = samples[-1].stamp + 50_000
                writer.add_message(channels[first // at_once % SENDERS], received, encode(samples), received)
            writer.finish()
        return path

    return write_recording


def sample(number: int) -> TransformStamped:
    """The next one of a chain of frames, each at 100 Hz."""
    tick, frame = divmod(number, FRAMES)
    turned = Transform.from_axis_angle((0.0, 0.0, 1.0), tick / 100, (1.0, tick / 1_000, float(frame)))
    return TransformStamped(f"f{frame - 1}" if frame else "map", f"f{frame}", START + tick * 10_000_000, turned)


@pytest.mark.parametrize("at_once", [1, 20])
def test_load(table: Table, write: Write, at_once: int) -> None:
    path = write(LOADED, at_once)
    rates = []
    for _ in range(ROUNDS):
        start = perf_counter()
        tree = load(path)
        rates.append(LOADED / (perf_counter() - start))
        assert tree.inserted == LOADED
    table.add(f"load, {at_once} in a message", f"{sorted(rates)[ROUNDS // 2]:,.0f}/s", wanted=">= 50,000/s")


@pytest.mark.parametrize("command", ["info", "query"])
def test_a_million_transforms(table: Table, write: Write, command: str) -> None:
    path = write(MILLION, 1)
    question = (
        ["info", str(path), "--json"] if command == "info" else ["query", str(path), "map", f"f{FRAMES - 1}", "--csv"]
    )
    start = perf_counter()
    process = subprocess.Popen([TFBUS, *question], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    seconds = perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0
    memory = usage.ru_maxrss / 1024
    wanted = "<= 30 s, 400 MB" if command == "info" else ""
    table.add(f"{command}, a million transforms", f"{seconds:.1f} s, {memory:.0f} MB", wanted=wanted)
