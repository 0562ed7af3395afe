"""Each allocation of a call fails: the buffers are as before or as after, and no waiter is lost.

Calls that the kernel alone answers are made without any memory as well. Other ones cannot: CPython 3.11 looks for room
in vain for ever before it runs an exception handler. The arithmetic of numpy is left out, because it crashes.
"""

import gc
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

import numpy as np
import pytest
from support.samples import live_tree, moving, static, tree_over

import tfbus
from tfbus import Buffer, Bus, FutureExtrapolationError, Question, TransformArray, TransformStamped
from tfbus.waiting.live_tree import Waiter

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.skipif(tfbus.kernel == "python", reason="CPython may hang in an exception handler without memory"),
    # A generator whose frame has no room cannot be closed.
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

T = TypeVar("T")

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


def sweep(call: Callable[[T], object], fresh: Callable[[], T], check: Callable[[T], None], *, plain: bool) -> int:
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


# Buffers on a bus


class Scene:
    """A chain of two moving edges and a static one on two buffers."""

    def __init__(self) -> None:
        self.bus = Bus()
        self.buffers = [Buffer(self.bus), Buffer(self.bus)]
        for stamp in range(1, 5):
            self.bus.publish(chain(stamp))
        self.bus.publish(static("b", "tip"))
        self.ask_all()

    def ask_all(self) -> object:
        """Everything that one can ask, as plain data."""
        said: list[object] = []
        for buffer in self.buffers:
            for at in (1, 3, 4, 6):
                try:
                    said.append(buffer.lookup_nowait("map", "tip", at))
                except FutureExtrapolationError as error:
                    said.append(str(error))
            said.append(buffer.tree.lookup_many("map", "tip", [1, 2, 3]).translations.tolist())
            said.append(buffer.tree.edges())
        return said


def chain(stamp: int) -> tuple[TransformStamped, TransformStamped]:
    return moving("map", "a", stamp, float(stamp)), moving("a", "b", stamp, float(stamp))


def ask(call: Callable[[Buffer], object]) -> Callable[[Scene], object]:
    return lambda scene: call(scene.buffers[0])


def read(found: TransformArray) -> object:
    return found.translations, found.rotations, found.stamps


def facts(found: TransformStamped) -> object:
    return found.parent, found.child, found.stamp, found.transform, found.authority, found.static


def error_text(buffer: Buffer) -> str:
    try:
        return repr(buffer.lookup_nowait("map", "tip", 99))
    except FutureExtrapolationError as error:
        return str(error)


MANY = np.full(300, 3)

PLAIN_QUESTIONS: dict[str, Callable[[Scene], object]] = {
    "lookup": ask(lambda buffer: facts(buffer.lookup_nowait("map", "tip", 3))),
    "lookup at": ask(lambda buffer: facts(buffer.lookup_nowait("map", "tip", at=3))),
    "latest": ask(lambda buffer: facts(buffer.tree.lookup("map", "tip"))),
    "lookup_many of few": ask(lambda buffer: read(buffer.tree.lookup_many("map", "tip", [1, 2, 3]))),
    "lookup_many of many": ask(lambda buffer: read(buffer.tree.lookup_many("map", "tip", MANY))),
}
QUESTIONS = {
    **PLAIN_QUESTIONS,
    "another path": ask(lambda buffer: facts(buffer.tree.lookup("a", "tip", 2))),
    "no answer": ask(error_text),
}


@pytest.mark.parametrize("name", QUESTIONS)
def test_a_question_changes_nothing_whichever_allocation_fails(name: str) -> None:
    scene = Scene()
    before = scene.ask_all()

    def check(scene: Scene) -> None:
        assert scene.ask_all() == before

    assert sweep(QUESTIONS[name], lambda: scene, check, plain=name in PLAIN_QUESTIONS) > 0


def test_a_batch_is_stored_whole_or_not_at_all_in_every_buffer_and_the_next_ones_are_stored() -> None:
    reference = Scene()
    before = reference.ask_all()
    reference.bus.publish(chain(6))
    after = reference.ask_all()

    def check(scene: Scene) -> None:
        assert scene.ask_all() in (before, after)
        scene.bus.publish(chain(20))
        assert [buffer.lookup_nowait("map", "b").stamp for buffer in scene.buffers] == [20, 20]

    assert sweep(lambda scene: scene.bus.publish(chain(6)), Scene, check, plain=True) > 0


def test_no_failed_allocation_leaks_a_reference() -> None:
    scene = Scene()
    names = [frame for edge in scene.buffers[0].tree.edges() for frame in (edge.parent, edge.child)]
    shared: list[object] = [*names, TransformStamped, TransformArray, scene, *scene.buffers]

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


# Waiters of a live tree, which no event loop has to wake: that takes memory, too


class Sleepers:
    """The same chain as a live tree, with lookups that wait for a later stamp."""

    def __init__(self, waiting: int) -> None:
        self.live = live_tree(None)
        self.tree = tree_over(self.live)
        for stamp in range(1, 5):
            self.live.insert(chain(stamp))
        self.live.insert((static("b", "tip"),))
        self.asleep: list[list[int]] = []
        for _ in range(waiting):
            self.park()

    def park(self) -> None:
        with pytest.raises(FutureExtrapolationError) as caught:
            self.tree.lookup("map", "tip", 6)
        asleep = [1]
        self.live.park(Waiter(Question("map", "tip", 6), 0, asleep.clear), caught.value)
        self.asleep.append(asleep)

    def insert_one_after_the_other(self) -> None:
        for sample in chain(6):
            self.live.insert((sample,))

    def cancel(self) -> None:
        for waiter in list(self.live.waiting.parked):
            self.live.waiting.remove(waiter)


CHANGES: dict[str, Callable[[Sleepers], object]] = {
    "insert": lambda scene: scene.live.insert(chain(6)),
    "insert one after the other": Sleepers.insert_one_after_the_other,
    "park": Sleepers.park,
    "cancel": Sleepers.cancel,
}


@pytest.mark.parametrize("waiting", [0, 1, 3])
@pytest.mark.parametrize("name", CHANGES)
def test_no_waiter_is_lost_whichever_allocation_fails(name: str, waiting: int) -> None:
    def check(scene: Sleepers) -> None:
        # The last one is beyond all limits.
        for stamp in (20, 21, 10**11):
            scene.live.insert(chain(stamp))
        assert scene.live.waiting.parked == {}
        assert (scene.live.waiting.by_frame, scene.live.waiting.limits) == ({}, [])
        if name != "cancel":
            assert not any(scene.asleep)
        assert scene.tree.lookup("map", "b").stamp == 10**11

    failures = sweep(CHANGES[name], lambda: Sleepers(waiting), check, plain="insert" in name)
    assert failures > 0 or name == "cancel"
