""""""

import pytest
from support.samples import edges_of, moving

from tfbus import (
    Buffer,
    Bus,
    Event,
    EventStream,
    FrameRemoved,
    InvalidTransformError,
    SampleRejected,
    SimulatedClock,
    Transform,
    TransformBroadcaster,
)


def test_reserving_a_frame_of_another_authority_is_an_error_that_names_both() -> None:
    bus = Bus(SimulatedClock())
    with bus.reserve("b", ""):
        with pytest.raises(InvalidTransformError) as caught:
            bus.reserve("b", "odometry")
        error = caught.value
        assert (error.reason, error.child, error.authority, error.owner) == ("reserved", "b", "odometry", "")
        assert str(error) == "frame 'b' is reserved for '' and cannot be reserved for 'odometry'"
    bus.reserve("b", "odometry").close()


def test_one_authority_may_reserve_a_frame_several_times_and_has_it_until_all_end() -> None:
    bus = Bus(SimulatedClock())
    first, second = (bus.reserve("b", "slam") for _ in range(2))
    for _ in range(2):
        first.close()
        with pytest.raises(InvalidTransformError):
            bus.publish(moving("a", "b", 1, authority="gps"))
    second.close()
    bus.publish(moving("a", "b", 1, authority="gps"))


def test_reserving_a_bad_name_or_for_a_bad_authority_is_an_error() -> None:
    bus = Bus(SimulatedClock())
    for name in ("", "/odom"):
        with pytest.raises(InvalidTransformError, match="frame name"):
            bus.reserve(name, "slam")
    with pytest.raises(TypeError):
        bus.reserve(7, "slam")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="authority must be a str, not None"):
        bus.reserve("odom", None)  # type: ignore[arg-type]


# Edges of others that keep a reserved frame from its place


def events_of(events: EventStream) -> list[Event]:
    return list(iter(events.queue.get, None))


def test_an_edge_that_hangs_an_ancestor_of_a_reserved_frame_below_it_is_refused() -> None:
    bus = Bus(SimulatedClock())
    owner = TransformBroadcaster(bus, "owner")
    with owner.owning("base"):
        owner.send("map", "base", Transform())
        for child in ("map", "base"):
            with pytest.raises(InvalidTransformError):
                TransformBroadcaster(bus, "stranger").send("base" if child == "map" else "x", child, Transform())
        owner.send("map", "base", Transform())


def test_an_edge_that_was_there_first_is_removed_when_the_owner_publishes(caplog: pytest.LogCaptureFixture) -> None:
    bus = Bus(SimulatedClock())
    buffer = Buffer(bus)
    owner, stranger = TransformBroadcaster(bus, "owner"), TransformBroadcaster(bus, "stranger")
    stranger.send("x", "base", Transform())
    stranger.send("base", "map", Transform())
    with bus.reserve("base", "owner"), bus.events() as events:
        owner.send("map", "base", Transform((1.0, 0.0, 0.0)))
        with pytest.raises(InvalidTransformError, match="loop"):
            stranger.send("base", "map", Transform())
        owner.send("map", "base", Transform((2.0, 0.0, 0.0)))
        found = events_of(events)
    assert buffer.lookup_nowait("map", "base").transform.translation == (2.0, 0.0, 0.0)
    assert [(edge.parent, edge.child) for edge in buffer.tree.edges()] == [("map", "base")]
    assert bus.statistics().rejected == {"displaced": 1, "cycle": 1}
    assert FrameRemoved(0, "map") in found
    (refused,) = (event for event in found if isinstance(event, SampleRejected) and event.reason == "displaced")
    assert (refused.frame, refused.parent, refused.authority) == ("map", "base", "stranger")
    assert (
        "removed a frame: the edge 'base' -> 'map' from 'stranger' would hang 'map' below 'base', "
        "which 'owner' has reserved and puts below 'map'" in caplog.messages
    )


def test_of_several_edges_of_others_the_one_that_was_published_last_is_removed() -> None:
    bus = Bus(SimulatedClock())
    TransformBroadcaster(bus, "urdf").send_static("base", "tool", Transform())
    stranger = TransformBroadcaster(bus, "stranger")
    stranger.send("earth", "map", Transform())
    TransformBroadcaster(bus, "urdf").send_static("base", "arm", Transform())
    stranger.send("tool", "map", Transform())
    # A late sample of another one is not the edge.
    TransformBroadcaster(bus, "late").send("earth", "map", Transform(), at=-1)
    with bus.reserve("base", "owner"):
        TransformBroadcaster(bus, "owner").send("map", "base", Transform())
    assert sorted((event.frame, event.parent) for event in edges_of(bus)) == [
        ("arm", "base"),
        ("base", "map"),
        ("tool", "base"),
    ]


