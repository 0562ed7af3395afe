import logging
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.samples import any_samples, moving, newest_samples, static

from tfbus import InvalidTransformError, SimulatedClock, TransformStamped
from tfbus.bus._announcer import Announcer
from tfbus.bus._ownership import OnConflict, Ownership
from tfbus.bus._plausibility import Plausibility
from tfbus.bus._topology import Topology
from tfbus.bus.once_logger import OnceLogger
from tfbus.geometry.bounds import MAX_TRANSLATION


def topology(*batches: Sequence[TransformStamped], on_conflict: OnConflict = "last") -> Topology:
    made = Topology(
        OnceLogger(logging.getLogger("tfbus")),
        Ownership(on_conflict),
        Plausibility(SimulatedClock(), MAX_TRANSLATION, 1.0, reject_ahead=False),
        Announcer(lambda: 0),
        lambda frame: made.remove(frame),
    )
    for batch in batches:
        made.accept(tuple(batch), "raise")
    return made


# Refused samples


def test_a_refused_batch_changes_nothing_but_a_count() -> None:
    known = topology([moving("a", "b", 0)])
    with pytest.raises(InvalidTransformError) as caught:
        known.accept((moving("x", "y", 0), static("x", "z"), moving("b", "a", 0)), "raise")
    assert caught.value.loop == ("a", "b", "a")
    assert set(known.names.sorted()) == {"a", "b"}
    assert known.latched == {}
    assert known.rejected == {"cycle": 1}


def test_dropping_leaves_out_only_the_refused_sample_counts_it_and_logs_it_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    known = topology([moving("a", "b", 0)])
    batch = (moving("x", "y", 0), moving("b", "a", 0, authority="bad"), static("x", "z"))
    for _ in range(2):
        assert known.accept(batch, "drop") == (batch[0], batch[2])
    assert known.rejected == {"cycle": 2}
    assert set(known.names.sorted()) == {"a", "b", "x", "y", "z"}
    assert [record.getMessage() for record in caplog.records if "loop" in record.getMessage()] == [
        "dropped a sample: the edge 'b' -> 'a' would close a loop of parents: a -> b -> a"
    ]


# The newest edges


@given(st.lists(st.lists(any_samples("abcd", last=3), min_size=1, max_size=4), max_size=12))
def test_the_newest_edge_of_each_child_is_that_of_its_newest_accepted_sample(
    batches: list[list[TransformStamped]],
) -> None:
    known = topology()
    stored: list[TransformStamped] = []
    for batch in batches:
        stored += known.accept(tuple(batch), "drop")
        newest = newest_samples(stored)
        assert set(known.names.sorted()) == {*newest, *(sample.parent for sample in newest.values())}
        assert len(known.names) == len(known.names.sorted())
        assert len(known) == len(newest)
        for child, sample in newest.items():
            edge = known.newest(child)
            assert edge is not None
            assert (edge.parent, edge.static) == (sample.parent, sample.static)
            assert edge.newest == (None if sample.static else sample.stamp)
        assert known.latched == {child: sample for child, sample in newest.items() if sample.static}


def test_the_newest_stamp_of_a_known_edge_only_moves_forward() -> None:
    known = topology([moving("a", "b", 10)])
    for stamp, expected in ((5, 10), (10, 10), (12, 12), (11, 12)):
        known.accept((moving("a", "b", stamp),), "raise")
        edge = known.newest("b")
        assert edge is not None
        assert edge.newest == expected


def test_the_authority_of_an_edge_is_that_of_its_newest_sample() -> None:
    known = topology([moving("a", "b", 10, authority="x")])
    for stamp, authority, expected in ((5, "y", "x"), (11, "y", "y"), (12, "y", "y"), (11, "x", "y"), (13, "x", "x")):
        known.accept((moving("a", "b", stamp, authority=authority),), "raise")
        edge = known.newest("b")
        assert edge is not None
        assert edge.authority == expected
    assert known.conflicts == 2


# Counts and log


def test_a_kind_change_is_counted_and_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    known = topology()
    for stamp in range(4):
        known.accept((static("a", "b", stamp=stamp, authority="urdf"),), "raise")
        known.accept((moving("a", "b", stamp, authority="urdf"),), "raise")
    assert known.kind_changes == 7
    assert [record.getMessage() for record in caplog.records] == ["frame 'b' is now moving, from 'urdf'"]


def test_changes_of_authority_are_counted_and_logged_once_with_both_names(caplog: pytest.LogCaptureFixture) -> None:
    known = topology([moving("a", "b", 0, authority="odometry")])
    for stamp in range(1, 5):
        known.accept((moving("a", "b", stamp, authority=("odometry", "slam")[stamp % 2]),), "raise")
    assert known.conflicts == 4
    assert [record.getMessage() for record in caplog.records] == [
        "frame 'b' comes from two authorities, 'odometry' and 'slam'"
    ]


def test_a_new_parent_is_counted_unless_its_sample_is_late() -> None:
    known = topology([moving("old", "b", 0)], [moving("new", "b", 10)])
    assert known.reparented == 1
    known.accept((moving("old", "b", 5),), "raise")
    assert known.reparented == 1
    known.accept((moving("old", "b", 11),), "raise")
    assert known.reparented == 2


# Removals and resets


def test_remove_forgets_the_child_and_keeps_its_children() -> None:
    known = topology([static("a", "b"), moving("b", "c", 0)])
    known.remove("b")
    assert known.latched == {}
    assert set(known.names.sorted()) == {"b", "c"}
    known.remove("unknown")
    batch = (moving("c", "a", 0),)
    assert known.accept(batch, "raise") == batch


def test_clear_moving_keeps_only_the_static_edges() -> None:
    known = topology([static("a", "b"), moving("b", "c", 100)])
    known.clear_moving()
    assert set(known.names.sorted()) == {"a", "b"}
    assert len(known) == 1
    batch = (moving("c", "a", 1),)
    assert known.accept(batch, "raise") == batch


def test_under_reject_a_child_cleared_by_a_reset_is_contained_until_it_is_removed() -> None:
    known = topology([moving("a", "b", 100, authority="slam"), static("b", "c")], on_conflict="reject")
    known.clear_moving()
    assert "b" in known
    assert (len(known), known.newest("b"), [event.frame for event in known.known()]) == (1, None, ["c"])
    known.remove("b")
    assert "b" not in known
