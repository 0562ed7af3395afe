import logging
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.samples import any_samples, moving, static

from tfbus import InvalidTransformError, TransformStamped
from tfbus._log import OnceLogger
from tfbus.bus._announcer import Announcer
from tfbus.bus._ownership import OnConflict, Ownership
from tfbus.bus._topology import Topology
from tfbus.tree.cycles import admit


def topology(*batches: Sequence[TransformStamped], on_conflict: OnConflict = "last") -> Topology:
    made = Topology(OnceLogger(logging.getLogger("tfbus")), Ownership(on_conflict), Announcer(lambda: 0))
    for batch in batches:
        made.accept(tuple(batch), "raise")
    return made


def has_circle(parents: dict[str, str]) -> bool:
    """By trying every child."""
    for child in parents:
        here: str | None = child
        for _ in range(len(parents) + 1):
            here = None if here is None else parents.get(here)
        if here is not None:
            return True
    return False


def newest_parents(stored: Iterable[TransformStamped]) -> dict[str, str]:
    """What the newest sample of each child says, the last kind winning."""
    newest: dict[str, TransformStamped] = {}
    for sample in stored:
        before = newest.get(sample.child)
        if before is None or before.static or sample.static or sample.stamp >= before.stamp:
            newest[sample.child] = sample
    return {child: sample.parent for child, sample in newest.items()}


# Loops


@pytest.mark.parametrize("length", [2, 3, 1_000])
def test_an_edge_that_closes_a_loop_is_refused_and_the_error_names_the_whole_loop(length: int) -> None:
    names = [f"frame {number}" for number in range(length)]
    known = topology([moving(parent, child, 0) for parent, child in pairwise(names)])
    with pytest.raises(InvalidTransformError) as caught:
        known.accept((moving(names[-1], names[0], 1, authority="somebody"),), "raise")
    error = caught.value
    assert error.reason == "cycle"
    assert (error.parent, error.child, error.authority) == (names[-1], names[0], "somebody")
    assert error.loop == (names[0], *reversed(names))
    assert f"{names[-1]!r} -> {names[0]!r}" in str(error)
    shown = error.loop if length < 10 else (*error.loop[:8], "(992 more)", names[0])
    assert " -> ".join(shown) in str(error)


def test_a_loop_of_static_edges_is_refused_too() -> None:
    known = topology([static("a", "b"), moving("b", "c", 5)])
    with pytest.raises(InvalidTransformError, match="a -> c -> b -> a"):
        known.accept((static("c", "a"),), "raise")


def test_one_batch_may_turn_an_edge_round() -> None:
    known = topology([moving("map", "base", 0)])
    batch = (moving("base", "map", 1), moving("world", "base", 1))
    assert known.accept(batch, "raise") == batch
    assert known.names() == {"map", "base", "world"}


def test_turning_an_edge_round_without_a_new_parent_for_the_other_end_is_a_loop() -> None:
    known = topology([moving("map", "base", 0)])
    with pytest.raises(InvalidTransformError):
        known.accept((moving("base", "map", 1),), "raise")


def test_a_loop_inside_one_batch_is_refused() -> None:
    accepted, refused = admit({}, (moving("a", "b", 0), moving("b", "c", 0), moving("c", "a", 0)))
    assert accepted == (moving("a", "b", 0), moving("b", "c", 0))
    assert [error.loop for error in refused] == [("a", "c", "b", "a")]


def test_only_the_newest_parents_are_judged() -> None:
    known = topology([moving("map", "base", 10), moving("base", "tool", 10)])
    late = (moving("tool", "base", 5),)
    assert known.accept(late, "raise") == late, "at 5 it is a loop, but the newest parents stay as they were"
    with pytest.raises(InvalidTransformError):
        known.accept((moving("tool", "base", 10),), "raise")


def test_a_static_sample_counts_whatever_its_stamp() -> None:
    known = topology([moving("map", "base", 10), moving("base", "tool", 10)])
    with pytest.raises(InvalidTransformError):
        known.accept((static("tool", "base", stamp=0),), "raise")


def test_after_a_static_sample_a_moving_one_of_any_stamp_is_the_newest() -> None:
    known = topology([moving("map", "base", 10), moving("base", "tool", 10)], [static("map", "base")])
    with pytest.raises(InvalidTransformError):
        known.accept((moving("tool", "base", 1),), "raise")


def test_a_refused_batch_leaves_no_trace_but_a_count() -> None:
    known = topology([moving("a", "b", 0)])
    with pytest.raises(InvalidTransformError):
        known.accept((moving("x", "y", 0), static("x", "z"), moving("b", "a", 0)), "raise")
    assert known.names() == {"a", "b"}
    assert known.latched == {}
    assert known.rejected == {"cycle": 1}


def test_dropping_leaves_out_only_the_offender(caplog: pytest.LogCaptureFixture) -> None:
    known = topology([moving("a", "b", 0)])
    batch = (moving("x", "y", 0), moving("b", "a", 0, authority="bad"), static("x", "z"))
    assert known.accept(batch, "drop") == (batch[0], batch[2])
    known.accept(batch, "drop")
    assert known.rejected == {"cycle": 2}
    assert [record.getMessage() for record in caplog.records if "loop" in record.getMessage()] == [
        "dropped a sample: the edge 'b' -> 'a' would close a loop of parents: a -> b -> a"
    ], "what repeats is counted, and logged once"


SAMPLES = any_samples("abcde", last=3)


