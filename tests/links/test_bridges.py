"""Buses between worlds without origins, such as ROS, and domains of buses: no echo, and nothing goes round."""

from collections import Counter

import pytest
from support.domains import Network, Process, SlowWorld, World
from support.foreign_world import ForeignMessage, ForeignTransform, ForeignWorld
from support.samples import moving, static

from tfbus.links.seams import SendReport

ARM = ForeignTransform("map", "arm", 5, 1.0)


def bridge(**options: bool) -> tuple[World, ForeignWorld, Process, Process]:
    """A bus with a link to a foreign world and one to a domain, and another bus there."""
    world, place = World(), ForeignWorld()
    network = Network(world)
    here = world.process(network, worlds=[place], **options)
    far = world.process(network)
    world.run(5.0)
    return world, place, here, far


def sent(place: ForeignWorld) -> list[ForeignMessage]:
    """The messages of buses in a foreign world."""
    return [message for node, message in place.published if node != "driver"]


def test_samples_without_origin_and_number_reach_the_bus_and_other_links_and_are_not_sent_back() -> None:
    world, place, here, far = bridge()
    place.say(ARM, ForeignTransform("arm", "tool", 6, 2.0))
    place.say(ForeignTransform("map", "lidar", 0, 3.0), static=True)
    world.run(1.0)
    expected = [
        (moving("map", "arm", 5, 1.0, "foreign"), moving("arm", "tool", 6, 2.0, "foreign")),
        (static("map", "lidar", 3.0, authority="foreign"),),
    ]
    for process in (here, far):
        assert process.batches == expected
        assert {sample.authority for sample in process.seen} == {"foreign"}
    assert sent(place) == []
    late = world.process(far.wire.network)
    world.run(3.0)
    assert late.frames == far.frames


def test_every_foreign_sample_is_news_also_an_older_one_but_the_same_again() -> None:
    world, place, here, far = bridge()
    for stamp in (5, 5, 4):
        place.say(ARM._replace(stamp=stamp))
        world.run(0.1)
    assert [sample.stamp for sample in here.seen] == [sample.stamp for sample in far.seen] == [5, 4]
    end = here.foreign_ends[0]
    assert (end.samples, end.duplicates, end.lost) == (2, 1, 0)


def test_what_buses_publish_goes_out_to_the_foreign_world_and_removals_as_far_as_it_knows_them() -> None:
    world, place, here, far = bridge()
    here.say(moving("map", "base", 7, 1.0))
    far.say(moving("map", "far", 8, 2.0), static("map", "camera", 3.0))
    world.run(1.0)
    here.say(static("map", "lidar", 4.0))
    camera, lidar = ForeignTransform("map", "camera", 0, 3.0), ForeignTransform("map", "lidar", 0, 4.0)
    assert sent(place) == [
        ForeignMessage(False, [ForeignTransform("map", "base", 7, 1.0)]),
        ForeignMessage(False, [ForeignTransform("map", "far", 8, 2.0)]),
        ForeignMessage(True, [camera]),
        ForeignMessage(True, [camera, lidar]),
    ]
    report = here.foreign_ends[0].report
    assert (report.messages, report.samples) == (4, 5)
    far.remove("camera")
    here.remove("base")
    world.run(1.0)
    assert sent(place)[-1] == ForeignMessage(True, [lidar])
    assert report.not_sent == {"removal": 1}
    here.say(moving("map", "lidar", 1))
    assert sent(place)[-1] == ForeignMessage(True, []), "a frame that moves now is not kept"


def test_the_removal_of_a_foreign_frame_goes_to_other_buses_and_it_comes_back_with_the_next_sample() -> None:
    world, place, here, far = bridge()
    place.say(ARM)
    world.run(1.0)
    far.remove("arm")
    world.run(1.0)
    assert (here.frames, far.frames) == ({}, {})
    place.say(ARM._replace(stamp=6))
    world.run(1.0)
    assert here.frames.keys() == far.frames.keys() == {"arm"}


def test_refusals_of_foreign_messages_are_counted_and_the_rest_of_a_message_is_published() -> None:
    world, place, here, _ = bridge()
    place.say()
    place.say(ForeignTransform("/map", "bad", 1, 0.0), ARM)
    world.run(0.1)
    assert here.foreign_ends[0].peers.rejected == {"empty": 1, "frame name": 1}
    assert here.frames.keys() == {"arm"}
    assert here.foreign_ends[0].peers.present == ()


