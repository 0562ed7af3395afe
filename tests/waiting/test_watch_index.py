from itertools import permutations

from hypothesis import given, settings
from hypothesis import strategies as st
from support.live_trees import live_tree, tree_over
from support.samples import any_samples, moving, static

from tfbus import ClockResetError, InvalidTransformError, TransformLookupError, TransformStamped, TransformTree
from tfbus.waiting.live_tree import LiveTree
from tfbus.waiting.watch_index import WatchState


class Watcher:
    """A watch that writes down how often it was woken."""

    def __init__(self, live: LiveTree, target: str, source: str) -> None:
        self.live = live
        self.state = WatchState(target, source, self._woken)
        self.woken = 0
        live.watching.add(self.state)

    def _woken(self) -> None:
        self.woken += 1

    def look(self) -> TransformStamped | None:
        """The answer, which is followed from now on; None while there is none."""
        try:
            answer = tree_over(self.live).lookup(self.state.target, self.state.source)
        except TransformLookupError:
            self.live.watching.set_no_answer(self.state)
            return None
        self.live.watching.set_answer(self.state, self.live.forest, answer.stamp)
        self.state.outdated = False
        return answer


def under(live: LiveTree) -> set[str]:
    return set(live.watching.by_frame)


def test_an_answer_is_kept_under_the_edges_that_it_is_made_of() -> None:
    live = live_tree(None)
    live.insert((moving("world", "map", 1), moving("map", "a", 1), moving("map", "b", 1), static("b", "c")))
    watcher = Watcher(live, "a", "c")
    assert under(live) == set()
    watcher.look()
    assert under(live) == {"a", "b", "c"}


def test_the_first_batch_wakes_and_those_that_follow_are_only_counted() -> None:
    live = live_tree(None)
    live.insert((moving("map", "a", 1), moving("a", "b", 1)))
    watcher = Watcher(live, "map", "b")
    watcher.look()
    live.insert((moving("map", "other", 2),))
    assert (watcher.woken, watcher.state.outdated, watcher.state.updates) == (0, False, 0)
    live.insert((moving("map", "a", 2), moving("a", "b", 2), moving("a", "b", 3)))
    live.insert((moving("map", "a", 3),))
    assert (watcher.woken, watcher.state.outdated, watcher.state.updates) == (1, True, 2)


def test_who_has_no_answer_hears_of_no_sample() -> None:
    live = live_tree(None)
    watcher = Watcher(live, "map", "a")
    assert watcher.look() is None
    live.insert((moving("map", "a", 1),))
    assert (watcher.woken, watcher.state.updates) == (0, 0)
    watcher.look()
    live.remove_frame("a")
    assert watcher.woken == 1
    assert watcher.look() is None
    assert under(live) == set()


def test_for_as_long_as_a_frame_has_had_two_parents_the_ways_by_both_are_followed() -> None:
    live = live_tree(5e-9)
    live.insert((moving("map", "left", 1), moving("map", "right", 1), moving("left", "box", 1)))
    watcher = Watcher(live, "map", "box")
    live.insert((moving("right", "box", 3),))
    # The answer is that of stamp 1, when the box was on the left; how far to go, the newest samples say.
    watcher.look()
    assert under(live) == {"left", "right", "box"}
    live.insert((moving("map", "left", 9), moving("map", "right", 9), moving("right", "box", 9)))
    watcher.look()
    assert under(live) == {"right", "box"}


def test_late_samples_that_close_a_loop_round_the_way_flag_it() -> None:
    live = live_tree(None)
    live.insert((moving("a", "c", 0),))
    live.insert((moving("a", "b", 0), moving("c", "b", 1), moving("d", "a", 1)))
    # At stamp 0 b hung on a, and now a on b.
    watchers = [Watcher(live, target, source) for target, source in permutations("abc", 2)]
    answers = [watcher.look() for watcher in watchers]
    live.insert((moving("b", "a", 0, 1.0),))
    flagged = [watcher for watcher in watchers if watcher.state.outdated]
    changed = [watcher for watcher, answer in zip(watchers, answers, strict=True) if watcher.look() != answer]
    assert changed
    assert set(changed) <= set(flagged)
    assert {watcher.woken for watcher in flagged} == {1}


