from collections.abc import Callable
from functools import partial
from itertools import count, permutations
from typing import Any

import numpy as np
import pytest
from support.samples import moving, static

from tfbus import LATEST, DisconnectedError, Outcome, TransformStamped, TransformTree
from tfbus.tree._saved_frames import save_frame
from tfbus.tree.forest import Forest
from tfbus.tree.history import FrameHistory


def forest(*batch: TransformStamped, window: int | None = None) -> Forest:
    made = Forest(window)
    for sample in batch:
        made.insert_judged(sample)
    return made


def test_insert_judged_returns_the_outcome() -> None:
    known = forest(moving("a", "b", 10), window=5)
    assert known.insert_judged(moving("a", "b", 4)) is Outcome.EXPIRED
    assert known.insert_judged(moving("a", "b", 5)) is Outcome.INSERTED
    assert known.insert_judged(moving("a", "b", 5)) is Outcome.REPLACED


def test_a_commit_counts_each_sample_of_a_batch_by_its_outcome() -> None:
    known = forest(moving("a", "b", 10), window=5)
    known.forget_changes()
    plain = (moving("a", "b", 11), moving("a", "b", 12))
    mixed = (
        moving("a", "b", 13),
        moving("a", "new", 1),
        *(moving("a", "b", stamp) for stamp in (14, 15, 16)),
        *(moving("a", "b", stamp) for stamp in (16, 10, 15, 12)),
        *(moving("a", "new", stamp) for stamp in (2, 3)),
    )
    version = known.version
    assert known.commit(plain)
    assert (known.inserted, known.replaced, known.expired) == (3, 0, 0)
    assert not known.commit(mixed)
    assert known.version > version
    assert (known.inserted, known.replaced, known.expired) == (3 + 5 + 2, 3, 1)
    assert [sample.child for sample in known.expired_samples] == ["b"]
    assert known.insert((moving("a", "b", 17), moving("a", "b", 17), moving("a", "b", 3))) == [
        Outcome.INSERTED,
        Outcome.REPLACED,
        Outcome.EXPIRED,
    ]
    assert (known.inserted, known.replaced, known.expired, known.expired_samples) == (11, 4, 2, [])


@pytest.mark.parametrize(
    ("stamps", "appended"),
    [
        ([11], True),
        ([10], False),
        ([9], False),
        ([11, 12, 20], True),
        ([10, 11], False),
        ([11, 11], False),
        ([12, 11], False),
        ([11, 13, 12], False),
    ],
)
def test_samples_are_appended_together_if_each_is_newer_than_those_before(stamps: list[int], appended: bool) -> None:
    known = forest(moving("a", "b", 9, authority="me"), moving("a", "b", 10, authority="me"))
    asked = np.array(stamps)
    assert known.can_append("a", "b", "me", asked) is appended
    for other in (("z", "b", "me"), ("a", "z", "me"), ("a", "b", "you")):
        assert not known.can_append(*other, asked)
    if appended:
        version = known.version
        known.append("b", asked, np.full((len(stamps), 7), 0.5))
        assert known.version > version
        assert known.inserted == 2 + len(stamps)
        history = known.frames["b"]
        assert [history.sample(i)[0] for i in range(len(history))] == [9, 10, *stamps]
        assert history.sample(2)[1] == (0.5,) * 7


def test_nothing_is_appended_to_a_static_an_emptied_or_a_reparented_frame() -> None:
    known = forest(static("a", "still"), moving("a", "empty", 5), moving("z", "moved", 4), moving("a", "moved", 5))
    known.frames["empty"].clear()
    assert not any(known.can_append("a", child, "", np.array([9])) for child in ("still", "empty", "moved"))


def test_a_permanent_path_is_cached() -> None:
    known = forest(moving("a", "b", 0), static("b", "c"))
    path = known.find_path("a", "c", LATEST)
    assert known.find_path("a", "c", 12_345) is path
    known.insert_judged(moving("a", "b", 1))
    known.insert_judged(moving("elsewhere", "x", 1))
    assert known.find_path("a", "c", 7) is path, "neither a newer sample nor a new frame makes it another path"


