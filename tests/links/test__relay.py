import gc
import weakref
from collections.abc import Callable
from functools import partial

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.samples import moving, static
from support.wires import (
    CHAIN,
    CIRCLE,
    CIRCLE_OF_FIVE,
    MESH,
    PAIR,
    RING,
    RING_WITH_A_TAIL,
    TRIANGLE,
    TWO_BRIDGES,
    Domain,
    Graph,
    Model,
    Network,
    Step,
    frames_of,
    latched,
    size_of,
    steps_of,
)

from tfbus import Bus, BusClosedError, PeerLost, SimulatedClock, TransformStamped
from tfbus.bus.event_stream import EventStream
from tfbus.links._attachment import pack
from tfbus.links._entries import OutgoingBatch, RemovedFrame
from tfbus.links._message import Message
from tfbus.links._relay import relay_of
from tfbus.tf_message import encode

graphs = pytest.mark.parametrize(
    "graph", [MESH, CHAIN, RING, CIRCLE, TWO_BRIDGES], ids=["mesh", "chain", "ring", "circle", "two bridges"]
)


def losses(events: EventStream) -> list[tuple[str, tuple[str, ...]]]:
    """Each lost peer that a stream of events tells of, with its frames."""
    return [(event.peer, event.frames) for event in iter(events.queue.get, None) if isinstance(event, PeerLost)]


# What is published.


@graphs
def test_every_bus_receives_each_batch_once_and_unchanged(graph: Graph) -> None:
    with Network(graph) as net:
        for member, bus in enumerate(net.buses):
            bus.publish(
                [
                    moving("map", f"a{member}", 5, 1.0, "odometry"),
                    static("map", f"s{member}", authority="calibration"),
                    moving("map", f"a{member}", 4, 2.0),
                ]
            )
            bus.publish(moving("map", f"b{member}", 6))
        net.settle()
        for member, bus in enumerate(net.buses):
            assert len(net.published(member)) == 2
            assert bus.statistics().samples == 4 * len(net.buses)
            for origin in set(range(len(net.buses))) - {member}:
                assert net.received(member, origin) == net.published(origin)


@graphs
def test_a_late_joiner_receives_the_static_frames_and_nothing_else(graph: Graph) -> None:
    with Network(graph) as net:
        for member, bus in enumerate(net.buses):
            bus.publish([moving("map", f"a{member}", 1), static("map", f"s{member}", float(member))])
        net.settle()
        late = [net.add_bus() for _ in net.domains]
        for bus, domain in zip(late, net.domains, strict=True):
            domain.join(bus)
        net.settle()
        expected = {f"s{member}": static("map", f"s{member}", float(member)) for member in range(len(net.buses))}
        for bus in late:
            assert frames_of(bus) == set(latched(bus))
            assert latched(bus).items() <= expected.items()
            assert len(latched(bus)) == len(net.buses) - len(late)


def test_a_second_link_of_a_bus_brings_its_static_frames_to_another_domain() -> None:
    with Network(PAIR) as net:
        net.buses[0].publish([static("map", "s"), static("map", "t")])
        net.buses[1].publish(static("map", "u"))
        net.settle()
        other = Domain()
        net.domains.append(other)
        far = net.add_bus()
        other.join(far)
        other.join(net.buses[1])
        net.settle()
        assert latched(far) == latched(net.buses[0])
        assert [bus.statistics().samples for bus in net.buses[:2]] == [3, 3]


def test_a_static_frame_goes_out_by_a_later_link_with_the_number_that_it_has() -> None:
    with Network([[0], [0], [0, 1]]) as net:
        bus = net.buses[0]
        net.buses[1].publish(static("map", "theirs"))
        net.settle()
        bus.publish([static("map", "mine"), static("map", "too")])
        net.settle()
        first, _, home = (end for end in net.ends if end.bus is bus)
        later = Domain().join(bus).endpoint.outbox.state
        for frame in ("mine", "too", "theirs"):
            entry, known = later.entry(frame), first.endpoint.outbox.state.entry(frame)
            assert isinstance(entry, OutgoingBatch)
            assert isinstance(known, OutgoingBatch)
            assert (entry.origin, entry.sequence) == (known.origin, known.sequence)
        assert home.endpoint.outbox.state.entry("theirs") is None, "nothing goes back"


