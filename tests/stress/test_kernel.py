"""The compiled kernel under threads, and without a leak."""

import gc
import logging
import pickle
import random
import sys
import tracemalloc
from itertools import pairwise
from typing import Any

import anyio
import anyio.lowlevel
import numpy as np
import pytest
from support.asking import threads_that
from support.both_kernels import COMPILED, needs_both
from support.samples import moving, over, static

from tfbus import (
    LATEST,
    Buffer,
    Bus,
    SimulatedClock,
    Transform,
    TransformError,
    TransformLookupError,
    TransformStamped,
)

pytestmark = pytest.mark.thorough


@needs_both
def test_nothing_that_a_user_can_do_leaks_memory_or_references(monkeypatch: pytest.MonkeyPatch) -> None:
    """Publish, look up, wait, hold, remove and err, each in many ways: the same number of objects is there after it."""
    # Pytest keeps each line.
    monkeypatch.setattr(logging.getLogger("tfbus"), "disabled", True)
    kernel: Any = COMPILED
    target, source, me = "".join(["ma", "p"]), "".join(["ca", "rt"]), "".join(["m", "e"])
    shared = [target, source, me, TransformStamped, *(kind for kind in vars(kernel).values() if isinstance(kind, type))]

    def sample(stamp: int) -> TransformStamped:
        return TransformStamped(target, source, stamp, Transform((float(stamp), 0.0, 0.0)), me)

    async def use() -> None:
        # Timers of the loop would remember the lookups for 5 s.
        with Bus(SimulatedClock()) as bus, Buffer(bus, keep=5e-8) as buffer:
            for batch in (sample(0), [sample(stamp) for stamp in range(1, 90)], (sample(60), sample(60)), sample(3)):
                bus.publish(batch)
            found = buffer.lookup_nowait(target, source, 60)
            assert found == buffer.lookup_nowait(target, source, at=60)
            for stamps in ([60, 70], np.array([60, 70]), np.full(300, 60), []):
                buffer.tree.lookup_many(target, source, stamps)
            copied, pickled = buffer.tree.copy(), pickle.loads(pickle.dumps(found))
            assert pickled == copied.lookup(target, source, 60)
            async with anyio.create_task_group() as tasks:
                for stamp in (100, 110, 120, 10**6):
                    tasks.start_soon(buffer.lookup, target, source, stamp)
                while len(buffer.pending()) < 4:
                    await anyio.lowlevel.checkpoint()
                bus.publish(sample(100))
                bus.publish([sample(stamp) for stamp in range(101, 120)], invalid="drop")
                bus.publish((moving(target, "new", 1), sample(120)))
                tasks.cancel_scope.cancel()
            for wrong in (
                lambda: bus.publish(sample(-(10**20))),
                lambda: bus.publish([sample(121), 5]),  # type: ignore[list-item]
                lambda: bus.publish(moving(source, target, 122)),
                lambda: bus.publish(moving(target, source, 123, 1e300)),
                lambda: buffer.lookup_nowait(target, source, 1),
                lambda: buffer.lookup_nowait(target, "x", 5),
                lambda: buffer.tree.lookup_many(target, source, [60, 900]),
                lambda: buffer.tree.lookup_many(target, source, [60, "x"]),  # type: ignore[arg-type]
            ):
                with pytest.raises((TransformError, TypeError, ValueError)):
                    wrong()
            bus.remove_frame(source)

    async def grown() -> int:
        """The bytes that a hundred calls leave behind, whenever they are made: the least of several times.

        CPython keeps names that it has looked up in a class, each new object of a name, up to some hundred kB.
        """
        sizes = []
        for _ in range(4):
            for _ in range(100):
                await use()
            gc.collect()
            forget_names()
            sizes.append(tracemalloc.get_traced_memory()[0])
        return min(after - before for before, after in pairwise(sizes))

    forget_names = getattr(sys, "_clear_internal_caches", None) or sys._clear_type_cache
    anyio.run(use)
    gc.collect()
    before = [sys.getrefcount(thing) for thing in shared]
    tracemalloc.start()
    try:
        # The smallest object that a call could leak would make 2,400.
        assert anyio.run(grown) < 2_000
    finally:
        tracemalloc.stop()
    assert [sys.getrefcount(thing) for thing in shared] == before


def test_four_threads_read_whole_answers_while_the_loop_publishes_and_wakes() -> None:
    """Left and right always move together, and each lookup that waits gets the answer of its own stamp."""
    bus = Bus(max_ahead=None, max_behind=None)
    buffer = Buffer(bus, keep=1e-6)
    bus.publish([*over("base", "left", [0, 1]), *over("base", "right", [0, 1]), static("left", "lamp")])
    tree = buffer.tree
    faults: list[object] = []
    answers = [0]

    def read() -> None:
        rng = random.Random()
        try:
            newest = tree.latest_common_stamp("base", "left") or 0
            at: Any = rng.choice([LATEST, newest, newest - rng.randrange(900)])
            found = buffer.lookup_nowait("lamp", "right", at).transform.translation
            many = tree.lookup_many("lamp", "right", np.arange(newest - 400, newest), out_of_range="nan")
        except TransformLookupError:
            return
        answers[0] += 1
        if any(found) or many.translations[many.valid].any():
            faults.append((found, many))

    async def wait(stamp: int) -> None:
        found = await buffer.lookup("lamp", "right", stamp, timeout=60.0)
        if (found.stamp, *found.transform.translation) != (stamp, 0.0, 0.0, 0.0):
            faults.append(found)

    async def publish() -> None:
        rng = random.Random(1)
        for stamp in range(2, 1_500):
            # Late ones as well, and now and then below another parent.
            late = [max(stamp - rng.randrange(1, 30), 0)] if rng.random() < 0.1 else []
            parent = "base" if rng.random() < 0.98 else "other"
            batches = [[moving("base", side, at, float(at)) for side in ("left", "right")] for at in late]
            batches.append([moving(parent, side, stamp, float(stamp)) for side in ("left", "right")])
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(wait, stamp)
                tasks.start_soon(wait, stamp)
                while len(buffer.pending()) < 2:
                    await anyio.lowlevel.checkpoint()
                for batch in batches:
                    bus.publish(batch)
            if rng.random() < 0.01:
                tree.copy()

    with threads_that(read, 4):
        anyio.run(publish)
    assert faults == []
    assert answers[0] > 100


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
