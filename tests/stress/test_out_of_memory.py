"""Each allocation of a call fails: the tree is as before or as after, and no waiter is lost.

Calls that the kernel alone answers are made without any memory as well. Other ones cannot: CPython 3.11 looks for room
in vain for ever before it runs an exception handler. The arithmetic of numpy is left out, because it crashes.
"""

import gc
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import pytest
from support.both_kernels import tfbus_on
from support.samples import moving, static

import tfbus
from tfbus import Buffer, Bus, FutureExtrapolationError, Question, TransformArray, TransformStamped, UnknownFrameError
from tfbus.tree.poses import PoseReader
from tfbus.waiting.waiting_index import Waiter

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.skipif(tfbus.kernel == "python", reason="CPython may hang in an exception handler without memory"),
    # A generator whose frame has no room cannot be closed.
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

memory: Any = pytest.importorskip("_testcapi")

MOST = 3_000
"""More allocations than any of the calls makes."""
NO_MEMORY = MemoryError, SystemError
"""CPython 3.11 raises the second where it has no room for the next frame of Python."""
QUIET = 20
"""So many calls in a row without a failure are taken for the end of a call's allocations."""


@contextmanager
def no_memory(first: int, end: int) -> Iterator[None]:
    """Have the allocations from number `first` up to `end` fail; 0 for all."""
    # CPython needs a tuple of three to leave a ``with lock``. It keeps those that were freed, and so has one as a rule.
    spare = [(number, number, number) for number in range(first, first + 100)]
    spare.clear()
    memory.set_nomemory(first, end)
    try:
        yield
    finally:
        memory.remove_mem_hooks()


class Scene:
    """A chain of two moving edges and a static one on two buffers, with lookups that wait for a later stamp."""

    def __init__(self) -> None:
        self.bus = Bus()
        self.buffers = [Buffer(self.bus), Buffer(self.bus)]
        for stamp in range(1, 5):
            self.bus.publish([moving("map", "a", stamp, float(stamp)), moving("a", "b", stamp, float(stamp))])
        self.bus.publish(static("b", "tip"))
        self.asleep: list[list[int]] = []
        self.reader = PoseReader(self.buffers[0]._forest)
        self.ask_all()

    def park(self, number: int, at: int = 6, target: str = "map", source: str = "tip") -> None:
        """Let a lookup wait in each buffer."""
        for buffer in self.buffers:
            with pytest.raises((FutureExtrapolationError, UnknownFrameError)) as caught:
                buffer.lookup_nowait(target, source, at)
            # To wake it takes no memory.
            asleep = [number]
            waiter = Waiter(Question(target, source, at), 0, asleep.clear)
            buffer._live.park(waiter, caught.value)
            self.asleep.append(asleep)

    def ask_all(self) -> object:
        """Everything that one can ask, as plain data."""
        said: list[object] = []
        for buffer in self.buffers:
            for at in (1, 3, 4, 6):
                try:
                    said.append(buffer.lookup_nowait("map", "tip", at)._fields)
                except FutureExtrapolationError as error:
                    said.append(str(error))
            said.append(buffer.tree.lookup_many("map", "tip", [1, 2, 3]).translations.tolist())
            said.append(buffer.tree.edges())
        said.append(self.reader.read("map").columns.tolist())
        return said


def publish_six(scene: Scene) -> None:
    scene.bus.publish([moving("map", "a", 6, 6.0), moving("a", "b", 6, 6.0)])


def publish_a_new_frame(scene: Scene) -> None:
    scene.bus.publish([moving("b", "new", 6, 6.0)])


def publish_one_after_the_other(scene: Scene) -> None:
    scene.bus.publish(moving("map", "a", 6, 6.0))
    scene.bus.publish(moving("a", "b", 6, 6.0))


def cancel(scene: Scene) -> None:
    for buffer in scene.buffers:
        waiting = buffer._live.waiting
        for waiter in list(waiting.parked):
            waiting.remove(waiter)


def ask(call: Callable[[Buffer], object]) -> Callable[[Scene], object]:
    return lambda scene: call(scene.buffers[0])


def read(found: TransformArray) -> object:
    return found.translations, found.rotations, found.stamps


def fields(found: TransformStamped) -> object:
    return found.stamp, found.transform, found._fields


MANY = np.full(300, 3)

PLAIN_QUESTIONS: dict[str, Callable[[Scene], object]] = {
    "lookup": ask(lambda buffer: fields(buffer.lookup_nowait("map", "tip", 3))),
    "lookup at": ask(lambda buffer: fields(buffer.lookup_nowait("map", "tip", at=3))),
    "latest": ask(lambda buffer: fields(buffer.tree.lookup("map", "tip"))),
    "lookup_many of few": ask(lambda buffer: read(buffer.tree.lookup_many("map", "tip", [1, 2, 3]))),
    "lookup_many of many": ask(lambda buffer: read(buffer.tree.lookup_many("map", "tip", MANY))),
}
QUESTIONS = {
    **PLAIN_QUESTIONS,
    "another path": ask(lambda buffer: fields(buffer.tree.lookup("a", "tip", 2))),
    "no answer": ask(lambda buffer: buffer.can_transform("map", "tip", 99)),
    "poses": lambda scene: scene.reader.read("map"),
    "poses at a stamp": lambda scene: scene.reader.read("a", 3),
}