def test_samples_of_several_origins_in_one_batch_keep_their_origins() -> None:
    with Network(RING) as net:
        a, b, c = net.buses
        a.publish(moving("map", "a", 1))
        b.publish(moving("map", "b", 1))
        net.settle()
        mixed = [net.received(2, 0)[0][0], moving("map", "c", 1), net.received(2, 1)[0][0], moving("map", "d", 1)]
        c.publish(mixed)
        net.settle()
        assert [bus.statistics().samples for bus in (a, b, c)] == [4, 4, 6]


@graphs
def test_buses_that_republish_received_batches_start_no_loop(graph: Graph) -> None:
    with Network(graph) as net:
        streams = [bus.stream(capacity=100, overflow="drop_oldest") for bus in net.buses]
        for member, bus in enumerate(net.buses):
            bus.publish([moving("map", f"a{member}", 1), static("map", f"s{member}")])
        net.settle()
        for bus, stream in zip(net.buses, streams, strict=True):
            for _ in range(len(net.buses)):
                batch = stream.queue.get()
                assert batch is not None
                if any(type(sample) is not TransformStamped for sample in batch):
                    bus.publish(batch)
        net.settle()
        passed_on = 2 * (len(net.buses) - 1)
        assert [bus.statistics().samples for bus in net.buses] == [2 * len(net.buses) + passed_on] * len(net.buses)
        assert all(latched(bus) == latched(net.buses[0]) for bus in net.buses)


def test_a_changed_sample_belongs_to_the_bus_that_changed_it() -> None:
    with Network(CHAIN) as net:
        net.buses[0].publish(moving("map", "a", 1))
        net.settle()
        (sample,) = net.received(1, 0)[0]
        net.buses[1].publish(sample.replace(child="b"))
        net.settle()
        assert net.received(0, 1) == net.received(3, 1) == [(moving("map", "b", 1),)]


def test_links_of_one_bus_may_be_for_different_frames() -> None:
    with Network([[0], [1]]) as net:
        bus = net.add_bus()
        net.domains[0].join(bus, frames={"a", "b"})
        net.domains[1].join(bus, frames={"b", "c"})
        for member in (0, 1):
            net.buses[member].publish([static("map", name, float(member)) for name in "abc"])
            net.settle()
        assert sorted(net.received(2, 0)[0], key=str) == [static("map", name) for name in "ab"]
        assert sorted(net.received(2, 1)[0], key=str) == [static("map", name, 1.0) for name in "bc"]
        assert net.received(0, 1) == [(static("map", "b", 1.0),)]
        assert net.received(1, 0) == [(static("map", "b"),)]


# What is removed.


@graphs
@pytest.mark.parametrize("removes", [0, -1])
def test_a_removed_frame_goes_everywhere_and_comes_back_with_newer_samples(graph: Graph, removes: int) -> None:
    with Network(graph) as net:
        for stamp in range(3):
            net.buses[0].publish([static("map", "s", float(stamp)), moving("map", "a", stamp)])
            net.settle()
            assert [frames_of(bus) for bus in net.buses] == [{"s", "a"}] * len(net.buses)
            net.buses[removes].remove_frame("s")
            net.buses[removes].remove_frame("a")
            net.settle()
            assert [frames_of(bus) for bus in net.buses] == [set()] * len(net.buses)
        assert [bus.statistics().samples for bus in net.buses] == [6] * len(net.buses)


@graphs
@pytest.mark.parametrize("removes", [0, -1])
def test_no_link_keeps_a_removed_static_frame_for_late_joiners(graph: Graph, removes: int) -> None:
    with Network(graph) as net:
        net.buses[0].publish([static("map", "s"), static("map", "t")])
        net.settle()
        net.buses[removes].remove_frame("s")
        net.settle()
        for end in net.ends:
            assert not end.endpoint.outbox.state.brings("s")
        for domain in net.domains:
            late = net.add_bus()
            domain.join(late)
            net.settle()
            assert set(latched(late)) == {"t"}


def test_late_joiners_receive_the_last_sample_of_any_publisher() -> None:
    with Network(MESH) as net:
        for member in (2, 0, 3):
            newest = static("map", "s", float(member))
            net.buses[member].publish(newest)
            net.settle()
            late = net.add_bus()
            net.domains[0].join(late)
            net.settle()
            assert latched(late) == {"s": newest}
        net.buses[1].publish(moving("map", "s", 1))
        net.settle()
        assert not any(isinstance(end.endpoint.outbox.state.entry("s"), OutgoingBatch) for end in net.ends)


