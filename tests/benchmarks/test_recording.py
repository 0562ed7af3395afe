"""Messages of ROS, to and from bytes, beside rosbags; the speed at which a recording is read; the cost of commands."""

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import anyio
import cases
import numpy as np
import pytest
from beside import Table, Turn, build, take_turns, timed
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore
from support.processes import TFBUS

from tfbus import Buffer, Bus, SimulatedClock, SystemClock, Transform, TransformStamped
from tfbus.recording import Player, convert, load
from tfbus.tf_message import decode, encode

pytest_plugins = ["side_by_side"]

CALLS = 200
MESSAGE = "tf2_msgs/msg/TFMessage"
ROS = get_typestore(Stores.ROS2_JAZZY)


def robot() -> list[TransformStamped]:
    """One batch of twenty frames, at places and in attitudes that need all digits."""
    samples = build(cases.insertions("insert batches")[: cases.BATCH])
    return [sample.replace(child=f"joint {place}") for place, sample in enumerate(samples)]


def repeated(call: Callable[[], object]) -> Turn:
    return timed(lambda: [call() for _ in range(CALLS)], CALLS)


def rounded(payload: bytes) -> bytes:
    """The message as somebody sends it who has single precision."""
    message = ROS.deserialize_cdr(payload, MESSAGE)
    for transform in message.transforms:  # type: ignore[attr-defined]
        rotation = transform.transform.rotation
        for axis in "xyzw":
            setattr(rotation, axis, float(np.float32(getattr(rotation, axis))))
    return bytes(ROS.serialize_cdr(message, MESSAGE))


def test_messages(table: Table) -> None:
    samples = robot()
    tags = [(sample.authority, sample.static) for sample in samples]
    payload = encode(samples)
    message = ROS.deserialize_cdr(payload, MESSAGE)
    assert bytes(ROS.serialize_cdr(message, MESSAGE)) == payload
    assert decode(payload, tags).samples == samples
    big_endian = bytes(ROS.serialize_cdr(message, MESSAGE, little_endian=False))
    ours, theirs = take_turns(repeated(lambda: encode(samples)), repeated(lambda: ROS.serialize_cdr(message, MESSAGE)))
    table.compare("encode 20 transforms", ours, "rosbags", theirs, "<= 20 us")
    for kind, data in (("", payload), (", to normalise", rounded(payload)), (", big endian", big_endian)):
        ours, theirs = take_turns(
            repeated(partial(decode, data, tags)), repeated(partial(ROS.deserialize_cdr, data, MESSAGE))
        )
        table.compare(f"decode 20 transforms{kind}", ours, "rosbags", theirs, "<= 40 us")


# Recordings

FRAMES = 50
SENDERS = 5
START = 1_700_000_000_000_000_000
ROUNDS = 3
LOADED = 200_000
MILLION = 1_000_000
PLAYED = 100_000

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


@pytest.mark.parametrize(("clock", "wanted"), [(SystemClock, ">= 300,000/s"), (SimulatedClock, ">= 150,000/s")])
def test_play(table: Table, write: Write, clock: type[SystemClock | SimulatedClock], wanted: str) -> None:
    path = write(PLAYED, 1)
    rates = []
    for _ in range(ROUNDS):
        with Bus(clock()) as bus, Buffer(bus) as buffer:
            start = perf_counter()
            anyio.run(Player(bus, path, rate=math.inf).play)
            rates.append(PLAYED / (perf_counter() - start))
            assert buffer.tree.inserted == PLAYED
    table.add(f"play, 1 in a message, {clock.__name__}", f"{max(rates):,.0f}/s", wanted=wanted)


def test_convert(table: Table, write: Write, tmp_path: Path) -> None:
    path = write(PLAYED, 1)
    rates = []
    for number in range(ROUNDS):
        start = perf_counter()
        assert convert([path], tmp_path / f"copy {number}.mcap").transforms == PLAYED
        rates.append(PLAYED / (perf_counter() - start))
    table.add("convert, 1 in a message", f"{max(rates):,.0f}/s", wanted=">= 260,000/s")


@pytest.mark.parametrize(
    ("command", "question", "wanted"),
    [("info", ["--json"], "<= 30 s, 400 MB"), ("query", ["map", f"f{FRAMES - 1}", "--csv"], "")],
)
def test_a_million_transforms(table: Table, write: Write, command: str, question: list[str], wanted: str) -> None:
    path = write(MILLION, 1)
    start = perf_counter()
    process = subprocess.Popen([TFBUS, command, path, *question], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    seconds, memory = perf_counter() - start, usage.ru_maxrss / 1024
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0
    table.add(f"{command}, a million transforms", f"{seconds:.1f} s, {memory:.0f} MB", wanted=wanted)


@pytest.mark.parametrize(("words", "wanted"), [("--version", "<= 50 ms"), ("tree --help", "<= 250 ms")])
def test_the_start_of_the_command(table: Table, words: str, wanted: str) -> None:
    def start(*command: str) -> float:
        """The seconds of the processor that it takes to run a command."""
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        assert process.returncode == 0
        return usage.ru_utime + usage.ru_stime

    ours, bare = take_turns(partial(start, TFBUS, *words.split()), partial(start, sys.executable, "-c", "pass"))
    table.compare(f"tfbus {words}", ours, "bare Python", bare, wanted, "ms")