@settings(deadline=None)
@given(st.lists(st.lists(SAMPLES, min_size=1, max_size=4), max_size=8))
def test_a_batch_is_taken_exactly_if_the_newest_parents_after_it_form_a_forest(
    batches: list[list[TransformStamped]],
) -> None:
    known = topology()
    stored: list[TransformStamped] = []
    for batch in batches:
        after = newest_parents([*stored, *batch])
        if has_circle(after):
            with pytest.raises(InvalidTransformError) as caught:
                known.accept(tuple(batch), "raise")
            assert caught.value.loop[0] == caught.value.loop[-1]
            assert all(after[child] == parent for child, parent in pairwise(caught.value.loop))
        else:
            assert known.accept(tuple(batch), "raise") == tuple(batch)
            stored += batch


@settings(deadline=None)
@given(st.lists(st.lists(SAMPLES, min_size=1, max_size=6), max_size=5))
def test_what_is_left_after_dropping_is_a_forest_and_nothing_is_dropped_without_need(
    batches: list[list[TransformStamped]],
) -> None:
    known = topology()
    stored: list[TransformStamped] = []
    for batch in batches:
        accepted = known.accept(tuple(batch), "drop")
        assert not has_circle(newest_parents([*stored, *accepted]))
        assert (accepted == tuple(batch)) == (not has_circle(newest_parents([*stored, *batch])))
        stored += accepted
    latched = {child for child, parent in newest_parents(stored).items() if child in known.latched}
    assert latched == set(known.latched)
    assert all(sample.static for sample in known.latched.values())


# What is known


def test_the_last_static_sample_of_each_child_is_latched() -> None:
    known = topology([static("a", "b", x=1.0), static("a", "c")], [static("a", "b", x=2.0)])
    assert known.latched == {"b": static("a", "b", x=2.0), "c": static("a", "c")}


def test_a_child_that_moves_is_latched_no_more() -> None:
    known = topology([static("a", "b")], [moving("a", "b", 5)])
    assert known.latched == {}
    assert known.kind_changes == 1


def test_a_kind_change_is_counted_and_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    known = topology()
    for stamp in range(4):
        known.accept((static("a", "b", stamp=stamp, authority="urdf"),), "raise")
        known.accept((moving("a", "b", stamp, authority="urdf"),), "raise")
    assert known.kind_changes == 7
    assert [record.getMessage() for record in caplog.records] == ["frame 'b' is now moving, from 'urdf'"]


def test_two_authorities_on_one_child_are_counted_and_both_named_once(caplog: pytest.LogCaptureFixture) -> None:
    known = topology([moving("a", "b", 0, authority="odometry")])
    for stamp in range(1, 5):
        known.accept((moving("a", "b", stamp, authority=("odometry", "slam")[stamp % 2]),), "raise")
    assert known.conflicts == 4
    assert [record.getMessage() for record in caplog.records] == [
        "frame 'b' comes from two authorities, 'odometry' and 'slam'"
    ]


def test_a_new_parent_is_counted_and_a_late_sample_of_the_old_one_is_not() -> None:
    known = topology([moving("old", "b", 0)], [moving("new", "b", 10)])
    assert known.reparented == 1
    known.accept((moving("old", "b", 5),), "raise")
    assert known.reparented == 1
    known.accept((moving("old", "b", 11),), "raise")
    assert known.reparented == 2


def test_more_of_the_same_moves_the_newest_stamp_on() -> None:
    known = topology([moving("map", "base", 0), moving("base", "tool", 0)], [moving("map", "base", 10)])
    batch = (moving("tool", "base", 9),)
    assert known.accept(batch, "raise") == batch, "older than the newest, so it decides nothing"


def test_more_of_the_same_that_is_late_does_not_move_the_newest_stamp_back() -> None:
    known = topology([moving("map", "base", 10), moving("base", "tool", 0)], [moving("map", "base", 3)])
    batch = (moving("tool", "base", 9),)
    assert known.accept(batch, "raise") == batch


def test_a_removed_child_is_forgotten_and_its_own_children_stay() -> None:
    known = topology([static("a", "b"), moving("b", "c", 0)])
    known.remove("b")
    assert known.latched == {}
    assert known.names() == {"b", "c"}
    known.remove("never heard of")
    batch = (moving("c", "a", 0),)
    assert known.accept(batch, "raise") == batch


def test_after_a_clock_reset_only_static_edges_are_known() -> None:
    known = topology([static("a", "b"), moving("b", "c", 100)])
    known.clear_moving()
    assert known.names() == {"a", "b"}
    assert len(known) == 1
    batch = (moving("c", "a", 1),)
    assert known.accept(batch, "raise") == batch


def test_under_reject_a_child_that_a_reset_forgot_can_still_be_removed() -> None:
    known = topology([moving("a", "b", 100, authority="slam"), static("b", "c")], on_conflict="reject")
    known.clear_moving()
    assert "b" in known
    assert (len(known), known.newest("b"), [event.frame for event in known.known()]) == (1, None, ["c"])
    known.remove("b")
    assert "b" not in known


def test_a_long_chain_in_one_batch_is_judged_link_by_link_and_not_pair_by_pair() -> None:
    class Counting(dict[str, Any]):
        asked = 0

        def get(self, key: str, default: Any = None) -> Any:
            self.asked += 1
            return super().get(key, default)

    edges = Counting()
    links = 2_000
    _, refused = admit(edges, [moving(f"f{i}", f"f{i + 1}", 0) for i in reversed(range(links))])
    assert not refused
    assert edges.asked < 10 * links