def test_the_second_bridge_does_not_keep_a_frame_whose_removal_came_by_the_first() -> None:
    with Network(TWO_BRIDGES) as net:
        source, first, second, _ = net.buses
        source.publish(static("map", "s"))
        net.settle()
        source.remove_frame("s")
        net.send(source)
        inner, outer = net.domains
        ends = {id(domain): {end.bus: end for end in domain.ends} for domain in net.domains}
        for domain, sender, receiver in ((inner, source, first), (outer, first, second)):
            wire = domain.wires[ends[id(domain)][sender], ends[id(domain)][receiver]]
            while wire.packets:
                wire.deliver()
            net.send(receiver)
        net.settle()
        for end in net.ends:
            assert end.endpoint.outbox.state.digest == 0


def test_a_copy_on_a_slower_way_does_not_bring_a_removed_frame_back() -> None:
    with Network(RING) as net:
        a, b, c = net.buses
        ends = [end for end in net.domains[1].ends if end.bus is c]
        slow = net.domains[1].wires[ends[0], next(end for end in net.domains[1].ends if end.bus is b)]
        for stamp in range(3):
            a.publish([moving("map", "a", stamp), static("map", "s", float(stamp))])
            a.remove_frame("a")
            a.remove_frame("s")
        for _ in range(10):
            for bus in net.buses:
                net.send(bus)
            for wire in net.wires:
                while wire.packets and wire is not slow:
                    wire.deliver()
        assert b.statistics().samples == 6
        assert slow.packets
        net.settle()
        assert [bus.statistics().samples for bus in net.buses] == [6, 6, 6]
        assert [frames_of(bus) for bus in net.buses] == [set()] * 3


@pytest.mark.thorough
def test_more_removals_at_once_than_are_remembered_do_not_go_round_a_ring_for_ever() -> None:
    with Network(RING_WITH_A_TAIL) as net:
        source = net.buses[3]
        for number in range(12_000):
            source.publish(moving("map", f"{number}", 1))
            source.remove_frame(f"{number}")
        net.settle()
        assert [bus.statistics().samples for bus in net.buses] == [12_000] * 4
        source.publish([moving("map", "0", 1), static("map", "s")])
        net.settle()
        assert [frames_of(bus) for bus in net.buses] == [{"0", "s"}] * 4


@pytest.mark.thorough
def test_frames_that_come_and_go_by_the_ten_thousand_leave_little_behind() -> None:
    with Network(RING) as net:
        relays = {end.relay for end in net.ends}
        for turn in range(75):
            source = net.buses[turn % 3]
            names = [f"{turn} {number}" for number in range(400)]
            source.publish([(static if turn % 2 else moving)("map", name, stamp=1) for name in names])
            net.settle()
            for number, name in enumerate(names):
                net.buses[number % 3].remove_frame(name)
            net.settle()
        assert [bus.statistics().frames for bus in net.buses] == [0, 0, 0]
        for relay in relays:
            assert 1_000 < size_of(relay) <= 20_030, "what was removed last is remembered, and it is not without end"
        for end in net.ends:
            assert size_of(end.endpoint.outbox) == 0
            assert 1_000 < size_of(end.endpoint.outbox.state) <= 60_000
        for end in net.ends:
            assert end.endpoint.outbox.state.digest == 0
            assert all(peer.frames == set() for peer in end.endpoint.peers.forget_all())


def test_a_removal_by_a_subscriber_that_hears_of_another_goes_everywhere() -> None:
    with Network(MESH) as net:
        a, b, *_ = net.buses
        careful = Bus(SimulatedClock())
        careful.subscribe(lambda _: None, lambda frame: careful.remove_frame("tool") if frame == "arm" else None)
        net.buses.append(careful)
        net.domains[0].join(careful)
        a.publish([static("map", "arm"), static("arm", "tool")])
        net.settle()
        b.remove_frame("arm")
        net.settle()
        assert [frames_of(bus) for bus in net.buses] == [set()] * 5


@pytest.mark.parametrize("early", [True, False])
def test_a_frame_that_a_subscriber_republishes_on_its_removal_stays(early: bool) -> None:
    with Network(MESH) as net:
        keeper = Bus(SimulatedClock())
        net.buses.append(keeper)
        again = static("map", "s", 2.0)
        keep: Callable[[], object] = partial(keeper.subscribe, lambda _: None, lambda _: keeper.publish(again))
        if early:
            keep()
        net.domains[0].join(keeper)
        if not early:
            keep()
        keeper.publish(static("map", "s", 1.0))
        net.settle()
        net.buses[0].remove_frame("s")
        net.settle()
        assert [latched(bus) for bus in net.buses] == [{"s": again}] * 5


