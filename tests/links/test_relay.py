"""Buses that are joined in chains and rings: what is said once is heard once, everywhere, and the last word holds."""

import copy
import pickle
import struct
from collections.abc import Callable, Sequence
from itertools import count
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import strategies as some
from support.domains import Network, Process, Stranger, World, agree, finish
from support.foreign_world import ForeignTransform, ForeignWorld
from support.processes import peak_of
from support.samples import moving, static

from tfbus import SECOND, Buffer, Bus, PeerLost, SimulatedClock, TransformStamped
from tfbus.links.message import Kind
from tfbus.links.relay import MOST_PASSED, relay_of
from tfbus.links.replica import MOST_REMOVALS, OutgoingBatch, ReceivedTransform, RemovedFrame, Replica
from tfbus.tf_message import decode, encode

Graph = Sequence[Sequence[int]]
"""The buses of each of several domains, by their numbers."""

GRAPHS: dict[str, Graph] = {
    "pair": [[0, 1]],
    "mesh": [[0, 1, 2, 3]],
    "chain": [[0, 1], [1, 2], [2, 3]],
    "ring": [[0, 1], [1, 2], [2, 0]],
    "circle": [[0, 1], [1, 2], [2, 3], [3, 0]],
    "ring with a tail": [[0, 1], [1, 2], [2, 0], [0, 3]],
    "two bridges": [[0, 1, 2], [1, 2, 3]],
    "triangle": [[0, 1, 2], [1, 2, 3], [2, 3, 0]],
}


def domains(graph: Graph, *, drop_lost: bool = False, seed: int = 0) -> tuple[World, list[Process]]:
    world = World(seed)
    networks = [Network(world) for _ in graph]
    for number in range(1 + max(max(members) for members in graph)):
        mine = [network for network, members in zip(networks, graph, strict=True) if number in members]
        world.process(*mine, drop_lost=drop_lost)
    world.run(5.0)
    return world, list(world.processes)


@pytest.mark.parametrize("graph", GRAPHS.values(), ids=GRAPHS)
def test_every_bus_hears_each_batch_once_and_unchanged_with_its_authorities(graph: Graph) -> None:
    world, processes = domains(graph)
    said = []
    for number, process in enumerate(processes):
        authority = f"node of {number}"
        batch = (
            moving("map", f"{number}", number + 1, 1.0, authority),
            moving("map", f"{number}", number + 9, 2.0),
            static(f"{number}", f"s{number}", authority=authority),
        )
        process.say(*batch)
        said.append(batch)
        world.run(0.1)
    world.run(20.0)
    for process in processes:
        assert sorted(tuple(map(repr, batch)) for batch in process.batches) == sorted(tuple(map(repr, b)) for b in said)
        assert process.bus.statistics().callbacks_failed == 0


@pytest.mark.parametrize("graph", GRAPHS.values(), ids=GRAPHS)
def test_a_removed_frame_goes_everywhere_once_and_comes_back_with_what_is_said_later(graph: Graph) -> None:
    world, processes = domains(graph)
    processes[0].say(static("map", "a", 1.0), moving("map", "b", 5))
    world.run(1.0)
    processes[-1].remove("a")
    processes[-1].remove("b")
    world.run(10.0)
    assert all(not process.frames for process in processes)
    assert all(sorted(process.removed) == ["a", "b"] for process in processes)
    processes[0].say(static("map", "a", 2.0), moving("map", "b", 4))
    world.run(10.0)
    assert agree(processes)
    assert processes[-1].frames["a"].transform.translation[0] == 2.0
    assert all(len(process.seen) == 4 for process in processes)


@given(st.integers(0, 10**6), st.sampled_from(list(GRAPHS.values())), st.booleans())
def test_of_what_several_say_of_one_frame_at_once_the_same_holds_everywhere(
    seed: int, graph: Graph, moves: bool
) -> None:
    world, processes = domains(graph, seed=seed)
    for step in range(6):
        process = world.random.choice(processes)
        match world.random.randrange(3 if moves else 2):
            case 0:
                process.say(static("map", "contended", float(step), stamp=step))
            case 1:
                process.remove("contended")
            case 2:
                process.say(moving("map", "contended", step))
        world.run(world.random.choice([0.0, 0.001, 0.01]))
    world.run(10.0)
    if moves:
        # Of moving samples of several buses, each bus shows the newest stamp that it has heard.
        processes[seed % 2].say(moving("map", "contended", 9))
        world.run(1.0)
    last = [process.frames.get("contended") for process in processes]
    assert all(sample == last[0] for sample in last)


