from functools import partial
from itertools import product
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.histories import live_tree, tree_over
from support.samples import any_samples, moving, static

from tfbus import (
    LATEST,
    BufferStatistics,
    ClockResetError,
    DisconnectedError,
    Edge,
    ExtrapolationError,
    FutureExtrapolationError,
    InvalidTransformError,
    Latest,
    PastExtrapolationError,
    Question,
    TransformLookupError,
    TransformStamped,
    TransformTree,
    UnknownFrameError,
)
from tfbus.errors import MAY_COME
from tfbus.tree.forest import LoopingSample
from tfbus.tree.history import FrameHistory
from tfbus.tree.lookup import Policy, answer
from tfbus.waiting.live_tree import LiveTree, Waiter


def park(live: LiveTree, target: str, source: str, at: int, woken: list[str]) -> None:
    """Park a lookup that appends its source to `woken` when it is woken."""
    with pytest.raises(TransformLookupError) as caught:
        tree_over(live).lookup(target, source, at)
    waiter = Waiter(Question(target, source, at), 0, lambda: woken.append(source))
    live.park(waiter, caught.value)


def blockers(live: LiveTree) -> list[type[TransformLookupError]]:
    return [type(pending.blocked_by) for pending in live.waiting.pending()]


def test_a_sample_wakes_exactly_the_waiters_whose_stamp_it_covers() -> None:
    live = live_tree(None)
    woken: list[str] = []
    live.insert((moving("map", "a", 1), moving("map", "b", 1)))
    for at in (5, 3, 4):
        park(live, "map", "a", at, woken)
    park(live, "map", "b", 3, woken)
    live.insert((moving("map", "a", 2),))
    assert woken == []
    live.insert((moving("map", "a", 4),))
    assert woken == ["a", "a"]
    assert [pending.question.at for pending in live.waiting.pending()] == [5, 3]


def test_an_expired_or_late_sample_does_not_wake_waiters_for_a_later_stamp() -> None:
    live = live_tree(1e-6)
    woken: list[str] = []
    live.insert((moving("map", "a", 9_000), moving("map", "a", 10_000)))
    park(live, "map", "a", 11_000, woken)
    live.insert((moving("map", "a", 1), moving("map", "a", 9_500)))
    assert woken == []
    assert live.statistics(4) == BufferStatistics(offered=4, inserted=3, replaced=0, expired=1, waiting=1)


@pytest.mark.parametrize("sample", [moving("map", "a", 1), moving("a", "child", 1), static("map", "a")])
def test_the_first_sample_that_names_an_unknown_frame_wakes_its_waiters(sample: object) -> None:
    live = live_tree(None)
    woken: list[str] = []
    live.insert((moving("map", "b", 1),))
    park(live, "map", "a", 1, woken)
    assert blockers(live) == [UnknownFrameError]
    live.insert((moving("b", "c", 1),))
    assert woken == []
    live.insert((sample,))  # type: ignore[arg-type]
    assert woken == ["a"]


@pytest.mark.parametrize("root", ["map", "world"])
def test_a_sample_of_either_root_wakes_a_waiter_for_two_trees(root: str) -> None:
    live = live_tree(None)
    woken: list[str] = []
    live.insert((moving("map", "a", 1), moving("world", "b", 1)))
    park(live, "a", "b", 1, woken)
    assert blockers(live) == [DisconnectedError]
    live.insert((moving("map", "a", 2), moving("world", "b", 2)))
    assert woken == []
    live.insert((moving("elsewhere", root, 1),))
    assert woken == ["b"]


@pytest.mark.parametrize(
    "sample",
    [
        pytest.param(moving("other", "a", 9), id="another parent"),
        pytest.param(static("map", "a"), id="another kind"),
        pytest.param(moving("map", "a", 0), id="a longer past"),
    ],
)
def test_a_change_of_parent_kind_or_oldest_sample_wakes_the_waiters_below(sample: object) -> None:
    live = live_tree(None)
    woken: list[str] = []
    live.insert((moving("map", "a", 1), moving("map", "b", 1)))
    park(live, "map", "a", 9, woken)
    park(live, "map", "b", 9, woken)
    live.insert((sample,))  # type: ignore[arg-type]
    assert woken == ["a"]