def test_a_frame_that_a_bus_has_forgotten_with_its_clock_is_still_removed_behind_it() -> None:
    clock = SimulatedClock(start=10)
    with Network([[0], [1]]) as net:
        bridge = Bus(clock)
        net.buses.append(bridge)
        for domain in net.domains:
            domain.join(bridge)
        net.buses[0].publish(moving("map", "a", 1))
        net.settle()
        clock.set(0)
        net.buses[0].remove_frame("a")
        net.settle()
        assert [frames_of(bus) for bus in net.buses] == [set()] * 3


# Who is lost.


def test_a_peer_that_is_lost_has_the_frames_that_it_was_the_last_to_publish() -> None:
    with Network(MESH) as net:
        a, b, c, d = net.buses
        a.publish([static("map", name) for name in "zyxwvu"])
        net.settle()
        b.publish(static("map", "y", 2.0))
        d.publish(static("map", "x", 2.0))
        net.settle()
        c.remove_frame("w")
        a.publish([moving("map", "v", 1), moving("map", "new", 1)])
        net.settle()
        d.publish(moving("map", "u", 1))
        net.settle()
        a.publish(moving("map", "u", 2))
        net.settle()
        lost = net.domains[0].ends[0]
        streams = [bus.events() for bus in (b, c, d)]
        net.domains[0].kill(lost)
        net.settle()
        assert [losses(events) for events in streams] == [[(lost.id, ("new", "u", "v", "z"))]] * 3
        assert {"u", "v", "x", "y", "z", "new"} == frames_of(b) == frames_of(c) == frames_of(d)


def test_frames_of_a_lost_peer_leave_also_behind_another_domain_and_those_taken_over_stay() -> None:
    with Network([[0, 1, 2], [1, 3], [3, 4]], drop_lost=True) as net:
        a, _, restarted, _, far = net.buses
        a.publish([static("map", name) for name in "xyz"])
        far.publish(static("map", "mine"))
        net.settle()
        restarted.publish(static("map", "y", 2.0))
        far.publish(static("map", "z", 2.0))
        net.settle()
        net.domains[0].kill(net.domains[0].ends[0])
        net.settle()
        expected = {"mine": static("map", "mine"), "y": static("map", "y", 2.0), "z": static("map", "z", 2.0)}
        assert [latched(bus) for bus in net.buses[1:]] == [expected] * 4
        assert frames_of(a) == {"mine", "x", "y", "z"}, "the dead one is not told"


def test_without_drop_the_frames_of_a_lost_peer_stay_everywhere() -> None:
    with Network(CHAIN) as net:
        net.buses[0].publish([static("map", "s"), moving("map", "a", 1)])
        net.settle()
        net.domains[0].kill(net.domains[0].ends[0])
        net.settle()
        assert [frames_of(bus) for bus in net.buses] == [{"s", "a"}] * 4


def test_a_frame_that_stayed_is_of_the_peer_that_says_it_again() -> None:
    with Network(PAIR) as net:
        (domain,) = net.domains
        here, there = domain.ends
        here.bus.publish(static("map", "s"))
        events = there.bus.events()
        for _ in range(2):
            net.settle()
            domain.part(here, there)
            net.settle()
            domain.meet(here, there)
        assert losses(events) == [(here.id, ("s",))] * 2


def test_the_loss_of_a_bridge_removes_no_frame_from_its_publisher() -> None:
    with Network(TWO_BRIDGES, drop_lost=True) as net:
        source, first, _, far = net.buses
        inner, outer = net.domains
        ends = {domain: {end.bus: end for end in domain.ends} for domain in net.domains}
        source.publish(static("map", "s"))
        net.send(source)
        # It is the first bridge from which everybody hears of it first.
        for domain, sender in ((inner, source), (outer, first)):
            for end in domain.ends:
                if end.bus is not sender and (sender is first or end.bus is first):
                    wire = domain.wires[ends[domain][sender], end]
                    while wire.packets:
                        wire.deliver()
            net.send(first)
        net.settle()
        for domain in net.domains:
            domain.kill(ends[domain][first])
        net.settle()
        assert set(latched(source)) == {"s"}
        source.publish(static("map", "s", 2.0))
        net.settle()
        assert latched(far) == {"s": static("map", "s", 2.0)}


