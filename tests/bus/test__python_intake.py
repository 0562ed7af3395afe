"""The batches that both kernels take, and their effects."""

import threading
from types import SimpleNamespace
from typing import Any

import pytest
from support.both_kernels import COMPILED, needs_both

from tfbus import LATEST
from tfbus.bus import _python_intake, _python_judge
from tfbus.geometry import _python_sample
from tfbus.stamps import STAMP_MAX
from tfbus.tree import _python_kernel
from tfbus.waiting import _python_feed

# The protocols in the modules of the intake and of the feed have the names of the classes.
PYTHON = SimpleNamespace(
    **(vars(_python_intake) | vars(_python_feed) | vars(_python_kernel) | vars(_python_sample) | vars(_python_judge))
)

on_both = pytest.mark.parametrize(
    "kernel", [pytest.param(PYTHON, id="python"), pytest.param(COMPILED, id="compiled", marks=needs_both)]
)


class Stage:
    """A bus with the edge of 'a' on 'map' from 'me', and two buffers, of which the second has no such frame."""

    def __init__(self, kernel: Any) -> None:
        self.kernel = kernel

        class Kind(kernel.Sample):  # type: ignore[misc]
            __slots__ = ()

        self.kind = Kind
        edge = kernel.Edge()
        edge.parent, edge.trusted, edge.newest = "map", "me", 10
        self.edges = {"a": edge}
        self.judge = kernel.Judge(self.edges, 1e6)
        self.judge.horizon = STAMP_MAX
        self.listeners: tuple[Any, ...] = ({}, [], [], {})
        self.intake = kernel.Intake(self.judge, Kind, self.listeners)
        self.history = kernel.History("map", None)
        self.history.authority = "me"
        self.history.push(10, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
        self.closely: list[Any] = []
        paths = [kernel.Paths(threading.Lock(), LATEST, Kind) for _ in range(2)]
        frames: list[dict[str, Any]] = [{"a": self.history}, {}]
        feeds = [kernel.Feed(paths[i], frames[i], {}, {}, {}, [], {}, list) for i in range(2)]
        self.intake.feeds = tuple((feed, self.closely.append) for feed in feeds)
        self.intake.thread = threading.get_ident()

    def sample(self, stamp: int, parent: str = "map", kind: Any = None) -> Any:
        made = (kind or self.kind)()
        made._fields = parent, "a", stamp, (float(stamp), 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), "me", False
        return made

    def is_untouched(self) -> bool:
        return (self.intake.samples, self.history.count, self.edges["a"].newest, self.closely) == (0, 1, 10, [])


@on_both
def test_a_plain_batch_is_judged_counted_and_inserted_and_handed_on_where_it_is_not_plain(kernel: Any) -> None:
    stage = Stage(kernel)
    one = stage.sample(20)
    assert stage.intake.take(one, "raise")
    assert (stage.history.newest, stage.edges["a"].newest, stage.intake.samples) == (20, 20, 1)
    assert stage.closely == [(one,)]
    batch = (stage.sample(30), stage.sample(40))
    assert stage.intake.take(batch, "drop")
    assert (stage.edges["a"].newest, stage.intake.samples) == (40, 3)
    # The Python kernel stores several samples at once in no feed.
    assert stage.closely[1:] in ([batch], [batch, batch])


@needs_both
def test_a_list_is_a_batch() -> None:
    stage = Stage(COMPILED)
    batch = [stage.sample(30), stage.sample(40)]
    assert stage.intake.take(batch, "raise")
    assert (stage.history.count, stage.intake.samples, stage.closely) == (3, 2, [tuple(batch)])


@on_both
def test_whatever_else_is_left_alone(kernel: Any) -> None:
    stage = Stage(kernel)
    sample = stage.sample(20)
    others: tuple[Any, ...] = ((), [], 5, "a", None, iter([sample]), (sample, 5), stage.sample(20, kind=kernel.Sample))
    for samples in others:
        assert not stage.intake.take(samples, "raise"), samples
    assert not stage.intake.take(stage.sample(20, parent="odom"), "raise")
    assert not stage.intake.take((sample, stage.sample(20, parent="odom")), "drop")
    for invalid in ("other", None, 5):
        assert not stage.intake.take(sample, invalid)
    for place in range(4):
        listening = stage.listeners[place]
        (listening.append if isinstance(listening, list) else listening.setdefault)(1)
        assert not stage.intake.take(sample, "raise")
        listening.clear()
    stage.intake.thread += 1
    assert not stage.intake.take(sample, "raise")
    stage.intake.thread -= 1
    stage.intake.open = False
    assert not stage.intake.take(sample, "raise")
    assert stage.is_untouched()
    stage.intake.open = True
    assert stage.intake.take(sample, "raise")


@on_both
def test_an_error_of_a_buffer_is_raised_after_all_others_have_the_batch(kernel: Any) -> None:
    stage = Stage(kernel)

    def fail(_batch: object) -> None:
        raise MemoryError

    other = stage.intake.feeds[1]
    stage.intake.feeds = ((other[0], fail), stage.intake.feeds[0], other)
    sample = stage.sample(20)
    with pytest.raises(MemoryError):
        stage.intake.take(sample, "raise")
    # The others have what the bus has judged.
    assert (stage.history.newest, stage.closely) == (20, [(sample,)])


@needs_both
def test_wrong_arguments_raise() -> None:
    kernel: Any = COMPILED
    stage = Stage(kernel)
    sample = stage.sample(20)
    for call in (
        lambda: stage.intake.take(sample),
        lambda: setattr(stage.intake, "feeds", []),
        lambda: kernel.Intake(stage.judge, stage.kind),
        lambda: kernel.Intake(5, stage.kind, ()),
        lambda: kernel.Intake(stage.judge, stage.kind, listeners=()),
    ):
        with pytest.raises(TypeError):
            call()
    with pytest.raises(RuntimeError):
        stage.intake.__init__(stage.judge, stage.kind, ())
    stage.intake.feeds = ((5, list),)
    with pytest.raises(TypeError):
        stage.intake.take(sample, "raise")
    assert not kernel.Intake.__new__(kernel.Intake).take(sample, "raise")
    without_length = kernel.Intake(stage.judge, stage.kind, (5,))
    without_length.thread = threading.get_ident()
    with pytest.raises(TypeError):
        without_length.take(sample, "raise")
