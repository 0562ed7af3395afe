"""The promise of the link: some seconds after any trouble, all buses of a domain hold the same."""

import pytest

from tests.support.domains import Network, Process, World

NAMES = [f"static{k}" for k in range(5)]
LIMIT = 10.0


def trouble(world: World, networks: list[Network], steps: int, drop_lost: list[bool]) -> None:
    """Publish, remove, start, kill, stop, cut and lose at random."""
    draw = world.random
    for _ in range(steps):
        running = [process for process in world.processes if not process.stopped]
        if not running:
            break
        process, network = draw.choice(running), draw.choice(networks)
        wire = draw.choice(process.wires)
        match draw.choices(range(9), (25, 15, 12, 6, 6, 6, 6, 8, 6))[0]:
            case 0:
                process.publish(draw.choice(NAMES), static=True)
            case 1:
                process.publish(f"moving of {process.wires[0].id[:4]}", static=False)
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
        world.run(draw.choice([0.0, 0.001, 0.01, 0.1, 1.0, 3.0, 8.0]))


def end_of_trouble(world: World, networks: list[Network]) -> None:
    for network in networks:
        network.heal()
    for process in world.processes:
        if process.stopped:
            process.go_on()


def shown(process: Process) -> dict[str, int]:
    return {frame: sample.stamp for frame, sample in process.frames.items()}


def agree(processes: list[Process]) -> bool:
    return all(shown(process) == shown(processes[0]) for process in processes)


def check_nothing_invented(world: World) -> None:
    for process in world.processes:
        assert {(sample.child, sample.stamp) for sample in process.seen} <= world.published
        for end in process.ends:
            assert not end.peers.rejected


def until_they_agree(world: World, groups: list[list[Process]]) -> None:
    end = world.now + LIMIT
    while not all(agree(group) for group in groups):
        assert world.now < end, [[shown(process) for process in group] for group in groups]
        world.run(0.5)


@pytest.mark.parametrize("drop_lost", [False, True])
@pytest.mark.parametrize(
    "seeds", [range(10), pytest.param(range(10, 1_000), marks=pytest.mark.thorough)], ids=["few", "many"]
)
def test_all_buses_show_the_same_some_seconds_after_any_trouble(seeds: range, drop_lost: bool) -> None:
    for seed in seeds:
        world = World(seed)
        network = Network(world)
        for _ in range(world.random.randint(2, 4)):
            world.process(network, drop_lost=drop_lost)
        trouble(world, [network], world.random.randint(5, 40), [drop_lost])
        end_of_trouble(world, [network])
        until_they_agree(world, [world.processes])
        check_nothing_invented(world)


@pytest.mark.parametrize(
    "seeds", [range(10), pytest.param(range(10, 500), marks=pytest.mark.thorough)], ids=["few", "many"]
)
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
        check_nothing_invented(world)


@pytest.mark.parametrize("drop_lost", [False, True])
@pytest.mark.parametrize(
    "seeds", [range(10), pytest.param(range(10, 500), marks=pytest.mark.thorough)], ids=["few", "many"]
)
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
        check_nothing_invented(world)