def test_removing_a_frame_wakes_the_waiters_for_it_and_its_descendants() -> None:
    live = live_tree(None)
    woken: list[str] = []
    live.insert((moving("map", "a", 1), moving("map", "b", 1), moving("b", "c", 1)))
    for source in "abc":
        park(live, "map", source, 9, woken)
    live.remove_frame("unknown")
    assert woken == []
    live.remove_frame("b")
    assert sorted(woken) == ["b", "c"]
    assert tree_over(live).frames() == ["a", "b", "c", "map"]
    live.remove_frame("a")
    assert sorted(woken) == ["a", "b", "c"]
    assert tree_over(live).frames() == ["b", "c"]


def test_removing_the_last_child_of_a_root_wakes_the_waiters_for_the_root() -> None:
    live = live_tree(None)
    woken: list[str] = []
    live.insert((moving("map", "a", 1), moving("world", "b", 1)))
    park(live, "map", "b", 9, woken)
    live.remove_frame("a")
    assert woken == ["b"]


def test_a_reset_drops_moving_samples_keeps_static_ones_and_wakes_every_waiter() -> None:
    live = live_tree(None)
    woken: list[str] = []
    live.insert((moving("map", "a", 5), static("a", "camera")))
    park(live, "map", "a", 9, woken)
    live.reset(5, 2)
    assert woken == ["a"]
    error = live.last_reset
    assert isinstance(error, ClockResetError)
    assert (error.before, error.after) == (5, 2)
    assert tree_over(live).can_transform("a", "camera", 5)
    with pytest.raises(FutureExtrapolationError):
        tree_over(live).lookup("map", "a", 5)


def test_two_equal_resets_are_two_objects() -> None:
    live = live_tree(None)
    live.reset(5, 2)
    first = live.last_reset
    live.reset(5, 2)
    assert live.last_reset is not first


def test_the_end_wakes_every_waiter_and_keeps_its_first_reason() -> None:
    live = live_tree(None)
    woken: list[str] = []
    park(live, "map", "a", 9, woken)
    live.end("the buffer is closed")
    live.end("the bus is closed")
    assert woken == ["a"]
    assert live.end_reason == "the buffer is closed"


def test_statistics_count_every_offered_sample_once() -> None:
    live = live_tree(1.0)
    batch = (moving("map", "a", 5), moving("map", "a", 5, 1.0), static("map", "s"), static("map", "s", x=2.0))
    live.insert(batch)
    live.insert((moving("map", "a", 10**10), moving("map", "a", 6)))
    assert live.statistics(6) == BufferStatistics(offered=6, inserted=3, replaced=2, expired=1, waiting=0)


STAMPS: tuple[int | Latest, ...] = (LATEST, 5, 15)
QUESTIONS = [
    *(Question(target, source, at) for target, source, at in product("abcd", "abcd", STAMPS)),
    *(Question(target, source, at, 10, fixed) for target, source, fixed, at in product("abc", "abc", "abc", STAMPS)),
]


def ask(live: LiveTree, question: Question) -> None:
    answer(
        live.forest,
        question.target,
        question.source,
        question.at,
        question.source_at,
        question.fixed,
        None,
        question.policy,
    )


@given(st.lists(st.lists(any_samples("abcd", 20), min_size=1, max_size=3), max_size=8), st.sampled_from([None, 8e-9]))
def test_a_waiter_that_is_not_woken_still_has_no_answer(
    batches: list[list[TransformStamped]], keep: float | None
) -> None:
    live, judge = live_tree(keep), TransformTree(keep)
    asleep: set[Question] = set()
    woken = list(QUESTIONS)
    past: list[Question] = []
    for batch in batches:
        for question in woken:
            try:
                ask(live, question)
            except PastExtrapolationError:
                past.append(question)
            except TransformLookupError as error:
                live.park(Waiter(question, 0, partial(woken.append, question)), error)
                asleep.add(question)
        woken[:] = past
        past.clear()
        try:
            judge.insert_many(batch)
        except InvalidTransformError:
            continue
        live.insert(tuple(batch))
        asleep.difference_update(woken)
        for question in asleep:
            # Nor is it hopeless.
            with pytest.raises(MAY_COME):
                ask(live, question)


