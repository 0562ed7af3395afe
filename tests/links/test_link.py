import threading
from collections.abc import Callable, Iterable, Iterator
from itertools import count, pairwise
from typing import Any

import anyio
import anyio.lowlevel
import anyio.to_thread
import pytest
from support.foreign_world import ForeignCarrier, ForeignMessage, ForeignTransform, ForeignWorld
from support.processes import until
from support.samples import moving, static

from tfbus import Bus, PeerJoined, PeerLost, PeerRejected, SimulatedClock
from tfbus._aio.turn_budget import TurnBudget
from tfbus.links import Link
from tfbus.links.ros.foreign_end import ForeignEnd, ReceivedMessage, Turn
from tfbus.links.seams import Joined, Left, Received, SendReport
from tfbus.tf_message import MalformedMessageError

pytestmark = pytest.mark.anyio

ARM = ForeignTransform("map", "arm", 5, 1.0)


class MineError(Exception):
    pass


class LoggedCarrier(ForeignCarrier):
    """Notes the calls of its link, and fails where a test wants it to."""

    def __init__(self, world: ForeignWorld | None = None, fails: str = "") -> None:
        super().__init__(world or ForeignWorld())
        self.calls: list[str] = []
        self.receive: Callable[[Received], object] = print
        self.fails = fails
        self.while_opening: Callable[[], object] = lambda: None

    def _note(self, call: str) -> None:
        self.calls.append(call)
        if call == self.fails:
            raise MineError(call)

    async def open(self, receive: Callable[[Received], object], report: SendReport) -> None:
        self.receive = receive
        self._note("open")
        await super().open(receive, report)
        self.while_opening()
        await anyio.lowlevel.checkpoint()

    def send(self, turn: Turn) -> None:
        self._note(f"send {sum(len(entry.samples) for entry in turn.entries if hasattr(entry, 'samples'))}")
        super().send(turn)

    def read(self, content: ForeignMessage) -> ReceivedMessage:
        if content.transforms and content.transforms[0].child == self.fails:
            raise MineError(self.fails)
        return super().read(content)

    async def run(self) -> None:
        self._note("run")
        await anyio.sleep_forever()

    async def close(self) -> None:
        self.calls.append("close")
        await super().close()


def link_of(
    bus: Bus,
    carrier: ForeignCarrier,
    frames: Iterable[str] | None = None,
    drop_lost: bool = False,
    max_frames: int = 10_000,
    **options: Any,
) -> Link:
    """A link to a foreign world."""
    return Link(ForeignEnd(bus, "world", carrier, frames, drop_lost, max_frames), **options)


def slow_budget(step: float) -> TurnBudget:
    """A budget by a clock for which so many s pass from one look to the next."""
    looks = count()

    def clock() -> float:
        return next(looks) * step

    return TurnBudget(now=clock, busy=clock)


async def receive_samples(link: Link, samples: int) -> None:
    """Wait until a link has published so many samples on its bus."""
    await until(lambda: link.statistics().received_samples >= samples)


async def test_a_link_between_a_bus_and_a_foreign_world_works_both_ways() -> None:
    world = ForeignWorld()
    world.say(ForeignTransform("map", "lidar", 0, 2.0), static=True)
    with Bus() as bus:
        bus.publish(static("map", "camera"))
        heard: list[Any] = []
        bus.subscribe(heard.append)
        async with link_of(bus, ForeignCarrier(world)) as link:
            world.say(ARM)
            await receive_samples(link, 2)
            bus.publish(moving("map", "base", 7, 3.0))
            await until(lambda: link.statistics().sent_messages == 2)
        assert heard[1:] == [
            (static("map", "lidar", 2.0, authority="foreign"),),
            (moving("map", "arm", 5, 1.0, "foreign"),),
            (moving("map", "base", 7, 3.0),),
        ]
        world.say(ARM._replace(stamp=9))
        bus.publish(moving("map", "base", 8))
        await anyio.lowlevel.checkpoint()
    assert [message for node, message in world.published if node == "tfbus"] == [
        ForeignMessage(True, [ForeignTransform("map", "camera", 0, 0.0)]),
        ForeignMessage(False, [ForeignTransform("map", "base", 7, 3.0)]),
    ]
    assert len(heard) == 5, "what comes behind the end stays outside"
    assert link.id == "tfbus"


