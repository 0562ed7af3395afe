from typing import Any

import pytest
from support.samples import moving, over, static, tree_of

from tfbus import (
    LATEST,
    DisconnectedError,
    FutureExtrapolationError,
    Latest,
    PastExtrapolationError,
    TransformLookupError,
    TransformStamped,
    UnknownFrameError,
)
from tfbus.tree._lookup import resolve, resolve_travel
from tfbus.tree.forest import Forest


def forest(*batch: TransformStamped) -> Forest:
    return tree_of(*batch).forest


@pytest.mark.parametrize(
    ("target", "source", "at", "stamp", "x", "still"),
    [
        ("a", "b", 5, 5, 5.0, False),
        ("a", "b", LATEST, 30, 30.0, False),
        ("b", "c", LATEST, 20, 20.0, False),
        ("a", "d", LATEST, 20, 140.0, False),
        ("c", "d", 77, 77, 100.0, True),
        ("c", "d", LATEST, 4, 100.0, True),
        ("d", "d", LATEST, 4, 0.0, True),
        ("b", "b", LATEST, 30, 0.0, True),
        ("a", "a", LATEST, 0, 0.0, True),
        ("a", "a", 77, 77, 0.0, True),
    ],
)
def test_a_question_amounts_to_a_stamp_a_row_and_whether_it_holds_for_ever(
    target: str, source: str, at: int | Latest, stamp: int, x: float, still: bool
) -> None:
    known = forest(*over("a", "b", [0, 30]), *over("b", "c", [0, 20]), static("c", "d", 100.0, stamp=4))
    found = resolve(known, target, source, at, None)
    assert (found[0], found[1][0], found[2]) == (stamp, x, still)
    assert type(found[0]) is int
    again = resolve(known, target, source, at, None)
    assert again == found, "now with a path that is remembered"


@pytest.mark.parametrize("at", [-1, 31, LATEST])
@pytest.mark.parametrize(("target", "source"), ["ac", "ca"])
def test_whether_the_path_is_remembered_changes_no_error(target: str, source: str, at: int | Latest) -> None:
    known = forest(*over("a", "b", [0, 30]), *over("b", "c", [40, 50]))
    facts = []
    for _ in range(2):
        with pytest.raises(TransformLookupError) as caught:
            resolve(known, target, source, at, None)
        facts.append((type(caught.value), vars(caught.value)))
    assert facts[0] == facts[1]


def test_latest_is_looked_up_on_the_path_that_holds_then() -> None:
    known = forest(*over("map", "base", [0, 15]), *over("map", "tool", [0, 10], 3.0), *over("base", "tool", [20, 30]))
    stamp, row, still = resolve(known, "map", "tool", LATEST, None)
    assert (stamp, row[0], still) == (15, 30.0, False), "the new parent begins only at 20"


@pytest.mark.parametrize("not_before", [20, 21])
def test_a_newest_common_stamp_that_is_too_old_is_what_the_lagging_edge_is_short_of(not_before: int) -> None:
    known = forest(*over("a", "b", [0, 30]), *over("b", "c", [0, 20]))
    if not_before <= 20:
        assert resolve(known, "a", "c", LATEST, not_before)[0] == 20
        return
    with pytest.raises(FutureExtrapolationError) as caught:
        resolve(known, "a", "c", LATEST, not_before)
    assert (caught.value.child, caught.value.stamp) == ("c", 21)


@pytest.mark.parametrize(
    ("at", "source_at", "stamp", "x"),
    [(8, 3, 8, -5.0), (LATEST, 3, 10, -7.0), (8, LATEST, 8, 2.0), (LATEST, LATEST, 10, 0.0)],
)
def test_in_time_travel_the_stamp_is_that_of_the_target(
    at: int | Latest, source_at: int | Latest, stamp: int, x: float
) -> None:
    known = forest(*over("map", "cart", [0, 10]))
    found = resolve_travel(known, "cart", "cart", at, source_at, "map", None)
    assert (found[0], found[1][0], found[2]) == (stamp, x, False)


@pytest.mark.parametrize(("source_at", "stamp"), [(3, 3), (LATEST, 10)])
def test_in_time_travel_to_a_latest_that_only_static_edges_answer_the_stamp_is_that_of_the_source(
    source_at: int | Latest, stamp: int
) -> None:
    known = forest(*over("map", "cart", [0, 10]), static("map", "wall", stamp=7))
    assert resolve_travel(known, "wall", "cart", LATEST, source_at, "map", None)[0] == stamp
    assert resolve_travel(known, "wall", "map", LATEST, source_at, "map", None)[::2] == (7, True)


@pytest.mark.parametrize(
    ("target", "at", "source", "source_at", "kind", "child"),
    [
        ("a", 99, "b", 5, FutureExtrapolationError, "a"),
        ("a", 5, "b", 99, FutureExtrapolationError, "b"),
        ("a", 99, "b", 99, FutureExtrapolationError, "b"),
        ("a", 99, "b", -1, PastExtrapolationError, "b"),
        ("a", -1, "b", 99, PastExtrapolationError, "a"),
        ("a", -1, "b", -1, PastExtrapolationError, "a"),
        ("y", 5, "b", 99, DisconnectedError, None),
        ("y", 5, "b", -1, PastExtrapolationError, "b"),
        ("a", 99, "y", 5, DisconnectedError, None),
        ("a", -1, "y", 5, PastExtrapolationError, "a"),
    ],
)
def test_of_two_legs_without_an_answer_the_one_that_waiting_cannot_help_decides(
    target: str, at: int, source: str, source_at: int, kind: type[TransformLookupError], child: str | None
) -> None:
    known = forest(*over("map", "a", [0, 10]), *over("map", "b", [0, 10]), *over("x", "y", [0, 10]))
    with pytest.raises(kind) as caught:
        resolve_travel(known, target, source, at, source_at, "map", None)
    assert getattr(caught.value, "child", None) == child


@pytest.mark.parametrize("names", [("nobody", "b", "a"), ("a", "nobody", "b"), ("a", "b", "nobody")])
def test_unknown_frames_come_before_all_else(names: tuple[str, str, str]) -> None:
    target, source, fixed = names
    with pytest.raises(UnknownFrameError) as caught:
        resolve_travel(forest(moving("a", "b", 5)), target, source, -1, 99, fixed, None)
    assert caught.value.frame == "nobody"


@pytest.mark.parametrize(("source_at", "fixed"), [(5, None), (None, "a"), (1.5, "a"), (True, "a")])
def test_what_is_no_second_instant_is_a_type_error(source_at: Any, fixed: str | None) -> None:
    with pytest.raises(TypeError):
        resolve_travel(forest(moving("a", "b", 5)), "a", "b", 5, source_at, fixed, None)