@pytest.mark.parametrize(
    ("before", "then", "target", "source", "at"),
    [
        pytest.param(
            [moving("b", "a", 11), moving("a", "d", 15), moving("b", "d", 13)],
            moving("b", "a", 14),
            "d",
            "b",
            LATEST,
            id="the parent changed between the common stamp and the newest",
        ),
        pytest.param(
            [moving("a", "d", 13), moving("d", "c", 16), moving("c", "b", 18), moving("a", "b", 16)],
            moving("a", "d", 18),
            "b",
            "d",
            LATEST,
            id="another edge is missing at the common stamp",
        ),
        pytest.param(
            [moving("a", "b", 17), moving("d", "a", 16), moving("c", "b", 23)],
            static("b", "d"),
            "d",
            "b",
            22,
            id="a root gets a parent below itself in the past",
        ),
    ],
)
def test_late_samples_wake_the_waiters_that_they_answer(
    before: list[TransformStamped], then: TransformStamped, target: str, source: str, at: int | Latest
) -> None:
    live = live_tree(None)
    for sample in before:
        live.insert((sample,))
    with pytest.raises(TransformLookupError) as caught:
        tree_over(live).lookup(target, source, at)
    woken: list[str] = []
    live.waiting.park(Waiter(Question(target, source, at), 0, partial(woken.append, source)), caught.value)
    live.insert((then,))
    assert tree_over(live).can_transform(target, source, at)
    assert woken == [source]


def test_changes_of_parents_elsewhere_wake_no_waiter() -> None:
    live = live_tree(None)
    live.insert((moving("map", "a", 1), moving("map", "b", 1), static("map", "mount")))
    woken: list[str] = []
    for _ in range(100):
        park(live, "map", "a", 9, woken)
    for stamp in range(2, 6):
        live.insert((moving("left" if stamp % 2 else "right", "b", stamp),))
    live.insert((moving("map", "b", 0),))
    live.insert((static("map", "mount", x=1.0),))
    assert woken == []
    assert len(live.waiting) == 100


@pytest.mark.parametrize(
    ("before", "question", "harmless", "then"),
    [
        pytest.param(
            [moving("map", "a", 0), moving("a", "b", 0), moving("a", "b", 9)],
            Question("map", "b", 5),
            moving("a", "b", 10),
            moving("a", "b", 11),
            id="another edge slides past the stamp",
        ),
        pytest.param(
            [moving("map", "a", 0), moving("a", "b", 3)],
            Question("map", "b", 5),
            moving("a", "b", 13),
            moving("a", "b", 16),
            id="another edge that lags jumps over the stamp",
        ),
        pytest.param(
            [moving("map", "a", 0), moving("a", "b", 0), moving("a", "b", 9), moving("map", "other", 500)],
            Question("map", "b", 5),
            moving("map", "other", 600),
            moving("a", "b", 11),
            id="other frames are far ahead",
        ),
        pytest.param(
            [moving("map", "a", 0), moving("a", "b", 0), moving("a", "b", 9)],
            Question("map", "b", 30, 5, "a"),
            moving("map", "a", 9),
            moving("a", "b", 11),
            id="the other half of time travel slides past its stamp",
        ),
        pytest.param(
            [moving("map", "a", 0), moving("a", "b", 0), moving("a", "b", 9)],
            Question("map", "b", 5, policy=Policy(tolerance=4)),
            moving("a", "b", 15),
            moving("a", "b", 20),
            id="with a tolerance, the nearest sample counts",
        ),
        pytest.param(
            [moving("map", "a", 0), moving("a", "b", 3)],
            Question("map", "b", 5, policy=Policy(max_gap=4)),
            moving("a", "b", 4),
            moving("a", "b", 9),
            id="a gap opens round the stamp",
        ),
    ],
)
def test_a_waiter_is_woken_by_the_insertion_that_makes_it_hopeless(
    before: list[TransformStamped], question: Question, harmless: TransformStamped, then: TransformStamped
) -> None:
    live = live_tree(10e-9)
    for sample in before:
        live.insert((sample,))
    woken: list[str] = []
    with pytest.raises(MAY_COME) as caught:
        ask(live, question)
    live.park(Waiter(question, 0, partial(woken.append, "woken")), caught.value)
    live.insert((harmless,))
    if woken:
        # Woken early, it asks again, and still may have an answer.
        with pytest.raises(MAY_COME) as caught:
            ask(live, question)
        live.park(Waiter(question, 0, partial(woken.append, "woken")), caught.value)
        woken.clear()
    assert woken == []
    live.insert((then,))
    assert woken == ["woken"]
    assert live.waiting.by_frame == {}
    with pytest.raises(ExtrapolationError) as raised:
        ask(live, question)
    assert not isinstance(raised.value, FutureExtrapolationError)