def test_a_path_that_depends_on_the_stamp_is_searched_each_time() -> None:
    known = forest(moving("a", "b", 0), moving("z", "b", 10))
    assert known.find_path("a", "b", 5).frames == ("a", "b")
    assert known.find_path("z", "b", 15).frames == ("z", "b")
    with pytest.raises(DisconnectedError):
        known.find_path("a", "b", 15)


def test_a_changing_newest_path_is_kept_until_the_topology_changes() -> None:
    known = forest(moving("a", "b", 0), moving("z", "b", 10))
    path = known.find_path("z", "b", LATEST)
    assert known.find_path("z", "b", 10) is path
    assert known.find_path("z", "b", LATEST) is path
    known.insert_judged(moving("y", "b", 20))
    assert known.find_path("y", "b", LATEST) is not path
    with pytest.raises(DisconnectedError):
        known.find_path("z", "b", LATEST)


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


# Recorded changes, from which a live tree finds the lookups to wake


def test_samples_that_change_no_path_are_not_recorded_as_changes() -> None:
    known = forest(moving("a", "b", 0), moving("a", "b", 10), static("b", "c"), window=15)
    known.new_parents.clear()
    known.changed.clear()
    for sample in (moving("a", "b", 20), moving("a", "b", 15), moving("a", "b", 30), static("b", "c", 1.0, stamp=9)):
        known.insert_judged(sample)
    assert (known.new_parents, known.changed) == (set(), set())


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(moving("z", "b", 20), id="another parent"),
        pytest.param(moving("z", "b", 5), id="another parent in the past"),
        pytest.param(static("a", "b"), id="now static"),
        pytest.param(moving("b", "c", 5), id="now moving"),
        pytest.param(moving("a", "b", -5), id="a longer past"),
    ],
)
def test_samples_that_may_change_a_path_are_recorded_as_changes(change: TransformStamped) -> None:
    known = forest(moving("a", "b", 0), moving("a", "b", 10), static("b", "c"))
    known.changed.clear()
    known.new_parents.clear()
    known.insert_judged(change)
    assert known.changed == {change.child}
    assert change.parent in known.new_parents


def test_the_expiry_of_an_old_parent_is_recorded_as_a_change() -> None:
    known = forest(moving("old", "b", 0), moving("new", "b", 10), window=10)
    known.changed.clear()
    known.insert_judged(moving("new", "b", 11))
    assert known.changed == {"b"}
    assert "old" not in known.names
    known.forget_changes()
    known.insert_judged(moving("new", "b", 12))
    assert known.changed == set(), "it is recorded once"


def test_a_static_sample_sent_again_leaves_the_path_and_one_that_moves_its_frame_does_not() -> None:
    known = forest(static("a", "b", 1.0), moving("b", "c", 5))
    path = known.find_path("a", "c", LATEST)
    known.insert_judged(static("a", "b", 1.0, stamp=9))
    assert known.find_path("a", "c", LATEST) is path
    known.insert_judged(static("a", "b", 2.0))
    assert known.find_path("a", "c", LATEST).row_at(5)[0] == 2.0


def test_after_all_samples_are_dropped_a_frame_has_its_newest_parent_and_the_next_sample_changes_nothing() -> None:
    known = forest(moving("old", "b", 0), moving("new", "b", 10))
    known.clear()
    known.forget_changes()
    assert known.names.sorted() == ("b", "new")
    known.insert_judged(moving("new", "b", 0))
    assert known.changed == set()


def test_the_first_parent_of_a_new_frame_and_of_a_root_are_recorded() -> None:
    known = forest(moving("a", "b", 0))
    assert (known.new_parents, known.changed) == ({"a"}, set())
    known.new_parents.clear()
    known.insert_judged(moving("root", "a", 0))
    assert (known.new_parents, known.changed) == ({"root"}, {"a"})


