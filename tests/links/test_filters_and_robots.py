"""Links that hear some frames, some robots, or some of them slowly."""

from typing import Any

import pytest
from support.domains import Network, Process, Stranger, World, write_text
from support.memory_wire import MemoryNetwork
from support.samples import moving, static

from tfbus import Bus, TransformStamped
from tfbus.links import DomainLink
from tfbus.links.channels import LONGEST_FILTER, MOST_FILTERS, filter_name
from tfbus.links.domain import MOST_ROBOTS
from tfbus.links.message import Heard, Kind, Outgoing, read_message, write_message
from tfbus.links.relay import relay_of
from tfbus.links.replica import CHUNK, ReceivedBatch
from tfbus.links.seams import Received


@pytest.fixture
def world() -> World:
    return World()


@pytest.fixture
def network(world: World) -> Network:
    return Network(world)


def counts(process: Process) -> dict[str, int]:
    """The number of samples of each frame that a bus has heard."""
    found: dict[str, int] = {}
    for sample in process.seen:
        found[sample.child] = found.get(sample.child, 0) + 1
    return found


def read_live(message: bytes) -> list[TransformStamped]:
    found: list[TransformStamped] = []
    for part in read_message(message):
        assert isinstance(part, Heard)
        for entry in part.entries:
            assert isinstance(entry, ReceivedBatch)
            found += entry.samples
    return found


# Frames


def test_a_link_for_some_frames_sends_and_takes_these_only_and_peers_send_it_no_others() -> None:
    world = World()
    network = Network(world)
    one = world.process(network)
    some = world.process(network, frames=["base", "camera", "own"])
    one.say(static("map", "camera"), static("map", "lidar"))
    world.run(3.0)
    network.carried.clear()
    before = some.end.messages
    for stamp in range(20):
        one.say(moving("map", "arm", stamp))
    assert all(kind is not Kind.LIVE for kind, _ in network.carried)
    for stamp in range(20):
        one.say(moving("map", "base", stamp), moving("map", "arm", stamp))
    some.say(static("map", "own"), static("map", "secret"))
    some.say(static("map", "secret"))
    one.remove("lidar")
    one.remove("camera")
    world.run(3.0)
    assert some.frames.keys() == {"base", "own", "secret"}
    assert counts(some)["base"] == 20
    assert one.frames.keys() == {"arm", "base", "own"}
    assert some.end.messages - before <= 25
    assert (some.end.lost, some.end.rejected) == (0, {})
    network.sent()
    world.run(20.0)
    assert network.sent(Kind.QUESTION) == 0


@pytest.mark.parametrize("how_many", [1, 3])
def test_a_filtered_link_that_met_others_while_nothing_came_through_has_its_frames_soon_after(how_many: int) -> None:
    world = World()
    network = Network(world)
    others = [world.process(network) for _ in range(how_many)]
    for number, process in enumerate(others):
        process.say(static("map", f"{number}"))
    network.loss = 1.0
    some = world.process(network, frames=[f"{number}" for number in range(how_many)])
    world.run(120.0)
    network.loss = 0.0
    world.run(10.0)
    assert len(some.frames) == how_many


