"""`DomainLink` on an event loop, over a network in memory."""

import asyncio
import gc
import os
import weakref
from collections.abc import Callable, Sequence
from itertools import count
from typing import Any

import anyio
import anyio.lowlevel
import anyio.to_thread
import pytest
from support.asking import settle
from support.memory_wire import MemoryNetwork, MemoryWire
from support.processes import until
from support.samples import moving, static

from tfbus import Buffer, Bus, BusClosedError, SimulatedClock, TransformStamped
from tfbus.links import BufferServer, DomainLink
from tfbus.links.message import MAX_SAMPLES, Heard, Kind, Outgoing, kind_of, read_message, write_message
from tfbus.links.replica import OutgoingBatch
from tfbus.links.seams import Hearing, Receive

pytestmark = pytest.mark.anyio
EVERYTHING = [Hearing("*", "all")]


class MineError(Exception):
    pass


class LoggedWire(MemoryWire):
    """Notes the calls of its link, and fails where a test wants it to."""

    def __init__(self, network: MemoryNetwork, fails: str = "") -> None:
        super().__init__(network, "")
        self.calls: list[str] = []
        self.fails = fails
        self.while_opening: Callable[[], object] = lambda: None

    async def open(self, hears: Sequence[Hearing], receive: Receive, warn: Callable[[Exception], object]) -> None:
        self.warn = warn
        self._note("open")
        await super().open(hears, receive, warn)
        self.while_opening()
        await anyio.lowlevel.checkpoint()

    async def run(self) -> None:
        self._note("run")
        await super().run()

    async def close(self) -> None:
        self.calls.append("close")
        await super().close()

    def _note(self, call: str) -> None:
        self.calls.append(call)
        if call == self.fails:
            raise MineError(call)


def live_messages(network: MemoryNetwork) -> list[bytes]:
    """The live messages that are carried from now on."""
    found: list[bytes] = []

    def note(sender: str, link: str, message: bytes) -> bool:
        del sender, link
        if kind_of(message) is Kind.LIVE:
            found.append(message)
        return False

    network.lose = note
    return found


async def raw(network: MemoryNetwork) -> tuple[MemoryWire, list[Any]]:
    """A wire that a test uses itself, and all that comes to it."""
    wire, items = network.wire(), list[Any]()
    await wire.open(EVERYTHING, lambda _, item: items.append(item), print)
    return wire, items


async def test_what_is_said_in_one_turn_goes_out_in_one_message_and_is_heard_batch_by_batch() -> None:
    network = MemoryNetwork()
    with Bus() as here, Bus() as there:
        here.publish(static("map", "camera", authority="driver"))
        heard: list[Any] = []
        there.subscribe(heard.append)
        async with DomainLink(there, "tf", network.wire()) as other, DomainLink(here, "tf", network.wire()) as link:
            await until(lambda: len(heard) == 1)
            messages = live_messages(network)
            before = link.statistics()
            batches = [(moving("map", "a", stamp, authority="slam"), moving("map", "b", stamp)) for stamp in range(10)]
            for batch in batches:
                here.publish(batch)
            here.remove_frame("camera")
            assert messages == []
            await until(lambda: there.statistics().frames == 2)
            assert len(messages) == 1
            assert heard[1:] == batches
            there.publish(static("map", "tool"))
            await until(lambda: here.statistics().frames == 3)
            for stamp in range(4_999):
                here.publish(moving("map", "a", stamp))
            assert len(messages) == 2
            here.publish(moving("map", "a", 5_000))
            assert len(messages) == 3, "a full turn goes out at once"
            await until(lambda: other.statistics().received_samples == 1 + 20 + 5_000)
            sent, received = link.statistics(), other.statistics()
            assert sent.sent_messages - before.sent_messages == 2
            assert sent.sent_samples - before.sent_samples == 21 + 5_000
            assert (received.lost, received.duplicates, received.rejected, received.peers) == (0, 0, {}, 1)
            here.publish(static("map", "last"))
            assert len(messages) == 3
        assert len(messages) == 4, "what was published last still went out"


async def test_a_link_tells_its_name_and_how_many_peers_it_has() -> None:
    network, told = MemoryNetwork(), list[str]()
    with Bus() as here, Bus() as there:
        link = DomainLink(here, "robots/tf", network.wire(), robot="r1", capacity=77)
        told.append(repr(link))
        async with link:
            told.append(repr(link))
            async with DomainLink(there, "robots/tf", network.wire()) as other:
                await until(lambda: bool(link.peers))
                assert (link.peers, other.peers) == ((other.id,), (link.id,))
                told.append(repr(link))
        told.append(repr(link))
    assert told == [f"<DomainLink 'robots/tf': {state}>" for state in ("not joined", "0 peers", "1 peer", "not joined")]
    assert (link.domain, link.robot, link.bus, len(link.id)) == ("robots/tf", "r1", here, 32)
    assert link.statistics().queue.capacity == 77