@pytest.mark.parametrize("far_ahead", [False, True])
def test_nothing_is_left_of_a_waiter_that_a_sample_wakes_before_it_becomes_hopeless(far_ahead: bool) -> None:
    live = live_tree(10e-9)
    live.insert((moving("map", "a", 0), moving("a", "b", 0), moving("a", "b", 9)))
    woken: list[str] = []
    if far_ahead:
        live.insert((moving("map", "other", 0),))
        park(live, "map", "other", 5, [])
        live.insert((moving("map", "other", 600),))
        live.waiting.pop_limited(600)
    park(live, "map", "b", 5, woken)
    assert len(live.waiting.limits) == (not far_ahead), "samples that are 10 ns newer drop those of b around the stamp"
    assert ("b" in live.waiting.by_frame) is far_ahead
    live.insert((moving("map", "a", 5),))
    assert woken == ["b"]
    assert (len(live.waiting), live.waiting.by_frame, live.waiting.limits) == (0, {}, [])


def test_a_frame_far_ahead_wakes_no_waiter_whose_own_edges_have_only_come_to_their_limits() -> None:
    live = live_tree(10e-9)
    live.insert((moving("map", "a", 0), moving("a", "b", 0), moving("a", "b", 10), moving("map", "other", 0)))
    woken: list[str] = []
    park(live, "map", "b", 5, woken)
    live.insert((moving("map", "other", 600),))
    assert woken == []
    live.insert((moving("a", "b", 11),))
    assert woken == ["b"]


def test_an_expired_sample_of_a_frame_that_is_static_by_the_end_of_its_batch_is_not_ahead() -> None:
    live = live_tree(10e-9)
    live.tell_expired = lambda _sample, newest, _authority: newest > 0
    live.insert((moving("map", "a", 100), moving("map", "b", 100)))
    live.insert((moving("map", "a", 1), moving("map", "b", 1), static("map", "b")))
    assert (live.statistics(5).expired, live.expired_ahead) == (2, 1)


def test_another_question_of_a_waiter_that_becomes_hopeless_wakes_it() -> None:
    live = live_tree(10e-9)
    live.insert((moving("map", "a", 0), moving("map", "b", 0), moving("map", "b", 9)))
    woken: list[str] = []
    with pytest.raises(FutureExtrapolationError) as caught:
        tree_over(live).lookup("map", "a", 5)
    others = (Question("map", "b", 5),)
    live.park(Waiter(Question("map", "a", 5), 0, partial(woken.append, "a"), others), caught.value)
    live.insert((moving("map", "b", 10),))
    assert woken == []
    live.insert((moving("map", "b", 11),))
    assert woken == ["a"]


class CountedFrames(dict[str, FrameHistory]):
    """Counts how often a frame is looked up."""

    reads = 0

    def get(self, key: str, default: Any = None) -> Any:
        self.reads += 1
        return super().get(key, default)


@pytest.mark.parametrize("event", ["another parent", "removal"])
def test_a_change_of_parents_costs_no_walk_through_all_frames(event: str) -> None:
    live = live_tree(None)
    live.insert(tuple(moving("map", f"f{number}", 1) for number in range(2_000)))
    live.insert(tuple(moving(f"f{number}", f"g{number}", 1) for number in range(2_000)))
    woken: list[str] = []
    for source in ("g7", "g8"):
        park(live, "map", source, 9, woken)
    live.forest.frames = frames = CountedFrames(live.forest.frames)
    if event == "removal":
        live.remove_frame("f7")
    else:
        live.insert((moving("elsewhere", "f7", 2),))
    assert woken == ["g7"]
    assert frames.reads < 50


