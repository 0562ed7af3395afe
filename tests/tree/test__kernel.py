"""The whole tree on both kernels: the same answers, bit for bit, and the same errors."""

import os
import random
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.both_kernels import needs_both, tfbus_on
from support.strategies import TODAY, rotations, vectors

from tfbus.stamps import STAMP_MAX, STAMP_MIN

FRAMES = "abcdef"
TREES = int(os.environ.get("KERNEL_TREES", "10000"))
"""The number of random trees in the thorough suite."""

Sample = tuple[str, str, int, tuple[float, ...], tuple[float, ...], str, bool]
Question = tuple[str, str, int | None]


def replies(kernel: str, keep: float | None, samples: list[Sample], questions: list[Question]) -> list[object]:
    """The answers of a tree on a kernel to samples and questions: values to the last bit, and whole messages."""
    tfbus = tfbus_on(kernel)
    tree = tfbus.TransformTree(keep)
    said: list[object] = []
    for parent, child, stamp, translation, rotation, authority, static in samples:
        transform = tfbus.Transform(translation, rotation)
        try:
            outcome = tree.insert(tfbus.TransformStamped(parent, child, stamp, transform, authority, static))
        except tfbus.InvalidTransformError as error:
            said.append(str(error))
        else:
            said.append(outcome.value)
    for target, source, at in questions:
        stamp = tfbus.LATEST if at is None else at
        try:
            found = tree.lookup(target, source, stamp)
        except tfbus.TransformError as error:
            said.append((type(error).__name__, str(error)))
        else:
            numbers = struct.pack("7d", *found.transform.translation, *found.transform.rotation)
            said.append((found.parent, found.child, found.stamp, found.static, numbers))
    stamps = [at for _, _, at in questions if at is not None]
    for target, source, _ in questions:
        # Not the numbers: without the compiled kernel they come from numpy, whose sine may differ in the last bit.
        try:
            many = tree.lookup_many(target, source, stamps)
        except tfbus.TransformError as error:
            said.append((type(error).__name__, str(error)))
        else:
            said.append(many.stamps.tolist())
    said.append([(edge.child, edge.parent, edge.samples, edge.oldest, edge.newest) for edge in tree.edges()])
    return said


def check(keep: float | None, samples: list[Sample], questions: list[Question]) -> list[object]:
    said = replies("compiled", keep, samples, questions)
    assert said == replies("python", keep, samples, questions)
    return said


@st.composite
def drawn_samples(draw: st.DrawFn) -> Sample:
    parent, child = draw(st.permutations(FRAMES))[:2]
    stamp = draw(st.integers(-8, 8) | st.sampled_from([STAMP_MIN, STAMP_MIN + 7, 2**53, STAMP_MAX - 1, STAMP_MAX]))
    return parent, child, stamp, draw(vectors()), draw(rotations()), draw(st.sampled_from(["", "me"])), draw(rarely())


def rarely() -> st.SearchStrategy[bool]:
    return st.integers(0, 9).map(lambda number: number == 0)


questions = st.tuples(
    st.sampled_from(FRAMES),
    st.sampled_from(FRAMES),
    st.integers(-9, 9) | st.sampled_from([None, STAMP_MIN, 2**52 + 1, STAMP_MAX]),
)


@needs_both
@given(
    st.sampled_from([0.0, 5e-9, 1.0, None]),
    st.lists(drawn_samples(), max_size=25),
    st.lists(questions, min_size=1, max_size=10),
)
def test_both_kernels_say_the_same(keep: float | None, samples: list[Sample], asked: list[Question]) -> None:
    check(keep, samples, asked)


def random_tree(rng: random.Random) -> tuple[float | None, list[Sample], list[Question]]:
    """A tree with few surprises in its shape, so that most questions are answered, and many in its numbers."""
    start = rng.choice([0, TODAY, STAMP_MIN, STAMP_MAX - 2**60, -(2**61)])
    step = rng.choice([1, 3, 10, 10**7, 10**9, 2**52 + 1, 2**55])
    samples: list[Sample] = []
    last: dict[str, tuple[float, ...]] = {}
    for moment in range(rng.randrange(1, 6)):
        for child in FRAMES[1:]:
            parent = rng.choice(FRAMES) if rng.random() < 0.02 else FRAMES[rng.randrange(FRAMES.index(child))]
            parent = FRAMES[FRAMES.index(child) - 1] if rng.random() < 0.9 or parent == child else parent
            stamp = min(start + (moment - rng.choice([0, 0, 0, 0, 1])) * step + rng.randrange(2), STAMP_MAX)
            rotation = last[child] = random_rotation(rng, last.get(child))
            place = tuple(rng.choice([rng.uniform(-9, 9), 0.0, -0.0, 1e-300, 1e9]) for _ in range(3))
            samples.append((parent, child, max(stamp, STAMP_MIN), place, rotation, "", rng.random() < 0.03))
    asked: list[Question] = [
        (rng.choice(FRAMES), rng.choice(FRAMES), None if rng.random() < 0.3 else near(rng, samples)) for _ in range(8)
    ]
    return rng.choice([None, 10.0, step * 2e-9]), samples, asked


def near(rng: random.Random, samples: list[Sample]) -> int:
    one, other = rng.choice(samples)[2], rng.choice(samples)[2]
    at = rng.choice([one, one + 1, one - 1, (one + other) // 2])
    return min(max(at, STAMP_MIN), STAMP_MAX)


def random_rotation(rng: random.Random, before: tuple[float, ...] | None) -> tuple[float, ...]:
    """Any rotation, or one that has broken slerps: the same, its negative, one that is near, one half a turn away."""
    kind = rng.randrange(6)
    if before is None or kind == 0:
        parts = [rng.gauss(0.0, 1.0) for _ in range(4)]
    elif kind == 1:
        return before
    elif kind == 2:
        return tuple(-part for part in before)
    elif kind == 3:
        parts = [part + rng.gauss(0.0, 1.0) * 10 ** rng.uniform(-17, -2) for part in before]
    elif kind == 4:
        x, y, z, w = before
        parts = [w + rng.choice([0.0, 1e-16, 1e-9]), z, -y, -x]
    else:
        parts = [-part + rng.gauss(0.0, 1.0) * 1e-8 for part in before]
    norm = sum(part * part for part in parts) ** 0.5
    return tuple(part / norm for part in parts)


@needs_both
@pytest.mark.parametrize(
    ("seed", "count"),
    [(1, 60), *(pytest.param(seed, TREES // 20, marks=pytest.mark.thorough) for seed in range(2, 22))],
)
def test_both_kernels_say_the_same_of_random_trees(seed: int, count: int) -> None:
    rng = random.Random(seed)
    answered = sum(
        isinstance(said, tuple) and len(said) == 5 for _ in range(count) for said in check(*random_tree(rng))
    )
    assert answered > 3 * count


@needs_both
def test_both_copies_of_the_package_run_on_their_kernel() -> None:
    bases = {kernel: tfbus_on(kernel).TransformStamped.__mro__[1].__module__ for kernel in ("python", "compiled")}
    assert bases == {"python": "tfbus._python_kernel", "compiled": "tfbus._kernel"}
