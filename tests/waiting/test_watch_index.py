from itertools import permutations

from hypothesis import given
from hypothesis import strategies as st
from support.samples import any_samples, live_tree, moving, tree_over

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


def test_a_change_of_parent_off_the_path_does_not_make_a_watch_outdated() -> None:
    live = live_tree(None)
    live.insert((moving("world", "map", 1), moving("map", "a", 1), moving("map", "b", 1)))
    watcher = Watcher(live, "map", "a")
    watcher.read()
    live.insert((moving("mars", "map", 2),))
    live.insert((moving("a", "b", 2),))
    live.insert((moving("map", "new", 2),))
    assert (watcher.woken, watcher.state.outdated) == (0, False)


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
