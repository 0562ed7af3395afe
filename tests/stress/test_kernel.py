"""The compiled kernel under threads, and without a leak."""

import gc
import random
import sys
import threading
import tracemalloc
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import anyio
import anyio.lowlevel
import numpy as np
import pytest
from support.asking import threads_that
from support.both_kernels import COMPILED, bits, needs_both, sample_class
from support.samples import moving, over, static

from tfbus import LATEST, Buffer, Bus, TransformLookupError, TransformTree

pytestmark = pytest.mark.thorough


def row(metres: float) -> Any:
    return metres, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0


def test_four_threads_read_whole_answers_while_the_loop_inserts() -> None:
    """Left and right always move together, so any mixture of two states would be a distance between them."""
    tree = TransformTree(keep=1e-6)
    tree.insert_many([*over("base", "left", [0, 1]), *over("base", "right", [0, 1]), static("left", "lamp")])
    faults: list[object] = []
    answers = [0]

    def read() -> None:
        rng = random.Random()
        try:
            newest = tree.latest_common_stamp("base", "left") or 0
            at: Any = rng.choice([LATEST, newest, newest - rng.randrange(900)])
            found = tree.lookup("lamp", "right", at).transform.translation
            many = tree.lookup_many("lamp", "right", np.arange(newest - 400, newest), out_of_range="nan")
        except TransformLookupError:
            return
        answers[0] += 1
        if any(found) or many.translations[many.valid].any():
            faults.append((found, many))

    def insert() -> None:
        rng = random.Random(1)
        for stamp in range(2, 6_000):
            parent = "base" if rng.random() < 0.98 else "other"
            tree.insert_many(moving(parent, side, stamp, float(stamp)) for side in ("left", "right"))
            if rng.random() < 0.1:
                late = stamp - rng.randrange(1, 30)
                tree.insert_many(moving("base", side, max(late, 0), float(late)) for side in ("left", "right"))
            if rng.random() < 0.01:
                tree.copy()

    with threads_that(read, 4):
        insert()
    assert faults == []
    assert answers[0] > 100


def grown(call: Callable[[], object]) -> int:
    """The bytes that five hundred calls leave behind, whenever they are made: the least of several times."""
    tracemalloc.start()
    try:
        sizes = []
        for _ in range(5):
            for _ in range(500):
                call()
            gc.collect()
            sizes.append(tracemalloc.get_traced_memory()[0])
        return min(after - before for before, after in pairwise(sizes))
    finally:
        tracemalloc.stop()


def check_leaves_nothing(use: Callable[[], object], shared: Sequence[object]) -> None:
    """Check that calls leave neither memory behind nor references to the things that they share."""
    gc.collect()
    before = [sys.getrefcount(thing) for thing in shared]
    # The smallest object that a call could leak would make 8,000.
    assert grown(use) < 4_000
    assert [sys.getrefcount(thing) for thing in shared] == before


@needs_both
def test_no_call_leaks_memory_or_references() -> None:
    kernel: Any = COMPILED
    target, source, me = "".join(["ma", "p"]), "".join(["ca", "rt"]), "".join(["m", "e"])
    shared: list[Any] = [target, source, me, kernel.Sample, kernel.History, kernel.Chain, kernel.Paths, kernel.Held]

    def use() -> None:
        edge = kernel.History(target, 50)
        edge.authority = me
        edge.push(0, row(0.0))
        for stamp in range(1, 90):
            edge.append(target, stamp, row(stamp), me)
        edge.put(3, edge.stamp(3), row(1.0))
        edge.put(0, edge.horizon, row(1.0))
        held = edge.columns(2, 9)
        edge.put(5, edge.stamp(5), row(2.0))
        twin = kernel.History(target, None)
        twin.take(edge)
        path = kernel.Chain((edge, row(1.0)), (twin,))
        path.row(60), path.row(10_000), path.latest()
        many = path.hold()
        edge.clear()
        many.rows(np.arange(50, 80), np.empty((7, 30)))
        paths = kernel.Paths(threading.Lock(), LATEST, kernel.Sample)
        paths.recent[target] = {source: kernel.Chain((twin,), ())}
        for stamps in ([60, 70], np.array([60, 70]), np.full(300, 60), np.array([60, 900]), [60, "x"], np.zeros(2), []):
            paths.answer_many(target, source, stamps)
        found = paths.answer(target, source, 60)
        assert found._fields is found._fields
        found._fields = target, source, 5, row(1.0), me, True
        paths.answer(target, source, LATEST), paths.answer(target, source, 10**6), paths.answer(target, "x", 5)
        paths.recent = {}
        sample = sample_class(kernel)()
        sample._fields = target, source, 500, row(1.0), me, False
        kernel.commit({source: twin}, (sample, sample), 0)
        for wrong in (
            lambda: kernel.Chain((twin, 5), ()),
            lambda: kernel.History(5, None),
            lambda: setattr(sample, "_fields", (target, 5, 5, row(1.0), me, False)),
            lambda: many.rows(np.zeros(1), np.zeros(3)),
            lambda: kernel.Paths(5, 5, kernel.Sample),
            lambda: edge.put(9, 1, row(0.0)),
            lambda: path.__init__((), ()),
        ):
            with pytest.raises((TypeError, ValueError, IndexError, AttributeError, RuntimeError)):
                wrong()
        del held

    use()
    check_leaves_nothing(use, shared)


