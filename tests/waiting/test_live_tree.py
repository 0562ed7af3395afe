""""""

from functools import partial
from typing import Any

import pytest
from support.samples import live_tree, moving, static, tree_over

from tfbus import Edge, Question, TransformLookupError, UnknownFrameError
from tfbus.tree.history import FrameHistory
from tfbus.waiting.live_tree import LiveTree, Waiter
from tfbus.waiting.watch_index import WatchState


def park(live: LiveTree, target: str, source: str, at: int, woken: list[str]) -> None:
    """Park a lookup that appends its source to `woken` when it is woken."""
    with pytest.raises(TransformLookupError) as caught:
        tree_over(live).lookup(target, source, at)
    waiter = Waiter(Question(target, source, at), 0, lambda: woken.append(source))
    live.park(waiter, caught.value)


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


def test_an_expired_sample_of_a_frame_that_is_static_by_the_end_of_its_batch_is_not_ahead() -> None:
    live = live_tree(10e-9)
    live.tell_expired = lambda _sample, newest, _authority: newest > 0
    live.insert((moving("map", "a", 100), moving("map", "b", 100)))
    live.insert((moving("map", "a", 1), moving("map", "b", 1), static("map", "b")))
    assert (live.statistics(5).expired, live.expired_ahead) == (2, 1)


class CountedFrames(dict[str, FrameHistory]):
    """Counts how often a frame is looked up."""

    reads = 0

    def get(self, key: str, default: Any = None) -> Any:
        self.reads += 1
        return super().get(key, default)


@pytest.mark.parametrize("event", ["another parent", "removal"])
def test_a_change_of_parents_costs_no_walk_through_all_frames(event: str) -> None:
    live = live_tree(None)
    live.insert(tuple(moving("map", f"f{number}", 1) for number in range(300)))
    live.insert(tuple(moving(f"f{number}", f"g{number}", 1) for number in range(300)))
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


def test_an_error_of_one_waiter_or_watch_does_not_keep_others_from_being_woken() -> None:
    live = live_tree(None)
    live.insert((moving("map", "a", 1),))
    woken: list[str] = []

    def fail() -> None:
        raise RuntimeError("Event loop is closed")

    with pytest.raises(TransformLookupError) as caught:
        tree_over(live).lookup("map", "a", 9)
    live.waiting.park(Waiter(Question("map", "a", 9), 0, fail), caught.value)
    park(live, "map", "a", 9, woken)
    for wake in (fail, lambda: woken.append("watch")):
        state = WatchState("map", "a", wake)
        live.watching.add(state)
        live.watching.set_answer(state, live.forest, 1)
        state.outdated = False
    live.insert((moving("map", "a", 9),))
    assert woken == ["a", "watch"]


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
    assert live.waiting.parked == {}
