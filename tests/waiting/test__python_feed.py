"""The plain insertion and the plain wake-ups of both kernels."""

import sys
import threading
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
from support.both_kernels import COMPILED, needs_both

from tfbus import LATEST
from tfbus.geometry import _python_sample
from tfbus.stamps import STAMP_MAX, STAMP_MIN
from tfbus.tree import _python_kernel
from tfbus.waiting import _python_feed

# The protocol in the feed's module has the name of the class.
PYTHON = SimpleNamespace(**(vars(_python_feed) | vars(_python_kernel) | vars(_python_sample)))

on_both = pytest.mark.parametrize(
    "kernel", [pytest.param(PYTHON, id="python"), pytest.param(COMPILED, id="compiled", marks=needs_both)]
)


class Stage:
    """Edges a and b on 'map' from 'me' with a sample at 10, and whoever waits for them."""

    def __init__(self, kernel: Any) -> None:
        self.kernel = kernel
        self.lock = threading.Lock()
        self.paths = kernel.Paths(self.lock, LATEST, kernel.Sample)
        self.frames: dict[str, Any] = {}
        for child in "ab":
            history = kernel.History("map", None)
            history.authority = "me"
            history.push(10, (10.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
            self.frames[child] = history
            self.paths.recent.setdefault("map", {})[child] = kernel.Chain((history,), ())
        self.readers: dict[int, Any] = {}
        self.lines: dict[str, Any] = {}
        self.parked: dict[Any, None] = {}
        self.limits: list[Any] = []
        self.watches: dict[str, Any] = {}
        self.forgotten: list[Any] = []
        self.woken: list[Any] = []
        self.feed = kernel.Feed(
            self.paths,
            self.frames,
            self.readers,
            self.lines,
            self.parked,
            self.limits,
            self.watches,
            self.forgotten.append,
        )

    def sample(self, stamp: int, child: str = "a", parent: str = "map", static: bool = False) -> Any:
        made = self.kernel.Sample()
        made._fields = parent, child, stamp, (float(stamp), 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), "me", static
        return made

    def waiter(self, source: str = "a", at: object = LATEST) -> Any:
        made = self.kernel.Parked()
        made.plain = "map", source, at
        made.answer, made.version, made.elsewhere, made.place = None, 0, False, None
        made.wake = partial(self.woken.append, made)
        self.parked[made] = None
        return made

    def park(self, stamp: int, child: str = "a") -> Any:
        """Park a lookup that needs a stamp of a frame."""
        made = self.waiter(child, stamp)
        made.place = -stamp, -len(self.parked), made
        line = self.lines.setdefault(child, self.kernel.Line())
        line.places.append(made.place)
        line.places.sort(key=lambda place: place[:2])
        return made

    def counts(self) -> list[int]:
        return [history.count for history in self.frames.values()]


@on_both
def test_a_sample_wakes_those_that_need_its_stamp_or_an_older_one_in_order_with_their_answers(kernel: Any) -> None:
    stage = Stage(kernel)
    other, late, second, exact, first = (
        stage.park(15, "b"),
        stage.park(21),
        stage.park(15),
        stage.park(20),
        stage.park(STAMP_MIN),
    )
    third = stage.park(15)
    assert stage.feed.insert((stage.sample(20),))
    assert stage.woken == [first, second, third, exact]
    assert [None if waiter.answer is None else waiter.answer.stamp for waiter in stage.woken] == [None, 15, 15, 20]
    assert second.answer._row[0] == 15.0
    assert {waiter.version for waiter in stage.woken} == {stage.paths.version}
    assert [waiter.place for waiter in stage.woken] == [None] * 4
    assert list(stage.parked) == [other, late]
    assert [len(line.places) for line in stage.lines.values()] == [1, 1]
    assert stage.feed.insert((stage.sample(21),))
    assert list(stage.lines) == ["b"]
    assert stage.feed.insert((stage.sample(30, "b"),))
    assert stage.lines == {}
    assert stage.parked == {}
    assert stage.woken[4:] == [late, other]
    assert stage.counts() == [3, 2]


@on_both
def test_an_answer_is_that_after_the_whole_batch_and_only_of_a_plain_question(kernel: Any) -> None:
    stage = Stage(kernel)
    newest, vague = stage.park(STAMP_MIN), stage.park(11)
    newest.plain, vague.plain = ("map", "a", LATEST), None
    batch: tuple[Any, ...] = (stage.sample(20), stage.sample(30))
    if not stage.feed.insert(batch):
        # Only the compiled kernel stores more than one sample at once.
        assert kernel is PYTHON
        assert stage.feed.insert(batch[:1])
        batch = batch[:1]
    assert newest.answer.stamp == batch[-1].stamp
    assert vague.answer is None
    assert stage.woken == [newest, vague]


@on_both
def test_a_batch_that_is_not_plain_is_left_alone(kernel: Any) -> None:
    def any_sample(stage: Stage) -> None:
        stage.lines["a"].for_any[stage.waiter()] = None

    def own_limit(stage: Stage) -> None:
        stage.lines["a"].limits.append((-25, 0, stage.waiter()))

    def first_limit(stage: Stage) -> None:
        stage.limits.append((-19, 0, stage.waiter()))

    def least_limit(stage: Stage) -> None:
        stage.limits.append((-STAMP_MIN, 0, stage.waiter()))

    def watch(stage: Stage) -> None:
        stage.watches["a"] = {}

    def reader(stage: Stage) -> None:
        stage.readers[0] = set()

    reasons: list[Callable[[Stage], None]] = [any_sample, own_limit, first_limit, least_limit, watch, reader]
    for reason in reasons:
        stage = Stage(kernel)
        stage.park(20)
        reason(stage)
        assert not stage.feed.insert((stage.sample(20),)), reason
        assert not stage.feed.insert((stage.sample(11, "b"), stage.sample(20)))
        assert (stage.woken, stage.counts()) == ([], [1, 1])
    for sample in (("c", "map", False), ("a", "odom", False), ("a", "map", True)):
        stage = Stage(kernel)
        stage.park(20)
        child, parent, static = sample
        assert not stage.feed.insert((stage.sample(20, child, parent, static),))
        assert (stage.woken, stage.counts()) == ([], [1, 1])


@needs_both
def test_a_batch_that_comes_while_another_thread_looks_is_left_alone() -> None:
    stage = Stage(COMPILED)
    stage.park(20)
    with stage.lock:
        assert not stage.feed.insert((stage.sample(20),))
    assert (stage.woken, stage.counts()) == ([], [1, 1])


@on_both
def test_what_concerns_other_frames_and_later_stamps_leaves_a_batch_plain(kernel: Any) -> None:
    stage = Stage(kernel)
    waiting = stage.park(20)
    stage.limits.append((-20, 0, stage.waiter()))
    stage.watches["b"] = {}
    stage.lines["b"] = kernel.Line()
    stage.lines["b"].for_any[stage.waiter()] = None
    assert stage.feed.insert((stage.sample(20),))
    assert stage.woken == [waiting]


@on_both
def test_one_that_is_known_elsewhere_is_forgotten_there(kernel: Any) -> None:
    stage = Stage(kernel)
    waiting = stage.park(20)
    waiting.elsewhere = True
    assert stage.feed.insert((stage.sample(STAMP_MAX),))
    assert stage.forgotten == stage.woken == [waiting]
    assert list(stage.parked) == [waiting]


@on_both
def test_a_wake_up_that_raises_keeps_no_other_from_being_woken(kernel: Any) -> None:
    stage = Stage(kernel)
    failing, waiting = stage.park(20), stage.park(20)
    failing.wake = partial(int, "cancelled")
    assert stage.feed.insert((stage.sample(20),))
    assert stage.woken == [waiting]

    def stop() -> None:
        raise KeyboardInterrupt("the first")

    stage.park(30).wake = stop
    stage.park(30).wake = partial(sys.exit, 5)
    last, later = stage.park(30), stage.park(40)
    with pytest.raises(KeyboardInterrupt, match="the first"):
        stage.feed.insert((stage.sample(30),))
    assert stage.woken == [waiting, last]
    assert last.answer.stamp == 30
    assert list(stage.parked) == [later]


@on_both
def test_one_that_cannot_be_forgotten_is_woken_all_the_same(kernel: Any) -> None:
    stage = Stage(kernel)
    lost, other = stage.park(20), stage.park(20)
    lost.elsewhere = True
    del stage.parked[other]
    lines, parked = stage.lines, stage.parked
    feed = stage.kernel.Feed(stage.paths, stage.frames, {}, lines, parked, [], {}, partial(int, "no"))
    with pytest.raises(TypeError):
        feed.insert((stage.sample(20),))
    assert stage.woken == [lost, other]
    assert lines == {}


@on_both
def test_a_wake_up_may_change_what_it_belongs_to(kernel: Any) -> None:
    stage = Stage(kernel)
    waiter = stage.park(20)

    def change() -> None:
        waiter.wake, waiter.plain, waiter.answer = None, None, None
        stage.woken.append(waiter)

    waiter.wake = change
    del change
    assert stage.feed.insert((stage.sample(20),))
    assert stage.woken == [waiter]


@on_both
def test_a_wake_up_may_park_and_end_others(kernel: Any) -> None:
    stage = Stage(kernel)

    def change() -> None:
        stage.lines["a"].places.remove(ended.place)
        stage.park(20).plain = None
        stage.park(40)

    stage.park(15).wake = change
    ended, last = stage.park(16), stage.park(17)
    assert stage.feed.insert((stage.sample(20),))
    assert [waiter.plain and waiter.plain[2] for waiter in stage.woken] == [17, None]
    assert stage.woken[0] is last
    assert len(stage.lines["a"].places) == 1


@needs_both
def test_wrong_arguments_raise() -> None:
    kernel: Any = COMPILED
    stage = Stage(kernel)
    stage.park(20)
    parts: tuple[Any, ...] = stage.paths, {}, {}, {}, {}, [], {}, list
    for call in (
        lambda: stage.feed.insert([stage.sample(20)]),
        lambda: kernel.Feed(*parts[:-1]),
        lambda: kernel.Feed(5, *parts[1:]),
        lambda: kernel.Feed(*parts, forget=list),
        lambda: stage.feed.__init__(*parts),
        lambda: setattr(stage.waiter(), "version", "5"),
        lambda: setattr(kernel.Line(), "places", []),
    ):
        with pytest.raises((TypeError, AttributeError, RuntimeError)):
            call()
    assert not stage.feed.insert((5,))
    for place in (5, (1, 2), ("x", 0, stage.waiter()), (-5, 0, "nobody")):
        stage.lines["a"].places[:] = [place]
        with pytest.raises(TypeError):
            stage.feed.insert((stage.sample(stage.frames["a"].newest + 10),))
    stage.lines["a"] = "no line"
    assert not stage.feed.insert((stage.sample(1_000),))
    empty = kernel.Feed.__new__(kernel.Feed)
    assert not empty.insert((stage.sample(1_000),))