def test_no_change_is_recorded_any_longer_once_it_is_forgotten_or_was_inserted_without_a_bus() -> None:
    known = forest(moving("a", "b", 0), window=5)

    def changes() -> list[int]:
        return [len(each) for each in (known.changed, known.new_parents, known.looping, known.expired_samples)]

    batch = (moving("a", "b", 8), moving("z", "b", 9), moving("a", "b", 1), moving("b", "z", 9), moving("b", "z", 8))
    known.commit(batch)
    assert min(changes()) > 0
    known.forget_changes()
    assert changes() == [0, 0, 0, 0]
    known.insert((moving("y", "b", 10), moving("y", "b", 1)))
    assert changes() == [0, 0, 0, 0]


def test_the_version_is_another_one_after_each_change() -> None:
    known = forest(moving("a", "b", 0), moving("a", "c", 0))
    versions = [known.version]
    for change in (
        lambda: known.commit((moving("a", "b", 1),)),
        lambda: known.insert((moving("a", "b", 2),)),
        lambda: known.insert((moving("a", "b", 0),)),
        known.clear,
        lambda: known.commit((moving("z", "b", 3),)),
        lambda: known.remove("c"),
        lambda: known.append("b", np.array([4]), np.full((1, 7), 0.5)),
        known.clear,
    ):
        change()
        versions.append(known.version)
    assert len(set(versions)) == 9


def test_names_below_include_those_under_every_parent_in_the_window() -> None:
    known = forest(moving("a", "b", 0), moving("b", "c", 0), moving("x", "c", 5), static("c", "d"), moving("x", "y", 0))
    assert known.names_below("abcdxy", {"b"}) == {"b", "c", "d"}
    assert known.names_below("abcdxy", {"x"}) == {"x", "c", "d", "y"}
    assert known.names_below("ady", {"x"}) == {"d", "y"}
    assert known.names_below(["d", "nowhere"], {"nowhere"}) == {"nowhere"}


# Edges without samples


def test_edges_without_samples_are_forgotten_if_a_new_edge_forms_a_loop_with_them() -> None:
    known = forest(moving("map", "odom", 0), moving("odom", "base", 0), static("base", "camera"))
    known.clear()
    known.forget_changes()
    assert known.find_path("map", "camera", LATEST).frames == ("map", "odom", "base", "camera")
    known.insert_judged(moving("base", "map", 1))
    assert known.changed == {"map", "odom", "base"}
    assert known.find_path("base", "map", LATEST).frames == ("base", "map")
    assert sorted(known.frames) == ["camera", "map"]


def test_edges_without_samples_stay_while_no_new_edge_contradicts_them() -> None:
    known = forest(moving("map", "odom", 0), moving("odom", "base", 0))
    known.clear()
    known.insert_judged(moving("odom", "base", 1))
    known.insert_judged(moving("world", "map", 1))
    assert known.find_path("world", "base", LATEST).frames == ("world", "map", "odom", "base")


# Many stamps


def test_edges_above_are_those_by_every_parent_in_the_window() -> None:
    known = forest(moving("a", "b", 0), moving("b", "c", 0), moving("x", "c", 5), static("y", "x"), moving("c", "d", 0))
    assert sorted(edge.child for edge in known.edges_above("c")) == ["b", "c", "x"]
    assert sorted(edge.child for edge in known.edges_above("y", "b")) == ["b"]


def test_a_copy_within_a_shorter_window_has_only_the_frames_of_its_samples() -> None:
    known = forest(moving("old", "b", 0), moving("a", "b", 10), static("a", "c"), window=100)
    short = known.copy_within(5)
    assert (short.names.sorted(), known.names.sorted()) == (("a", "b", "c"), ("a", "b", "c", "old"))
    assert (short.window, short.changed, short.new_parents) == (5, set(), set())
    short.insert_judged(moving("a", "b", 20))
    assert (len(short.frames["b"]), len(known.frames["b"])) == (1, 2)


# All frames at one moment