@pytest.mark.parametrize("last", ["a", "map"])
@pytest.mark.parametrize("elsewhere", [False, True])
def test_of_two_edges_of_others_the_one_that_came_last_is_removed(last: str, elsewhere: bool) -> None:
    bus = Bus(SimulatedClock())
    if elsewhere:
        bus.publish([moving("x", "a", 0, authority="one"), moving("x", "map", 0, authority="two")])
    edges = {"a": moving("base", "a", 0, authority="one"), "map": moving("a", "map", 0, authority="two")}
    for child in sorted(edges, key=last.__eq__):
        bus.publish(edges[child])
    with bus.reserve("base", "owner"):
        TransformBroadcaster(bus, "owner").send("map", "base", Transform())
    assert {event.frame for event in edges_of(bus)} == {"base", "a", "map"} - {last}


def test_a_loop_of_the_owners_own_edges_or_those_of_other_owners_is_refused() -> None:
    bus = Bus(SimulatedClock())
    one, two = TransformBroadcaster(bus, "one"), TransformBroadcaster(bus, "two")
    with bus.reserve("a", "one"), bus.reserve("b", "two"):
        two.send("a", "b", Transform())
        with pytest.raises(InvalidTransformError, match="loop"):
            one.send("b", "a", Transform())
        one.send("a", "c", Transform())
        with pytest.raises(InvalidTransformError, match="loop"):
            one.send("c", "a", Transform())
    with pytest.raises(InvalidTransformError, match="loop"):
        one.send("b", "a", Transform())
    assert bus.statistics().rejected == {"cycle": 3}


def test_only_the_owner_of_a_frame_has_edges_of_others_removed() -> None:
    bus = Bus(SimulatedClock())
    with bus.reserve("base", "owner"):
        TransformBroadcaster(bus, "stranger").send("x", "map", Transform())
        with pytest.raises(InvalidTransformError, match="loop"):
            TransformBroadcaster(bus, "another").send("map", "x", Transform())
    assert [(event.parent, event.frame) for event in edges_of(bus)] == [("x", "map")]
    assert bus.statistics().rejected == {"cycle": 1}


def test_in_one_batch_the_edge_of_the_other_is_refused() -> None:
    bus = Bus(SimulatedClock())
    batch = [moving("base", "map", 1, authority="stranger"), moving("map", "base", 1, authority="owner")]
    with bus.reserve("base", "owner"):
        with pytest.raises(InvalidTransformError) as caught:
            bus.publish(batch)
        assert (caught.value.authority, caught.value.reason, caught.value.owner) == ("stranger", "reserved", "owner")
        assert bus.statistics().frames == 0
        bus.publish([batch[0], *batch], invalid="drop")
    assert [event.frame for event in edges_of(bus)] == ["base"]
    # One when all was refused, then each of the two that were left out.
    assert bus.statistics().rejected == {"reserved": 3}


def test_a_batch_that_is_refused_for_another_reason_removes_nothing() -> None:
    bus = Bus(SimulatedClock())
    bus.publish([moving("base", "map", 1, authority="stranger"), moving("p", "q", 1)])
    good = moving("map", "base", 1, authority="owner")
    with bus.reserve("base", "owner"), bus.reserve("z", "somebody"):
        for bad in (moving("q", "p", 1), moving("map", "z", 1), moving("map", "w", 1, 1e13)):
            with pytest.raises(InvalidTransformError):
                bus.publish([good, bad])
        assert [event.frame for event in edges_of(bus)] == ["map", "q"]
        bus.publish([good, moving("q", "p", 1), moving("map", "w", 1, 1e13)], invalid="drop")
    assert [event.frame for event in edges_of(bus)] == ["q", "base"]


def test_after_a_jump_back_of_the_clock_the_owner_still_has_its_place() -> None:
    clock = SimulatedClock(10)
    bus = Bus(clock)
    owner = TransformBroadcaster(bus, "owner")
    with owner.owning("base"):
        owner.send("map", "base", Transform())
        clock.set(0)
        TransformBroadcaster(bus, "stranger").send("base", "map", Transform())
        owner.send("map", "base", Transform())
        assert [event.frame for event in edges_of(bus)] == ["base"]
