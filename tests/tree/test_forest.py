""""""

from collections.abc import Callable
from functools import partial
from itertools import count, permutations
from threading import Lock
from typing import Any

import numpy as np
import pytest
from support.samples import moving, moving_edge, static_edge

from tfbus import LATEST, DisconnectedError, Transform, TransformStamped, TransformTree
from tfbus.tree.forest import Forest, Path, PathCache, find_path
from tfbus.tree.history import FrameHistory, save_frame
from tfbus.tree.tree import forest_of

Frames = dict[str, FrameHistory]


def frames_of(*edges: FrameHistory) -> Frames:
    return {edge.child: edge for edge in edges}


def static_frames(parents: dict[str, str]) -> Frames:
    """Static edges from each key to its value."""
    return frames_of(*(static_edge(parent, child, Transform()) for child, parent in parents.items()))


# Search


def test_the_search_climbs_above_the_common_ancestor_no_further_than_the_shorter_side() -> None:
    asked: list[str] = []

    class CountedFrames(dict[str, FrameHistory]):
        def get(self, key: str, default: FrameHistory | None = None) -> FrameHistory | None:  # type: ignore[override]
            asked.append(key)
            return super().get(key, default)

    trunk = {f"trunk {depth + 1}": f"trunk {depth}" for depth in range(5_000)}
    frames = CountedFrames(static_frames({**trunk, "left": "trunk 5000", "right": "trunk 5000", "tip": "right"}))
    assert find_path(frames, "left", "tip", None).frames == ("left", "trunk 5000", "right", "tip")
    assert len(asked) <= 6


# The path that counts at a stamp


def forest(*batch: TransformStamped, window: int | None = None) -> Forest:
    made = Forest(window)
    for sample in batch:
        made.insert_judged(sample)
    return made


def test_a_bounded_number_of_changing_newest_paths_is_kept() -> None:
    known = forest()
    names = [f"{number}" for number in range(80)]
    for name in names:
        known.insert_judged(moving("old", name, 0))
        known.insert_judged(moving("new", name, 1))
    pairs = list(permutations(names, 2))
    for target, source in pairs:
        assert known.find_path(target, source, LATEST).frames == (target, "new", source)
    assert len(pairs) == 6_320
    assert len(known.changing_paths) == 1_320, "5,000 are kept, and then none"


# All frames at one moment


@pytest.mark.parametrize(
    "change",
    [
        lambda known: known.insert((moving("root", "f0", 1),)),
        lambda known: known.insert((moving("root", "f0", 0, 1.0), moving("f1", "f0", 1))),
        lambda known: known.commit((moving("root", "f0", 1),)),
        lambda known: known.commit((moving("f1", "f0", 1), moving("f0", "new", 1))),
        lambda known: known.append("f0", np.array([1]), np.full((1, 7), 0.5)),
        lambda known: known.remove("f0"),
        lambda known: known.clear(),
        lambda known: known.rebuild(save_frame),
    ],
    ids=["insert", "insert closely", "commit", "commit closely", "append", "remove", "clear", "rebuild"],
)
def test_every_kind_of_change_is_seen_by_those_who_read_meanwhile(change: Callable[[Forest], object]) -> None:
    known = forest(*(moving("root", f"f{number}", 0) for number in range(150)))
    seen: list[str] = []

    def history_itself(history: FrameHistory) -> tuple[FrameHistory, int | None]:
        seen.append(history.child)
        if len(seen) == 120:
            known.lock.release()
            change(known)
            known.lock.acquire()
        return history, history.newest

    found = known.read_all(history_itself)
    # Without the frame that was just being read, which no change can reach while the lock is held.
    del found["f119"], known.frames["f119"]
    assert found == {child: (history, history.newest) for child, history in known.frames.items()}


# Searches without the lock


class WatchedFrames(dict[str, FrameHistory]):
    """The frames of a forest, which call a function before each step of a climb, with whether the lock is held."""

    def __init__(self, forest: Forest, on_step: Callable[[bool], None]) -> None:
        super().__init__(forest.frames)
        self._lock = forest.lock
        self._on_step = on_step

    def get(self, name: Any, default: Any = None) -> Any:
        self._on_step(self._lock.locked())
        return super().get(name, default)


DEEP = 50


def deep_tree(on_step: Callable[[bool], None]) -> TransformTree:
    """A chain of 50 edges from f0 down."""
    tree = TransformTree()
    tree.insert_many(moving(f"f{k}", f"f{k + 1}", stamp) for stamp in (0, 10) for k in range(DEEP))
    forest = forest_of(tree)
    forest.frames = WatchedFrames(forest, on_step)
    return tree


@pytest.mark.parametrize(
    "ask",
    [
        lambda tree: tree.lookup("f0", "f50", 5),
        lambda tree: tree.lookup("f0", "f50"),
        lambda tree: tree.lookup("f0", "f50", 5, source_at=6, fixed="f25"),
        lambda tree: tree.lookup_many("f0", "f50", [5, 6]),
        lambda tree: tree.chain("f0", "f50"),
        lambda tree: tree.latest_common_stamp("f0", "f50"),
        lambda tree: tree.twist("f50", "f0", 5),
        lambda tree: tree.twist("f1", "f0", 5, expressed_in="f50"),
    ],
)
def test_a_new_path_is_searched_while_others_may_insert(ask: Callable[[TransformTree], object]) -> None:
    held: list[bool] = []
    ask(deep_tree(held.append))
    assert held.count(False) >= DEEP
    assert held.count(True) < 5


@pytest.mark.parametrize("batch", [(), (moving("elsewhere", "f25", 20), moving("f24", "f25", 30))])
def test_a_path_that_is_kept_is_not_searched_again(batch: tuple[TransformStamped, ...]) -> None:
    held: list[bool] = []
    tree = deep_tree(held.append)
    tree.insert_many(batch)
    for lookup in (tree.lookup, partial(tree.lookup, tolerance=1e-9)):
        lookup("f0", "f50")
        held.clear()
        lookup("f0", "f50")
        assert held == []


def test_a_path_that_was_found_while_a_parent_changed_is_not_used() -> None:
    steps = count(1)

    def change(_held: bool) -> None:
        # Both ends take steps in turn; that from below has passed f25 then, and has not yet reached f0.
        if next(steps) == 60:
            tree.insert(moving("elsewhere", "f25", 20))

    tree = deep_tree(change)
    with pytest.raises(DisconnectedError):
        tree.lookup("f0", "f50")
    assert next(steps) > 60
    assert tree.lookup("elsewhere", "f25").stamp == 20


def path_of_one_edge() -> Path:
    return find_path({"b": moving_edge("a", "b", [(0, Transform())])}, "a", "b", None)


def test_paths_that_are_asked_for_are_kept_and_others_are_forgotten_in_time() -> None:
    cache, kept = PathCache(Lock()), path_of_one_edge()
    cache.keep("a", "wanted", kept)
    for number in range(50_000):
        cache.keep("a", str(number), kept)
        if number % 1_000 == 0:
            assert len(cache) <= 20_000
            assert cache.find("a", "wanted") is kept
    assert cache.find("a", "0") is None
    assert cache.find("a", "49999") is kept
    assert [cache.holds("a", name) for name in ("0", "41000", "49999", "wanted")] == [False, True, True, True]
    assert not cache.holds("b", "wanted")


class Name(str):
    __slots__ = ()


def test_names_that_are_no_plain_strings_are_not_kept() -> None:
    cache = PathCache(Lock())
    cache.keep(Name("a"), "b", path_of_one_edge())
    cache.keep("a", Name("b"), path_of_one_edge())
    assert len(cache) == 0