def test_a_bus_that_republishes_and_changes_what_it_hears_starts_no_loop_and_its_word_is_its_own() -> None:
    world, (one, two, three) = domains(GRAPHS["ring"])

    def republish(batch: Sequence[TransformStamped]) -> None:
        if batch[0].child == "a" and len(two.seen) == 1:
            two.bus.publish(batch)
            two.bus.publish([sample.replace(child="changed", authority="two") for sample in batch])

    two.bus.subscribe(republish)
    one.say(moving("map", "a", 1, authority="one"))
    world.run(5.0)
    for process in (one, three):
        assert [(sample.child, sample.authority) for sample in process.seen] == [("a", "one"), ("changed", "two")]


def test_a_subscriber_may_answer_a_removal_with_another_and_with_the_frame_itself() -> None:
    world, (one, two) = domains(GRAPHS["pair"])
    one.say(static("map", "a"), static("map", "b"), static("map", "c"))
    world.run(1.0)

    def answer(frame: str) -> None:
        if frame == "a":
            two.bus.remove_frame("b")
        if frame == "c":
            two.bus.publish(static("map", "c", 2.0))

    two.bus.subscribe(lambda _: None, answer)
    one.remove("a")
    one.remove("c")
    world.run(5.0)
    assert agree([one, two])
    assert one.frames.keys() == {"c"}
    assert one.frames["c"].transform.translation[0] == 2.0


def test_a_link_that_begins_later_brings_what_its_bus_has_and_one_that_has_ended_brings_nothing() -> None:
    world = World()
    near, far = Network(world), Network(world)
    one = world.process(near)
    one.bus.publish(static("map", "before"))
    one.flush()
    bridge, other = world.process(near, far), world.process(far)
    world.run(3.0)
    assert other.frames.keys() == {"before"}
    world.end(bridge)
    one.say(static("map", "after"))
    bridge.bus.publish(static("map", "alone"))
    world.run(3.0)
    assert (set(one.frames), set(other.frames)) == ({"before", "after"}, {"before"})


def test_what_no_message_can_hold_keeps_nothing_else_from_late_joiners() -> None:
    world, (one, _) = domains(GRAPHS["pair"])
    too_long = "x" * 100_000
    one.say(static("map", too_long))
    for names in ("a", "ab"):
        one.say(static("map", names[-1]))
        late = world.process(one.wire.network)
        world.run(5.0)
        assert set(late.frames) == set(names)
        assert not late.end.rejected
        one.remove(too_long)
        world.run(100.0)
        one.wire.network.sent()
        world.run(100.0)
        assert one.wire.network.sent(Kind.QUESTION) == 0


def test_a_moving_sample_from_before_a_static_one_or_a_removal_is_no_news_when_it_is_late() -> None:
    world = World()
    network = Network(world)
    listener = world.process(network)
    one, other = Stranger(network), Stranger(network)
    one.say(one.batch(static("map", "a"), number=10), one.removal("b", number=10))
    one.say(one.batch(moving("map", "a", 12), moving("map", "b", 12), number=12))
    other.say(other.batch(moving("map", "a", 9), moving("map", "b", 9), number=9))
    other.say(other.batch(moving("map", "a", 11), moving("map", "b", 11), number=11))
    assert [sample.stamp for sample in listener.seen if not sample.static] == [12, 12, 11, 11]


# Lost peers


def losses(process: Process) -> list[tuple[tuple[str, ...], tuple[str, ...]]]:
    """The frames and the authorities of the peers that a process has lost."""
    found = []
    with process.bus.events(stale_after=None) as events:
        process.world.run(5.0)
        while (event := events.queue.get()) is not None:
            if isinstance(event, PeerLost):
                found.append((event.frames, event.authorities))
    return found


@pytest.mark.parametrize("drop_lost", [False, True])
def test_a_lost_peer_is_told_with_its_frames_which_stay_or_go(drop_lost: bool) -> None:
    world, (one, two, three) = domains([[0, 1, 2]], drop_lost=drop_lost)
    one.say(moving("map", "a", 1, authority="slam"), static("map", "b", authority="driver"), moving("map", "c", 1))
    world.run(1.0)
    # It is the last to speak of this frame.
    three.say(moving("map", "c", 2))
    world.run(1.0)
    world.arrive(0, 0, lambda: world.kill(one), 1.0)
    assert losses(two) == [(("a", "b"), ("", "driver", "slam"))]
    assert set(two.frames) == set(three.frames) == ({"c"} if drop_lost else {"a", "b", "c"})


