"""The cases that both sides measure, on the same data from the same seed.

Standard library only, because `tf2_peer.py` imports this under the system's Python.
"""

import math
import random
from collections.abc import Callable
from typing import NamedTuple

AUTHORITY = "benchmark"
BASE = "base"
KEEP = 10
START = 1_000_000_000_000
PERIOD = 10_000_000
BATCH = 20
MANY = 10_000

Vector = tuple[float, float, float]
Pass = Callable[[], tuple[float, Vector]]
"""Makes all calls of a case: seconds a call, and a translation that shows that both sides did the same."""


class Case(NamedTuple):
    kind: str
    chain: str = ""
    """One letter an edge: ``m`` for a moving one, ``s`` for a static one."""


class Sample(NamedTuple):
    parent: str
    child: str
    stamp: int
    translation: Vector
    rotation: tuple[float, float, float, float]
    static: bool = False


def insertions(kind: str) -> list[Sample]:
    """Samples of one frame, or of twenty in turn; most of them fall into windows that are full."""
    rng = random.Random(1)
    if kind != "insert batches":
        return _trajectory(rng, BASE, "f0", 10_000)
    frames = [_trajectory(rng, BASE, f"f{i}", 2_000) for i in range(BATCH)]
    return [sample for together in zip(*frames, strict=True) for sample in together]


def history(chain: str) -> list[Sample]:
    """A thousand samples for each moving edge of a chain from `BASE` over f0, f1 and so on."""
    rng = random.Random(2)
    frames = [BASE, *(f"f{i}" for i in range(len(chain)))]
    samples: list[Sample] = []
    for parent, child, kind in zip(frames, frames[1:], chain, strict=False):
        samples += _trajectory(rng, parent, child, 1_000 if kind == "m" else 1, static=kind == "s")
    return samples


def questions(kind: str) -> list[int]:
    """Stamps at which every moving edge of a `history` has to interpolate."""
    rng = random.Random(3)
    if kind == "lookup newest":
        return [rng.randrange(START + 990 * PERIOD, START + 999 * PERIOD) for _ in range(2_000)]
    count = MANY if kind.startswith("many") else 2_000
    stamps = [rng.randrange(START + PERIOD, START + 999 * PERIOD) for _ in range(count)]
    return sorted(stamps) if kind == "many, sorted" else stamps


def _trajectory(rng: random.Random, parent: str, child: str, count: int, *, static: bool = False) -> list[Sample]:
    """Arbitrary poses at 100 Hz, with a phase of the edge's own."""
    phase = rng.randrange(PERIOD)
    return [Sample(parent, child, START + phase + i * PERIOD, *_pose(rng), static) for i in range(count)]


def _pose(rng: random.Random) -> tuple[Vector, tuple[float, float, float, float]]:
    x, y, z, w = (rng.gauss(0.0, 1.0) for _ in range(4))
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    return (rng.uniform(-1, 1), rng.uniform(-1, 1), rng.uniform(-1, 1)), (x / norm, y / norm, z / norm, w / norm)
