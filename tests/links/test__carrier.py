"""The protocol of carriers: that a carrier of another kind than zenoh's can be written, and what it may count."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from support.samples import moving, static
from support.wires import Domain, ForeignCarrier, ForeignMessage, ForeignTransform, ForeignWorld, WireCarrier, latched
from tfbus.links._carrier import Carrier, SendReport
from tfbus.links._endpoint import Endpoint
from tfbus.links.zenoh._carrier import ZenohCarrier

from tfbus import Bus, SimulatedClock, TransformStamped

Batch = tuple[TransformStamped, ...]
CARRIERS: list[type[Carrier]] = [ForeignCarrier, WireCarrier, ZenohCarrier]
"""That they fit the protocol, mypy says."""

ARM = ForeignTransform("map", "arm", 5, 1.0)


class Bridge:
    """A bus with a link to a foreign world and one to a domain of buses, driven without an event loop."""

    def __init__(self, max_frames: int = 10_000) -> None:
        self.bus = Bus(SimulatedClock())
        self.heard: list[Batch] = []
        self.bus.subscribe(self.heard.append)
        self.world = ForeignWorld()
        self.errors: list[Exception] = []
        self.report = SendReport(self.errors.append)
        carrier = ForeignCarrier(self.world)
        self.endpoint = Endpoint(self.bus, "foreign", carrier, lambda: None, max_frames=max_frames)
        carrier.connect(self.endpoint.handle, self.report)
        self.endpoint.attach()
        self.domain = Domain()
        self.end = self.domain.join(self.bus)

    def add_bus(self) -> tuple[Bus, list[Batch]]:
        """A bus in the domain, and all that it hears."""
        bus = Bus(SimulatedClock())
        heard: list[Batch] = []
        bus.subscribe(heard.append)
        self.domain.join(bus)
        return bus, heard

    def settle(self) -> None:
        """Send and deliver everything; something that went round would never end."""
        for _ in range(20):
            self.endpoint.send()
            for end in self.domain.ends:
                end.endpoint.send()
            wires = [wire for wire in self.domain.wires.values() if wire.packets]
            if not wires and not self.domain.pass_time():
                return
            for wire in wires:
                while wire.packets:
                    wire.deliver()
        raise AssertionError("something goes round")

    @property
    def sent(self) -> list[ForeignMessage]:
        """The messages of this bus in the foreign world."""
        return [message for node, message in self.world.published if node == "tfbus"]


@contextmanager
def bridge(max_frames: int = 10_000) -> Iterator[Bridge]:
    made = Bridge(max_frames)
    yield made
    made.endpoint.detach()
    for end in made.domain.ends:
        end.leave()


def test_samples_without_origin_and_number_reach_the_bus_and_other_links_and_are_not_sent_back() -> None:
    with bridge() as here:
        far, heard = here.add_bus()
        here.world.say(ARM, ForeignTransform("arm", "tool", 6, 2.0))
        here.world.say(ForeignTransform("map", "lidar", 0, 3.0), static=True)
        here.settle()
        expected = [
            (moving("map", "arm", 5, 1.0, "foreign"), moving("arm", "tool", 6, 2.0, "foreign")),
            (static("map", "lidar", 3.0, authority="foreign"),),
        ]
        assert here.heard == heard == expected
        assert here.sent == []
        late, _ = here.add_bus()
        here.settle()
        assert latched(late) == latched(far) == {"lidar": expected[1][0]}


def test_every_foreign_sample_is_news_also_an_older_one_but_the_same_again() -> None:
    with bridge() as here:
        _, heard = here.add_bus()
        for stamp in (5, 5, 4):
            here.world.say(ARM._replace(stamp=stamp))
            here.settle()
        assert [batch[0].stamp for batch in here.heard] == [batch[0].stamp for batch in heard] == [5, 4]
        assert (here.endpoint.inbox.samples, here.endpoint.inbox.duplicates, here.endpoint.inbox.lost) == (2, 1, 0)


def test_what_buses_publish_goes_out_to_the_foreign_world() -> None:
    with bridge() as here:
        far, _ = here.add_bus()
        here.bus.publish(moving("map", "base", 7, 1.0))
        far.publish([moving("map", "far", 8, 2.0), static("map", "camera", 3.0)])
        here.settle()
        here.bus.publish(static("map", "lidar", 4.0))
        here.settle()
        camera, lidar = ForeignTransform("map", "camera", 0, 3.0), ForeignTransform("map", "lidar", 0, 4.0)
        assert here.sent == [
            ForeignMessage(False, [ForeignTransform("map", "base", 7, 1.0)]),
            ForeignMessage(False, [ForeignTransform("map", "far", 8, 2.0)]),
            ForeignMessage(True, [camera]),
            ForeignMessage(True, [camera, lidar]),
        ]
        assert (here.report.messages, here.report.samples) == (4, 5)


def test_a_removal_shrinks_the_static_frames_and_is_counted_for_moving_ones() -> None:
    with bridge() as here:
        here.bus.publish([static("map", "lidar"), static("map", "camera"), moving("map", "base", 1)])
        here.settle()
        here.bus.remove_frame("lidar")
        here.bus.remove_frame("base")
        here.settle()
        assert here.sent[-1] == ForeignMessage(True, [ForeignTransform("map", "camera", 0, 0.0)])
        assert here.report.not_sent == {"removal": 1}
        assert ["base" in str(error) for error in here.errors] == [True]


def test_the_removal_of_a_foreign_frame_goes_to_other_buses_and_it_comes_back_with_the_next_sample() -> None:
    with bridge() as here:
        far, heard = here.add_bus()
        here.world.say(ARM)
        here.settle()
        far.remove_frame("arm")
        here.settle()
        assert here.bus.statistics().frames == 0
        here.world.say(ARM._replace(stamp=6))
        here.settle()
        assert (here.bus.statistics().frames, far.statistics().frames) == (1, 1)
        assert [batch[0].stamp for batch in heard] == [5, 6]


def test_refusals_of_foreign_messages_are_counted_and_the_rest_of_a_message_is_published() -> None:
    with bridge(max_frames=2) as here:
        here.world.say()
        here.world.say(ForeignTransform("/map", "bad", 1, 0.0), ARM)
        here.world.say(*[ForeignTransform("map", f"{number}", 1, 0.0) for number in range(5)])
        assert here.endpoint.peers.rejected == {"empty": 1, "frame name": 1, "too many frames": 4}
        assert [[sample.child for sample in batch] for batch in here.heard] == [["arm"], ["0"]]
        assert here.endpoint.peers.present == ()


def test_a_bus_between_two_foreign_worlds_passes_on_from_each_to_the_other() -> None:
    with bridge() as here:
        second = ForeignWorld()
        carrier = ForeignCarrier(second)
        endpoint = Endpoint(here.bus, "second", carrier, lambda: None)
        carrier.connect(endpoint.handle, here.report)
        endpoint.attach()
        for world, stamp in ((here.world, 1), (second, 2)):
            world.say(ARM._replace(stamp=stamp))
        for _ in range(3):
            endpoint.send()
            here.settle()
        assert second.published[1:] == [("tfbus", ForeignMessage(False, [ARM._replace(stamp=1)]))]
        assert here.sent == [ForeignMessage(False, [ARM._replace(stamp=2)])]
        endpoint.detach()


@pytest.mark.parametrize("times", [1, 3])
def test_a_report_counts_what_was_sent_and_warns_of_what_was_not(times: int) -> None:
    errors: list[Exception] = []
    report = SendReport(errors.append)
    refused, failed = ValueError("too long"), OSError("no buffer")
    for _ in range(times):
        report.sent(20)
        report.refused("stamp", refused, 7)
        report.refused("removal", refused)
        report.failed(failed)
    assert (report.messages, report.samples) == (times, 20 * times)
    assert report.not_sent == {"stamp": 7 * times, "removal": times}
    assert errors == [refused, refused, failed] * times