# Entering and leaving


@pytest.mark.every_loop
async def test_a_link_is_entered_once_on_an_open_bus_of_its_thread() -> None:
    network, closed = MemoryNetwork(), Bus()
    closed.close()
    with Bus() as bus:
        link = DomainLink(bus, "tf", network.wire())
        async with link:
            with pytest.raises(RuntimeError, match="entered once"):
                await link.__aenter__()
        with pytest.raises(RuntimeError, match="entered once"):
            await link.__aenter__()
    with pytest.raises(BusClosedError):
        await DomainLink(closed, "tf", network.wire()).__aenter__()

    async def enter(bus: Bus) -> None:
        with pytest.raises(RuntimeError, match="thread"):
            await DomainLink(bus, "tf", network.wire()).__aenter__()

    with Bus() as bus, bus.threadsafe():
        # This event loop has a claim on the bus now.
        await anyio.to_thread.run_sync(asyncio.run, enter(bus))
    assert network.wires == {}


@pytest.mark.every_loop
@pytest.mark.parametrize("when", ["before", "opening", "body"])
async def test_a_link_that_is_cancelled_closes_its_wire_and_leaves_the_bus_as_it_was(when: str) -> None:
    wire = LoggedWire(MemoryNetwork())
    with Bus() as bus:
        with anyio.CancelScope() as scope:
            if when == "before":
                scope.cancel()
            wire.while_opening = scope.cancel if when == "opening" else lambda: None
            async with DomainLink(bus, "tf", wire):
                scope.cancel()
                await anyio.sleep_forever()
        assert scope.cancelled_caught
        assert wire.calls[-1] == "close"
        bus.publish(moving("map", "a", 1))
        async with DomainLink(bus, "tf", MemoryNetwork().wire()):
            pass


@pytest.mark.parametrize("fails", ["open", "run", "body"])
async def test_an_error_of_the_wire_or_the_body_comes_out_as_it_is(fails: str) -> None:
    wire = LoggedWire(MemoryNetwork(), fails)
    with Bus() as bus, pytest.raises(MineError) as caught:
        async with DomainLink(bus, "tf", wire):
            if fails == "body":
                raise MineError
            await anyio.sleep_forever()
    assert (caught.value.__cause__, wire.calls[-1]) == (None, "close")


async def test_a_bus_that_closes_while_the_wire_opens_is_not_linked_and_one_that_closes_later_ends_nothing() -> None:
    network = MemoryNetwork()
    wire, bus = LoggedWire(network), Bus()
    wire.while_opening = bus.close
    with pytest.raises(BusClosedError):
        await DomainLink(bus, "tf", wire).__aenter__()
    assert wire.calls == ["open", "close"]
    bus = Bus()
    with Bus() as other:
        async with DomainLink(bus, "tf", network.wire()) as link, DomainLink(other, "tf", network.wire()):
            bus.close()
            other.publish(static("map", "a"))
            await until(lambda: bool(link.peers))
            await settle()
            assert link.statistics().rejected == {}


async def test_a_later_link_brings_the_newest_moving_samples_of_others_and_no_frame_keeps_an_ended_one() -> None:
    near, far = MemoryNetwork(), MemoryNetwork()
    with Bus() as one, Bus() as bridge, Bus() as other:
        links = [DomainLink(bridge, "tf", near.wire())]
        async with DomainLink(one, "tf", near.wire()), links[0]:
            await until(lambda: len(links[0].peers) == 1)
            one.publish(moving("map", "goal", 1))
            await until(lambda: bridge.statistics().frames == 1)
            async with DomainLink(bridge, "tf", far.wire()), DomainLink(other, "tf", far.wire()):
                await until(lambda: other.statistics().frames == 1)
        ended = weakref.ref(links[0])
        near = far = MemoryNetwork()
        links.clear()
        gc.collect()
        assert ended() is None


