"""Worlds without origins, such as ROS, that are joined in rings: every sample goes round once and no more."""

from collections import Counter

import pytest
from support.domains import Network, Process, SlowWorld, World
from support.foreign_world import ForeignMessage, ForeignTransform
from support.samples import latched, moving

SEEDS = range(5)


class NamelessWorld(SlowWorld):
    """It does not tell who has sent a message, as ROS does not."""

    def deliver(self, sender: str, node: str, message: ForeignMessage) -> None:
        del sender
        super().deliver("", node, message)

    @property
    def transforms(self) -> Counter[tuple[bool, str, int]]:
        """The number of times that each transform was published."""
        return Counter(
            (message.static, each.child, each.stamp) for _, message in self.published for each in message.transforms
        )


def moved(process: Process) -> Counter[tuple[str, int]]:
    """The number of times that a bus has heard each moving sample."""
    return Counter((sample.child, sample.stamp) for sample in process.seen if not sample.static)


def arm(stamp: int) -> ForeignTransform:
    return ForeignTransform("map", "arm", stamp, float(stamp))


def lidar(x: float) -> ForeignTransform:
    return ForeignTransform("arm", "lidar", 0, x)


@pytest.mark.parametrize("seed", SEEDS)
def test_two_links_of_one_bus_in_one_world_give_each_sample_once(seed: int) -> None:
    world = World(seed)
    ros = NamelessWorld(world)
    process = world.process(worlds=(ros, ros))
    for stamp in range(100):
        ros.say(arm(stamp))
        process.say(moving("map", "base", stamp))
        if stamp == 50:
            ros.say(lidar(3.0), static=True)
        world.run(world.random.choice((0.0, 0.001, 0.01)))
    world.run(10.0)
    assert len(process.seen) == 201
    assert Counter((sample.child, sample.stamp) for sample in process.seen).most_common(1)[0][1] == 1


@pytest.mark.parametrize("seed", SEEDS)
def test_two_buses_between_two_worlds_pass_each_sample_on_once_each(seed: int) -> None:
    world = World(seed)
    near, far = NamelessWorld(world), NamelessWorld(world)
    processes = [world.process(worlds=(near, far)) for _ in range(2)]
    for stamp in range(100):
        near.say(arm(stamp))
        world.run(world.random.choice((0.0, 0.001, 0.01)))
    world.run(10.0)
    assert sum((near.transforms + far.transforms).values()) == 300
    assert [len(process.seen) for process in processes] == [100, 100]


@pytest.mark.parametrize("seed", SEEDS)
def test_a_ring_of_three_buses_with_two_worlds_and_a_domain_hears_each_sample_once(seed: int) -> None:
    """ROS 1 joins the first two buses, ROS 2 the second two, and a domain of buses the last to the first."""
    world = World(seed)
    ros1, ros2, network = NamelessWorld(world), NamelessWorld(world), Network(world)
    processes = [
        world.process(network, worlds=(ros1,)),
        world.process(worlds=(ros1, ros2)),
        world.process(network, worlds=(ros2,)),
    ]
    world.run(1.0)
    for stamp in range(30):
        ros1.say(arm(stamp))
        ros2.say(ForeignTransform("map", "leg", stamp, 1.0))
        processes[stamp % 3].say(moving("map", "base", stamp))
        if stamp % 10 == 0:
            ros1.say(lidar(float(stamp)), static=True)
            world.run(1.0)
        world.run(world.random.choice((0.0, 0.001, 0.01)))
    world.run(10.0)
    expected = {(child, stamp) for child in ("arm", "leg", "base") for stamp in range(30)}
    for process in processes:
        assert moved(process) == Counter(expected)
        assert latched(process.bus)["lidar"].transform.translation == (20.0, 0.0, 0.0)
    # A static sample is said once more by a bus that has it from both sides.
    told = Counter((sample.child, sample.transform) for sample in processes[0].seen if sample.static)
    assert max(told.values()) <= 2
    for ros in (ros1, ros2):
        assert max(ros.transforms[False, child, 0] for child in ("arm", "leg", "base")) <= 2
