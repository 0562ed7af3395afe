"""The last seconds of moving frames for a link that joins late."""

import math
from collections.abc import Iterable
from typing import Any

import pytest
from support.domains import Network, Process, Stranger, World
from support.memory_wire import MemoryNetwork
from support.samples import moving, static

from tfbus import SECOND, Buffer, Bus, TransformStamped
from tfbus.links import DomainLink
from tfbus.links.history import LONGEST_HISTORY, MOST_HELD, MOST_OF_FRAME, PATIENCE
from tfbus.links.message import Kind, Outgoing, write_message
from tfbus.links.replica import Claim


def scene(*, keep: float | None = None, seed: int = 0) -> tuple[World, Network, Process, Buffer]:
    """A process with a buffer."""
    world = World(seed)
    network = Network(world)
    teller = world.process(network)
    return world, network, teller, Buffer(teller.bus, keep)


def stamps_of(heard: Iterable[TransformStamped], child: str) -> list[float]:
    return [sample.stamp / SECOND for sample in heard if sample.child == child]


def test_who_joins_late_has_the_last_seconds_with_stamps_parents_and_authorities_before_what_is_live() -> None:
    for seed in range(10):
        world, network, teller, _ = scene(seed=seed)
        for second in range(10):
            parent, authority = ("map", "odometry") if second < 8 else ("odom", "slam")
            teller.say(moving(parent, "base", second * SECOND, float(second), authority))
        teller.say(static("base", "lidar"), moving("map", "old", 3 * SECOND))
        late = world.process(network, history=5.0)
        for second in range(10, 20):
            teller.say(moving("odom", "base", second * SECOND, float(second), "slam"))
            world.run(0.002)
        world.run(5.0)
        base = [sample for sample in late.seen if sample.child == "base"]
        first = int(stamps_of(base, "base")[0])
        assert 5 <= first <= 7, "those of 5 s before the question came"
        assert [sample.stamp // SECOND for sample in base] == list(range(first, 20))
        assert [sample.parent for sample in base] == ["map" if s < 8 else "odom" for s in range(first, 20)]
        assert [sample.authority for sample in base] == ["odometry" if s < 8 else "slam" for s in range(first, 20)]
        assert [sample.transform.translation[0] for sample in base] == list(range(first, 20))
        assert stamps_of(late.seen, "old") == [3]
        assert [sample.child for sample in late.seen if sample.static] == ["lidar"]
        assert late.end.rejected == {}


def test_the_past_is_not_told_as_late_data_and_what_comes_live_is() -> None:
    world, network, teller, _ = scene()
    teller.say(*[moving("map", "base", second * SECOND) for second in range(10)])
    late = world.process(network, history=4.5)
    world.run(5.0)
    assert stamps_of(late.seen, "base") == [5, 6, 7, 8, 9]
    assert late.bus.statistics().behind == 0
    teller.say(moving("map", "base", 10 * SECOND))
    world.run(5.0)
    assert late.bus.statistics().behind == 1


@pytest.mark.parametrize("keeps", [(2.0, 8.0), (8.0, 2.0)])
def test_the_past_is_that_of_the_buffer_which_holds_most_of_it(keeps: tuple[float, float]) -> None:
    world, network, teller, _ = scene(keep=keeps[0])
    with Buffer(teller.bus, keeps[1]), Buffer(teller.bus, 4.0):
        for second in range(20):
            teller.say(moving("map", "base", second * SECOND))
        # One that has never heard of the frame.
        with Buffer(teller.bus):
            late = world.process(network, history=60.0)
            world.run(5.0)
    held = stamps_of(late.seen, "base")
    assert held == list(range(20))[-len(held) :]
    assert 8 <= len(held) <= 10


def test_without_a_buffer_there_or_the_wish_here_only_the_newest_comes() -> None:
    # Whichever peer answers first.
    for seed in range(10):
        world, network, teller, buffer = scene(seed=seed)
        teller.say(moving("map", "base", SECOND), moving("map", "base", 2 * SECOND))
        wishless = world.process(network)
        world.run(5.0)
        buffer.close()
        late = world.process(network, history=5.0)
        world.run(5.0)
        assert stamps_of(wishless.seen, "base") == stamps_of(late.seen, "base") == [2]


def test_of_a_killed_process_nobody_tells_the_past_and_its_newest_samples_stay() -> None:
    for seed in range(10):
        world, network, teller, _ = scene(seed=seed)
        for _ in range(2):
            world.process(network)
        teller.say(moving("map", "base", SECOND), moving("map", "base", 2 * SECOND))
        world.run(1.0)
        world.kill(teller)
        late = world.process(network, history=5.0)
        world.run(5.0)
        assert stamps_of(late.seen, "base") == [2]


def test_what_a_link_has_heard_itself_it_does_not_tell_as_its_past() -> None:
    world, network, teller, _ = scene()
    other = world.process(network)
    with Buffer(other.bus):
        teller.say(*(moving("map", "base", second * SECOND) for second in range(3)))
        world.run(1.0)
        world.kill(teller)
        world.run(1.0)
        late = world.process(network, history=5.0)
        world.run(10.0)
    assert stamps_of(late.seen, "base") == [2]


def test_the_past_comes_in_chunks_of_whole_frames_in_order_and_is_bounded() -> None:
    world, network, teller, _ = scene()
    names = [f"f{number}" for number in (3, 1, 0, 4, 2)]
    teller.say(*(moving("map", f"a{number}", 0) for number in range(9)))
    for stamp in range(MOST_OF_FRAME // 2):
        teller.bus.publish([moving("map", name, stamp) for name in names])
    teller.say(*(moving("map", "much", stamp) for stamp in range(MOST_OF_FRAME + 10)))
    network.sent()
    late = world.process(network, history=LONGEST_HISTORY)
    world.run(5.0)
    counts = {name: len(stamps_of(late.seen, name)) for name in [*names, "much"]}
    assert len(stamps_of(late.seen, "a8")) == 1
    assert counts == {**dict.fromkeys(names, MOST_OF_FRAME // 2), "much": MOST_OF_FRAME}
    assert stamps_of(late.seen, "much")[0] == 10 / SECOND
    assert [sample.child for sample in late.seen] == sorted(sample.child for sample in late.seen)
    assert sum(kind is Kind.PAST for kind, _ in network.carried) == 4


def test_a_sample_that_no_message_can_hold_keeps_none_of_the_past_from_late_joiners() -> None:
    world, network, teller, _ = scene()
    teller.say(*(moving("map", name, second * SECOND) for name in "ac" for second in range(5)))
    teller.say(moving("map", "b", SECOND), moving("x" * 2_000, "b", 2 * SECOND), moving("map", "b", 3 * SECOND))
    late = world.process(network, history=60.0)
    world.run(5.0)
    assert [stamps_of(late.seen, name) for name in "abc"] == [[0, 1, 2, 3, 4], [1, 3], [0, 1, 2, 3, 4]]


def test_a_peer_is_asked_once_even_if_it_comes_back() -> None:
    world, network, teller, _ = scene()
    teller.say(moving("map", "base", SECOND))
    late = world.process(network, history=5.0)
    world.run(5.0)
    network.cut(late.wire)
    for second in (2, 3):
        teller.say(moving("map", "base", second * SECOND))
    network.heal()
    world.run(5.0)
    assert stamps_of(late.seen, "base") == [1, 3]
    assert network.sent(Kind.PAST_QUESTION) == 1


@pytest.mark.parametrize("end", ["silence", "answer", "garbage", "loss", "many", "same again"])
def test_what_was_held_back_comes_when_the_peer_says_nothing_leaves_or_sends_too_much(end: str) -> None:
    world = World()
    network = Network(world)
    late = world.process(network, history=5.0)
    peer = Stranger(network)
    world.run(0.01)
    count = MOST_HELD + 2 if end == "many" else 3
    for stamp in range(count):
        batch = peer.batch(moving("map", "base", stamp), number=stamp + 10)
        peer.publish("all", write_message(Outgoing(Kind.LIVE, peer.bus, stamp + 1), [batch]))
    world.run(0.01)
    if end != "many":
        assert late.seen == []
    past = peer.batch(moving("map", "base", 0), number=9)
    match end:
        case "silence":
            world.run(PATIENCE)
        case "answer":
            # Each answer may take so long.
            for frame in ("a", "b"):
                world.run(PATIENCE - 1.0)
                other = peer.batch(moving("map", frame, 0), number=9)
                peer.say(other, kind=Kind.PAST, claim=Claim(0, 0, 0, final=False))
            peer.say(past, kind=Kind.PAST)
        case "garbage":
            peer.say(peer.batch(moving("map", "base", 0), number=2**64 - 1), kind=Kind.PAST)
            assert late.end.rejected == {"number": 1}
        case "loss":
            network.remove(peer)
            world.run(0.01)
        case "same again":
            for _ in range(2):
                peer.say(past, kind=Kind.PAST, claim=Claim(0, 0, 0, final=False))
            assert len(peer.heard(Kind.PAST_QUESTION)) == 2
    heard = [sample.stamp for sample in late.seen if sample.child == "base"]
    assert heard == ([0] if end in ("answer", "same again") else []) + list(range(count))
    assert late.end.rejected.keys() <= {"number"}


def test_a_peer_whose_past_has_no_end_holds_back_the_samples_of_nobody_for_longer_than_a_minute() -> None:
    world = World()
    network = Network(world)
    world.process(network).say(moving("map", "rests", 1))
    late = world.process(network, history=5.0)
    peer = Stranger(network)
    for number in range(30):
        batch = peer.batch(moving("map", f"{number:02}", 1), number=number + 1)
        peer.say(batch, kind=Kind.PAST, claim=Claim(0, 0, 0, final=False))
        world.run(PATIENCE - 1.0)
    assert "rests" in late.frames


def test_so_many_samples_wait_for_the_past_of_all_peers_together() -> None:
    world = World()
    network = Network(world)
    late = world.process(network, history=5.0)
    # The messages of earlier peers have made room for those of later ones.
    for _ in range(2):
        shown = len(late.seen)
        peers = [Stranger(network), Stranger(network)]
        world.run(0.01)
        for peer in peers:
            for _ in range(3):
                # A removal counts as two, and a large message is held in parts.
                peer.say(*[peer.removal("none")] * 9_000)
            peer.say(peer.batch(*(moving("map", peer.id, stamp) for stamp in range(500))))
        assert {sample.child for sample in late.seen[shown:]} == {peers[1].id}
        world.run(PATIENCE)


def test_it_has_to_be_a_time_that_passes() -> None:
    bus, wire = Bus(), MemoryNetwork().wire()
    bad: list[Any] = [0.0, -1.0, math.nextafter(LONGEST_HISTORY, math.inf), math.nan]
    for seconds in bad:
        with pytest.raises(ValueError, match="history"):
            DomainLink(bus, "tf", wire, history=seconds)
    for seconds in (1e-3, LONGEST_HISTORY):
        DomainLink(bus, "tf", wire, history=seconds)