async def test_a_bus_that_links_again_hears_and_says_nothing_twice() -> None:
    network = MemoryNetwork()
    with Bus() as bus, Bus() as other:
        heard: list[TransformStamped] = []
        said: list[TransformStamped] = []
        async with DomainLink(other, "tf", network.wire()) as peer:
            async with DomainLink(bus, "tf", network.wire()) as link:
                other.publish([static("map", "camera"), static("map", "lidar"), moving("map", "base", 1)])
                bus.publish(static("map", "own"))
                await until(lambda: (bus.statistics().frames, other.statistics().frames) == (4, 4))
            await until(lambda: not peer.peers)
            bus.remove_frame("lidar")
            bus.publish(static("map", "meanwhile"))
            for samples, each in ((heard, bus), (said, other)):
                each.subscribe(samples.extend)
                samples.clear()
            async with DomainLink(bus, "tf", network.wire()) as link:
                await until(lambda: len(heard) == 1 and len(said) == 1)
                other.publish(moving("map", "base", 2))
                await until(lambda: len(heard) == 2)
                assert link.peers == (peer.id,)
        # The frame that was removed without a link comes back, for others still have it.
        assert heard == [static("map", "lidar"), moving("map", "base", 2)]
        assert said == [static("map", "meanwhile"), moving("map", "base", 2)]


@pytest.mark.every_loop
async def test_a_link_that_is_used_in_another_event_loop_says_so(anyio_backend_name: str) -> None:
    async def use(link: DomainLink) -> None:
        for use in (
            lambda: link.lookup("map", "base"),
            link.__aenter__,
            lambda: link.__aexit__(None, None, None),
            BufferServer(buffer, link).__aenter__,
        ):
            with pytest.raises(RuntimeError, match="'tf': 0 peers> was entered in another event loop"):
                await use()

    with Bus() as bus, Buffer(bus) as buffer:
        async with DomainLink(bus, "tf", MemoryNetwork().wire()) as link:
            await anyio.to_thread.run_sync(lambda: anyio.run(use, link, backend=anyio_backend_name))
            with pytest.raises(RuntimeError, match="entered once"):
                await link.__aenter__()
        assert repr(link) == "<DomainLink 'tf': not joined>"


def test_all_links_of_a_bus_are_entered_in_one_event_loop() -> None:
    async def use(entered: asyncio.Event, refused: asyncio.Event) -> None:
        async with DomainLink(bus, "tf", network.wire()):
            entered.set()
            await refused.wait()
            async with link:
                pass

    network, first, second = MemoryNetwork(), asyncio.new_event_loop(), asyncio.new_event_loop()
    entered, refused = asyncio.Event(), asyncio.Event()
    with Bus() as bus:
        link = DomainLink(bus, "another", network.wire())
        task = first.create_task(use(entered, refused))
        first.run_until_complete(entered.wait())
        with pytest.raises(RuntimeError, match="'tf': 0 peers> was entered in another event loop"):
            second.run_until_complete(link.__aenter__())
        refused.set()
        first.run_until_complete(task)
    first.close()
    second.close()


def test_after_a_crash_of_the_event_loop_what_comes_does_no_harm_and_what_is_published_says_so(
    caplog: pytest.LogCaptureFixture,
) -> None:
    network = MemoryNetwork()

    async def crash(bus: Bus) -> DomainLink:
        link = DomainLink(bus, "tf", network.wire())
        await link.__aenter__()
        return link

    with Bus() as bus:
        loop = asyncio.new_event_loop()
        link = loop.run_until_complete(crash(bus))
        for task in asyncio.all_tasks(loop):
            task.cancel()
        loop.run_until_complete(asyncio.sleep(0))
        loop.close()
        for _ in range(3):
            network.wires[link.id].receive("peer", b"anything")
        assert link.statistics().queue.pending == 3
        bus.publish(moving("map", "a", 1))
    assert "<DomainLink 'tf': 0 peers> sends nothing any more: the event loop in which it was entered" in caplog.text


# Under load


@pytest.mark.parametrize(("batches", "samples"), [(1, MAX_SAMPLES), (4_000, 1)])
async def test_a_large_message_takes_many_turns_and_each_batch_of_it_is_seen_whole(batches: int, samples: int) -> None:
    network, heard = MemoryNetwork(), list[int]()
    origin = os.urandom(16)
    entries = [
        OutgoingBatch(origin, n + 1, tuple(moving("map", f"f{n}/{i}", 1) for i in range(samples)))
        for n in range(batches)
    ]
    message = write_message(Outgoing(Kind.LIVE, origin, 1), entries)
    with Bus(SimulatedClock()) as bus:
        bus.subscribe(lambda batch: heard.append(len(batch)))
        async with DomainLink(bus, "tf", network.wire()) as link:
            wire, _ = await raw(network)
            await until(lambda: bool(link.peers))
            wire.publish("all", message)
            turns = 0
            while sum(heard) < batches * samples:
                turns += 1
                await anyio.lowlevel.checkpoint()
            assert link.statistics().received_messages == 1
    assert heard == [samples] * batches
    assert turns >= 3


