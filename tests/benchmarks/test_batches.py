"""Many stamps and many points at once, beside the libraries that do the same and a loop over tf2.

All sides take turns in each round, as in `test_speed.py`, and their answers are compared. The packages have to be
installed for it; a side that is missing is named in the table. transform-tree and tfbus give the same transforms, one
as matrices, the other as columns. pytransform3d moves along screws, so that it agrees at the samples only, and it is
checked there.
"""

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from itertools import pairwise
from time import perf_counter
from typing import Any, NamedTuple

import cases
import numpy as np
import numpy.typing as npt
import pytest
from beside import Ask, Table, build, show
from cases import BASE, MANY, PERIOD, START, Case
from support.both_kernels import COMPILED, tfbus_on

import tfbus
from tfbus import SECOND, PointCloud, Transform, TransformArray, TransformStamped, TransformTree, do_transform

pytest_plugins = ["side_by_side"]

ROUNDS = 25
FEW_ROUNDS = 7
"""For what takes pytransform3d up to a second."""
POINTS = 100_000
SWEEP = SECOND // 10
HANDFUL = 5
WANTED = {1: "<= 250 ns", 3: "<= 650 ns"}
TO_REACH = {10: "<= 0.7", 1_000: "<= 0.7", 100_000: "<= 0.5"}

Floats = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]
Points = npt.NDArray[np.float32]
Turn = Callable[[], float]
"""Has one side do its work once: seconds for each stamp, or for all points."""


def timed(call: Callable[[], Any], count: int = 1) -> Turn:
    def one_turn() -> float:
        # The turn of another side has left other things in the caches.
        call()
        start = perf_counter()
        call()
        return (perf_counter() - start) / count

    return one_turn


def take_turns(
    benchmark: Any, ours: Turn, peers: list[Turn], rounds: int = ROUNDS
) -> tuple[list[float], list[list[float]]]:
    """The seconds of each round, ours and each peer's."""
    our_rounds: list[float] = []
    their_rounds: list[list[float]] = [[] for _ in peers]

    def their_turns() -> None:
        for turn, seconds in zip(peers, their_rounds, strict=True):
            seconds.append(turn())

    benchmark.pedantic(lambda: our_rounds.append(ours()), setup=their_turns, rounds=rounds)
    return our_rounds, their_rounds


def last_of(chain: str) -> str:
    return f"f{len(chain) - 1}"


def tree_of(chain: str) -> TransformTree:
    tree = TransformTree(keep=2.0 * cases.KEEP)
    tree.insert_many(build(sample) for sample in cases.history(chain))
    return tree


class Series(NamedTuple):
    """One edge as arrays."""

    parent: str
    child: str
    stamps: Stamps
    translations: Floats
    wxyz: Floats


def series_of(chain: str) -> list[Series]:
    frames = [BASE, *(f"f{i}" for i in range(len(chain)))]
    samples = cases.history(chain)
    series = []
    for parent, child in pairwise(frames):
        own = [sample for sample in samples if sample.child == child]
        x, y, z, w = np.array([sample.rotation for sample in own]).T
        stamps = np.array([sample.stamp for sample in own])
        translations = np.array([sample.translation for sample in own])
        series.append(Series(parent, child, stamps, translations, np.stack((w, x, y, z), axis=1)))
    return series


def transform_tree_of(chain: str) -> Any | None:
    """The tree of transform-tree, interpolating as tf2 does; None if it is not installed."""
    if find_spec("tf_tree") is None:
        return None
    series = series_of(chain)
    tree = import_module("tf_tree").build([(s.parent, s.child) for s in series], capacity=1024, interp="lerpslerp")
    for parent, child, stamps, translations, wxyz in series:
        with tree.publisher(child, parent) as publisher:
            publisher.push_many(stamps, np.hstack((wxyz, translations)))
    return tree


def transform_tree(chain: str) -> Callable[[Stamps], Floats] | None:
    """The answers of transform-tree at many stamps; None if it is not installed."""
    tree = transform_tree_of(chain)
    if tree is None:
        return None
    matrices: Callable[[Stamps], Floats] = tree.plan(BASE, last_of(chain)).at
    return matrices


def pytransform3d(chain: str) -> Callable[[Stamps], Floats] | None:
    """pytransform3d's side, whose time is in seconds; None if it is not installed."""
    if find_spec("pytransform3d") is None:
        return None
    manager = import_module("pytransform3d.transform_manager")
    transforms = manager.TemporalTransformManager()
    for parent, child, stamps, translations, wxyz in series_of(chain):
        motion = manager.NumpyTimeseriesTransform((stamps - START) / SECOND, np.hstack((translations, wxyz)))
        transforms.add_transform(child, parent, motion)

    def matrices(stamps: Stamps) -> Floats:
        found: Floats = transforms.get_transform_at_time(last_of(chain), BASE, (stamps - START) / SECOND)
        return found

    return matrices