def test_more_filters_than_are_served_and_names_that_are_too_long_still_bring_their_frames() -> None:
    world = World()
    network = Network(world)
    one = world.process(network)

    def hear(frame: str) -> Stranger:
        hearer = Stranger(network, channel=filter_name([frame]))
        world.run(0.01)
        for _ in range(2):
            hearer.send(one.wire.id, write_text(Kind.QUESTION, {"since": 0, "frames": [frame]}))
            world.run(0.1)
        return hearer

    many = [hear(f"f{number}") for number in range(MOST_FILTERS + 5)]
    long = world.process(
        network, frames=[f"{number}{'x' * 900}" for number in range(LONGEST_FILTER // 900 + 1)] + ["f0"]
    )
    another = world.process(network, frames=["f0", "f1"])
    world.run(1.0)
    for stamp in range(3):
        one.say(*(moving("map", f"f{number}", stamp) for number in range(len(many))))
    world.run(0.1)
    for number, hearer in enumerate(many):
        samples = [sample for heard in map(read_live, hearer.heard(Kind.LIVE)) for sample in heard]
        assert [sample.stamp for sample in samples if sample.child == f"f{number}"] == [0, 1, 2]
        assert len(samples) == (3 if number < MOST_FILTERS else 3 * len(many))
    assert counts(long) == {"f0": 3}
    assert counts(another) == {"f0": 3, "f1": 3}
    # Filters without hearers make room.
    for hearer in many:
        network.remove(hearer)
    world.run(60.0)
    # Signs show what was missed to those that had no room, too.
    network.loss = 1.0
    one.say(moving("map", "f1", 3))
    network.loss = 0.0
    world.run(60.0)
    assert another.frames["f1"].stamp == 3
    late = hear("late")
    one.say(moving("map", "late", 3), moving("map", "f0", 3))
    world.run(0.1)
    assert [sample.child for message in late.heard(Kind.LIVE) for sample in read_live(message)] == ["late"]


def test_who_meets_a_link_with_names_that_are_too_long_has_its_static_frames_soon(
    world: World, network: Network
) -> None:
    frames = [f"{number}{'x' * 150}" for number in range(CHUNK + 1)]
    world.process(network, robot="r1")
    some = world.process(network, robot="r2", frames=frames)
    some.say(*(static("map", frame) for frame in frames))
    world.run(5.0)
    late = world.process(network)
    world.run(10.0)
    assert late.frames.keys() == set(frames)


@pytest.mark.parametrize("letter", ["я", "框", "\udc80", '"'])
def test_the_names_of_a_filter_may_be_in_any_script(letter: str) -> None:
    world = World()
    network = Network(world)
    one = world.process(network)
    size = len((letter * 18).encode("utf-8", "surrogatepass")) + len("1234,")
    frames = [f"{number}{letter * 18}" for number in range(LONGEST_FILTER // size - 1)]
    some = world.process(network, frames=[*frames, "plain"])
    one.say(static("map", "plain"))
    world.run(1.0)
    one.say(static("map", frames[0]), moving("map", "plain", 1))
    world.run(1.0)
    assert counts(some)["plain"] == 2
    assert (frames[0] in some.frames) == (letter != "\udc80"), "no message can hold half of a letter"


def test_a_link_for_no_frame_at_all_hears_and_sends_nothing(world: World, network: Network) -> None:
    one, none = world.process(network), world.process(network, frames=[])
    one.say(static("map", "a"), moving("map", "b", 1))
    none.say(static("map", "c"))
    world.run(5.0)
    assert (set(one.frames), set(none.frames)) == ({"a", "b"}, {"c"})


# Robots


def test_only_the_robots_that_are_asked_for_are_peers_and_heard(world: World, network: Network) -> None:
    robots = {name: world.process(network, robot=name) for name in ("r1", "r17", "s1")}
    unnamed = world.process(network)
    some = world.process(network, robots={"r1": float("inf")})
    pattern = world.process(network, robots={"r*": float("inf")})
    for name, process in robots.items():
        process.say(static("map", name), moving("map", f"{name}/base", 1))
    unnamed.say(static("map", "unnamed"))
    world.run(5.0)
    assert some.frames.keys() == {"r1", "r1/base"}
    assert pattern.frames.keys() == {"r1", "r1/base", "r17", "r17/base"}
    assert len(unnamed.frames) == 7
    assert some.end.present == (robots["r1"].wire.id,)
    assert len(unnamed.end.present) == 5


def test_of_a_slow_robot_come_static_frames_at_once_and_the_newest_of_moving_ones_at_its_rate() -> None:
    world = World()
    network = Network(world)
    robot = world.process(network, robot="r1", slow_rate=5.0)
    fast, slow = world.process(network), world.process(network, robots={"r1": 2.0})
    at_most = world.process(network, robots={"r1": 100.0})
    world.run(5.0)
    for step in range(1_000):
        robot.say(moving("map", "base", step), moving("map", "arm", step))
        world.run(0.01)
        if step == 500:
            robot.say(static("map", "camera"))
            world.run(3.0)
            assert "camera" in slow.frames
    assert counts(fast)["base"] == 1_000
    assert 15 <= counts(slow)["base"] <= 23
    assert 45 <= counts(at_most)["base"] <= 60, "no more often than the robot's link sends"
    world.run(3.0)
    assert slow.frames["base"].stamp == slow.frames["arm"].stamp == 999
    robot.remove("base")
    world.run(5.0)
    assert "base" not in slow.frames
    assert slow.end.lost == 0


def test_a_message_of_newest_samples_is_taken_or_left_out_as_a_whole_however_long_its_parts_take() -> None:
    world = World()
    network = Network(world)
    board = world.process(network, robots={"*": 0.5})
    robot = Stranger(network, robot="r1")
    world.run(1.0)
    for second in range(5):
        entries = [robot.batch(moving("map", f"{n}", second), number=second + 1) for n in range(1_000)]
        message = write_message(Outgoing(Kind.LIVE, robot.bus), entries)
        for part in board.end.split(Received(robot.id, message)):
            if part is not None:
                board.end.handle(robot.id, part)
            # Other tasks have their turn.
            world.now += 0.03
        world.run(0.8)
    assert set(counts(board).values()) == {3}
    assert len(board.frames) == 1_000


def test_a_slow_hearer_is_sent_the_last_moving_sample_of_each_frame_that_is_still_there(
    world: World, network: Network
) -> None:
    robot, hearer = world.process(network, slow_rate=5.0), Stranger(network, channel="slow")
    world.run(1.0)
    robot.say(*(moving("map", frame, 1) for frame in "abcd"))
    robot.say(moving("map", "a", 2), static("map", "b"))
    robot.remove("c")
    world.run(1.0)
    assert [[(s.child, s.stamp) for s in read_live(message)] for message in hearer.heard(Kind.LIVE)] == [
        [("d", 1), ("a", 2)]
    ]
    # A later hearer gets no samples that waited for one that has gone.
    robot.say(moving("map", "a", 3))
    network.remove(hearer)
    robot.say(moving("map", "a", 4))
    late = Stranger(network, channel="slow")
    world.run(1.0)
    assert late.heard(Kind.LIVE) == []


@pytest.mark.parametrize(("rate", "turns"), [(float("inf"), 3), (2.0, 13)])
def test_a_link_at_rest_sends_no_samples_and_has_few_turns(
    world: World, network: Network, rate: float, turns: int
) -> None:
    robot = world.process(network, robot="r1", slow_rate=5.0)
    world.process(network, robots={"r1": rate})
    world.run(1.0)
    robot.say(moving("map", "base", 1))
    world.run(30.0)
    network.sent()
    due = set()
    for _ in range(200):
        world.run(0.01)
        due.add(robot.due)
    assert len(due) <= turns
    assert network.sent(Kind.LIVE) == 0


def test_of_a_robot_of_rate_0_nothing_comes_but_it_is_a_peer(world: World, network: Network) -> None:
    robot = world.process(network, robot="r1")
    quiet = world.process(network, robots={"r1": 0.0}, history=5.0)
    robot.say(static("map", "a"))
    for stamp in range(10):
        robot.say(moving("map", "b", stamp))
        world.run(1.0)
    assert quiet.frames == {}
    assert quiet.end.present == (robot.wire.id,)
    assert not quiet.end.rejected


def test_a_frame_name_of_two_robots_has_the_newest_of_both_and_costs_a_link_that_hears_both_few_questions(
    world: World, network: Network
) -> None:
    one, other = (world.process(network, robot=name, robots=[name]) for name in "ab")
    both = world.process(network)
    one.say(static("map", "base"))
    world.run(1.0)
    other.say(static("odom", "base"))
    world.run(20.0)
    assert [process.frames["base"].parent for process in (one, other, both)] == ["map", "odom", "odom"]
    assert network.sent(Kind.QUESTION) <= 6
    for number in range(60):
        one.say(static("map", f"camera {number}"))
        world.run(10.0)
    assert network.sent(Kind.QUESTION) <= 1
    one.say(static("world", "base"))
    world.run(20.0)
    assert [process.frames["base"].parent for process in (one, other, both)] == ["world", "odom", "world"]
    assert network.sent(Kind.QUESTION) <= 2


@pytest.mark.parametrize("drop_lost", [False, True])
def test_of_robots_that_have_gone_so_many_are_remembered_and_the_oldest_make_room(
    world: World, network: Network, drop_lost: bool
) -> None:
    stays = world.process(network, drop_lost=drop_lost)
    for number in range(MOST_ROBOTS + 5):
        robot = world.process(network, robot=f"r{number}")
        robot.say(static("map", f"{number}"))
        world.run(0.5)
        world.end(robot)
        world.run(0.1)
    assert len(stays.frames) == (0 if drop_lost else MOST_ROBOTS + 5)
    assert set(stays.end.views) == {"", *(f"r{number}" for number in range(5, MOST_ROBOTS + 5))}
    oldest = 5 if drop_lost else 0
    assert set(relay_of(stays.bus).replica.entries) == {f"{number}" for number in range(oldest, MOST_ROBOTS + 5)}


def test_what_a_link_publishes_goes_to_each_hearer_in_its_own_way(world: World, network: Network) -> None:
    robot = world.process(network, robot="r1")
    hearers = [
        world.process(network),
        world.process(network, frames=["a"]),
        world.process(network, robots={"r1": 1.0}),
        world.process(network, robots={"r1": 1.0, "*": float("inf")}, frames=["a"]),
        world.process(network, robots={"*": 0.0}),
    ]
    world.run(3.0)
    robot.say(static("map", "a"), static("map", "b"))
    world.run(5.0)
    assert [sorted(process.frames) for process in hearers] == [["a", "b"], ["a"], ["a", "b"], ["a"], []]
    robot.remove("a")
    world.run(5.0)
    assert [sorted(process.frames) for process in hearers] == [["b"], [], ["b"], [], []]


@pytest.mark.parametrize(
    ("error", "options"),
    [
        (TypeError, {"frames": "base"}),
        (TypeError, {"robots": "r1"}),
        (ValueError, {"robots": ["r 1"]}),
        (ValueError, {"robots": [""]}),
        (ValueError, {"robots": {"r1": -1.0}}),
        (ValueError, {"robots": {"r1": float("nan")}}),
        (ValueError, {"robot": "r/1"}),
        (ValueError, {"robot": ""}),
        (ValueError, {"robot": "x" * 201}),
        (ValueError, {"slow_rate": 0.0}),
        (ValueError, {"slow_rate": float("inf")}),
        (ValueError, {"slow_rate": float("nan")}),
        (ValueError, {"max_frames": 0}),
        (ValueError, {"capacity": 0}),
        (TypeError, {"tell_clock": True}),
        (ValueError, {"domain": "a b"}),
        (ValueError, {"domain": ""}),
        (ValueError, {"domain": "/a"}),
    ],
)
def test_arguments_that_make_no_sense_are_refused(error: type[Exception], options: dict[str, Any]) -> None:
    with pytest.raises(error, match=r"."):
        DomainLink(Bus(), **{"domain": "tf", "wire": MemoryNetwork().wire(), **options})