@pytest.mark.parametrize("graph", [PAIR, CHAIN, MESH, RING_WITH_A_TAIL], ids=["pair", "chain", "mesh", "tail"])
@pytest.mark.parametrize("drop_lost", [True, False])
def test_a_peer_that_comes_back_may_say_the_same_again(graph: Graph, drop_lost: bool) -> None:
    with Network(graph, drop_lost) as net:
        source = net.buses[-1 if graph is RING_WITH_A_TAIL else 0]
        domain = net.domains[-1 if graph is RING_WITH_A_TAIL else 0]
        end = next(end for end in domain.ends if end.bus is source)
        source.publish([static("map", "s"), moving("map", "a", 1)])
        net.settle()
        others = [other for other in domain.ends if other is not end]
        for times in range(1, 3):
            for other in others:
                domain.part(end, other)
            net.settle()
            for bus in net.buses:
                if bus is not source:
                    assert frames_of(bus) == (set() if drop_lost else {"s", "a"})
            for other in others:
                domain.meet(end, other)
            net.settle()
            assert [set(latched(bus)) for bus in net.buses] == [{"s"}] * len(net.buses)
            source.publish(moving("map", "a", 1 + times))
            net.settle()
            assert [frames_of(bus) for bus in net.buses] == [{"s", "a"}] * len(net.buses)
        assert net.published(net.buses.index(source)) == net.heard[net.buses.index(source)]


def test_a_restarted_bridge_brings_back_the_frames_behind_it() -> None:
    with Network([[0, 1], [1, 2], [2, 3]], drop_lost=True) as net:
        net.buses[0].publish(static("map", "s"))
        net.settle()
        for domain in net.domains[:2]:
            domain.kill(next(end for end in domain.ends if end.bus is net.buses[1]))
        net.settle()
        assert [set(latched(bus)) for bus in net.buses] == [{"s"}, {"s"}, set(), set()]
        bridge = net.add_bus()
        for domain in net.domains[:2]:
            domain.join(bridge, drop_lost=True)
        net.settle()
        assert [set(latched(bus)) for bus in net.buses] == [{"s"}] * 5


def test_samples_on_a_slower_way_do_not_bring_back_a_lost_frame() -> None:
    with Network(RING, drop_lost=True) as net:
        a, b, c = net.buses
        a.publish([static("map", "s"), moving("map", "a", 1)])
        net.send(a)
        slow = next(wire for wire in net.domains[1].wires.values() if wire.sender.bus is c)
        for wire in net.wires:
            while wire.packets:
                wire.deliver()
        net.send(c)
        assert len(slow.packets) == 1
        for domain in (net.domains[0], net.domains[2]):
            domain.kill(next(end for end in domain.ends if end.bus is a))
        for wire in net.wires:
            while wire.packets and wire is not slow:
                wire.deliver()
        net.settle()
        assert [frames_of(bus) for bus in (b, c)] == [set(), set()]


# What was lost comes back as soon as its owner is reached, and not without it; see `Removals`.


@pytest.mark.parametrize("graph", [RING, CIRCLE, CIRCLE_OF_FIVE, TRIANGLE], ids=["3", "4", "5", "triangle"])
def test_a_ring_that_is_cut_has_all_static_frames_everywhere_and_loses_those_of_a_dead_bus(graph: Graph) -> None:
    with Network(graph, drop_lost=True) as net:
        for member, bus in enumerate(net.buses):
            bus.publish(static("map", f"{member}"))
        net.settle()
        ends = {end.bus: end for end in net.domains[0].ends}
        net.domains[0].part(ends[net.buses[0]], ends[net.buses[1]])
        net.settle()
        everything = {f"{member}" for member in range(len(net.buses))}
        assert [set(latched(bus)) for bus in net.buses] == [everything] * len(net.buses)
        dead = net.buses[0]
        for domain in net.domains:
            for end in [end for end in domain.ends if end.bus is dead]:
                domain.kill(end)
        net.settle()
        assert [set(latched(bus)) for bus in net.buses[1:]] == [everything - {"0"}] * (len(net.buses) - 1)


