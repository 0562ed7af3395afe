import weakref
from collections.abc import Callable
from typing import Any

import pytest

from tfbus import (
    LATEST,
    DisconnectedError,
    FutureExtrapolationError,
    Latest,
    PastExtrapolationError,
    Question,
    TransformLookupError,
    UnknownFrameError,
)
from tfbus.waiting import live_tree
from tfbus.waiting.live_tree import Waiter, WaitingIndex, without_traceback


@pytest.fixture
def index() -> WaitingIndex:
    return WaitingIndex()


def waiter(wake: Callable[[], object] = list) -> Waiter:
    return Waiter(Question("map", "tool", LATEST), since=0, wake=wake)


def short_of(child: str, stamp: int | Latest) -> FutureExtrapolationError:
    return FutureExtrapolationError(child=child, stamp=stamp, oldest=None, newest=None)


def unknown(frame: str) -> UnknownFrameError:
    return UnknownFrameError(frame=frame)


def disconnected(target_root: str, source_root: str) -> DisconnectedError:
    return DisconnectedError(target="t", source="s", roots=(target_root, source_root))


def parked(index: WaitingIndex, error: TransformLookupError) -> Waiter:
    made = waiter()
    index.park(made, error)
    return made


def test_parking_with_an_error_that_waiting_cannot_help_is_a_type_error(index: WaitingIndex) -> None:
    with pytest.raises(TypeError, match="waiting cannot help"):
        index.park(waiter(), PastExtrapolationError(child="tool", stamp=1, oldest=2, newest=3))
    assert len(index) == 0
    assert index.pop_all() == []


def test_a_waiter_is_looked_at_when_any_frame_passes_its_first_limit(index: WaitingIndex) -> None:
    early, late, without = waiter(), waiter(), waiter()
    index.park(late, short_of("tool", 5), [("arm", 40), ("hand", 30)])
    index.park(early, short_of("tool", 5), [("arm", 20)])
    index.park(without, short_of("tool", 5))
    assert (index.limit, len(index.limits)) == (20, 2)
    assert index.pop_limited(20) == []
    assert index.pop_limited(30) == [early]
    assert (index.limit, len(index)) == (30, 3)
    assert index.pop_limited(31) == [late]
    assert index.limit > 2**63


def test_under_a_limit_that_some_frame_has_passed_a_waiter_is_given_by_its_own_frame_only(index: WaitingIndex) -> None:
    index.pop_limited(100)
    waiting = waiter()
    index.park(waiting, short_of("tool", 5), [("arm", 40), ("hand", 30), ("base", 100)])
    assert index.limit == 100
    assert index.pop_unblocked("arm", 40) == []
    assert index.pop_unblocked("base", 1_000) == []
    assert index.pop_unblocked("hand", 31) == [waiting]
    assert (len(index), index.by_frame) == (0, {})
    assert index.limit > 2**63


def test_a_waiter_that_is_blocked_and_limited_by_one_frame_is_given_once(index: WaitingIndex) -> None:
    index.pop_limited(100)
    waiting = waiter()
    index.park(waiting, disconnected("map", "odom"), [("map", 10), ("map", 20), ("odom", 10)])
    assert index.pop_unblocked("map", 50) == [waiting]
    assert index.by_frame == {}


def test_new_limits_of_a_waiter_replace_the_old_ones(index: WaitingIndex) -> None:
    waiting = waiter()
    index.park(waiting, short_of("tool", 500), [("arm", 10), ("hand", 50)])
    assert index.pop_limited(20) == [waiting]
    index.set_limits(waiting, [("arm", 15), ("hand", 50)])
    assert index.limit == 50
    assert index.pop_limited(60) == [waiting]
    index.set_limits(waiting, [("hand", 55)])
    assert index.pop_unblocked("arm", 1_000) == []
    assert index.pop_unblocked("hand", 1_000) == [waiting]
    assert index.by_frame == {}


def test_the_names_are_those_of_all_questions_of_parked_waiters(index: WaitingIndex) -> None:
    plain = waiter()
    wide = Waiter(Question("map", "laser", 5, 5, "odom"), 0, list)
    wide.others = (Question("base", "laser", 7),)
    index.park(plain, unknown("tool"))
    index.park(wide, unknown("laser"))
    assert set(index.names) == {"map", "tool", "laser", "odom", "base"}
    assert index.pop_asking_for({"base", "odom", "nothing"}) == [wide]
    assert set(index.names) == {"map", "tool"}
    index.remove(plain)
    assert set(index.names) == set()


def test_without_traceback_has_none_in_the_error_and_in_all_its_causes() -> None:
    def fail() -> None:
        try:
            try:
                raise unknown("camera")
            except UnknownFrameError as first:
                raise disconnected("map", "odom") from first
        except DisconnectedError as second:
            raise short_of("tool", 5) from second

    with pytest.raises(FutureExtrapolationError) as caught:
        fail()
    error = without_traceback(caught.value)
    assert error is caught.value
    chain = [error, error.__cause__, error.__cause__ and error.__cause__.__cause__]
    assert [type(part) for part in chain] == [FutureExtrapolationError, DisconnectedError, UnknownFrameError]
    assert [part and part.__traceback__ for part in chain] == [None, None, None]


class Watched(Waiter):
    """A waiter whose end can be noticed."""


@pytest.mark.parametrize(
    "let_go",
    [
        lambda index, _waiting: index.pop_unblocked("tool", 5),
        lambda index, _waiting: index.pop_unblocked("hand", 31),
        lambda index, _waiting: index.pop_asking_for({"map"}),
        lambda index, _waiting: index.pop_all(),
        lambda index, waiting: index.remove(waiting),
    ],
    ids=["unblocked", "beyond a limit", "asked for", "all", "removed"],
)
def test_no_reference_cycle_keeps_a_waiter_that_has_left_the_index(
    let_go: Callable[[WaitingIndex, Waiter], object],
) -> None:
    index = WaitingIndex()
    index.pop_limited(100)
    waiting = Watched(Question("map", "tool", 5), since=0, wake=list)
    index.park(waiting, short_of("tool", 5), [("hand", 30), ("arm", 40), ("base", 500)])
    assert index.names == {"map", "tool"}
    let_go(index, waiting)
    assert (len(index), index.by_frame, index.limits, set(index.names)) == (0, {}, [], set())
    gone = weakref.ref(waiting)
    del waiting
    assert gone() is None


@pytest.mark.parametrize("others_need", [4, 6])
def test_a_waiter_for_which_there_is_no_memory_leaves_nothing_and_disturbs_no_other(
    index: WaitingIndex, monkeypatch: pytest.MonkeyPatch, others_need: int
) -> None:
    other = parked(index, short_of("tool", others_need))

    def fail(_places: list[Any], _place: Any) -> None:
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr(live_tree, "insort", fail)
        with pytest.raises(MemoryError):
            index.park(waiter(), short_of("tool", 5))
    assert index.pop_unblocked("tool", 9) == [other]
    assert (len(index), index.by_frame) == (0, {})