def test_late_samples_that_form_a_loop_are_told_once_for_each() -> None:
    told: list[LoopingSample] = []
    live = LiveTree(live_tree(None).forest, told.append)
    live.insert((moving("c", "a", 0), moving("c", "a", 9), moving("a", "b", 4), moving("a", "b", 9)))
    live.insert((moving("c", "a", 10),))
    assert told == []
    late = moving("b", "a", 5)
    live.insert((late,))
    live.insert((moving("c", "a", 11),))
    assert told == [(late, (5, ("a", "b", "a")))]
    assert live.statistics(7).looped == 1


def test_an_error_of_one_waiter_does_not_keep_others_from_being_woken() -> None:
    live = live_tree(None)
    live.insert((moving("map", "a", 1),))
    woken: list[str] = []

    def fail() -> None:
        raise RuntimeError("Event loop is closed")

    with pytest.raises(TransformLookupError) as caught:
        tree_over(live).lookup("map", "a", 9)
    live.waiting.park(Waiter(Question("map", "a", 9), 0, fail), caught.value)
    park(live, "map", "a", 9, woken)
    live.insert((moving("map", "a", 9),))
    assert woken == ["a"]


def test_changing_the_tree_of_a_buffer_directly_is_an_error() -> None:
    live = live_tree(None)
    live.insert((moving("map", "a", 1),))
    tree = tree_over(live)
    for change, instead in (
        (partial(tree.insert, moving("map", "a", 2)), "use bus.publish"),
        (partial(tree.insert_many, [moving("map", "a", 2)]), "use bus.publish"),
        (partial(tree.remove_frame, "a"), "use bus.remove_frame"),
        (tree.clear, "clear a copy"),
        (partial(tree.forget_before, 2), "its samples leave it after `keep` seconds"),
    ):
        with pytest.raises(RuntimeError, match=f"a bus feeds this tree: {instead}"):
            change()
    assert tree.edges() == [Edge("map", "a", False, 1, 1, 1, "")]
    own = tree_over(live).copy()
    own.insert(moving("map", "a", 2))
    assert (tree_over(live).latest_common_stamp("map", "a"), own.latest_common_stamp("map", "a")) == (1, 2)


def test_an_end_callback_is_called_once_or_at_once_after_the_end() -> None:
    live = live_tree(10.0)
    calls: list[str] = []
    live.on_end(lambda: calls.append("early"))
    live.on_end(lambda: calls.append("closed")).close()
    assert live.has_waiters
    live.end("the bus is closed")
    assert calls == []
    live.call_end_callbacks()
    live.call_end_callbacks()
    assert calls == ["early"]
    live.on_end(lambda: calls.append("late"))
    assert calls == ["early", "late"]
    assert not live.has_waiters


def test_an_error_of_an_end_callback_is_logged_and_the_others_are_called(
    caplog: pytest.LogCaptureFixture,
) -> None:
    live = live_tree(10.0)
    calls: list[str] = []
    live.on_end(lambda: 1 / 0)
    live.on_end(lambda: calls.append("called"))
    live.end("the bus is closed")
    live.call_end_callbacks()
    assert calls == ["called"]
    assert "ZeroDivisionError" in caplog.text


def test_forgetting_edges_without_samples_that_form_a_loop_wakes_the_waiters_below() -> None:
    live = live_tree(None)
    woken: list[str] = []
    live.insert((moving("b", "c", 11), moving("a", "b", 10)))
    live.reset(11, 9)
    with pytest.raises(TransformLookupError) as caught:
        tree_over(live).lookup("c", "b")
    live.waiting.park(Waiter(Question("c", "b", LATEST), 0, lambda: woken.append("b")), caught.value)
    # Now a is the parent of c, and the edges that the reset left without samples are contradicted.
    live.insert((static("a", "c"),))
    live.insert((moving("a", "b", 10),))
    assert tree_over(live).can_transform("c", "b")
    assert woken == ["b"]


def test_an_interrupt_of_one_wake_up_keeps_no_other_from_being_woken() -> None:
    live = live_tree(None)
    woken: list[str] = []

    def interrupt() -> None:
        raise KeyboardInterrupt

    with pytest.raises(UnknownFrameError) as caught:
        tree_over(live).lookup("map", "a", 5)
    live.park(Waiter(Question("map", "a", 5), 0, interrupt), caught.value)
    park(live, "map", "a", 5, woken)
    with pytest.raises(KeyboardInterrupt):
        live.insert((moving("map", "a", 5),))
    assert woken == ["a"]
    assert live.waiting.pending() == ()
