"""Worlds without origins, such as ROS, that are joined in rings: every sample goes round once and no more."""

import random
from collections import Counter
from collections.abc import Callable, Iterable

import pytest
from support.samples import moving
from support.wires import Domain, ForeignCarrier, ForeignMessage, ForeignTransform, ForeignWorld, latched

from tfbus import Bus, SimulatedClock, TransformStamped
from tfbus.links._carrier import SendReport
from tfbus.links._endpoint import Endpoint
from tfbus.links._receive_queue import Received

SEEDS = range(5)


class SlowWorld(ForeignWorld):
    """A world whose messages are on their way until a test delivers them, to each node in order."""

    def __init__(self) -> None:
        super().__init__()
        self.on_their_way: dict[str, list[tuple[str, ForeignMessage]]] = {}

    def publish(self, node: str, message: ForeignMessage) -> None:
        self.published.append((node, message))
        for other in self._nodes:
            if other != node:
                self.on_their_way.setdefault(other, []).append((node, message))

    def deliver(self, node: str) -> None:
        sender, message = self.on_their_way[node].pop(0)
        self._nodes[node](sender, message)

    @property
    def transforms(self) -> Counter[tuple[bool, str, int]]:
        """The number of times that each transform was published."""
        return Counter(
            (message.static, each.child, each.stamp) for _, message in self.published for each in message.transforms
        )


class Net:
    """Buses in worlds and domains; what happens next is random."""

    def __init__(self, seed: int, buses: int) -> None:
        self.random = random.Random(seed)
        self.buses = [Bus(SimulatedClock()) for _ in range(buses)]
        self.heard: list[list[TransformStamped]] = [[] for _ in self.buses]
        for bus, heard in zip(self.buses, self.heard, strict=True):
            bus.subscribe(heard.extend)
        self.worlds: list[SlowWorld] = []
        self.domains: list[Domain] = []
        self.endpoints: list[Endpoint] = []

    def world(self, members: Iterable[int]) -> SlowWorld:
        world = SlowWorld()
        self.worlds.append(world)
        for number, member in enumerate(members):
            carrier = ForeignCarrier(world, f"node {number}")
            endpoint = Endpoint(self.buses[member], "world", carrier, lambda: None)
            carrier.connect(_unnamed(endpoint), SendReport(lambda _: None))
            endpoint.attach()
            self.endpoints.append(endpoint)
        return world

    def domain(self, members: Iterable[int]) -> None:
        domain = Domain()
        self.domains.append(domain)
        for member in members:
            self.endpoints.append(domain.join(self.buses[member]).endpoint)

    def settle(self) -> None:
        """Deliver everything in a random order, and end turns of the buses in between."""
        for _ in range(20_000):
            ways = [(world, node) for world in self.worlds for node, sent in world.on_their_way.items() if sent]
            wires = [wire for domain in self.domains for wire in domain.wires.values() if wire.packets]
            full = [endpoint for endpoint in self.endpoints if endpoint.outbox.pending]
            if not ways and not wires and not full:
                for endpoint in self.endpoints:
                    endpoint.send()
                asked = [domain.pass_time() for domain in self.domains]
                if not any(asked) and not any(any(world.on_their_way.values()) for world in self.worlds):
                    return
                continue
            choice = self.random.randrange(len(ways) + len(wires) + len(full))
            if choice < len(ways):
                world, node = ways[choice]
                world.deliver(node)
            elif choice < len(ways) + len(wires):
                wires[choice - len(ways)].deliver()
            else:
                full[choice - len(ways) - len(wires)].send()
        raise AssertionError("something goes round for ever")


def _unnamed(endpoint: Endpoint) -> Callable[[Received], object]:
    """Hand items to an endpoint without their sender, which ROS does not tell."""
    return lambda item: endpoint.handle(Received("", item.content, item.size, item.moving))


def arm(stamp: int) -> ForeignTransform:
    return ForeignTransform("map", "arm", stamp, float(stamp))


def lidar(x: float) -> ForeignTransform:
    return ForeignTransform("arm", "lidar", 0, x)


@pytest.mark.parametrize("seed", SEEDS)
def test_two_links_of_one_bus_in_one_world_give_each_sample_once(seed: int) -> None:
    net = Net(seed, 1)
    world = net.world([0, 0])
    for stamp in range(100):
        world.say(arm(stamp))
        net.buses[0].publish(moving("map", "base", stamp))
        if stamp == 50:
            world.say(lidar(3.0), static=True)
    net.settle()
    assert len(net.heard[0]) == 201
    assert Counter((sample.child, sample.stamp) for sample in net.heard[0]).most_common(1)[0][1] == 1


@pytest.mark.parametrize("seed", SEEDS)
def test_two_buses_between_two_worlds_pass_each_sample_on_once_each(seed: int) -> None:
    net = Net(seed, 2)
    near, far = net.world([0, 1]), net.world([0, 1])
    for stamp in range(100):
        near.say(arm(stamp))
    net.settle()
    assert sum((near.transforms + far.transforms).values()) == 300
    assert [len(heard) for heard in net.heard] == [100, 100]


@pytest.mark.parametrize("seed", SEEDS)
def test_a_ring_of_three_buses_with_two_worlds_and_a_domain_hears_each_sample_once(seed: int) -> None:
    """ROS 1 joins the first two buses, ROS 2 the second two, and a domain of buses the last to the first."""
    net = Net(seed, 3)
    ros1, ros2 = net.world([0, 1]), net.world([1, 2])
    net.domain([2, 0])
    for stamp in range(30):
        ros1.say(arm(stamp))
        ros2.say(ForeignTransform("map", "leg", stamp, 1.0))
        net.buses[stamp % 3].publish(moving("map", "base", stamp))
        if stamp % 10 == 0:
            ros1.say(lidar(float(stamp)), static=True)
            net.settle()
    net.settle()
    expected = {(child, stamp) for child in ("arm", "leg", "base") for stamp in range(30)}
    for bus, heard in zip(net.buses, net.heard, strict=True):
        moved = Counter((sample.child, sample.stamp) for sample in heard if not sample.static)
        assert moved == Counter(expected)
        assert latched(bus)["lidar"].transform.translation == (20.0, 0.0, 0.0)
    # A static sample is said once more by a bus that has it from both sides.
    assert max(Counter((sample.child, sample.transform) for sample in net.heard[0] if sample.static).values()) <= 2
    for world in (ros1, ros2):
        assert max(world.transforms[False, child, 0] for child in ("arm", "leg", "base")) <= 2