@pytest.mark.parametrize(
    ("graph", "steps"),
    [
        (
            TWO_BRIDGES,
            [
                ("part", 6, 5, [1]),
                ("part", 1, 5, [11]),
                ("publish", 7, 9, [7]),
                ("send", 3, 7, [4]),
                ("deliver", 5, 8, [4]),
                ("part", 6, 1, [5]),
            ],
        ),
        (
            [[0, 1, 2], [1, 2, 3], [3, 4], [4, 0]],
            [
                ("publish", 3, 0, [11]),
                ("send", 3, 0, [0]),
                ("part", 11, 8, [10]),
                ("flush", 0, 0, [0]),
                ("part", 2, 9, [0]),
            ],
        ),
        (
            CIRCLE_OF_FIVE,
            [
                ("publish", 5, 7, [6, 11, 3, 8]),
                ("send", 10, 5, [0]),
                ("deliver", 9, 0, [6]),
                ("part", 3, 8, [2]),
                ("part", 2, 10, [11]),
                ("deliver", 8, 8, [1]),
                ("part", 6, 9, [5]),
                ("send", 1, 6, [8]),
                ("deliver", 4, 3, [10]),
            ],
        ),
    ],
    ids=["two bridges", "bridges in a ring", "five"],
)
def test_schedules_after_which_a_frame_once_stayed_away_for_good(graph: Graph, steps: list[Step]) -> None:
    with Network(graph, drop_lost=True) as net:
        Model(net).live(steps)


def test_a_bus_that_has_taken_a_frame_from_a_bridge_keeps_it_when_another_peer_brings_it_instead() -> None:
    steps = [
        ("part", 4, 0, [5]),
        ("part", 2, 0, [0]),
        ("publish", 2, 0, [11]),
        ("send", 2, 0, [0]),
        ("deliver", 2, 0, [11]),
        ("send", 1, 0, [0]),
        ("part", 0, 3, [7]),
    ]
    with Network(TWO_BRIDGES) as net:
        Model(net).live(steps)


def test_an_owner_says_a_frame_again_once_for_each_loss_that_it_has_not_answered() -> None:
    with Network(PAIR) as net:
        owner, other = net.domains[0].ends
        owner.bus.publish([static("map", "s"), static("map", "t")])
        net.settle()
        number = owner.relay.newest_number("s")
        assert number is not None

        def told(frame: str, sequence: int, origin: bytes = b"another bus here") -> tuple[int, int]:
            """The rise of the number of `s`, and of the samples that the other bus has."""
            before, samples = owner.relay.newest_number("s"), other.bus.statistics().samples
            payload, attachment = encode(()), pack(0, [RemovedFrame(origin, sequence, frame, lost=True)])
            owner.receive(other.id, Message(payload, attachment, 0))
            net.settle()
            after = owner.relay.newest_number("s")
            assert before is not None
            assert after is not None
            return after[1] - before[1], other.bus.statistics().samples - samples

        later = number[1] + 10
        assert told("s", later) == (11, 1)
        assert told("s", later) == (0, 0), "that loss is answered"
        assert told("s", number[1]) == (0, 0), "it is of an older sample"
        assert told("s", later + 100, owner.relay.origin) == (0, 0), "the owner itself has lost nothing"
        assert told("unknown", later + 100) == (0, 0)
        assert told("t", later + 200) == (0, 1)
        assert [set(latched(end.bus)) for end in (owner, other)] == [{"s", "t"}] * 2
        owner.bus.publish(moving("map", "s", 1))
        net.settle()
        assert told("s", later + 500) == (0, 0), "the next sample of a moving frame is news by itself"


def test_a_subscriber_may_remove_and_publish_frames_of_a_lost_peer_when_it_hears_of_it() -> None:
    with Network(PAIR, drop_lost=True) as net:
        a, b = net.buses
        heard: list[str] = []

        def removed(frame: str) -> None:
            heard.append(frame)
            if frame == "arm":
                b.remove_frame("tool")
                b.publish(static("map", "wheel", 2.0))

        b.subscribe(lambda _: None, removed)
        a.publish([static("map", name) for name in ("arm", "tool", "wheel", "zoo")])
        net.settle()
        with b.events() as events:
            net.domains[0].kill(net.domains[0].ends[0])
            net.settle()
            assert [frames for _, frames in losses(events)] == [("arm", "tool", "wheel", "zoo")]
        assert heard == ["arm", "tool", "zoo"]
        assert latched(b) == {"wheel": static("map", "wheel", 2.0)}
        assert b.statistics().callbacks_failed == 0


# The life of a relay.