def test_a_bridge_that_ends_says_nothing_more_and_its_frames_stay_or_go() -> None:
    for drop_lost, stays in ((False, {"arm"}), (True, set())):
        world, place = World(), ForeignWorld()
        network = Network(world)
        here = world.process(network, worlds=[place])
        far = world.process(network, drop_lost=drop_lost)
        world.run(1.0)
        place.say(ARM)
        world.run(1.0)
        world.end(here)
        place.say(ARM._replace(stamp=6))
        far.say(moving("map", "far", 1))
        world.run(1.0)
        assert far.frames.keys() == stays | {"far"}
        assert sent(place) == []


# Rings; whatever goes round would never end


SEEDS = range(5)


def arm(stamp: int) -> ForeignTransform:
    return ForeignTransform("map", "arm", stamp, float(stamp))


def lidar(x: float) -> ForeignTransform:
    return ForeignTransform("arm", "lidar", 0, x)


def transforms(*places: ForeignWorld) -> Counter[tuple[bool, str, int]]:
    """The number of times that each transform was published."""
    published = [message for place in places for _, message in place.published]
    return Counter((message.static, each.child, each.stamp) for message in published for each in message.transforms)


@pytest.mark.parametrize("seed", SEEDS)
def test_two_links_of_one_bus_in_one_world_give_each_sample_once(seed: int) -> None:
    world = World(seed)
    place = SlowWorld(world)
    process = world.process(worlds=[place, place])
    for stamp in range(100):
        place.say(arm(stamp))
        process.say(moving("map", "base", stamp))
        if stamp == 50:
            place.say(lidar(3.0), static=True)
    world.run(5.0)
    assert len(process.seen) == 201
    assert Counter((sample.child, sample.stamp) for sample in process.seen).most_common(1)[0][1] == 1


@pytest.mark.parametrize("seed", SEEDS)
def test_two_buses_between_two_worlds_pass_each_sample_on_once_each(seed: int) -> None:
    world = World(seed)
    near, far = SlowWorld(world), SlowWorld(world)
    processes = [world.process(worlds=[near, far]) for _ in range(2)]
    for stamp in range(100):
        near.say(arm(stamp))
    world.run(5.0)
    assert sum(transforms(near, far).values()) == 300
    assert [len(process.seen) for process in processes] == [100, 100]


@pytest.mark.parametrize("seed", SEEDS)
def test_a_ring_of_three_buses_with_two_worlds_and_a_domain_hears_each_sample_once(seed: int) -> None:
    """ROS 1 joins the first two buses, ROS 2 the second two, and a domain of buses the last to the first."""
    world = World(seed)
    ros1, ros2, network = SlowWorld(world), SlowWorld(world), Network(world)
    processes = [
        world.process(network, worlds=[ros1]),
        world.process(worlds=[ros1, ros2]),
        world.process(network, worlds=[ros2]),
    ]
    world.run(5.0)
    for stamp in range(30):
        ros1.say(arm(stamp))
        ros2.say(ForeignTransform("map", "leg", stamp, 1.0))
        processes[stamp % 3].say(moving("map", "base", stamp))
        if stamp % 10 == 0:
            ros1.say(lidar(float(stamp)), static=True)
            world.run(1.0)
    world.run(10.0)
    expected = Counter((child, stamp) for child in ("arm", "leg", "base") for stamp in range(30))
    for process in processes:
        assert Counter((sample.child, sample.stamp) for sample in process.seen if not sample.static) == expected
        assert process.frames["lidar"].transform.translation == (20.0, 0.0, 0.0)
    # A static sample is said once more by a bus that has it from both sides.
    said = Counter((sample.child, sample.transform) for sample in processes[0].seen if sample.static)
    assert max(said.values()) <= 2
    for place in (ros1, ros2):
        assert max(transforms(place)[False, child, 0] for child in ("arm", "leg", "base")) <= 2


@pytest.mark.parametrize("times", [1, 3])
def test_a_report_counts_what_was_sent_and_warns_of_what_was_not(times: int) -> None:
    errors: list[Exception] = []
    report = SendReport(errors.append)
    refused, failed = ValueError("too long"), OSError("no buffer")
    for _ in range(times):
        report.sent(20)
        report.refused("stamp", refused, 7)
        report.failed(failed)
    assert (report.messages, report.samples, report.not_sent) == (times, 20 * times, {"stamp": 7 * times})
    assert errors == [refused, failed] * times
