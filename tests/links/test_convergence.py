"""The promise of the link: some seconds after any trouble, all buses of a domain hold the same.

`CONVERGENCE_SEEDS` in the environment is the number of random runs that the thorough suite has of each kind of trouble.
"""

import os
from collections.abc import Sequence
from typing import Any

import pytest
from support.domains import Network, Process, Stranger, World, agree, shown
from support.samples import moving, static

from tfbus import Buffer, Covariance, Transform, TransformStamped, UncertainSample
from tfbus.links.message import Kind

NAMES = [f"static{k}" for k in range(5)]
LIMIT = 10.0
SEEDS = int(os.environ.get("CONVERGENCE_SEEDS", "40"))


def few_or_many(few: int, many: int) -> pytest.MarkDecorator:
    """The first seeds in the default suite, and the others in the thorough one."""
    rest = pytest.param(range(few, many), marks=pytest.mark.thorough)
    return pytest.mark.parametrize("seeds", [range(few), rest], ids=["few", "many"])


PLACES = {
    "one network": [[0], [0], [0], [0], [0]],
    "two bridges": [[0, 1], [0, 1], [0], [0], [1]],
    "a ring": [[0, 1], [1, 2], [0, 2], [0], [2]],
    "two machines": [[0, 1], [0, 2], [1], [1], [2], [0]],
}
"""The networks on which processes are that are started again when they die."""
ALL_TROUBLES = (25, 15, 12, 6, 6, 6, 6, 8, 6, 8, 6, 3, 4, 4)
OF_PLACES = (25, 15, 12, 0, 0, 6, 6, 8, 6, 12, 6, 3, 4, 4)
WITHOUT_DEATHS = (25, 15, 12, 0, 0, 6, 6, 8, 6, 0, 6, 3, 4, 4)
"""Only other links of a dead robot tell its frames to late joiners."""


def trouble(
    world: World, networks: list[Network], steps: int, drop_lost: list[bool], kinds: Sequence[int] = ALL_TROUBLES
) -> None:
    """Publish, remove, start, kill, stop, cut and lose at random."""
    draw = world.random
    for _ in range(steps):
        running = [process for process in world.processes if not process.stopped]
        if not running:
            break
        process, network = draw.choice(running), draw.choice(networks)
        wire = draw.choice(process.wires)
        match draw.choices(range(len(kinds)), kinds)[0]:
            case 0:
                process.publish(draw.choice(NAMES), static=True)
            case 1:
                process.publish(draw.choice([f"moving of {process.name}", "moving of all"]), static=False)
            case 2:
                process.remove(draw.choice([*process.frames, *NAMES]))
            case 3 if len(world.processes) < 6:
                some = draw.sample(networks, draw.randint(1, len(networks)))
                world.process(*some, drop_lost=draw.choice(drop_lost))
            case 4 if len(world.processes) > 2:
                world.kill(process)
            case 5:
                process.stop()
            case 6:
                stopped = [process for process in world.processes if process.stopped]
                if stopped:
                    draw.choice(stopped).go_on()
            case 7:
                wire.network.cut(wire, **draw.choice([{}, {"inwards": False}, {"outwards": False}]))
            case 8:
                network.loss = draw.choice([0.0, 0.3, 0.9])
                if not network.loss:
                    network.heal()
            case 9:
                world.kill(process)
                world.run(draw.choice([0.0, 0.001, 0.5]))
                again = world.process(*process.networks, drop_lost=process.drop_lost, name=process.name)
                again.publish(f"static of {again.name}", static=True)
                again.publish(f"moving of {again.name}", static=False)
            case 10:
                wire.network.silence(wire)
            case 11:
                # More than a stopped process has room for.
                for _ in range(150):
                    process.publish(f"moving of {process.name}", static=False)
            case 12:
                process.publish(f"either of {process.name}", static=draw.random() < 0.5)
            case 13:
                frame = draw.choice(NAMES)
                process.remove(frame)
                process.publish(frame, static=True)
        world.run(draw.choice([0.0, 0.001, 0.01, 0.1, 1.0, 3.0, 8.0]))


def end_of_trouble(world: World, networks: list[Network]) -> None:
    for network in networks:
        network.heal()
    for process in world.processes:
        if process.stopped:
            process.go_on()