def test_the_frames_of_a_lost_bus_go_also_behind_a_bridge_and_come_back_with_it() -> None:
    world, (one, bridge, far) = domains([[0, 1], [1, 2]], drop_lost=True)
    one.say(static("map", "camera"), moving("map", "base", 1))
    far.say(static("map", "lidar"))
    world.run(1.0)
    network = one.wire.network
    network.cut(one.wire)
    world.run(1.0)
    assert [set(process.frames) for process in (one, bridge, far)] == [{"camera", "base"}, {"lidar"}, {"lidar"}]
    network.heal()
    world.run(5.0)
    assert [len(process.frames) for process in (one, bridge, far)] == [3, 3, 3]
    world.kill(bridge)
    world.run(1.0)
    assert [set(process.frames) for process in (one, far)] == [{"camera", "base"}, {"lidar"}]
    world.process(one.wire.network, far.wire.network, drop_lost=True)
    world.run(5.0)
    assert agree(world.processes)
    assert len(far.frames) == 3


def test_a_frame_that_a_lost_bus_has_taken_over_is_gone_until_it_is_said_again() -> None:
    world, (one, two, three) = domains([[0, 1, 2]], drop_lost=True)
    one.say(static("map", "tool", 1.0))
    world.run(1.0)
    two.say(static("map", "tool", 2.0))
    world.run(1.0)
    world.kill(two)
    world.run(5.0)
    assert one.frames == three.frames == {}
    one.say(static("map", "tool", 3.0))
    late = world.process(one.wire.network, drop_lost=True)
    world.run(5.0)
    assert one.frames == three.frames == late.frames == {"tool": static("map", "tool", 3.0)}


@pytest.mark.parametrize("drop_lost", [False, True])
@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("reached_again", [False, True])
def test_what_a_lost_bus_has_said_does_not_take_a_frame_over_when_it_is_late_and_is_not_heard_again(
    reached_again: bool, late: bool, drop_lost: bool
) -> None:
    world = World()
    network = Network(world)
    listener = world.process(network, drop_lost=drop_lost)
    old, new, bridge = (Stranger(network) for _ in range(3))
    said = old.batch(moving("map", "base", 1), number=10)
    sayings = [(old, said), (new, new.batch(moving("map", "base", 2), number=20))]
    # A program that was started again may be read first.
    for speaker, batch in sayings[:: -1 if late else 1]:
        speaker.say(batch)
    network.remove(old)
    world.run(1.0)
    assert listener.frames == {"base": moving("map", "base", 2)}
    if reached_again:
        bridge.say(kind=Kind.SIGN, reach=[(old.bus, ())])
    bridge.say(said)
    assert len(listener.seen) == 2


