"""Many stamps and many points at once, beside the libraries that do the same and a loop over tf2.

The sides take turns in each round, and their answers are compared; a benchmark whose peer is not installed is skipped.
transform-tree and tfbus give the same transforms, one as matrices, the other as columns.
"""

from collections.abc import Callable
from itertools import count, pairwise
from time import perf_counter, thread_time
from typing import Any, NamedTuple

import cases
import numpy as np
import numpy.typing as npt
import pytest
from beside import Ask, Table, Turn, edges, last_of, take_turns, timed, tree_of
from cases import BASE, MANY, PERIOD, START, Case

from tfbus import SECOND, PointCloud, TransformStamped

pytest_plugins = ["side_by_side"]

FEW_ROUNDS = 7
POINTS = 100_000
SWEEP = SECOND // 10
HANDFUL = 5
TO_REACH = {10: "<= 0.7", 1_000: "<= 0.7", 100_000: "<= 0.5"}

CHAINS = pytest.mark.parametrize("chain", ["m", "mmm", "m" * 10], ids=edges)

Floats = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]
Points = npt.NDArray[np.float32]


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


def transform_tree_of(series: list[Series]) -> Any:
    """The tree of transform-tree, interpolating as tf2 does."""
    tf_tree = pytest.importorskip("tf_tree")
    tree = tf_tree.build([(each.parent, each.child) for each in series], capacity=1024, interp="lerpslerp")
    for parent, child, stamps, translations, wxyz in series:
        with tree.publisher(child, parent) as publisher:
            publisher.push_many(stamps, np.hstack((wxyz, translations)))
    return tree


def transform_tree(chain: str) -> Callable[[Stamps], Floats]:
    """The answers of transform-tree at many stamps."""
    matrices: Callable[[Stamps], Floats] = transform_tree_of(series_of(chain)).plan(BASE, last_of(chain)).at
    return matrices


@CHAINS
def test_one_lookup_by_name(table: Table, chain: str) -> None:
    peer = transform_tree_of(series_of(chain))
    source, stamps = last_of(chain), cases.questions("lookup")

    def with_each(ask: Callable[[str, str, int], Any]) -> Turn:
        return timed(lambda: [ask(BASE, source, stamp) for stamp in stamps], len(stamps))

    def on(package: Any) -> Turn:
        tree = tree_of(chain, package)
        found = tree.lookup(BASE, source, stamps[0]).transform.matrix()
        np.testing.assert_allclose(found, peer.lookup(BASE, source, stamps[0]), rtol=0, atol=1e-12)
        return with_each(tree.lookup)

    table.measure(f"lookup by name, {edges(chain)}", on, "transform-tree", with_each(peer.lookup), "<= 0.6", "ns")


DEEP = pytest.mark.parametrize("chain", ["m" * 10, "m" * 30], ids=edges)
TREES = 50
"""So many trees get a new sample, and then each is asked once; so nothing is known from the question before."""


@DEEP
def test_one_lookup_by_a_plan(table: Table, chain: str) -> None:
    """No stamp comes twice, and the peer has its path and needs no names."""
    series, source = series_of(chain), last_of(chain)
    plan = transform_tree_of(series).plan(BASE, source)
    stamps = [*dict.fromkeys(cases.questions("lookup"))]

    def on(package: Any) -> Turn:
        tree = tree_of(chain, package)
        found = tree.lookup(BASE, source, stamps[0]).transform.matrix()
        np.testing.assert_allclose(found, plan.at(stamps[0]), rtol=0, atol=1e-12)
        return timed(lambda: [tree.lookup(BASE, source, stamp) for stamp in stamps], len(stamps))

    peer = timed(lambda: [plan.at(stamp) for stamp in stamps], len(stamps))
    table.measure(f"lookup at a stamp, {edges(chain)}", on, "plan of transform-tree", peer, "<= 1.0", "ns")