def check_truth(world: World) -> None:
    """Nothing was invented, refused, or heard twice."""
    for process in world.processes:
        assert process.again == []
        assert {(sample.child, sample.stamp) for sample in process.seen} <= world.published
        for end in process.ends:
            assert not end.rejected


def until_they_agree(world: World, groups: list[list[Process]]) -> None:
    end = world.now + LIMIT
    while not all(agree(group) for group in groups):
        assert world.now < end, (world.seed, [[shown(process) for process in group] for group in groups])
        world.run(0.5)


@pytest.mark.parametrize("drop_lost", [False, True])
@few_or_many(3, SEEDS)
def test_all_buses_show_the_same_some_seconds_after_any_trouble(seeds: range, drop_lost: bool) -> None:
    for seed in seeds:
        world = World(seed)
        network = Network(world)
        for _ in range(world.random.randint(2, 4)):
            world.process(network, drop_lost=drop_lost)
        trouble(world, [network], world.random.randint(5, 40), [drop_lost])
        end_of_trouble(world, [network])
        until_they_agree(world, [world.processes])
        check_truth(world)


@few_or_many(3, SEEDS)
def test_buses_with_both_settings_agree_among_themselves(seeds: range) -> None:
    for seed in seeds:
        world = World(seed)
        network = Network(world)
        for k in range(4):
            world.process(network, drop_lost=k % 2 == 1)
        trouble(world, [network], 30, [False, True])
        end_of_trouble(world, [network])
        settings = [[p for p in world.processes if p.drop_lost is drop] for drop in (False, True)]
        until_they_agree(world, [group for group in settings if group])
        check_truth(world)


@pytest.mark.parametrize("drop_lost", [False, True])
@few_or_many(3, SEEDS)
def test_links_that_hear_only_some_frames_hold_exactly_these_in_the_end(seeds: range, drop_lost: bool) -> None:
    for seed in seeds:
        world = World(seed)
        network = Network(world)
        others = [world.process(network, drop_lost=drop_lost) for _ in range(3)]
        chosen = {"static0", "static3", *(f"moving of {process.name}" for process in others[:2])}
        leaves = [world.process(network, drop_lost=drop_lost, frames=frames) for frames in (chosen, {"static0"}, set())]
        world.run(world.random.choice((0.0, 5.0)))
        trouble(world, [network], 30, [drop_lost])
        whole = world.process(network, drop_lost=drop_lost)
        end_of_trouble(world, [network])
        world.run(LIMIT)
        until_they_agree(world, [[process for process in world.processes if process not in leaves]])
        for leaf, frames in zip(leaves, (chosen, {"static0"}, set[str]()), strict=True):
            said_here = {sample.child for sample in leaf.seen if sample.authority == leaf.wire.id[:4]}
            assert {sample.child for sample in leaf.seen} <= frames | said_here
            if leaf in world.processes:
                held = {frame: stamp for frame, stamp in shown(leaf).items() if frame in frames}
                assert held == {frame: stamp for frame, stamp in shown(whole).items() if frame in frames}


@pytest.mark.parametrize("drop_lost", [False, True])
@few_or_many(3, SEEDS)
def test_buses_behind_bridges_and_in_rings_agree(seeds: range, drop_lost: bool) -> None:
    for seed in seeds:
        world = World(seed)
        networks = [Network(world) for _ in range(3)]
        one, two, three = networks
        for some in ((one, two), (two, three), (one, three), (one,), (three,)):
            world.process(*some, drop_lost=drop_lost)
        trouble(world, networks, 25, [drop_lost])
        # Enough bridges for everybody to be reached again.
        for some in ((one, two), (two, three)):
            world.process(*some, drop_lost=drop_lost)
        end_of_trouble(world, networks)
        until_they_agree(world, [world.processes])
        check_truth(world)