def test_a_link_that_has_ended_sends_nothing_and_its_bus_can_go() -> None:
    with Network(PAIR) as net:
        _, b = net.buses
        net.domains[0].ends[1].leave()
        heard = len(net.heard[1])
        b.publish(static("map", "b"))
        assert len(net.heard[1]) == heard + 1
        turn = net.domains[0].ends[1].endpoint.outbox.flush()
        assert (turn.entries, turn.statics) == ([], {})
        net.domains[0].ends.pop()
    gone = weakref.ref(b)
    del b
    net.buses.clear()
    net.heard.clear()
    net.domains.clear()
    gc.collect()
    assert gone() is None


def test_the_links_of_a_bus_share_a_relay_that_forgets_everything_when_the_last_one_ends() -> None:
    with Network(RING) as net:
        a, b, _ = net.buses
        a.publish([static("map", "s"), moving("map", "a", 1)])
        b.publish([static("map", "t"), moving("map", "b", 1)])
        net.settle()
        a.remove_frame("b")
        net.settle()
        first, second = [end for end in net.ends if end.bus is a]
        assert first.relay is second.relay
        first.leave()
        assert size_of(first.relay) > len(first.relay.origin), "the other link still needs it"
        second.leave()
        a.publish([static("map", "later"), moving("map", "a", 2)])
        a.remove_frame("t")
        assert size_of(first.relay) == len(first.relay.origin), "and hears of nothing more"
        for domain in net.domains:
            domain.ends = [end for end in domain.ends if end.bus is not a]


def test_frames_of_a_link_that_has_ended_are_of_the_peer_that_says_them_again_by_another_link() -> None:
    with Network([[0, 1], [0, 2], [1, 3]], drop_lost=True) as net:
        a, b, *_ = net.buses
        b.publish([static("map", "s"), moving("map", "m", 1)])
        net.settle()
        for end in list(net.domains[0].ends):
            end.leave()
        net.domains[0].ends.clear()
        assert frames_of(a) == {"s", "m"}
        net.domains[1].join(b, drop_lost=True)
        b.publish(moving("map", "m", 2))
        net.settle()
        net.domains[1].kill(net.domains[1].ends[-1])
        net.settle()
        assert frames_of(a) == set()


def test_a_bus_that_is_linked_again_receives_none_of_its_own_samples() -> None:
    with Network(PAIR) as net:
        net.buses[0].publish(static("map", "s"))
        net.settle()
        for end in list(net.ends):
            end.leave()
            net.domains[0].kill(end)
        for bus in net.buses:
            net.domains[0].join(bus)
        net.settle()
        assert net.heard[0] == [(static("map", "s"),)]
        net.buses[0].remove_frame("s")
        net.settle()
        assert [latched(bus) for bus in net.buses] == [{}, {}]


def test_a_bus_whose_links_end_and_begin_again_knows_its_own_samples() -> None:
    with Network(RING) as net:
        a = net.buses[0]
        a.publish([static("map", "s"), moving("map", "a", 1)])
        net.settle()
        for domain in (net.domains[0], net.domains[2]):
            end = next(end for end in domain.ends if end.bus is a)
            end.leave()
            domain.kill(end)
        net.settle()
        a.publish(moving("map", "a", 2))
        for domain in (net.domains[0], net.domains[2]):
            domain.join(a)
        net.settle()
        a.publish(moving("map", "a", 3))
        net.settle()
        assert [batch[0].stamp for batch in net.heard[0]] == [0, 2, 3]
        for bus in net.buses[1:]:
            assert set(latched(bus)) == {"s"}
            assert frames_of(bus) == {"s", "a"}


def test_a_closed_bus_is_not_joined() -> None:
    bus = Bus(SimulatedClock())
    bus.close()
    with Network(PAIR) as net, pytest.raises(BusClosedError):
        net.domains[0].join(bus)
    assert size_of(relay_of(bus)) == len(relay_of(bus).origin)


# A model; tests/stress/test_links_model.py has more of it.


@given(
    graph=st.sampled_from((CHAIN, RING, TWO_BRIDGES)),
    steps=steps_of("part", "part", "meet", "overtake", "drop", "repeat", "join"),
)
@settings(max_examples=15, suppress_health_check=[HealthCheck.too_slow])
def test_when_messages_and_peers_are_lost_all_agree_in_the_end(graph: Graph, steps: list[Step]) -> None:
    with Network(graph) as net:
        Model(net).live(steps)
