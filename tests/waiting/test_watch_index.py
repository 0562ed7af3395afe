from itertools import permutations

from hypothesis import given
from hypothesis import strategies as st
from support.samples import any_samples, live_tree, moving, tree_over

from tfbus import InvalidTransformError, TransformLookupError, TransformStamped, TransformTree
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