async def test_arguments_that_make_no_sense_are_refused() -> None:
    with pytest.raises(TypeError, match="'base'"):
        link_of(Bus(), LoggedCarrier(), frames="base")
    with pytest.raises(ValueError, match="capacity"):
        link_of(Bus(), LoggedCarrier(), capacity=0)
    with pytest.raises(ValueError, match="max_frames"):
        link_of(Bus(), LoggedCarrier(), max_frames=0)


async def test_what_comes_while_the_carrier_opens_is_published_when_the_link_has_joined() -> None:
    carrier = LoggedCarrier()
    message = Received("driver", ForeignMessage(False, [ARM]))
    carrier.while_opening = lambda: carrier.receive(message)
    with Bus() as bus:
        async with link_of(bus, carrier) as link:
            await receive_samples(link, 1)
            assert bus.statistics().frames == 1


@pytest.mark.every_loop
async def test_what_was_published_last_goes_out_while_the_carrier_still_runs() -> None:
    class EndingCarrier(LoggedCarrier):
        async def run(self) -> None:
            try:
                await super().run()
            finally:
                self.calls.append("end")

    carrier = EndingCarrier()
    with Bus() as bus:
        async with link_of(bus, carrier):
            await until(lambda: "run" in carrier.calls)
            bus.publish(moving("map", "a", 1))
    assert carrier.calls == ["open", "run", "send 1", "end", "close"]


async def test_threads_may_bring_messages_in_any_number_and_the_loop_has_time_for_others() -> None:
    carrier = LoggedCarrier()
    with Bus() as bus:
        async with link_of(bus, carrier, budget=slow_budget(0.0001)) as link:

            def bring() -> None:
                for stamp in range(2_000):
                    message = ForeignMessage(False, [ARM._replace(stamp=stamp)])
                    carrier.receive(Received("driver", message, moving=True))

            thread = threading.Thread(target=bring)
            thread.start()
            thread.join()
            seen = set()
            while link.statistics().received_samples < 2_000:
                seen.add(link.statistics().received_samples)
                await anyio.lowlevel.checkpoint()
            # At most 10 items of 0.1 ms in a turn of 1 ms, and this task has been run in between.
            assert len(seen) >= 90
            assert link.statistics().received_messages == 2_000


class SplittingForeignCarrier(LoggedCarrier):
    """Splits each message in its transforms."""

    def split(self, content: Any) -> Iterator[Any]:
        for number, each in enumerate(content.transforms):
            if each.child == self.fails:
                raise MalformedMessageError("cut", "it ends here")
            self.later = number > 0
            yield content._replace(transforms=[each])

    def read(self, content: ForeignMessage) -> ReceivedMessage:
        message = super().read(content)
        message.continues = self.later
        return message


async def test_a_message_that_its_carrier_splits_takes_several_turns_and_is_counted_once() -> None:
    carrier = SplittingForeignCarrier(fails="broken")
    with Bus() as bus:
        async with link_of(bus, carrier, budget=slow_budget(0.001)) as link:
            many = [ARM._replace(child=f"arm{number}", stamp=1) for number in range(50)]
            carrier.receive(Received("driver", ForeignMessage(False, [*many, ARM._replace(child="broken"), ARM])))
            carrier.receive(Received("driver", ForeignMessage(False, [ARM._replace(stamp=2)])))
            seen = []
            while link.statistics().received_samples < 51:
                seen.append(link.statistics().received_samples)
                await anyio.lowlevel.checkpoint()
            assert max(after - before for before, after in pairwise(seen)) <= 4
            assert link.statistics().received_messages == 2
            assert link.statistics().rejected == {"cut": 1}


async def test_the_rest_of_a_split_message_is_dropped_when_the_clock_jumps_back() -> None:
    clock, carrier = SimulatedClock(start=10), SplittingForeignCarrier()
    with Bus(clock) as bus:
        async with link_of(bus, carrier, budget=slow_budget(0.001)) as link:
            many = [ARM._replace(child=f"arm{number}") for number in range(50)]
            carrier.receive(Received("driver", ForeignMessage(False, many), moving=True))
            while link.statistics().received_samples < 5:
                await anyio.lowlevel.checkpoint()
            clock.set(5)
            carrier.receive(Received("driver", ForeignMessage(False, [ARM._replace(child="last")])))
            await until(lambda: link.statistics().received_messages == 2)
            assert link.statistics().received_samples < 50