def test_frames_that_change_while_others_are_read_are_read_again() -> None:
    known = forest(*(moving("root", f"f{number}", 0) for number in range(250)))
    seen: list[str] = []

    def newest(history: FrameHistory) -> int | None:
        seen.append(history.child)
        if len(seen) in (150, 250):
            # Another thread cannot do this here, because the lock is held; it does so between two parts.
            known.lock.release()
            known.commit((moving("root", "f0", len(seen)), moving("root", "new", len(seen))))
            if len(seen) == 250:
                known.remove("f1")
            known.lock.acquire()
        return history.newest

    found = known.read_all(newest)
    assert (found["f0"], found["new"], found["f249"]) == (250, 250, 0)
    assert found.keys() == known.frames.keys()
    assert "f1" not in found
    assert len(seen) <= 254


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


def test_reading_ends_although_all_frames_change_all_the_time() -> None:
    known = forest(*(moving("root", f"f{number}", 0) for number in range(250)))
    seen: list[str] = []

    def newest(history: FrameHistory) -> int | None:
        seen.append(history.child)
        if len(seen) <= 650 and len(seen) % 50 == 0:
            known.lock.release()
            known.commit(tuple(moving("root", f"f{number}", len(seen)) for number in range(250)))
            known.lock.acquire()
        return history.newest

    found = known.read_all(newest)
    assert (set(found.values()), len(seen)) == ({650}, 899)
    known.commit((moving("root", "f0", 10_000),))
    assert found["f0"] != 10_000


def test_an_error_of_a_reader_ends_the_reading() -> None:
    known = forest(moving("root", "a", 0))
    with pytest.raises(ZeroDivisionError):
        known.read_all(lambda _: 1 / 0)
    assert not known.lock.locked()
    assert known.readers == {}, "nobody is to be told of changes any longer"
    assert known.read_all(len) == {"a": 1}
    assert known.readers == {}


# Loops of parents in the past


def looping(*batch: TransformStamped) -> list[tuple[str, int, tuple[str, ...]]]:
    known = forest()
    for sample in batch:
        known.insert_judged(sample)
        known.find_past_loops()
    assert known.looped == len(known.looping)
    return [(found.sample.child, found.loop.stamp, found.loop.frames) for found in known.looping]


def test_late_samples_that_form_a_loop_in_the_past_are_noted() -> None:
    before = (moving("c", "a", 0), moving("c", "a", 9), moving("a", "b", 4), moving("a", "b", 9))
    assert looping(*before) == []
    assert looping(*before, moving("b", "a", 5)) == [("a", 5, ("a", "b", "a"))]
    # The late sample comes before the frame of its parent does: the loop begins with that.
    assert looping(*before, moving("b", "a", 2)) == [("a", 4, ("a", "b", "a"))]


def test_the_first_sample_of_a_root_may_form_a_loop_in_the_past() -> None:
    before = [moving("a", "b", 0), moving("a", "b", 5), moving("odom", "b", 10)]
    assert looping(*before, moving("b", "a", 3)) == [("a", 3, ("a", "b", "a"))]
    assert looping(*before, moving("b", "a", 11)) == []


def test_frames_that_change_places_in_one_batch_form_no_loop() -> None:
    known = forest(moving("c", "a", 0), moving("a", "b", 0))
    known.commit((moving("b", "a", 10), moving("c", "b", 10)))
    known.commit((moving("c", "a", 20), moving("a", "b", 20)))
    assert known.looped == 0


def test_the_notes_of_loops_are_emptied_and_their_number_stays() -> None:
    known = forest(moving("c", "a", 0), moving("c", "a", 9), moving("a", "b", 4), moving("a", "b", 9))
    known.forget_changes()
    known.commit((moving("b", "a", 5),))
    assert [found.sample for found in known.looping] == [moving("b", "a", 5)]
    known.forget_changes()
    assert (known.looping, known.looped) == ([], 1)
    known.commit((moving("b", "a", 6),))
    assert known.looped == 2
    known.commit((moving("root", "c", 0),))
    assert known.looped == 2, "none is noted twice"


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
    tree._forest.frames = WatchedFrames(tree._forest, on_step)
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