def test_another_parent_elsewhere_flags_nobody_whose_own_frames_have_kept_theirs() -> None:
    live = live_tree(None)
    live.insert((moving("world", "map", 1), moving("map", "a", 1), moving("map", "b", 1)))
    watcher = Watcher(live, "map", "a")
    watcher.look()
    live.insert((moving("mars", "map", 2),))
    live.insert((moving("a", "b", 2),))
    live.insert((moving("map", "new", 2),))
    assert (watcher.woken, watcher.state.outdated) == (0, False)


def test_a_reset_flags_and_wakes_everybody_and_keeps_them_in() -> None:
    live = live_tree(None)
    live.insert((moving("map", "a", 5),))
    answered, waiting = Watcher(live, "map", "a"), Watcher(live, "map", "nobody")
    answered.look()
    live.reset(5, 2)
    for watcher in (answered, waiting):
        assert (watcher.woken, watcher.state.outdated) == (1, True)
        assert isinstance(watcher.state.reset, ClockResetError)
    assert (len(live.watching), under(live)) == (2, set())


def test_the_end_wakes_everybody_and_takes_them_out_for_good() -> None:
    live = live_tree(None)
    live.insert((moving("map", "a", 5),))
    watchers = [Watcher(live, "map", "a"), Watcher(live, "map", "nobody")]
    watchers[0].look()
    live.end("the bus is closed")
    assert [(watcher.woken, watcher.state.ended) for watcher in watchers] == [(1, True), (1, True)]
    assert watchers[0].look() is not None
    assert (len(live.watching), under(live)) == (0, set())


def test_a_watch_that_is_taken_out_leaves_the_others_under_the_same_frame() -> None:
    live = live_tree(None)
    live.insert((moving("map", "a", 1),))
    going, staying = Watcher(live, "map", "a"), Watcher(live, "a", "map")
    for watcher in (going, staying):
        watcher.look()
    for _ in range(2):
        live.watching.remove(going.state)
    live.insert((moving("map", "a", 2),))
    assert (going.woken, staying.woken, len(live.watching)) == (0, 1, 1)


def test_one_watch_that_cannot_be_woken_does_not_keep_the_others_asleep() -> None:
    live = live_tree(None)
    live.insert((moving("map", "a", 1),))

    def gone() -> None:
        raise RuntimeError("Event loop is closed")

    first, second = Watcher(live, "map", "a"), Watcher(live, "map", "a")
    first.state.wake = gone
    for watcher in (first, second):
        watcher.look()
    live.insert((moving("map", "a", 2),))
    assert second.woken == 1


def test_whether_a_task_waits_here_is_known() -> None:
    live = live_tree(None)
    watcher = Watcher(live, "map", "a")
    assert not live.has_waiters
    watcher.state.waiting = True
    assert live.has_waiters


@settings(deadline=None)
@given(st.lists(st.lists(any_samples("abcd", 20), min_size=1, max_size=3), max_size=8), st.sampled_from([None, 8e-9]))
def test_whoever_has_no_flag_has_the_same_answer_as_before(
    batches: list[list[TransformStamped]], keep: float | None
) -> None:
    live, judge = live_tree(keep), TransformTree(keep)
    watchers = [Watcher(live, target, source) for target, source in permutations("abcd", 2)]
    answers = [watcher.look() for watcher in watchers]
    for batch in batches:
        try:
            judge.insert_many(batch)
        except InvalidTransformError:
            continue
        live.insert(tuple(batch))
        for place, watcher in enumerate(watchers):
            if watcher.state.outdated:
                answers[place] = watcher.look()
            else:
                # A frame in itself is left out: with its last child it can become unknown, which changes no answer.
                assert tree_over(live).lookup(watcher.state.target, watcher.state.source) == answers[place]