async def test_live_messages_beyond_the_capacity_are_dropped_and_counted_and_the_last_of_each_frame_comes() -> None:
    network = MemoryNetwork()
    with Bus() as here, Bus() as there:
        async with (
            DomainLink(here, "tf", network.wire()),
            DomainLink(there, "tf", network.wire(), capacity=10) as link,
        ):
            await until(lambda: bool(link.peers))
            await settle()
            wire, _ = await raw(network)
            await until(lambda: len(link.peers) == 2)
            origin = os.urandom(16)
            for number in range(25):
                batch = OutgoingBatch(origin, number + 1, (moving("map", f"f{number % 2}", number),))
                wire.publish("all", write_message(Outgoing(Kind.LIVE, origin, number + 1), [batch]))
            assert (link.statistics().queue.pending, link.statistics().queue.dropped) == (10, 15)
            await until(lambda: link.statistics().received_samples == 10)
            assert link.statistics().lost == 0, "of a peer of which nothing had come before"


async def test_what_no_message_can_hold_is_counted_and_logged_and_the_rest_goes_out(
    caplog: pytest.LogCaptureFixture,
) -> None:
    network = MemoryNetwork()
    with Bus(max_ahead=None) as here, Bus() as there:
        async with DomainLink(here, "tf", network.wire()) as link, DomainLink(there, "tf", network.wire()) as other:
            await until(lambda: bool(link.peers))
            for _ in range(2):
                here.publish([moving("map", "far", 2**62), moving("map", "a", 1), moving("map", "x" * 1_025, 1)])
                here.publish([moving("map", "b", 1, authority="x" * 65_536)])
            here.remove_frame("x" * 1_025)
            await until(lambda: there.statistics().frames == 1)
            assert link.statistics().not_sent == {"stamp": 2, "frame name": 3, "authority": 2}
            # All together are too large for one message.
            messages, long = live_messages(network), "x" * 1_000
            here.publish([moving("map", f"{n}{long}", 1) for n in range(3)])
            for n in range(3_000):
                here.publish(static(f"{n}{long}", f"{n}{long}s"))
            await until(lambda: there.statistics().frames == 3_004)
            parts = [part for message in messages for part in read_message(message) if isinstance(part, Heard)]
            assert sum(len(part.entries) for part in parts) == 3_001
            assert (len(messages) > 1, other.statistics().lost) == (True, 0)
            assert link.statistics().not_sent == {"stamp": 2, "frame name": 3, "authority": 2}
    assert sum("not sent over the link tf" in message for message in caplog.messages) <= 6


async def test_a_newest_sample_that_no_message_can_hold_hides_nothing_from_who_joins_later() -> None:
    network = MemoryNetwork()
    with Bus(max_ahead=None) as here, Buffer(here), Bus() as there, Buffer(there) as buffer:
        async with DomainLink(here, "tf", network.wire()):
            for stamp in (1, 2**62):
                here.publish([static("map", "post", stamp=stamp), moving("map", "arm", stamp)])
            here.publish([moving("map", "base", stamp) for stamp in (1, 2, 3)])
            here.publish([static("map", f"post {n}") for n in range(600)])
            await settle()
            async with DomainLink(there, "tf", network.wire(), history=5.0):
                await until(lambda: there.statistics().frames == 603)
                assert buffer.lookup_nowait("map", "arm").stamp == 1
                await buffer.lookup("map", "base", 2, timeout=3.0)


async def test_what_the_wire_warns_of_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    wire = LoggedWire(MemoryNetwork())
    with Bus() as bus:
        async with DomainLink(bus, "tf", wire):
            for _ in range(2):
                wire.warn(OSError("the cable is out"))
    assert sum("the cable is out" in message for message in caplog.messages) == 1


# Events


# Clocks