CHANGES: dict[str, Callable[[Scene], object]] = {
    "publish": publish_six,
    "publish twice": publish_one_after_the_other,
    "park": lambda scene: scene.park(9),
    "cancel": cancel,
}


def sweep(
    call: Callable[[Scene], object], fresh: Callable[[], Scene], check: Callable[[Scene], None], *, plain: bool
) -> int:
    """The number of failures of a call when each allocation fails, alone and, of a plain one, with all behind it."""
    failures = 0
    for alone in (True, False)[: 1 + plain]:
        quiet = 0
        for number in range(MOST):
            scene = fresh()
            failed = False
            try:
                with no_memory(number, number + 1 if alone else 0):
                    call(scene)
            except NO_MEMORY:
                failed = True
            check(scene)
            failures += failed
            quiet = 0 if failed else quiet + 1
            if quiet == QUIET:
                break
        else:
            pytest.fail("there are more allocations than were tried")
    return failures


@pytest.mark.parametrize("name", QUESTIONS)
def test_a_question_changes_nothing_whichever_allocation_fails(name: str) -> None:
    scene = Scene()
    before = scene.ask_all()

    def check(scene: Scene) -> None:
        assert scene.ask_all() == before

    assert sweep(QUESTIONS[name], lambda: scene, check, plain=name in PLAIN_QUESTIONS) > 0


@pytest.mark.parametrize("waiting", [0, 1, 3])
@pytest.mark.parametrize("name", CHANGES)
def test_a_change_is_made_whole_or_not_at_all_and_no_waiter_is_lost(name: str, waiting: int) -> None:
    def fresh() -> Scene:
        scene = Scene()
        for number in range(waiting):
            scene.park(number)
        return scene

    reference = fresh()
    before = reference.ask_all()
    CHANGES[name](reference)
    after = reference.ask_all()

    def check(scene: Scene) -> None:
        if name != "publish twice":
            assert scene.ask_all() in (before, after)
        # The last one is beyond all limits.
        for stamp in (20, 21, 10**11):
            scene.bus.publish([moving("map", "a", stamp), moving("a", "b", stamp)])
        lost = [buffer.pending() for buffer in scene.buffers if buffer.pending()]
        assert lost == []
        if name != "cancel":
            assert not any(scene.asleep)
        left = [(buffer._live.waiting.by_frame, buffer._live.waiting.limits) for buffer in scene.buffers]
        assert left == [({}, []), ({}, [])]
        assert [buffer.lookup_nowait("map", "b").stamp for buffer in scene.buffers] == [10**11] * 2

    assert sweep(CHANGES[name], fresh, check, plain="publish" in name) > (0 if name != "cancel" else -1)


@pytest.mark.parametrize("late", [False, True])
def test_the_twin_stores_a_sample_whole_or_not_at_all(late: bool) -> None:
    twin = tfbus_on("python")
    failures = 0

    def at(stamp: int) -> Any:
        return twin.TransformStamped("map", "a", stamp, twin.Transform((float(stamp**2), 0.0, 0.0)))

    # Of so many samples, some do not fit into the memory of those before, and some make others leave the window.
    for count in range(1, 40):
        quiet = 0
        for number in range(MOST):
            bus = twin.Bus()
            buffer = twin.Buffer(bus, keep=5e-8)
            for index in range(count):
                bus.publish(at(2 * index))
            newest = 2 * count - 2
            sample = at(newest - 1 if late else newest + 2)
            failed = False
            try:
                with no_memory(number, number + 1):
                    bus.publish(sample)
            except NO_MEMORY:
                failed = True
            assert buffer.lookup_nowait("map", "a").stamp in (newest, newest + 2)
            bus.publish(at(newest + 4))
            assert buffer.lookup_nowait("map", "a").stamp == newest + 4
            for stamp in [*range(max(0, newest - 46), newest + 1, 2), newest + 4]:
                assert buffer.lookup_nowait("map", "a", stamp).transform.translation[0] == stamp**2
            failures += failed
            quiet = 0 if failed else quiet + 1
            if quiet == QUIET:
                break
    assert failures > 0


def test_no_failed_allocation_leaks_a_reference() -> None:
    scene = Scene()
    names = [frame for edge in scene.buffers[0].tree.edges() for frame in (edge.parent, edge.child)]
    shared: list[object] = [*names, TransformStamped, TransformArray, scene, scene.buffers[0]._paths]

    def use() -> None:
        for call in PLAIN_QUESTIONS.values():
            for number in range(60):
                for end in (number + 1, 0):
                    with suppress(*NO_MEMORY), no_memory(number, end):
                        call(scene)

    use()
    gc.collect()
    before = [sys.getrefcount(thing) for thing in shared]
    use()
    gc.collect()
    assert [sys.getrefcount(thing) for thing in shared] == before