@needs_both
def test_the_garbage_collector_frees_what_a_cycle_through_a_chain_holds() -> None:
    kernel: Any = COMPILED

    edge = kernel.History("map", None)
    edge.push(0, row(0.0))
    block = edge.columns(0, 1)[0].obj
    gc.collect()
    before = sys.getrefcount(block)
    for _ in range(10):
        path = kernel.Chain((edge,), ())
        # The collector clears the path first.
        around: list[Any] = [path.hold()]
        around.append(around)
        del path, around
    gc.collect()
    assert sys.getrefcount(block) == before


@needs_both
def test_no_publish_and_no_wake_up_leaks_memory_or_references() -> None:
    kernel: Any = COMPILED
    parent, child, me = "".join(["ma", "p"]), "".join(["ca", "rt"]), "".join(["m", "e"])
    kinds = [kernel.Edge, kernel.Judge, kernel.Parked, kernel.Line, kernel.Feed, kernel.Intake]
    shared: list[Any] = [parent, child, me, kernel.Sample, *kinds]

    def sample(stamp: int) -> Any:
        made = kernel.Sample()
        made._fields = parent, child, stamp, row(1.0), me, False
        return made

    def use() -> None:
        edge, history = kernel.Edge(), kernel.History(parent, 50)
        edge.parent, edge.trusted, edge.newest = parent, me, 0
        history.authority = me
        history.push(0, row(0.0))
        judge = kernel.Judge({child: edge}, 100.0)
        judge.__init__({child: edge}, 100.0)
        judge.horizon = 1_000
        paths = kernel.Paths(threading.Lock(), LATEST, kernel.Sample)
        paths.recent[parent] = {child: kernel.Chain((history,), ())}
        lines: dict[str, Any] = {child: kernel.Line()}
        parked: dict[Any, Any] = {}
        limits: list[Any] = []
        lines[child].__init__()
        woken: list[Any] = []
        for stamp in (30, 20, 10):
            waiter = kernel.Parked()
            waiter.plain, waiter.place = (parent, child, stamp), (-stamp, 0, waiter)
            waiter.wake, waiter.answer = woken.append if stamp == 20 else woken.clear, sample(1)
            waiter.elsewhere = stamp == 30
            lines[child].places.append(waiter.place)
            parked[waiter] = None
        # A cycle that only the garbage collector ends.
        lines[child].for_any[lines[child].places[0][2]] = None
        feed = kernel.Feed(paths, {child: history}, {}, lines, parked, limits, {}, parked.pop)
        assert not feed.insert((sample(5),))
        lines[child].for_any.clear()
        intake = kernel.Intake(judge, kernel.Sample, ({}, []))
        intake.feeds, intake.thread = ((feed, list), (feed, list)), threading.get_ident()
        assert intake.take(sample(15), "raise")
        assert intake.take([sample(stamp) for stamp in range(16, 99)], "drop")
        assert not parked
        assert not intake.take(sample(2_000), "raise")
        assert not intake.take([sample(100), 5], "raise")
        lines[child] = kernel.Line()
        lines[child].places.append((-5, 0, "nobody"))
        for wrong in (
            lambda: intake.take(sample(200), "raise"),
            lambda: feed.insert([]),
            lambda: setattr(intake, "feeds", 5),
            lambda: kernel.Intake(judge, kernel.Sample, 5),
            lambda: kernel.Judge([], 1.0),
            lambda: feed.__init__(paths, {}, {}, {}, {}, [], {}, list),
            lambda: intake.__init__(judge, kernel.Sample, ()),
        ):
            with pytest.raises((TypeError, RuntimeError)):
                wrong()
        around = kernel.Parked()
        around.plain = around.wake = around.place = around.answer = around
        lines[child].for_any[around] = lines
        limits.append(feed)
        parked[intake] = intake

    use()
    check_leaves_nothing(use, shared)