@pytest.mark.parametrize("drop_lost", [False, True])
@pytest.mark.parametrize("places", PLACES.values(), ids=PLACES)
@few_or_many(1, SEEDS // 10)
def test_programs_that_are_started_again_agree_after_each_of_several_troubles(
    seeds: range, places: list[list[int]], drop_lost: bool
) -> None:
    for seed in seeds:
        world = World(seed)
        networks = [Network(world) for _ in range(3)]
        for place in places:
            world.process(*(networks[number] for number in place), drop_lost=drop_lost)
        for _ in range(5):
            trouble(world, networks, world.random.randint(1, 15), [drop_lost], OF_PLACES)
            end_of_trouble(world, networks)
            until_they_agree(world, [world.processes])
            check_truth(world)


@pytest.mark.parametrize("drop_lost", [False, True])
@pytest.mark.parametrize("places", PLACES.values(), ids=PLACES)
@few_or_many(1, SEEDS // 10)
def test_links_of_several_robots_agree_after_each_of_several_troubles(
    seeds: range, places: list[list[int]], drop_lost: bool
) -> None:
    for seed in seeds:
        world = World(seed)
        networks = [Network(world) for _ in range(3)]
        for place in places:
            robot: dict[str, Any] = world.random.choice([{}, {"robot": "r1"}, {"robot": "r2"}])
            world.process(*(networks[number] for number in place), drop_lost=drop_lost, **robot)
        for _ in range(3):
            trouble(world, networks, world.random.randint(1, 15), [drop_lost], WITHOUT_DEATHS)
            end_of_trouble(world, networks)
            until_they_agree(world, [world.processes])
            check_truth(world)


@pytest.mark.parametrize("seconds", [1.5, 7.0, 30.0])
@pytest.mark.parametrize("trouble", ["stop", "cut", "inwards", "outwards"])
@pytest.mark.parametrize("drop_lost", [False, True])
@few_or_many(1, 5)
def test_what_was_said_once_while_a_peer_was_away_arrives_soon_after(
    seeds: range, trouble: str, seconds: float, drop_lost: bool
) -> None:
    for seed in seeds:
        world = World(seed)
        network = Network(world)
        one, other, away = (world.process(network, drop_lost=drop_lost) for _ in range(3))
        one.say(static("map", "gone"))
        world.run(10.0)
        match trouble:
            case "stop":
                away.stop()
            case "cut":
                network.cut(away.wire)
            case "inwards":
                network.cut(away.wire, outwards=False)
            case "outwards":
                network.cut(away.wire, inwards=False)
        world.run(seconds / 2)
        other.say(moving("map", "goal", 1))
        one.say(static("map", "camera"))
        one.remove("gone")
        # More than a stopped process has room for.
        for stamp in range(200):
            other.say(moving("map", "base", stamp))
        if trouble in ("cut", "inwards"):
            away.say(moving("map", "own goal", 1), static("map", "own camera"))
        world.run(seconds / 2)
        network.heal()
        if away.stopped:
            away.go_on()
        world.run(3.0)
        assert agree(world.processes)
        assert {"goal", "camera"} <= away.frames.keys()
        assert "gone" not in away.frames


@pytest.mark.parametrize("drop_lost", [False, True])
def test_of_what_two_parted_buses_have_said_of_one_frame_the_later_holds_for_all(drop_lost: bool) -> None:
    world = World()
    network = Network(world)
    # The one that speaks first was started last and has more to say, so it would have the higher numbers if buses only
    # counted from their start.
    other, one = (world.process(network, drop_lost=drop_lost) for _ in range(2))
    network.cut(one.wire)
    for stamp in range(200):
        one.say(moving("map", "base", stamp))
    one.say(moving("map", "goal", 1), static("map", "camera", 1.0))
    world.run(7.0)
    other.say(moving("map", "goal", 2), static("map", "camera", 2.0))
    network.heal()
    world.run(5.0)
    late = world.process(network, drop_lost=drop_lost)
    world.run(5.0)
    for process in (one, other, late):
        assert process.frames["goal"].stamp == 2
        assert process.frames["camera"].transform.translation[0] == 2.0


@pytest.mark.parametrize("seconds", [0.01, 60.0])
def test_what_a_killed_process_has_said_stays_for_all_and_for_late_joiners_or_for_nobody(seconds: float) -> None:
    world = World()
    network = Network(world)
    keep, drop = world.process(network), world.process(network, drop_lost=True)
    dies, ends = world.process(network), world.process(network)
    dies.say(static("map", "camera"), moving("map", "goal", 1))
    ends.say(static("map", "lidar"))
    world.run(seconds)
    world.kill(dies)
    world.end(ends)
    world.run(seconds)
    late, late_drop = world.process(network), world.process(network, drop_lost=True)
    world.run(5.0)
    assert keep.frames.keys() == late.frames.keys() == {"camera", "goal", "lidar"}
    assert drop.frames.keys() == late_drop.frames.keys() == set()
    # Until somebody removes it, and for whoever was not there then.
    away = world.process(network)
    world.run(5.0)
    network.cut(away.wire)
    late.remove("camera")
    keep.remove("goal")
    network.heal()
    later = world.process(network)
    world.run(5.0)
    assert [set(process.frames) for process in (keep, late, away, later)] == [{"lidar"}] * 4


@pytest.mark.parametrize("drop_lost", [False, True])
def test_a_late_sample_of_another_bus_brings_no_frame_back_that_was_withdrawn(drop_lost: bool) -> None:
    world = World()
    network = Network(world)
    process = world.process(network, drop_lost=drop_lost)
    earlier, newest = Stranger(network), Stranger(network)
    newest.say(newest.batch(moving("map", "goal", 2), number=2))
    network.remove(newest)
    world.run(0.1)
    earlier.say(earlier.batch(moving("map", "goal", 1), number=1))
    assert shown(process) == ({} if drop_lost else {"goal": 2})
    assert [sample.stamp for sample in process.seen] == ([2] if drop_lost else [2, 1])


@pytest.mark.parametrize(
    "batch",
    [
        (static("map", "a", 1.0), static("map", "a", 2.0)),
        (moving("map", "a", 5, 1.0), moving("map", "a", 5, 2.0)),
        (moving("map", "a", 5, 1.0), static("map", "a", 2.0)),
        (static("map", "a", 1.0), moving("map", "a", -5, 2.0)),
    ],
)
def test_of_two_samples_of_a_frame_in_one_batch_all_buses_and_late_joiners_hold_the_same(
    batch: tuple[TransformStamped, ...],
) -> None:
    world = World()
    networks = Network(world), Network(world)
    one, two = world.process(*networks), world.process(*networks)
    world.run(5.0)
    one.say(*batch)
    world.run(5.0)
    late = world.process(networks[0])
    world.run(5.0)
    assert [process.frames["a"] for process in (one, two, late)] == [batch[1]] * 3
    assert two.seen == list(batch)


def test_copies_that_agree_cost_signs_only_and_ever_fewer() -> None:
    world = World()
    network = Network(world)
    processes = [world.process(network) for _ in range(4)]
    for place, process in enumerate(processes):
        process.say(*(static("map", f"{place}/{number}") for number in range(100)))
    world.run(10.0)
    network.sent()
    received = [process.received for process in processes]
    world.run(100.0)
    assert [process.received for process in processes] == received, "a sign without news has woken an event loop"
    others = set(Kind) - {Kind.SIGN}
    assert sum(kind in others for kind, _ in network.carried) == 0
    assert network.sent(Kind.SIGN) <= 4 * 3 * 51
    # While something is published, signs come more often, and still nobody asks.
    for stamp in range(100):
        for process in processes:
            process.say(moving("map", process.wire.id, stamp))
        world.run(0.1)
    assert sum(kind in (Kind.QUESTION, Kind.ANSWER) for kind, _ in network.carried) == 0


def test_many_static_frames_reach_a_late_joiner_in_parts() -> None:
    world = World()
    network = Network(world)
    one, other = world.process(network), world.process(network)
    one.say(*(static("map", f"{number}") for number in range(3_000)))
    other.say(*(static("map", f"other {number}") for number in range(10)))
    world.run(10.0)
    network.sent()
    late = world.process(network)
    world.run(1.0)
    assert late.frames.keys() == one.frames.keys()
    assert len(late.seen) == 3_010
    assert network.sent(Kind.QUESTION) <= 8


def test_covariances_reach_other_buses_bridges_and_late_joiners() -> None:
    world = World()
    near, far = Network(world), Network(world)
    here, bridge, there = world.process(near), world.process(near, far), world.process(far)
    world.run(3.0)
    error, calibration = Covariance.of(xyz=0.3, rpy=0.01), Covariance.of(xyz=0.4)
    now = here.bus.clock.now()
    with Buffer(bridge.bus) as early, Buffer(there.bus) as other:
        here.bus.publish([UncertainSample("map", "base", now, Transform(), covariance=error, kind="drift")])
        here.bus.publish([UncertainSample("base", "eye", now, Transform(), static=True, covariance=calibration)])
        world.run(5.0)
        late = world.process(far)
        with Buffer(late.bus) as last:
            world.run(5.0)
            for buffer in (early, other, last):
                found = buffer.lookup_nowait("map", "eye", covariance=True)
                assert found.covariance.sigmas == pytest.approx([0.5] * 3 + [0.01] * 3)
                assert found.exact == ()