@DEEP
@pytest.mark.parametrize("equal", [True, False], ids=["equal stamps", "own stamps"])
def test_the_latest_after_each_new_sample(table: Table, chain: str, equal: bool) -> None:
    """With equal stamps, `latest` of a plan gives our answer. With stamps of their own, the plan is told the stamp."""
    series, source = series_of(chain), last_of(chain)
    if equal:
        series = [each._replace(stamps=START + PERIOD * np.arange(1_000)) for each in series]
    common = np.min([each.stamps for each in series], axis=0)

    def asked_once(asks: list[Callable[[int], Any]], insert: Callable[[int], None]) -> Turn:
        steps = count()
        insert(next(steps))

        def one_turn() -> float:
            insert(step := next(steps))
            stamp = int(common[step])
            start = thread_time()
            for ask in asks:
                ask(stamp)
            return (thread_time() - start) / len(asks)

        # The first answer of each tree finds the path.
        one_turn()
        return one_turn

    def on(package: Any) -> Turn:
        trees = [package.TransformTree() for _ in range(TREES)]

        def insert(step: int) -> None:
            for tree in trees:
                for parent, child, stamps, translations, wxyz in series:
                    rotation = np.roll(wxyz[step], -1)
                    tree.insert_columns(parent, child, stamps[[step]], translations[[step]], rotation[None])

        def ask_of(tree: Any) -> Callable[[int], Any]:
            return lambda _: tree.lookup(BASE, source)

        ours = asked_once(list(map(ask_of, trees)), insert)
        found = trees[0].lookup(BASE, source)
        assert found.stamp == common[1]
        np.testing.assert_allclose(found.transform.matrix(), plans[0].at(int(common[1])), rtol=0, atol=1e-12)
        return ours

    tf_tree = pytest.importorskip("tf_tree")
    names = [(each.parent, each.child) for each in series]
    peers = [tf_tree.build(names, capacity=64, interp="lerpslerp") for _ in range(TREES)]
    publishers = [[peer.publisher(child, parent) for parent, child in names] for peer in peers]
    plans = [peer.plan(BASE, source) for peer in peers]

    def insert_into_peers(step: int) -> None:
        for their in publishers:
            for publisher, each in zip(their, series, strict=True):
                publisher.push(int(each.stamps[step]), [*each.wxyz[step], *each.translations[step]])

    def plan_of(plan: Any) -> Callable[[int], Any]:
        return (lambda _: plan.latest()) if equal else plan.at

    peer = asked_once(list(map(plan_of, plans)), insert_into_peers)
    label = f"LATEST, new {'equal' if equal else 'own'} stamps, {edges(chain)}"
    table.measure(label, on, "plan of transform-tree", peer, "<= 1.0", "ns")


@pytest.mark.parametrize("order", ["sorted", "random"])
@pytest.mark.parametrize("peer", ["transform-tree", "tf2 in a loop"])
@CHAINS
def test_many_stamps(table: Table, tf2: Ask | None, chain: str, order: str, peer: str) -> None:
    case = Case(f"many, {order}", chain)
    tree, source = tree_of(chain), last_of(chain)
    stamps = np.array(cases.questions(case.kind))
    found = tree.lookup_many(BASE, source, stamps)
    if peer == "tf2 in a loop":
        if tf2 is None:
            pytest.skip("no tf2 to measure beside; on Debian: apt-get install python3-tf2-ros")
        assert found[-1].translation == pytest.approx(tf2(case)[1], abs=1e-6)
        theirs: Turn = lambda: tf2(case)[0]  # noqa: E731
    else:
        matrices = transform_tree(chain)
        np.testing.assert_allclose(found.matrices(), matrices(stamps), rtol=0, atol=1e-12)
        theirs = timed(lambda: matrices(stamps), MANY)
    ours, rounds = take_turns(timed(lambda: tree.lookup_many(BASE, source, stamps), MANY), theirs, rounds=FEW_ROUNDS)
    wanted = "<= 0.125" if peer == "tf2 in a loop" else ""
    table.compare(f"lookup_many, {edges(chain)}, {order}", ours, peer, rounds, wanted, "ns")