def test_four_threads_read_whole_answers_while_the_loop_publishes_and_wakes() -> None:
    """Left and right always move together; and each lookup that waits gets the answer of its own stamp."""
    bus = Bus(max_ahead=None)
    buffer = Buffer(bus, keep=1e-6)
    bus.publish([*over("base", "left", [0]), *over("base", "right", [0])])
    faults: list[object] = []
    answers = [0]

    def read() -> None:
        found = buffer.lookup_nowait("left", "right").transform.translation
        answers[0] += 1
        if any(found):
            faults.append(found)

    async def wait(stamp: int) -> None:
        found = await buffer.lookup("base", "left", stamp, timeout=60.0)
        if (found.stamp, found.transform.translation[0]) != (stamp, float(stamp)):
            faults.append(found)

    async def publish() -> None:
        for stamp in range(1, 2_000):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(wait, stamp)
                tasks.start_soon(wait, stamp)
                while len(buffer.pending()) < 2:
                    await anyio.lowlevel.checkpoint()
                bus.publish([moving("base", side, stamp, float(stamp)) for side in ("left", "right")])

    with threads_that(read, 4):
        anyio.run(publish)
    assert faults == []
    assert answers[0] > 100


@needs_both
def test_no_allocation_that_fails_does_harm() -> None:
    """Every allocation of a call fails once: the call raises `MemoryError` or hands back, and the history is whole."""
    memory = pytest.importorskip("_testcapi")
    kernel: Any = COMPILED
    poses = [(stamp, row(stamp)) for stamp in range(8)]

    def edge_of() -> Any:
        edge = kernel.History("parent", None)
        for stamp, pose in poses:
            edge.push(stamp, pose)
        return edge

    def calls(edge: Any, path: Any) -> list[Callable[[], object]]:
        return [
            lambda: edge.push(100, poses[0][1]),
            lambda: edge.put(1, 1, poses[0][1]),
            lambda: edge.append("parent", 100, poses[0][1], ""),
            lambda: edge.columns(0, 4),
            lambda: edge.sample(3),
            lambda: kernel.History("a", None).take(edge),
            lambda: kernel.Chain((edge,), ()),
            lambda: path.row(3),
            lambda: path.hold(),
            lambda: path.hold().rows(np.arange(5), np.empty((7, 5))),
            lambda: paths_of(path).answer_many("parent", "child", [1, 2, 3]),
            lambda: kernel.Paths(threading.Lock(), LATEST, kernel.Sample),
        ]

    failures = 0
    for number in range(len(calls(edge_of(), None))):
        for allowed in range(12):
            edge = edge_of()
            path = kernel.Chain((edge,) * 40, (edge,))
            before = [edge.sample(i) for i in range(edge.count)]
            call = calls(edge, path)[number]
            memory.set_nomemory(allowed, 0)
            try:
                call()
                failed = False
            except MemoryError:
                failed = True
            finally:
                memory.remove_mem_hooks()
            if failed:
                failures += 1
                assert [edge.sample(i) for i in range(edge.count)] == before
                assert bits(path.row(3)) == bits(edge_path(kernel, edge).row(3))
            edge.push(200, row(9.0))
            assert edge.newest == 200
    assert failures > 10


def paths_of(path: Any) -> Any:
    kernel: Any = COMPILED
    paths = kernel.Paths(threading.Lock(), LATEST, kernel.Sample)
    paths.recent = {"parent": {"child": path}}
    return paths


def edge_path(kernel: Any, edge: Any) -> Any:
    return kernel.Chain((edge,) * 40, (edge,))


@needs_both
def test_the_compiled_kernel_is_refused_in_another_interpreter() -> None:
    interpreters = pytest.importorskip("_xxsubinterpreters")
    script = """
from importlib.util import module_from_spec, spec_from_file_location
try:
    spec = spec_from_file_location("tfbus._kernel", PLACE)
    spec.loader.exec_module(module_from_spec(spec))
except ImportError as error:
    assert "main interpreter only" in str(error) or "subinterpreters" in str(error), error
else:
    raise RuntimeError("it was loaded")
"""
    assert COMPILED is not None
    number = interpreters.create()
    try:
        interpreters.run_string(number, script.replace("PLACE", repr(COMPILED.__file__)))
    finally:
        interpreters.destroy(number)