@pytest.mark.parametrize("edges", [1, 3, 10])
def test_one_lookup_by_name(benchmark: Any, table: Table, edges: int) -> None:
    chain = "m" * edges
    peer = transform_tree_of(chain)
    if peer is None:
        pytest.skip("no transform-tree to measure beside")
    source, stamps = last_of(chain), cases.questions("lookup")

    def with_each(ask: Callable[[str, str, int], Any]) -> Turn:
        return timed(lambda: [ask(BASE, source, stamp) for stamp in stamps], len(stamps))

    def on(package: Any) -> Turn:
        tree = package.TransformTree(keep=2.0 * cases.KEEP)
        tree.insert_many(build(sample, package) for sample in cases.history(chain))
        found = tree.lookup(BASE, source, stamps[0]).transform.matrix()
        np.testing.assert_allclose(found, peer.lookup(BASE, source, stamps[0]), rtol=0, atol=1e-12)
        return with_each(tree.lookup)

    other = "python" if tfbus.kernel == "compiled" else "compiled"
    peers = [with_each(peer.lookup)]
    if other == "python" or COMPILED is not None:
        peers.append(on(tfbus_on(other)))
    ours, theirs = take_turns(benchmark, on(tfbus), peers)
    label = f"lookup by name, {edges} edge{'s' * (edges > 1)}"
    table.compare(label, ours, "transform-tree", theirs[0], "<= 0.6", unit="ns")
    for rounds in theirs[1:]:
        table.compare(f"  on the {other} kernel", rounds, "transform-tree", theirs[0], unit="ns")


@pytest.mark.parametrize("order", ["sorted", "random"])
@pytest.mark.parametrize("edges", [1, 3, 10])
def test_many_stamps(benchmark: Any, table: Table, tf2: Ask | str, edges: int, order: str) -> None:
    chain = "m" * edges
    case = Case(f"many, {order}", chain)
    tree, source = tree_of(chain), last_of(chain)
    stamps = np.array(cases.questions(case.kind))
    assert len(stamps) == MANY
    found = tree.lookup_many(BASE, source, stamps)
    peers: dict[str, Turn] = {}
    absent: list[str] = []

    matrices = transform_tree(chain)
    if matrices is None:
        absent.append("transform-tree")
    else:
        np.testing.assert_allclose(found.matrices(), matrices(stamps), rtol=0, atol=1e-12)
        peers["transform-tree"] = timed(lambda: matrices(stamps), MANY)

    along_screws = pytransform3d(chain)
    if along_screws is None:
        absent.append("pytransform3d")
    else:
        if edges == 1:
            samples = series_of(chain)[0].stamps[1:-1]
            at_samples = tree.lookup_many(BASE, source, samples).matrices()
            np.testing.assert_allclose(at_samples, along_screws(samples), rtol=0, atol=1e-12)
        peers["pytransform3d"] = timed(lambda: along_screws(stamps), MANY)

    if isinstance(tf2, str):
        absent.append("tf2")
    else:
        assert found[-1].translation == pytest.approx(tf2(case)[1], abs=1e-6)
        peers["tf2 in a loop"] = lambda: tf2(case)[0]

    our_turn = timed(lambda: tree.lookup_many(BASE, source, stamps), MANY)
    ours, theirs = take_turns(benchmark, our_turn, [*peers.values()], FEW_ROUNDS)
    label = f"lookup_many, {edges} edge{'s' * (edges > 1)}, {order}"
    table.add(label, show(ours, "ns"), wanted=WANTED.get(edges, ""))
    for name, rounds in zip(peers, theirs, strict=True):
        table.compare("", ours, name, rounds, "<= 0.125" if name == "tf2 in a loop" else "", unit="ns")
    for name in absent:
        table.add("", "", f"{name} is not there")