async def test_one_clock_is_followed_until_its_peer_is_lost_and_the_time_goes_before_what_is_said_at_it() -> None:
    network = MemoryNetwork()
    clocks = [SimulatedClock(start=1_000), SimulatedClock(start=5_000)]
    following = SimulatedClock()
    jumps: list[tuple[int, int]] = []
    seen: list[tuple[int, int]] = []
    following.on_jump(lambda before, after: jumps.append((before, after)))
    with Bus(clocks[0]) as first, Bus(clocks[1]) as second, Bus(following) as bus:
        bus.subscribe(lambda batch: seen.append((following.now(), batch[0].stamp)))
        async with DomainLink(bus, "tf", network.wire(), clock=following, tell_clock=True) as link:
            async with DomainLink(first, "tf", network.wire(), tell_clock=True):
                await until(lambda: following.now() == 1_000)
                async with DomainLink(second, "tf", network.wire(), tell_clock=True):
                    await until(lambda: link.statistics().rejected.get("second clock", 0) > 0)
                    clocks[0].set(2_000)
                    first.publish(moving("map", "a", 2_000))
                    await until(lambda: len(seen) == 1)
                    await until(lambda: following.now() == 2_000)
                    clocks[0].set(1_500)
                    await until(lambda: following.now() == 1_500)
                await until(lambda: len(link.peers) == 1)
            await until(lambda: not link.peers)
            async with DomainLink(second, "tf", network.wire(), tell_clock=True):
                await until(lambda: following.now() == 5_000)
        clocks[1].set(9_000)
        await settle()
        assert following.now() == 5_000
    assert [after < before for before, after in jumps][:2] == [False, True]


async def test_a_link_tells_the_time_that_it_finds_and_none_that_it_is_not_to_tell() -> None:
    network = MemoryNetwork()
    following = SimulatedClock()
    with Bus(SimulatedClock(start=7)) as silent, Bus(following) as bus:
        async with DomainLink(silent, "tf", network.wire()) as link, DomainLink(bus, "tf", network.wire()) as other:
            await until(lambda: bool(link.peers and other.peers))
            silent.publish(moving("map", "a", 7))
            await until(lambda: other.statistics().received_samples == 1)
            assert following.now() == 0
    with Bus(SimulatedClock(start=7)) as telling, Bus(following) as bus:
        async with (
            DomainLink(bus, "tf", network.wire(), clock=following),
            DomainLink(telling, "tf", network.wire(), tell_clock=True),
        ):
            await until(lambda: following.now() == 7)


async def test_when_the_clock_jumps_back_moving_messages_that_wait_are_dropped_and_stamps_may_come_again() -> None:
    network, clock, numbers = MemoryNetwork(), SimulatedClock(start=100), count(1)
    origin = os.urandom(16)

    def message(is_static: bool) -> bytes:
        number = next(numbers)
        sample = static("map", "s", float(number)) if is_static else moving("map", "m", 5)
        kind = Kind.ANSWER if is_static else Kind.LIVE
        return write_message(
            Outgoing(kind, origin, number * (kind is Kind.LIVE)), [OutgoingBatch(origin, number, [sample])]
        )

    with Bus(clock) as bus:
        async with DomainLink(bus, "tf", network.wire()) as link:
            wire, _ = await raw(network)
            await until(lambda: bool(link.peers))
            wire.publish("all", message(is_static=True))
            wire.publish("all", message(is_static=False))
            clock.set(200)
            assert link.statistics().queue.dropped == 0
            clock.set(50)
            assert link.statistics().queue.dropped == 1
            await until(lambda: link.statistics().received_samples == 1)
            wire.publish("all", message(is_static=False))
            await until(lambda: bus.statistics().frames == 2)


async def test_a_message_that_tells_of_a_jump_back_is_published_whole_however_many_turns_it_takes() -> None:
    network, clock, following = MemoryNetwork(), SimulatedClock(start=100), SimulatedClock()
    heard: list[TransformStamped] = []
    with Bus(clock) as bus, Bus(following) as other:
        other.subscribe(heard.extend)
        async with (
            DomainLink(other, "tf", network.wire(), clock=following),
            DomainLink(bus, "tf", network.wire(), tell_clock=True),
        ):
            await until(lambda: following.now() == 100)
            clock.set(50)
            for number in range(1_000):
                bus.publish(moving("map", f"{number}", 50))
            await until(lambda: following.now() == 50)
            await until(lambda: len(heard) == 1_000)


async def test_ctrl_c_in_a_task_of_the_wire_leaves_the_link_as_itself() -> None:
    class InterruptedWire(MemoryWire):
        async def run(self) -> None:
            # trio raises it in the task that runs, and each group of tasks around that wraps it.
            raise BaseExceptionGroup("tasks of the wire", [KeyboardInterrupt()])

    with pytest.raises(KeyboardInterrupt):
        async with DomainLink(Bus(), "tf", InterruptedWire(MemoryNetwork(), "")):
            await anyio.sleep_forever()
