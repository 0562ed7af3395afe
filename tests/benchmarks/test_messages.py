"""Messages of ROS, beside rosbags: the twenty transforms of a robot, to and from bytes."""

import random
from collections.abc import Callable
from time import perf_counter
from typing import Any

import cases
import numpy as np
import pytest
from beside import Table, build, show
from rosbags.typesys import Stores, get_typestore

from tfbus import TransformStamped
from tfbus.tf_message import decode, encode

pytest_plugins = ["side_by_side"]

ROUNDS = 25
CALLS = 200
MESSAGE = "tf2_msgs/msg/TFMessage"
ROS = get_typestore(Stores.ROS2_JAZZY)


def robot(name: str = "joint {}") -> list[TransformStamped]:
    """One batch of twenty frames, at places and in attitudes that need all digits."""
    samples = [build(sample) for sample in cases.insertions("insert batches")[: cases.BATCH]]
    return [sample.replace(child=name.format(place)) for place, sample in enumerate(samples)]


def seconds_of(call: Callable[[], object]) -> float:
    """Of one call."""
    start = perf_counter()
    for _ in range(CALLS):
        call()
    return (perf_counter() - start) / CALLS


def compare(
    table: Table, benchmark: Any, label: str, ours: Callable[[], object], peer: Callable[[], object], wanted: str = ""
) -> None:
    our_rounds: list[float] = []
    peer_rounds: list[float] = []
    benchmark.pedantic(
        lambda: our_rounds.append(seconds_of(ours)),
        setup=lambda: peer_rounds.append(seconds_of(peer)),
        rounds=ROUNDS,
    )
    table.compare(label, our_rounds, "rosbags", peer_rounds, wanted)


def test_encoding(benchmark: Any, table: Table) -> None:
    samples = robot()
    payload = encode(samples)
    message = ROS.deserialize_cdr(payload, MESSAGE)
    assert bytes(ROS.serialize_cdr(message, MESSAGE)) == payload
    compare(
        table,
        benchmark,
        "encode 20 transforms",
        lambda: encode(samples),
        lambda: ROS.serialize_cdr(message, MESSAGE),
        "<= 20 us",
    )


def rounded(payload: bytes) -> bytes:
    """The message as somebody sends it who has single precision."""
    message = ROS.deserialize_cdr(payload, MESSAGE)
    for transform in message.transforms:  # type: ignore[attr-defined]
        rotation = transform.transform.rotation
        for axis in "xyzw":
            setattr(rotation, axis, float(np.float32(getattr(rotation, axis))))
    return bytes(ROS.serialize_cdr(message, MESSAGE))


@pytest.mark.parametrize(
    ("label", "precise", "little_endian"),
    [
        ("decode 20 transforms", True, True),
        ("decode 20 transforms, to normalise", False, True),
        ("decode 20 transforms, big endian", True, False),
    ],
)
def test_decoding(benchmark: Any, table: Table, label: str, precise: bool, little_endian: bool) -> None:
    samples = robot()
    payload = encode(samples) if precise else rounded(encode(samples))
    tags = [(sample.authority, sample.static) for sample in samples]
    if not little_endian:
        message = ROS.deserialize_cdr(payload, MESSAGE)
        payload = bytes(ROS.serialize_cdr(message, MESSAGE, little_endian=False))
    decoded = decode(payload, tags).samples
    if precise:
        assert decoded == samples
    compare(
        table,
        benchmark,
        label,
        lambda: decode(payload, tags),
        lambda: ROS.deserialize_cdr(payload, MESSAGE),
        "<= 40 us",
    )


def test_decoding_names_that_are_always_new(table: Table) -> None:
    """The cost of a peer that makes up names: nothing of it can be remembered."""
    rng = random.Random(4)
    payloads = [encode(robot(f"{rng.getrandbits(64):x} {{}}")) for _ in range(CALLS)]
    rounds: list[float] = []
    for payload in payloads:
        start = perf_counter()
        decode(payload)
        rounds.append(perf_counter() - start)
    table.add("decode 20 transforms, names never seen", show(rounds, "us"))