@pytest.mark.parametrize("count", [10, 1_000, 100_000])
@pytest.mark.parametrize("read", [False, True])
def test_stamps_in_order_on_both_kernels(benchmark: Any, table: Table, count: int, read: bool) -> None:
    """`read` makes the arrays of the answer as well, which are else made when somebody reads them."""
    chain = "mmm"
    matrices = transform_tree(chain)
    if matrices is None:
        pytest.skip("no transform-tree to measure beside")
    stamps = np.sort(np.random.default_rng(6).integers(START + PERIOD, START + 999 * PERIOD, count))
    repeats = max(1, 3_000 // count)

    def on(package: Any) -> Turn:
        tree = package.TransformTree(keep=2.0 * cases.KEEP)
        tree.insert_many(build(sample, package) for sample in cases.history(chain))

        def ask() -> None:
            for _ in range(repeats):
                found = tree.lookup_many(BASE, "f2", stamps)
                if read:
                    _ = found.translations, found.rotations

        return timed(ask, count * repeats)

    other = "python" if tfbus.kernel == "compiled" else "compiled"
    peers = [timed(lambda: [matrices(stamps) for _ in range(repeats)], count * repeats)]
    if other == "python" or COMPILED is not None:
        peers.append(on(tfbus_on(other)))
    ours, theirs = take_turns(benchmark, on(tfbus), peers)
    label = f"lookup_many, {count:,} in order" + ", arrays read" * read
    table.compare(label, ours, "transform-tree", theirs[0], "" if read else TO_REACH[count], unit="ns")
    for rounds in theirs[1:]:
        table.compare(f"  on the {other} kernel", rounds, "transform-tree", theirs[0], unit="ns")


def scattered_points() -> Points:
    return np.random.default_rng(4).uniform(-50.0, 50.0, (POINTS, 3)).astype(np.float32)


@pytest.mark.parametrize(("name", "span"), [("a sweep of 0.1 s", SWEEP), ("10 s of history", 998 * PERIOD)])
def test_deskew(benchmark: Any, table: Table, name: str, span: int) -> None:
    tree, frame, points = tree_of("m"), "f0", scattered_points()
    stamps = np.sort(np.random.default_rng(5).integers(START + PERIOD, START + PERIOD + span, POINTS))
    at = int(stamps[-1])
    cloud = PointCloud(frame, at, points, stamps=stamps)
    found = tree.lookup_many(BASE, frame, stamps)
    matrices = transform_tree("m")
    label = f"deskew 100,000 points, {name}"
    peers = [timed(lambda: found.apply(points))]
    if matrices is not None:

        def in_one_frame() -> Floats:
            base_from_frame = matrices(stamps)
            frame_from_base = np.linalg.inv(matrices(stamps[-1:])[0])
            in_base = np.einsum("nij,nj->ni", base_from_frame[:, :3, :3], points) + base_from_frame[:, :3, 3]
            moved: Floats = in_base @ frame_from_base[:3, :3].T + frame_from_base[:3, 3]
            return moved

        np.testing.assert_allclose(tree.deskew(cloud, frame, BASE).points, in_one_frame(), rtol=0, atol=2e-5)
        peers.append(timed(in_one_frame))
    ours, theirs = take_turns(benchmark, timed(lambda: tree.deskew(cloud, frame, BASE)), peers)
    table.compare(label, ours, "numpy with known transforms", theirs[0], "<= 4", unit="ms")
    for rounds in theirs[1:]:
        table.compare("", ours, "transform-tree, einsum", rounds, "<= 20 ms", unit="ms")


def test_one_transform_for_all_points(benchmark: Any, table: Table) -> None:
    transform = Transform.from_axis_angle((1.0, 2.0, 3.0), 0.7, (1.0, 2.0, 3.0))
    answer = TransformStamped(BASE, "f0", START, transform)
    cloud = PointCloud("f0", START, scattered_points())
    matrix = transform.matrix().astype(np.float32)
    turn, translation = matrix[:3, :3], matrix[:3, 3]

    def bare() -> Points:
        return cloud.points @ turn.T + translation

    moved = do_transform(cloud, answer).points
    assert moved.dtype == np.float32
    np.testing.assert_allclose(moved, bare(), rtol=0, atol=2e-5)
    ours, theirs = take_turns(benchmark, timed(lambda: do_transform(cloud, answer)), [timed(bare)])
    table.compare("do_transform 100,000 points, float32", ours, "points @ R.T + t", theirs[0], "<= 1.5", unit="ms")


@pytest.mark.parametrize("form", ["list", "array"])
@pytest.mark.parametrize("edges", [1, 3, 10])
def test_a_handful_of_stamps(benchmark: Any, table: Table, edges: int, form: str) -> None:
    """So few stamps that one call of numpy costs as much as several lookups: `lookup_many` must not be slower."""
    chain = "m" * edges
    tree, source, stamps = tree_of(chain), last_of(chain), cases.questions("few")
    handfuls = [stamps[i : i + HANDFUL] for i in range(0, len(stamps), HANDFUL)]
    asked: list[Any] = handfuls if form == "list" else [np.array(handful) for handful in handfuls]

    def at_once() -> list[TransformArray]:
        ask = tree.lookup_many
        return [ask(BASE, source, handful) for handful in asked]

    def one_by_one() -> list[list[TransformStamped]]:
        ask = tree.lookup
        return [[ask(BASE, source, stamp) for stamp in handful] for handful in handfuls]

    for array, answers in zip(at_once(), one_by_one(), strict=True):
        assert [*array] == [answer.transform for answer in answers]
    count = len(handfuls)
    ours, theirs = take_turns(benchmark, timed(at_once, count), [timed(one_by_one, count)])
    label = f"lookup_many of 5 in a{'n' * (form == 'array')} {form}, {edges} edge{'s' * (edges > 1)}"
    table.compare(label, ours, "5 lookups", theirs[0], "<= 1.2")
