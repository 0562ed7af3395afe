"""Lookups at the door of the tree; `test_tree_model.py` holds all that a model of plain lists can tell."""

import inspect
import pickle
from typing import Any

import numpy as np
import pytest
from support.samples import moving, over, static, tree_of, x_of

from tfbus import LATEST, Buffer, FutureExtrapolationError, PastExtrapolationError, TransformTree
from tfbus.stamps import STAMP_MAX, STAMP_MIN

# Stamps and names


def test_the_first_and_last_possible_stamps_can_be_looked_up() -> None:
    tree = tree_of(moving("a", "b", STAMP_MIN, 1.0), moving("a", "b", STAMP_MAX, 2.0), keep=None)
    assert x_of(tree, "a", "b", STAMP_MIN) == 1.0
    assert x_of(tree, "a", "b") == 2.0
    assert x_of(tree, "a", "b", 0) == pytest.approx(1.5)


def test_not_before_applies_to_both_legs_of_time_travel() -> None:
    tree = tree_of(*over("map", "a", [0, 30]), *over("map", "b", [0, 20]))
    assert tree.lookup("a", "b", source_at=5, fixed="map", not_before=30).stamp == 30
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.lookup("a", "b", source_at=LATEST, fixed="map", not_before=30)
    assert caught.value.child == "b"


def test_any_text_is_a_frame_name_also_one_that_tf2_reserves() -> None:
    tree = tree_of(moving("NO_PARENT", "base link", 0, 1.0), moving("base link", "küche/🦾", 0, 1.0))
    assert x_of(tree, "NO_PARENT", "küche/🦾", 0) == 2.0


def test_a_stamp_that_was_asked_before_is_answered_from_the_samples_that_there_are_now() -> None:
    tree = tree_of(*over("a", "b", [0, 10]), *over("b", "c", [0, 10]), keep=2e-8)

    def asked() -> list[float]:
        return [x_of(tree, target, source, 5) for target, source in (("a", "b"), ("a", "c"), ("b", "c"), ("c", "a"))]

    assert asked() == asked() == [5.0, 10.0, 5.0, -10.0]
    tree.insert_many([moving("a", "b", 6, 12.0), moving("b", "c", 11, 11.0)])
    assert asked() == [10.0, 15.0, 5.0, -15.0]
    tree.insert(moving("a", "b", 6, 18.0))
    assert asked() == [15.0, 20.0, 5.0, -20.0]
    tree.insert(moving("a", "b", 20, 20.0))
    assert asked() == [15.0, 20.0, 5.0, -20.0]
    tree.insert(moving("a", "b", 26, 26.0))
    for _ in range(2):
        with pytest.raises(PastExtrapolationError):
            tree.lookup("a", "c", 5)
    tree.clear()
    tree.insert_many(over("a", "b", [5]))
    assert x_of(tree, "a", "b", 5) == 5.0


# Arguments


@pytest.mark.parametrize(
    ("question", "error", "text"),
    [
        ({"at": 1.5}, TypeError, r"from_seconds\(.*1\.5\)"),
        ({"at": np.float64(1.5)}, TypeError, r"from_seconds\(.*1\.5\)"),
        ({"source_at": 1.5, "fixed": "a"}, TypeError, r"from_seconds\(.*1\.5\)"),
        *(({"at": stamp}, TypeError, "a stamp is an int") for stamp in (True, None, "5")),
        *(({"source_at": stamp, "fixed": "a"}, TypeError, "a stamp is an int") for stamp in (True, "5")),
        ({"at": 2**63}, ValueError, "64-bit"),
        ({"source_at": 5}, TypeError, "source_at and fixed go together"),
        ({"source_at": LATEST}, TypeError, "source_at and fixed go together"),
        ({"fixed": "a"}, TypeError, "source_at and fixed go together"),
        ({"not_before": 1}, TypeError, "LATEST"),
        ({"not_after": 9}, TypeError, "LATEST"),
        ({"source_at": 5, "fixed": "a", "not_before": 1}, TypeError, "LATEST"),
        ({"source": 5}, TypeError, "must be a str"),
        ({"source": b"b"}, TypeError, "must be a str"),
        ({"target": None}, TypeError, "must be a str"),
    ],
)
@pytest.mark.parametrize("source", ["b", "c", "a"])
def test_a_wrong_argument_is_an_error_that_says_what_is_right(
    source: str, question: dict[str, Any], error: type[Exception], text: str
) -> None:
    tree = tree_of(moving("a", "b", 5), static("a", "c"))
    # After the first time the path is known, and a question with right arguments has a plain answer.
    for covariance in (False, True, False):
        with pytest.raises(error, match=text):
            tree.lookup(**{"target": "a", "source": source, "at": 5, "covariance": covariance, **question})
        assert tree.lookup("a", source, 5).stamp == 5


@pytest.mark.parametrize("at", [np.int64(5), np.datetime64(5, "ns")])
def test_a_number_or_a_date_of_numpy_is_a_stamp_and_is_returned_as_an_int(at: Any) -> None:
    tree = tree_of(moving("a", "b", 5), moving("z", "c", 1), moving("b", "c", 5), static("a", "d"))
    for question in ({}, {"tolerance": 1.0}, {"source_at": 5, "fixed": "a"}, {"source_at": at, "fixed": "a"}):
        for source in "bcd":
            found = tree.lookup("a", source, at, **question)
            assert type(found.stamp) is int
            assert found.stamp == 5


def test_the_latest_answer_goes_the_way_that_an_answer_at_its_stamp_goes() -> None:
    tree = tree_of(
        moving("map", "b", 100, 1.0),
        moving("b", "c", 103, 2.0),
        moving("c", "b", 97, 4.0),
        moving("b", "tool", 97, 8.0),
    )
    # The newest way, down to c, has no sample at 97, but that of c's former child has one.
    assert tree.lookup("c", "tool").stamp == 97
    assert x_of(tree, "c", "tool") == x_of(tree, "c", "tool", 97) == 12.0


METHODS: list[Any] = [TransformTree.lookup, TransformTree.lookup_many, Buffer.lookup_nowait]


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.__qualname__)
def test_it_has_the_signature_and_the_documentation_of_the_method(method: Any) -> None:
    function = inspect.unwrap(method)
    assert inspect.isfunction(function)
    assert inspect.signature(method) == inspect.signature(function)
    assert [*inspect.signature(method).parameters][:3] == ["self", "target", "source"]
    assert method.__doc__.startswith("The transform")
    names = (method.__module__, method.__name__, method.__annotations__)
    assert names == (function.__module__, function.__name__, function.__annotations__)
    assert inspect.isroutine(method)


def test_it_binds_pickles_and_is_overridden_as_a_method() -> None:
    class Counted(TransformTree):
        asked = 0

        def lookup(self, *args: Any, **options: Any) -> Any:
            self.asked += 1
            return super().lookup(*args, **options)

    tree = tree_of(moving("map", "cart", 1, 1.0))
    counted = Counted()
    counted.insert(moving("map", "cart", 1, 1.0))
    assert counted.can_transform("map", "cart", 1)
    assert counted.lookup("map", "cart") == tree.lookup("map", "cart") == TransformTree.lookup(tree, "map", "cart", 1)
    assert counted.asked == 2
    assert pickle.loads(pickle.dumps(tree.lookup))("map", "cart").stamp == 1
    assert tree.lookup.__self__ is tree  # type: ignore[attr-defined]
