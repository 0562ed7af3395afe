from dataclasses import dataclass

import pytest
from support.samples import moving, static

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
from tfbus.bus.ownership import OnConflict, Ownership

POLICIES: list[OnConflict] = ["last", "reject"]


@dataclass(frozen=True)
class Known:
    authority: str
    parent: str = "a"
    static: bool = False
    newest: int | None = 0


def test_under_last_every_authority_may_publish_every_child() -> None:
    ownership = Ownership("last")
    assert not ownership.restricts
    batch = (moving("a", "b", 0, authority="odometry"), moving("a", "b", 1, authority="slam"))
    assert ownership.split(batch, {"b": Known("gps")}) == (batch, [])


def test_under_reject_the_first_authority_keeps_the_child() -> None:
    ownership = Ownership("reject")
    assert ownership.restricts
    mine, other = moving("a", "b", 1, authority="odometry"), moving("x", "b", 2, authority="slam")
    allowed, (error,) = ownership.split((other, mine), {"b": Known("odometry")})
    assert allowed == (mine,)
    assert (error.reason, error.child, error.parent, error.authority, error.owner) == (
        "authority",
        "b",
        "x",
        "slam",
        "odometry",
    )
    assert str(error) == "frame 'b' comes from 'odometry', who was first: no sample of it is taken from 'slam'"


def test_under_reject_the_first_sample_of_a_new_child_in_a_batch_decides() -> None:
    batch = (
        moving("a", "b", 1, authority="one"),
        static("a", "b", authority="two"),
        moving("a", "c", 1, authority="two"),
    )
    allowed, refused = Ownership("reject").split(batch, {})
    assert allowed == (batch[0], batch[2])
    assert [error.owner for error in refused] == ["one"]


@pytest.mark.parametrize("first", ["", "odometry"])
def test_under_reject_a_remembered_child_stays_with_its_authority_until_it_is_forgotten(first: str) -> None:
    ownership = Ownership("reject")
    ownership.remember({"b": Known(first)})
    mine, other = moving("a", "b", 1, authority=first), moving("a", "b", 2, authority="slam")
    allowed, (error,) = ownership.split((other, mine), {})
    assert (allowed, error.owner) == ((mine,), first)
    assert ownership.split((other,), {"b": Known("slam")}) == ((other,), []), "what is known now counts more"
    ownership.remember({"c": Known("gps")})
    assert ownership.remembers("b")
    ownership.forget("b")
    assert not ownership.remembers("b")
    assert ownership.split((other,), {}) == ((other,), [])


def test_under_last_nothing_is_remembered() -> None:
    ownership = Ownership("last")
    ownership.remember({"b": Known("odometry")})
    assert not ownership.remembers("b")
    assert not ownership.restricts


@pytest.mark.parametrize(("first", "second"), [("", "slam"), ("slam", "")])
def test_the_empty_authority_is_an_authority_like_any_other(first: str, second: str) -> None:
    ownership = Ownership("reject")
    (_, refused) = ownership.split((moving("a", "b", 1, authority=second),), {"b": Known(first)})
    assert [(error.owner, error.authority) for error in refused] == [(first, second)]
    with ownership.reserve("c", first), pytest.raises(InvalidTransformError):
        ownership.reserve("c", second)


@pytest.mark.parametrize("policy", POLICIES)
def test_a_reserved_frame_is_for_one_authority_only_even_if_another_was_first(policy: OnConflict) -> None:
    ownership = Ownership(policy)
    known = {"b": Known("odometry")}
    old, new = moving("a", "b", 1, authority="odometry"), moving("a", "b", 1, authority="slam")
    with ownership.reserve("b", "slam"):
        assert ownership.restricts
        assert ownership.reserved_for("b") == "slam"
        allowed, (error,) = ownership.split((old, new), known)
        assert allowed == (new,)
        assert (error.reason, error.owner, error.authority) == ("reserved", "slam", "odometry")
        assert str(error) == "frame 'b' is reserved for 'slam': no sample of it is taken from 'odometry'"
    assert ownership.reserved_for("b") is None
    assert ownership.split((old,), known) == ((old,), [])


def test_reserving_a_frame_of_another_authority_is_an_error_that_names_both() -> None:
    ownership = Ownership("last")
    with ownership.reserve("b", "slam"):
        with pytest.raises(InvalidTransformError) as caught:
            ownership.reserve("b", "odometry")
        error = caught.value
        assert (error.reason, error.child, error.authority, error.owner) == ("reserved", "b", "odometry", "slam")
        assert str(error) == "frame 'b' is reserved for 'slam' and cannot be reserved for 'odometry'"
    ownership.reserve("b", "odometry").close()


def test_one_authority_may_reserve_a_frame_several_times_and_has_it_until_all_end() -> None:
    ownership = Ownership("last")
    first, second, third = (ownership.reserve("b", "slam") for _ in range(3))
    first.close()
    first.close()
    second.close()
    assert ownership.reserved_for("b") == "slam"
    third.close()
    assert ownership.reserved_for("b") is None
    assert not ownership.restricts


def test_reserving_a_bad_name_or_for_a_bad_authority_is_an_error() -> None:
    ownership = Ownership("last")
    for name in ("", "/odom"):
        with pytest.raises(InvalidTransformError, match="frame name"):
            ownership.reserve(name, "slam")
    with pytest.raises(TypeError):
        ownership.reserve(7, "slam")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="authority must be a str, not None"):
        ownership.reserve("odom", None)  # type: ignore[arg-type]
    assert not ownership.restricts


def test_an_unknown_policy_is_an_error() -> None:
    with pytest.raises(ValueError, match="on_conflict must be 'last' or 'reject', not 'first'"):
        Ownership("first")  # type: ignore[arg-type]


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
    assert sorted((event.frame, event.parent) for event in bus._topology.known()) == [
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
    assert {event.frame for event in bus._topology.known()} == {"base", "a", "map"} - {last}


def test_another_edge_of_the_owner_below_the_same_parent_does_not_protect_that_of_the_other() -> None:
    bus = Bus(SimulatedClock())
    bus.publish(moving("base", "map", 0, authority="stranger"))
    with bus.reserve("base", "owner"):
        bus.publish([moving("map", "base", 0, authority="owner"), moving("base", "tool", 0, authority="owner")])
    assert {(event.parent, event.frame) for event in bus._topology.known()} == {("map", "base"), ("base", "tool")}


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
    assert [(event.parent, event.frame) for event in bus._topology.known()] == [("x", "map")]
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
    assert [event.frame for event in bus._topology.known()] == ["base"]
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
        assert [event.frame for event in bus._topology.known()] == ["map", "q"]
        bus.publish([good, moving("q", "p", 1), moving("map", "w", 1, 1e13)], invalid="drop")
    assert [event.frame for event in bus._topology.known()] == ["q", "base"]


def test_after_a_jump_back_of_the_clock_the_owner_still_has_its_place() -> None:
    clock = SimulatedClock(10)
    bus = Bus(clock)
    owner = TransformBroadcaster(bus, "owner")
    with owner.owning("base"):
        owner.send("map", "base", Transform())
        clock.set(0)
        TransformBroadcaster(bus, "stranger").send("base", "map", Transform())
        owner.send("map", "base", Transform())
        assert [event.frame for event in bus._topology.known()] == ["base"]
