"""Random lives of networks of links: in the end all buses agree, whatever was lost, late or repeated."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.wires import (
    CHAIN,
    CIRCLE,
    CIRCLE_OF_FIVE,
    MESH,
    RING,
    RING_WITH_A_TAIL,
    TRIANGLE,
    TWO_BRIDGES,
    Graph,
    Model,
    Network,
    Step,
    frames_of,
    latched,
    steps_of,
)

from tfbus import Buffer, Bus, SimulatedClock

pytestmark = pytest.mark.thorough

LOSSY = st.sampled_from((MESH, CHAIN, RING, CIRCLE, CIRCLE_OF_FIVE, RING_WITH_A_TAIL, TRIANGLE, TWO_BRIDGES))


@given(graph=st.sampled_from((MESH, CHAIN, RING, CIRCLE)), steps=steps_of("takeover", "banish"))
@settings(suppress_health_check=[HealthCheck.too_slow])
def test_without_loss_every_bus_receives_every_batch_once_whole_and_in_order(graph: Graph, steps: list[Step]) -> None:
    with Network(graph) as net:
        model = Model(net)
        buffers = [Buffer(bus, keep=None) for bus in net.buses]
        for step in steps:
            model.do(*step)
        net.settle()
        model.check_nothing_went_wrong()
        members = range(len(net.buses))
        for member in members:
            for origin in members:
                if origin != member:
                    assert net.received(member, origin) == net.published(origin)
            assert len(net.heard[member]) == sum(len(net.published(origin)) for origin in members)
        assert len({frozenset(latched(bus).values()) for bus in net.buses}) == 1
        assert len({frozenset(frames_of(bus)) for bus in net.buses}) == 1
        for child in frames_of(net.buses[0]):
            assert len({buffer.tree.parent(child) for buffer in buffers}) == 1
        assert sum(end.endpoint.inbox.lost for end in net.ends) == 0
        late = net.add_bus()
        net.domains[-1].join(late)
        net.settle()
        assert latched(late) == latched(net.buses[0])


@given(graph=LOSSY, steps=steps_of("overtake", "overtake", "drop", "repeat", "join"))
@settings(suppress_health_check=[HealthCheck.too_slow])
def test_with_loss_nothing_older_comes_and_in_the_end_all_agree_on_what_is_static(
    graph: Graph, steps: list[Step]
) -> None:
    with Network(graph) as net:
        model = Model(net)
        for step in steps:
            model.do(*step)
        net.settle()
        net.recover()
        model.check_nothing_went_wrong()
        model.check_nothing_older_came()
        model.check_no_echo()
        model.move_on()
        model.check_all_agree()


@given(
    graph=LOSSY,
    steps=steps_of("part", "part", "meet", "overtake", "drop", "repeat", "join", "freeze", "expel", "contend"),
    drop_lost=st.booleans(),
)
@settings(suppress_health_check=[HealthCheck.too_slow])
def test_whatever_is_lost_late_repeated_cut_frozen_removed_by_others_or_contended_all_agree_in_the_end(
    graph: Graph, steps: list[Step], drop_lost: bool
) -> None:
    with Network(graph, drop_lost) as net:
        Model(net).live(steps)


@given(
    graph=LOSSY,
    steps=steps_of("part", "meet", "overtake", "drop", "repeat", "join", "freeze", "expel", "contend"),
    drop_lost=st.booleans(),
)
@settings(suppress_health_check=[HealthCheck.too_slow])
def test_links_that_hear_only_some_frames_hold_exactly_these_in_the_end(
    graph: Graph, steps: list[Step], drop_lost: bool
) -> None:
    chosen = [{"0.0", "1.1", "2.2", "contended"}, {"0.0", "0.1", "0.2", "3.0"}, set[str]()]
    with Network(graph, drop_lost) as net:
        leaves = [Bus(SimulatedClock()) for _ in chosen]
        for leaf, frames in zip(leaves, chosen, strict=True):
            net.domains[0].join(leaf, frames, drop_lost=drop_lost)
        Model(net).live(steps)
        first = net.buses[0]
        for leaf, frames in zip(leaves, chosen, strict=True):
            assert frames_of(leaf) == frames_of(first) & frames
            assert latched(leaf) == {child: sample for child, sample in latched(first).items() if child in frames}
            assert leaf.statistics().rejected == {}


@given(graph=LOSSY, steps=steps_of(), more=steps_of(), which=st.integers(0, 3))
@settings(suppress_health_check=[HealthCheck.too_slow])
def test_the_frames_of_a_dead_bus_leave_everywhere_whatever_is_on_its_way(
    graph: Graph, steps: list[Step], more: list[Step], which: int
) -> None:
    with Network(graph, drop_lost=True) as net:
        model = Model(net)
        for step in steps:
            model.do(*step)
        dead = net.buses[which % len(net.buses)]
        for domain in net.domains:
            for end in [end for end in domain.ends if end.bus is dead]:
                domain.kill(end)
        for step in more:
            model.do(*step)
        net.settle()
        model.check_nothing_went_wrong()
        model.check_nothing_older_came(say_again=True)
        alive = [bus for bus in net.buses if bus is not dead]
        for bus in alive:
            assert not any(frame.startswith(f"{net.buses.index(dead)}.") for frame in frames_of(bus))