@pytest.mark.parametrize("count", [10, 1_000, 100_000])
@pytest.mark.parametrize("read", [False, True])
def test_stamps_in_order_on_both_kernels(table: Table, count: int, read: bool) -> None:
    """With `read`, the arrays of the answer are made too; else they are made when somebody reads them."""
    chain = "mmm"
    matrices = transform_tree(chain)
    stamps = np.sort(np.random.default_rng(6).integers(START + PERIOD, START + 999 * PERIOD, count))
    repeats = max(1, 3_000 // count)

    def on(package: Any) -> Turn:
        tree = tree_of(chain, package)

        def ask() -> None:
            for _ in range(repeats):
                found = tree.lookup_many(BASE, "f2", stamps)
                if read:
                    _ = found.translations, found.rotations

        return timed(ask, count * repeats)

    peer = timed(lambda: [matrices(stamps) for _ in range(repeats)], count * repeats)
    label = f"lookup_many, {count:,} in order{', arrays read' * read}"
    table.measure(label, on, "transform-tree", peer, "" if read else TO_REACH[count], "ns")


def scattered_points(count: int = POINTS) -> Points:
    return np.random.default_rng(4).uniform(-50.0, 50.0, (count, 3)).astype(np.float32)


ROWS = 1_000


@pytest.mark.parametrize("into", ["bus", "tree"])
@pytest.mark.parametrize("shape", ["one frame, many stamps", "many frames, one stamp"])
def test_samples_from_arrays(table: Table, into: str, shape: str) -> None:
    """With all checks. The peer stores the stamps of one frame, and checks less."""
    rng = np.random.default_rng(7)
    translations, rotations = rng.normal(size=(ROWS, 3)), rng.normal(size=(ROWS, 4))
    rotations /= np.linalg.norm(rotations, axis=1)[:, None]
    steps = np.arange(1, ROWS + 1)
    names = "f0" if shape.startswith("one") else [f"f{i}" for i in range(ROWS)]
    repeats = 5

    def on(package: Any) -> Turn:
        def one_turn() -> float:
            bus, tree = package.Bus(max_behind=None), package.TransformTree()
            buffer = package.Buffer(bus)
            store = bus.publish_columns if into == "bus" else tree.insert_columns
            store(BASE, names, START if isinstance(names, list) else START - ROWS + steps, translations, rotations)
            start = perf_counter()
            for turn in range(1, repeats + 1):
                stamps = START + turn * ROWS + (0 if isinstance(names, list) else steps)
                store(BASE, names, stamps, translations, rotations)
            seconds = perf_counter() - start
            assert (buffer.tree if into == "bus" else tree).inserted == (repeats + 1) * ROWS
            bus.close()
            return seconds / ROWS / repeats

        return one_turn

    peer = None
    if isinstance(names, str):
        tf_tree = pytest.importorskip("tf_tree")
        wxyz = np.hstack((rotations[:, 3:], rotations[:, :3], translations))

        def theirs() -> float:
            built = tf_tree.build([(BASE, "f0")], capacity=8 * ROWS, interp="lerpslerp")
            with built.publisher("f0", BASE) as publisher:
                start = perf_counter()
                for turn in range(repeats):
                    publisher.push_many(START + turn * ROWS + steps, wxyz)
                return (perf_counter() - start) / ROWS / repeats

        peer = theirs
    label = f"{'publish' if into == 'bus' else 'insert'}_columns, {shape}"
    table.measure(label, on, "transform-tree", peer, "", "ns")


@pytest.mark.parametrize("count", [100, 10_000, POINTS, 1_000_000])
@pytest.mark.parametrize(("name", "span"), [("a sweep of 0.1 s", SWEEP), ("10 s of history", 998 * PERIOD)])
def test_deskew(table: Table, name: str, span: int, count: int) -> None:
    tree, frame, points = tree_of("m"), "f0", scattered_points(count)
    stamps = np.sort(np.random.default_rng(5).integers(START + PERIOD, START + PERIOD + span, count))
    cloud = PointCloud(frame, int(stamps[-1]), points, stamps=stamps)
    found = tree.lookup_many(BASE, frame, stamps)
    _ = found.translations, found.rotations
    sides = timed(lambda: tree.deskew(cloud, frame, BASE)), timed(lambda: found.apply(points))
    ours, theirs = take_turns(*sides, rounds=FEW_ROUNDS)
    table.compare(f"deskew {count:,} points, {name}", ours, "numpy with known transforms", theirs, "<= 4", "ms")


@pytest.mark.parametrize("form", [list, np.array])
@CHAINS
def test_a_handful_of_stamps(table: Table, chain: str, form: Callable[[list[int]], Any]) -> None:
    """So few stamps that one call of numpy costs as much as several lookups: `lookup_many` must not be slower."""
    tree, source, stamps = tree_of(chain), last_of(chain), cases.questions("few")
    handfuls = [stamps[i : i + HANDFUL] for i in range(0, len(stamps), HANDFUL)]
    asked = [form(handful) for handful in handfuls]

    def at_once() -> list[Any]:
        return [tree.lookup_many(BASE, source, handful) for handful in asked]

    def one_by_one() -> list[list[TransformStamped]]:
        return [[tree.lookup(BASE, source, stamp) for stamp in handful] for handful in handfuls]

    for array, answers in zip(at_once(), one_by_one(), strict=True):
        assert [*array] == [answer.transform for answer in answers]
    ours, theirs = take_turns(timed(at_once, len(handfuls)), timed(one_by_one, len(handfuls)))
    label = f"lookup_many of 5 in {'a list' if form is list else 'an array'}, {edges(chain)}"
    table.compare(label, ours, "5 lookups", theirs, "<= 1.2")
