"""Reserved frames, and the edges of others that keep them from their places."""

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


def test_reserving_a_frame_of_another_authority_is_an_error_that_names_both(bus: Bus) -> None:
    with bus.reserve("b", ""):
        with pytest.raises(InvalidTransformError) as caught:
            bus.reserve("b", "odometry")
        error = caught.value
        assert (error.reason, error.child, error.authority, error.owner) == ("reserved", "b", "odometry", "")
        assert str(error) == "frame 'b' is reserved for '' and cannot be reserved for 'odometry'"
    bus.reserve("b", "odometry").close()


def test_reserving_a_bad_name_or_for_a_bad_authority_is_an_error(bus: Bus) -> None:
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


def test_of_several_edges_of_others_the_one_that_was_published_last_is_removed(bus: Bus) -> None:
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


def test_of_one_batch_the_edge_of_the_other_is_left_out() -> None:
    bus = Bus(SimulatedClock())
    batch = [moving("base", "map", 1, authority="stranger"), moving("map", "base", 1, authority="owner")]
    with bus.reserve("base", "owner"):
        bus.publish(batch, invalid="drop")
    assert [event.frame for event in edges_of(bus)] == ["base"]


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
