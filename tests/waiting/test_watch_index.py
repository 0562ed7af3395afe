from itertools import permutations

from hypothesis import given
from hypothesis import strategies as st
from support.histories import live_tree, tree_over
from support.samples import any_samples, moving, static

from tfbus import ClockResetError, InvalidTransformError, TransformLookupError, TransformStamped, TransformTree
from tfbus.waiting.live_tree import LiveTree
from tfbus.waiting.watch_index import WatchState


class Watcher:
    """A watch that counts how often it was woken."""

    def __init__(self, live: LiveTree, target: str, source: str) -> None:
        self.live = live
        self.state = WatchState(target, source, self._woken)
        self.woken = 0
        live.watching.add(self.state)

    def _woken(self) -> None:
        self.woken += 1

    def read(self) -> TransformStamped | None:
        """Look the answer up and watch its path; None while there is no answer."""
        try:
            answer = tree_over(self.live).lookup(self.state.target, self.state.source)
        except TransformLookupError:
            self.live.watching.set_no_answer(self.state)
            return None
        self.live.watching.set_answer(self.state, self.live.forest, answer.stamp)
        self.state.outdated = False
        return answer


def watched_frames(live: LiveTree) -> set[str]:
    return set(live.watching.by_frame)


def test_an_answer_is_indexed_by_the_edges_of_its_path() -> None:
    live = live_tree(None)
    live.insert((moving("world", "map", 1), moving("map", "a", 1), moving("map", "b", 1), static("b", "c")))
    watcher = Watcher(live, "a", "c")
    assert watched_frames(live) == set()
    watcher.read()
    assert watched_frames(live) == {"a", "b", "c"}


def test_the_first_batch_on_the_path_wakes_and_later_ones_are_only_counted() -> None:
    live = live_tree(None)
    live.insert((moving("map", "a", 1), moving("a", "b", 1)))
    watcher = Watcher(live, "map", "b")
    watcher.read()
    live.insert((moving("map", "other", 2),))
    assert (watcher.woken, watcher.state.outdated, watcher.state.updates) == (0, False, 0)
    live.insert((moving("map", "a", 2), moving("a", "b", 2), moving("a", "b", 3)))
    live.insert((moving("map", "a", 3),))
    assert (watcher.woken, watcher.state.outdated, watcher.state.updates) == (1, True, 2)


def test_a_watch_without_an_answer_is_woken_by_no_sample() -> None:
    live = live_tree(None)
    watcher = Watcher(live, "map", "a")
    assert watcher.read() is None
    live.insert((moving("map", "a", 1),))
    assert (watcher.woken, watcher.state.updates) == (0, 0)
    watcher.read()
    live.remove_frame("a")
    assert watcher.woken == 1
    assert watcher.read() is None
    assert watched_frames(live) == set()


def test_the_frames_of_watches_without_a_permanent_path_may_change() -> None:
    live = live_tree(None)
    live.insert((moving("map", "a", 1),))
    Watcher(live, "map", "a").read()
    Watcher(live, "world", "nobody").read()
    assert live.watching.changing_names == {"world", "nobody"}


def test_the_paths_over_both_parents_are_watched_while_both_are_in_the_window() -> None:
    live = live_tree(5e-9)
    live.insert((moving("map", "left", 1), moving("map", "right", 1), moving("left", "box", 1)))
    watcher = Watcher(live, "map", "box")
    live.insert((moving("right", "box", 3),))
    # The answer is that of stamp 1, under 'left'; the newest common stamp is that of the newest path.
    watcher.read()
    assert watched_frames(live) == {"left", "right", "box"}
    live.insert((moving("map", "left", 9), moving("map", "right", 9), moving("right", "box", 9)))
    watcher.read()
    assert watched_frames(live) == {"right", "box"}


def test_late_samples_that_form_a_loop_in_the_past_make_watches_outdated() -> None:
    live = live_tree(None)
    live.insert((moving("a", "c", 0),))
    live.insert((moving("a", "b", 0), moving("c", "b", 1), moving("d", "a", 1)))
    # At stamp 0, a is the parent of b, and soon b the parent of a.
    watchers = [Watcher(live, target, source) for target, source in permutations("abc", 2)]
    answers = [watcher.read() for watcher in watchers]
    live.insert((moving("b", "a", 0, 1.0),))
    outdated = [watcher for watcher in watchers if watcher.state.outdated]
    changed = [watcher for watcher, answer in zip(watchers, answers, strict=True) if watcher.read() != answer]
    assert changed
    assert set(changed) <= set(outdated)
    assert {watcher.woken for watcher in outdated} == {1}