def test_a_removal_that_all_buses_of_a_ring_forget_goes_round_once() -> None:
    world, (one, *_, last) = domains(GRAPHS["ring"])
    one.say(static("map", "old"))
    known = relay_of(one.bus).replica.entries["old"].source.sequence
    stranger = Stranger(one.networks[0])
    for first in range(0, MOST_REMOVALS, MOST_REMOVALS // 4):
        later = range(first, first + MOST_REMOVALS // 4)
        stranger.say(*(stranger.removal(f"{number}", known + 100 + number) for number in later))
    world.run(10.0)
    for network in one.networks:
        network.sent()
    stranger.say(stranger.removal("old", known + 1), stranger.removal("unknown", known + 2))
    world.run(10.0)
    assert last.frames == {}
    assert sum(network.sent(Kind.LIVE) for network in one.networks) < 20


@pytest.mark.thorough
def test_frames_that_come_and_go_by_the_ten_thousand_leave_little_behind() -> None:
    world, (one, two) = domains(GRAPHS["pair"])

    def come_and_go(turn: int, count: int = 500) -> None:
        for number in range(count):
            one.say(moving("map", f"{turn}/{number}", number))
            one.remove(f"{turn}/{number}")
        world.run(1.0)
        for process in (one, two):
            for heard in (process.seen, process.batches, process.removed):
                heard.clear()

    for turn in range(21):
        come_and_go(turn)
    assert peak_of(lambda: come_and_go(99, 100)) < 3_000_000
    assert not one.frames
    assert not two.frames
    assert two.end.rejected == {}


def test_an_ended_link_forgets_and_its_bus_can_go_on_or_close() -> None:
    world, (one, two) = domains(GRAPHS["pair"])
    one.say(static("map", "a"))
    world.run(1.0)
    world.end(one)
    one.bus.publish(static("map", "b"))
    one.bus.close()
    two.bus.close()
    world.run(5.0)
    assert two.end.rejected == {}


def test_when_one_of_two_links_ends_what_it_brought_stays_and_the_other_leads_there_no_more() -> None:
    world, (one, bridge, other) = domains([[0, 1], [1, 2]], drop_lost=True)
    one.say(static("map", "a"))
    world.run(1.0)
    ended = bridge.ends.pop(0)
    ended.detach()
    ended.send()
    finish(ended.network.close())
    world.run(10.0)
    world.process(other.networks[0])
    world.run(10.0)
    assert (set(bridge.frames), set(other.frames)) == ({"a"}, set())


# Samples that came over a link

SHARED: list[Callable[[TransformStamped], TransformStamped]] = [
    copy.copy,
    copy.deepcopy,
    *[lambda sample, n=n: pickle.loads(pickle.dumps(sample, n)) for n in range(2, pickle.HIGHEST_PROTOCOL + 1)],
]


def received(sample: TransformStamped) -> TransformStamped:
    """The same sample as it comes over a link."""
    world, (one, two) = domains(GRAPHS["pair"])
    one.say(sample)
    world.run(1.0)
    assert type(two.seen[0]) is ReceivedTransform
    return two.seen[0]


def bits(sample: TransformStamped) -> tuple[object, ...]:
    """Everything in a sample, with numbers that only a bit tells apart kept apart."""
    row = *sample.transform.translation, *sample.transform.rotation
    return sample.parent, sample.child, sample.stamp, struct.pack("<7d", *row), sample.authority, sample.static


@given(sample=some.samples(at=some.stamps(0, 2**31 * SECOND - 1)))
def test_a_received_sample_is_that_which_was_sent_to_the_bit_and_a_copy_is_a_plain_one(
    sample: TransformStamped,
) -> None:
    twin = received(sample)
    assert twin == sample
    assert {sample: 1}[twin] == 1
    assert (repr(twin), str(twin), bits(twin)) == (repr(sample), str(sample), bits(sample))
    for share in SHARED:
        assert type(share(twin)) is TransformStamped
        assert bits(share(twin)) == bits(sample)


def test_a_received_sample_differs_from_others_and_changed_or_answered_it_is_a_plain_one() -> None:
    sample = received(moving("map", "a", 1, 2.0, "odometry"))
    assert sample not in (moving("map", "a", 2), "a")
    changed = sample.replace(stamp=5)
    assert type(changed) is TransformStamped
    assert changed == moving("map", "a", 5, 2.0, "odometry")
    with Bus(SimulatedClock()) as bus, Buffer(bus) as buffer:
        bus.publish([sample])
        assert type(buffer.lookup_nowait("map", "a", 1)) is TransformStamped


def test_a_quaternion_that_is_a_little_off_is_normalised_once_and_then_copied_as_it_is() -> None:
    message = bytearray(encode([moving("map", "a", 1)]))
    message[-32:] = struct.pack("<4d", 0.1, 0.2, 0.3, 0.93)
    (twin,) = decode(bytes(message), None, ReceivedTransform).samples
    assert twin is not None
    assert all(bits(share(twin)) == bits(twin) for share in SHARED)


# Samples that passed over a bus beside worlds without origins


class Beside:
    """A bus of a foreign world and of a network on which a stranger says things again, as another bus's."""

    def __init__(self) -> None:
        self.world, self.place = World(), ForeignWorld()
        network = Network(self.world)
        self.process = self.world.process(network, worlds=[self.place])
        self.stranger = Stranger(network)
        self.numbers = count(2**51)
        self.stranger.say()

    def is_news(self, sample: TransformStamped) -> bool:
        before = len(self.process.seen)
        self.stranger.say(self.stranger.batch(sample, number=next(self.numbers)))
        return len(self.process.seen) > before


@pytest.mark.parametrize(
    ("first", "second", "same"),
    [
        (moving("map", "a", 5), moving("map", "a", 5), True),
        (moving("map", "a", 5, 1.0, "x"), moving("map", "a", 5, 2.0, "y"), True),
        (moving("map", "a", 5), moving("map", "a", 6), False),
        (moving("map", "a", 5), moving("odom", "a", 5), False),
        (moving("map", "a", 5), moving("map", "b", 5), False),
        (moving("map", "a", 5), static("map", "a", stamp=5), False),
        (static("map", "a", stamp=5), moving("map", "a", 5), False),
        # Static ones are ranked instead.
        (static("map", "a", 1.0, authority="x"), static("map", "a", 1.0, authority="y"), False),
    ],
)
def test_beside_another_world_a_moving_sample_is_known_by_child_parent_stamp_and_kind(
    first: TransformStamped, second: TransformStamped, same: bool
) -> None:
    beside = Beside()
    beside.process.say(first)
    assert beside.is_news(second) is not same


def test_what_comes_back_from_another_world_is_no_news_and_a_static_frame_is_known_by_its_value_too() -> None:
    place, twin = ForeignWorld(), ForeignTransform("map", "a", 0, 1.0)
    process = World().process(worlds=[place])
    process.say(static("map", "a", 1.0), moving("map", "b", 5, 1.0))
    place.say(twin, static=True)
    place.say(ForeignTransform("map", "b", 5, 2.0))
    assert len(process.seen) == 2
    place.say(twin._replace(x=2.0), static=True)
    place.say(twin._replace(stamp=1, x=2.0), static=True)
    place.say(ForeignTransform("map", "b", 6, 2.0))
    assert len(process.seen) == 5


def test_so_many_samples_of_each_frame_are_remembered_and_some_of_a_frame_that_was_removed() -> None:
    beside = Beside()
    beside.process.say(*(moving("map", "a", stamp) for stamp in range(MOST_PASSED + 2)), moving("map", "b", 0))
    assert [beside.is_news(moving("map", "a", stamp)) for stamp in (2, MOST_PASSED, 1)] == [False, False, True]
    assert not beside.is_news(moving("map", "b", 0))
    beside.process.remove("a")
    assert not beside.is_news(moving("map", "a", MOST_PASSED + 1))
    assert beside.is_news(moving("map", "a", 3))


# Batches that go on


@pytest.mark.parametrize("links", [1, 2])
@pytest.mark.parametrize("options", [{}, {"drop_lost": True}, {"frames": ["a", "b"]}], ids=str)
def test_a_batch_that_only_goes_on_is_taken_as_each_of_its_samples_would_be(
    options: dict[str, Any], links: int
) -> None:
    def run(seed: int) -> object:
        world = World(seed)
        networks = [Network(world) for _ in range(links)]
        process = world.process(*networks, **options)
        strangers = [Stranger(network, bus=b"a stranger's bus") for network in networks]
        replica, draw = process.end.relay.replica, world.random
        origins = [strangers[0].bus, strangers[0].bus, b"one more origin.", replica.origin]
        reaches = [(b"one more origin.", ())]
        world.run(0.01)
        for step in range(60):
            frames = draw.sample("abcd", draw.randint(1, 3)) + draw.choices("ab", k=draw.random() < 0.2)
            kinds = draw.choices((moving, static), (9, 1), k=len(frames))
            samples = [
                kind("map", frame, stamp=draw.randint(0, step)) for kind, frame in zip(kinds, frames, strict=True)
            ]
            origin, number = draw.choice(origins), 10**6 + step + draw.randint(-4, 1)
            stranger = draw.choice(strangers)
            match draw.choices(("live", "answer", "removal", "own", "own removal", "reach"), (14, 2, 2, 2, 1, 1))[0]:
                case "own":
                    process.say(*samples)
                case "own removal":
                    process.remove(frames[0])
                case "reach":
                    stranger.say(kind=Kind.SIGN, reach=reaches[: draw.randint(0, 1)])
                case "removal":
                    stranger.say(RemovedFrame(origin, number, frames[0]))
                case kind:
                    stranger.say(OutgoingBatch(origin, number, samples), kind=Kind[kind.upper()])
        entries = {
            frame: (one.source.rank, one.sample, one.shown and one.shown.rank, one.floor, one.numbers, one.passed)
            for frame, one in replica.entries.items()
        }
        names = [view for end in process.domain_ends for view in end.views.values()]
        views = {frame: [names.index(view) for view in one.views] for frame, one in replica.entries.items()}
        told = process.end.own.claim(world.now + 10.0).digest, process.end.duplicates
        return entries, views, replica._held, replica._removals, told, process.batches, process.removed

    with pytest.MonkeyPatch.context() as patch:
        # The numbers that this bus gives lie among those of the stranger.
        patch.setattr("tfbus.links.relay.time_ns", lambda: 10**9)
        found = [run(seed) for seed in range(8)]
        patch.setattr(Replica, "go_on", lambda *_: 0)
        assert found == [run(seed) for seed in range(8)]
