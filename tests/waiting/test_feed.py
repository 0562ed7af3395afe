"""The feed is only a faster way: with it and without it, a live tree wakes the same lookups, in the same order."""

from functools import partial
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from support.histories import live_tree, tree_over
from support.samples import moving, static

from tfbus import LATEST, Question, TransformLookupError
from tfbus.errors import MAY_COME
from tfbus.waiting.live_tree import LiveTree, Waiter

FRAMES = "abc"
STAMPS = st.integers(0, 12)
SAMPLES = st.tuples(
    st.sampled_from(["map", "a", "b"]), st.sampled_from(FRAMES), STAMPS, st.sampled_from([False] * 9 + [True])
)
STEPS = st.one_of(
    st.tuples(st.just("insert"), st.lists(SAMPLES, min_size=1, max_size=4)),
    st.tuples(st.just("park"), st.sampled_from(["map", *FRAMES]), st.sampled_from(FRAMES), STAMPS | st.none()),
    st.tuples(st.just("remove"), st.sampled_from(FRAMES)),
    st.tuples(st.just("end one"), st.integers(0, 5)),
)


class Play:
    """A live tree whose plain edges go on by themselves, and what happened to it."""

    def __init__(self, keep: float | None, feeds: bool) -> None:
        self.live: LiveTree = live_tree(keep)
        if not feeds:
            self.live.feed = None
        self.said: list[object] = []
        self.waiters: list[Waiter] = []

    def insert(self, drawn: list[tuple[str, str, int, bool]]) -> None:
        batch = tuple(
            static(parent, child) if is_static else moving(parent, child, stamp, float(stamp))
            for parent, child, stamp, is_static in drawn
            if parent != child
        )
        self.live.insert(batch)

    def park(self, target: str, source: str, at: int | None) -> None:
        stamp: Any = LATEST if at is None else at
        try:
            tree_over(self.live).lookup(target, source, stamp)
        except MAY_COME as error:
            waiter = Waiter(Question(target, source, stamp), 0, list)
            waiter.wake = partial(self.note, waiter)
            self.live.park(waiter, error)
            self.waiters.append(waiter)
        except TransformLookupError:
            return

    def note(self, waiter: Waiter) -> None:
        answer = waiter.answer
        found = None if answer is None else (answer.stamp, answer.transform)
        self.said.append((waiter.question, found, waiter.version == self.live.forest.version))

    def remove(self, frame: str) -> None:
        self.live.remove_frame(frame)

    def end_one(self, number: int) -> None:
        if self.waiters:
            self.live.waiting.remove(self.waiters.pop(number % len(self.waiters)))


@given(st.sampled_from([None, 5e-9]), st.lists(STEPS, max_size=40))
def test_with_and_without_the_feed_the_same_lookups_are_woken_with_the_same_answers(
    keep: float | None, steps: list[tuple[str, ...]]
) -> None:
    plays = [Play(keep, feeds) for feeds in (True, False)]
    for play in plays:
        # Then most of what is drawn continues these edges.
        play.insert([("map", child, 1, False) for child in FRAMES])
    for name, *arguments in steps:
        for play in plays:
            getattr(play, name.replace(" ", "_"))(*arguments)
        first, second = (play.live for play in plays)
        assert plays[0].said == plays[1].said
        assert list(map(str, first.waiting.pending())) == list(map(str, second.waiting.pending()))
        assert first.waiting.by_frame.keys() == second.waiting.by_frame.keys()
        assert first.statistics(0) == second.statistics(0)
        assert [place[:2] for place in first.waiting.limits] == [place[:2] for place in second.waiting.limits]
        assert list(first.waiting.names) == list(second.waiting.names) or name != "remove"