def test_a_change_of_parent_off_the_path_does_not_make_a_watch_outdated() -> None:
    live = live_tree(None)
    live.insert((moving("world", "map", 1), moving("map", "a", 1), moving("map", "b", 1)))
    watcher = Watcher(live, "map", "a")
    watcher.read()
    live.insert((moving("mars", "map", 2),))
    live.insert((moving("a", "b", 2),))
    live.insert((moving("map", "new", 2),))
    assert (watcher.woken, watcher.state.outdated) == (0, False)


def test_only_watches_that_ask_for_a_frame_and_have_no_permanent_path_are_marked_for_it() -> None:
    live = live_tree(None)
    live.insert((moving("map", "a", 1),))
    watchers = [Watcher(live, *ends) for ends in (("map", "a"), ("map", "x"), ("x", "map"), ("y", "x"), ("x", "x"))]
    for watcher in watchers:
        watcher.read()
        watcher.state.outdated = False
    answered, source_named, target_named, neither, both = watchers
    live.watching.add(outdated := WatchState("map", "x", list))
    assert live.watching.mark_asking_for({"map"}) == [source_named.state, target_named.state]
    assert [watcher.state.outdated for watcher in (answered, source_named, target_named, neither, both)] == [
        False,
        True,
        True,
        False,
        False,
    ]
    assert live.watching.mark_asking_for({"map", "x"}) == [neither.state, both.state]
    assert (outdated.outdated, outdated.updates) == (True, 0)


def test_a_reset_makes_every_watch_outdated_and_keeps_it_registered() -> None:
    live = live_tree(None)
    live.insert((moving("map", "a", 5),))
    answered, waiting = Watcher(live, "map", "a"), Watcher(live, "map", "unknown")
    answered.read()
    live.reset(5, 2)
    for watcher in (answered, waiting):
        assert (watcher.woken, watcher.state.outdated) == (1, True)
        assert isinstance(watcher.state.reset, ClockResetError)
    assert (len(live.watching), watched_frames(live)) == (2, set())


def test_the_end_wakes_and_removes_every_watch() -> None:
    live = live_tree(None)
    live.insert((moving("map", "a", 5),))
    watchers = [Watcher(live, "map", "a"), Watcher(live, "map", "unknown")]
    watchers[0].read()
    live.end("the bus is closed")
    assert [(watcher.woken, watcher.state.ended) for watcher in watchers] == [(1, True), (1, True)]
    assert watchers[0].read() is not None
    assert (len(live.watching), watched_frames(live)) == (0, set())


def test_removing_a_watch_keeps_the_others_under_its_frames() -> None:
    live = live_tree(None)
    live.insert((moving("map", "a", 1),))
    going, staying = Watcher(live, "map", "a"), Watcher(live, "a", "map")
    for watcher in (going, staying):
        watcher.read()
    for _ in range(2):
        live.watching.remove(going.state)
    live.insert((moving("map", "a", 2),))
    assert (going.woken, staying.woken, len(live.watching)) == (0, 1, 1)


def test_an_error_of_one_watch_does_not_keep_others_from_being_woken() -> None:
    live = live_tree(None)
    live.insert((moving("map", "a", 1),))

    def fail() -> None:
        raise RuntimeError("Event loop is closed")

    first, second = Watcher(live, "map", "a"), Watcher(live, "map", "a")
    first.state.wake = fail
    for watcher in (first, second):
        watcher.read()
    live.insert((moving("map", "a", 2),))
    assert second.woken == 1


def test_a_waiting_watch_counts_as_a_waiter() -> None:
    live = live_tree(None)
    watcher = Watcher(live, "map", "a")
    assert not live.has_waiters
    watcher.state.waiting = True
    assert live.has_waiters


@given(st.lists(st.lists(any_samples("abcd", 20), min_size=1, max_size=3), max_size=8), st.sampled_from([None, 8e-9]))
def test_a_watch_that_is_not_outdated_has_the_same_answer_as_before(
    batches: list[list[TransformStamped]], keep: float | None
) -> None:
    live, judge = live_tree(keep), TransformTree(keep)
    watchers = [Watcher(live, target, source) for target, source in permutations("abcd", 2)]
    answers = [watcher.read() for watcher in watchers]
    for batch in batches:
        try:
            judge.insert_many(batch)
        except InvalidTransformError:
            continue
        live.insert(tuple(batch))
        for place, watcher in enumerate(watchers):
            if watcher.state.outdated:
                answers[place] = watcher.read()
            else:
                assert tree_over(live).lookup(watcher.state.target, watcher.state.source) == answers[place]
