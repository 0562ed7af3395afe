"""The samples that both kernels judge plain, and the stamps that they note."""

import math
from types import ModuleType
from typing import Any

import pytest
from support.both_kernels import COMPILED, needs_both, sample_class

from tfbus.bus import _python_judge
from tfbus.stamps import STAMP_MAX, STAMP_MIN
from tfbus.tree import _python_kernel

on_both = pytest.mark.parametrize(
    "kernel", [pytest.param(_python_judge, id="python"), pytest.param(COMPILED, id="compiled", marks=needs_both)]
)


def edges(kernel: Any) -> dict[str, Any]:
    """Frames a and b on 'map', from 'me', at 10."""
    made = {}
    for child in "ab":
        made[child] = kernel.Edge()
        made[child].parent, made[child].trusted, made[child].newest = "map", "me", 10
    return made


def judge(kernel: Any, edges: dict[str, Any], batch: Any, horizon: int, square: float) -> bool:
    judge = kernel.Judge(edges, square)
    assert judge.horizon == STAMP_MIN
    judge.horizon = horizon
    accepted: bool = judge.accepts(batch)
    return accepted


@on_both
@pytest.mark.parametrize(("stamp", "plain"), [(11, False), (12, True), (14, True), (15, False)])
def test_the_bounds_of_stamps_are_inclusive(kernel: Any, stamp: int, plain: bool) -> None:
    known = edges(kernel)
    known["a"].late = False
    judge = kernel.Judge(known, 81.0)
    judge.allow(12, 14, STAMP_MAX)
    assert (judge.earliest, judge.horizon) == (12, 14)
    assert judge.accepts((sample(kernel, stamp=stamp),)) is plain
    assert judge.behind == 0


@on_both
def test_old_stamps_of_a_late_edge_are_plain_and_counted(kernel: Any) -> None:
    known = edges(kernel)
    known["a"].late = True
    known["b"].late = False
    judge = kernel.Judge(known, 81.0)
    judge.allow(15, 30, STAMP_MAX)
    late = sample(kernel, stamp=12)
    assert judge.accepts((late,))
    assert judge.accepts((late, sample(kernel, stamp=15), sample(kernel, child="b", stamp=15), late))
    assert not judge.accepts((late, sample(kernel, child="b", stamp=14)))
    assert judge.behind == 3


@on_both
def test_no_batch_is_plain_once_the_bounds_are_out_of_date(kernel: Any) -> None:
    judge = kernel.Judge(edges(kernel), 81.0)
    judge.allow(STAMP_MIN, STAMP_MAX, 0)
    assert not judge.accepts((sample(kernel),))
    judge.allow(STAMP_MIN, STAMP_MAX, STAMP_MAX)
    assert judge.accepts((sample(kernel),))


def sample(kernel: ModuleType, **changes: Any) -> Any:
    fields: dict[str, Any] = {"parent": "map", "child": "a", "stamp": 20, "x": 1.0, "authority": "me", "static": False}
    fields.update(changes)
    made = sample_class(_python_kernel if kernel is _python_judge else kernel)()
    row = (fields["x"], 4.0, 8.0, 0.0, 0.0, 0.0, 1.0)
    made._fields = fields["parent"], fields["child"], fields["stamp"], row, fields["authority"], fields["static"]
    return made


@on_both
def test_a_batch_that_continues_known_edges_is_plain_and_its_newest_stamps_are_noted(kernel: Any) -> None:
    known = edges(kernel)
    known["b"].newest = None
    batch = (sample(kernel), sample(kernel, stamp=15), sample(kernel, child="b", stamp=-5), sample(kernel, stamp=30))
    assert judge(kernel, known, batch, 30, 81.0)
    assert [edge.newest for edge in known.values()] == [30, -5]
    assert judge(kernel, known, (sample(kernel, stamp=7),), 30, math.inf)
    assert known["a"].newest == 30
    assert judge(kernel, known, (), 30, 81.0)


@on_both
def test_of_two_frames_in_a_batch_both_are_noted(kernel: Any) -> None:
    known = edges(kernel)
    assert judge(kernel, known, (sample(kernel), sample(kernel, child="b", stamp=21)), STAMP_MAX, 81.0)
    assert [edge.newest for edge in known.values()] == [20, 21]


@on_both
@pytest.mark.parametrize(
    ("changes", "horizon", "square"),
    [
        ({"child": "new"}, STAMP_MAX, math.inf),
        ({"parent": "other"}, STAMP_MAX, math.inf),
        ({"authority": "you"}, STAMP_MAX, math.inf),
        ({"static": True}, STAMP_MAX, math.inf),
        ({"stamp": 41}, 40, math.inf),
        ({"stamp": STAMP_MIN + 1}, STAMP_MIN, math.inf),
        ({}, STAMP_MAX, 80.999),
        ({"x": math.nan}, STAMP_MAX, math.inf),
        ({"x": math.inf}, STAMP_MAX, 1e24),
    ],
)
def test_one_sample_that_is_not_plain_leaves_every_edge_as_it_was(
    kernel: Any, changes: dict[str, Any], horizon: int, square: float
) -> None:
    known = edges(kernel)
    plain = sample(kernel, child="b", stamp=min(30, horizon))
    for batch in ((plain, sample(kernel, **changes)), (sample(kernel, **changes), plain)):
        assert not judge(kernel, known, batch, horizon, square)
        assert [edge.newest for edge in known.values()] == [10, 10]


@on_both
def test_nobody_is_trusted_with_an_edge_that_trusts_nobody(kernel: Any) -> None:
    known = edges(kernel)
    known["a"].trusted = None
    assert known["a"].trusted is None
    assert not judge(kernel, known, (sample(kernel),), STAMP_MAX, math.inf)


@on_both
def test_a_batch_of_any_size_is_judged(kernel: Any) -> None:
    known = edges(kernel)
    assert judge(kernel, known, tuple(sample(kernel, stamp=stamp) for stamp in range(500)), STAMP_MAX, 81.0)
    assert known["a"].newest == 499


@needs_both
def test_wrong_arguments_raise() -> None:
    kernel: Any = COMPILED
    edge = kernel.Edge()
    for call in (
        lambda: judge(kernel, {}, [], 0, 0.0),
        lambda: judge(kernel, {}, (), "0", 0.0),  # type: ignore[arg-type]
        lambda: judge(kernel, {}, (), 0, "0"),  # type: ignore[arg-type]
        lambda: kernel.Judge({}, 0.0).allow(0, "1", 0),
        lambda: kernel.Judge({}, 0.0).allow(0, 1),
        lambda: kernel.Judge([], 0.0),
        lambda: kernel.Judge({}),
        lambda: kernel.Judge(edges={}, square=0.0),
        lambda: delattr(kernel.Judge({}, 0.0), "horizon"),
        lambda: edge.parent,
        lambda: setattr(edge, "parent", 5),
        lambda: setattr(edge, "newest", "5"),
        lambda: delattr(edge, "newest"),
        lambda: delattr(edge, "trusted"),
    ):
        with pytest.raises((TypeError, AttributeError)):
            call()
    assert not judge(kernel, {"a": 5}, (sample(kernel),), STAMP_MAX, math.inf)
    assert not judge(kernel, {}, (5,), STAMP_MAX, math.inf)