async def test_a_sample_that_comes_once_more_is_news_again_when_the_clock_has_jumped_back() -> None:
    clock, carrier = SimulatedClock(start=10), LoggedCarrier()
    with Bus(clock) as bus:
        async with link_of(bus, carrier) as link:
            counts = []
            for now in (10, 20, 20, 5):
                clock.set(now)
                carrier.receive(Received("driver", ForeignMessage(False, [ARM]), moving=True))
                await until(lambda: link.statistics().queue.pending == 0)
                counts.append((link.statistics().received_samples, link.statistics().duplicates))
    assert counts == [(1, 0), (1, 1), (1, 2), (2, 2)]


async def test_presence_and_refusals_are_announced_under_the_name_of_the_link() -> None:
    carrier = LoggedCarrier(fails="broken")
    with Bus() as bus, bus.events(stale_after=None) as events:
        async with link_of(bus, carrier, drop_lost=True) as link:
            message = ForeignMessage(False, [ARM])
            broken = ForeignMessage(False, [ARM._replace(child="broken")])
            for content in (Joined(), message, broken, Joined()):
                carrier.receive(Received("driver", content))
            await until(lambda: link.statistics().rejected == {"not published": 1})
            await until(lambda: link.statistics().queue.pending == 0)
            assert link.peers == ("driver",)
            for again in (Left(), Left(), Joined()):
                carrier.receive(Received("driver", again))
            await until(lambda: link.statistics().queue.pending == 0)
            assert bus.statistics().frames == 0
        bus.close()
        told = [event async for event in events if isinstance(event, PeerJoined | PeerLost | PeerRejected)]
    assert [type(event) for event in told] == [PeerJoined, PeerRejected, PeerLost, PeerJoined]
    assert {(event.link, event.peer) for event in told} == {("world", "driver")}
    rejected, lost = told[1], told[2]
    assert isinstance(rejected, PeerRejected)
    assert (rejected.reason, str(rejected.error)) == ("not published", "broken")
    assert isinstance(lost, PeerLost)
    assert (lost.authorities, lost.frames) == (("foreign",), ("arm",))


async def test_only_wanted_frames_go_out_and_come_in() -> None:
    world = ForeignWorld()
    with Bus() as bus:
        async with link_of(bus, ForeignCarrier(world), frames=iter(["arm", "base"])) as link:
            world.say(ARM, ForeignTransform("map", "tool", 1, 0.0))
            await receive_samples(link, 1)
            bus.publish([moving("map", "base", 1), moving("map", "lidar", 1)])
            await until(lambda: link.statistics().sent_samples == 1)
        assert bus.statistics().samples == 3
    assert world.published[-1] == ("tfbus", ForeignMessage(False, [ForeignTransform("map", "base", 1, 0.0)]))


async def test_a_link_drives_a_clock_that_follows_and_tells_the_time_of_its_own() -> None:
    clock = SimulatedClock()
    followers: list[int] = []
    with Bus(clock) as bus, pytest.raises(TypeError, match="needs a SimulatedClock"):
        link_of(Bus(), LoggedCarrier(), tell_clock=True)
    clock.on_move(followers.append)
    carrier = LoggedCarrier()
    told: list[int | None] = []
    carrier.send = lambda turn: told.append(turn.time)  # type: ignore[method-assign]
    carrier.read = lambda content: ReceivedMessage([], time=content)  # type: ignore[method-assign, arg-type]
    with Bus(clock) as bus:
        async with link_of(bus, carrier, clock=clock, tell_clock=True):
            carrier.receive(Received("robot", Joined()))
            carrier.receive(Received("robot", 1_000))
            await until(lambda: clock.now() == 1_000)
            carrier.receive(Received("robot", 1_500))
            await until(lambda: clock.now() == 1_500)
            await until(lambda: told[-1] == 1_500)
    assert followers == [1_000, 1_500]
    await clock.advance(1.0)
    clock.set(1)
    await anyio.wait_all_tasks_blocked()
    assert told[-1] == max(filter(None, told)) == 1_500, "behind the end nothing is told"
