import asyncio
import gc
import math
import socket
import subprocess
import sys
import weakref
from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from time import time_ns
from typing import Any
from uuid import uuid4

import anyio
import anyio.lowlevel
import anyio.to_thread
import pytest
import zenoh
from support.processes import PATIENCE, free_ports, new_domain, until
from support.samples import moving, static

from tfbus import (
    Buffer,
    Bus,
    ClockResetError,
    FutureExtrapolationError,
    PeerJoined,
    PeerLost,
    SimulatedClock,
    TransformBroadcaster,
    TransformStamped,
)
from tfbus.links._carrier import SendReport
from tfbus.links._entries import MovingFrame, OutgoingBatch
from tfbus.links._message import MessageWriter, write_answer
from tfbus.links._state import LinkState, StateStep
from tfbus.links.zenoh import ZenohLink
from tfbus.links.zenoh._keys import Keys
from tfbus.links.zenoh._settings import settings

pytestmark = pytest.mark.anyio

ON_ONE_LOOP = pytest.mark.parametrize("anyio_backend", [("asyncio", {})], ids=["asyncio"])
"""For tests that take long and depend on zenoh only."""

Batch = tuple[TransformStamped, ...]


class Place:
    """A domain and an address for the links of one test."""

    def __init__(self) -> None:
        self.domain = new_domain()
        self.address = f"tcp/127.0.0.1:{free_ports(1)[0]}"
        self._taken = False

    def link(self, bus: Bus, **options: Any) -> ZenohLink:
        """A link; the first one listens and the others connect to it."""
        first = not self._taken
        self._taken = True
        options["listen" if first else "connect"] = self.address
        return ZenohLink(bus, options.pop("domain", self.domain), **options)


class OlderLink:
    """A link from before there were filters: it sends by its live key only, and its answers tell of nothing else."""

    def __init__(self, place: Place) -> None:
        self.id = f"{uuid4().int | 1 << 127:032x}"
        self._origin = uuid4().bytes
        self._state = LinkState()
        self._writer = MessageWriter(SendReport(lambda _: None))
        keys = Keys(place.domain, self.id)
        self._session = zenoh.open(settings([], place.address, {"id": self.id}, 2.0))
        self._live = self._session.declare_publisher(keys.own("live"), allowed_destination=zenoh.Locality.REMOTE)
        self._queryable = self._session.declare_queryable(keys.own("state"), self._answer)
        self._token = self._session.liveliness().declare_token(keys.token("0"))

    def publish(self, *samples: TransformStamped) -> None:
        since, number = self._state.number, self._state.number + 1
        for sample in samples:
            if sample.static or not self._state.brings(sample.child):
                batch = OutgoingBatch(self._origin, number, (sample,))
                self._state.change(sample.child, batch if sample.static else MovingFrame(sample.child))
        step = StateStep(since, self._state.number, self._state.digest)
        sequence = time_ns() // 1_000
        for message in self._writer.write([OutgoingBatch(self._origin, sequence, samples)], step):
            self._live.put(message.payload, attachment=message.attachment)

    def _answer(self, query: zenoh.Query) -> None:
        assert query.payload is not None
        since = int.from_bytes(query.payload.to_bytes(), "little")
        message = write_answer(*self._state.changes(since))
        query.reply(query.key_expr, message.payload, attachment=message.attachment)
        query.drop()

    def close(self) -> None:
        self._session.close()


@pytest.fixture
def place() -> Place:
    return Place()


async def meet(*links: ZenohLink) -> None:
    """Wait until each knows of all others."""
    await until(lambda: all({link.id for link in links} <= {*one.peers, one.id} for one in links))


@asynccontextmanager
async def joined(place: Place, *buses: Bus, **options: Any) -> AsyncIterator[list[ZenohLink]]:
    """A link for each bus, and all of them know each other."""
    async with AsyncExitStack() as stack:
        links = [await stack.enter_async_context(place.link(bus, **options)) for bus in buses]
        await meet(*links)
        yield links


def is_free(place: Place) -> bool:
    """Whether no link listens there."""
    try:
        socket.create_server(("127.0.0.1", int(place.address.rpartition(":")[2]))).close()
    except OSError:
        return False
    return True


def hear(bus: Bus) -> list[Batch]:
    """A list that receives all batches of a bus from now on."""
    heard: list[Batch] = []
    bus.subscribe(heard.append)
    return heard


def frames(bus: Bus) -> set[str]:
    """The static frames of a bus."""
    return {sample.child for sample in known(bus)}


def known(bus: Bus) -> Sequence[TransformStamped]:
    """The static samples that a new subscriber is given."""
    latched: list[TransformStamped] = []
    bus.subscribe(latched.extend).close()
    return latched


async def test_samples_arrive_as_they_were_published_and_in_the_same_batches(place: Place) -> None:
    with Bus() as here, Bus() as there:
        async with joined(place, here, there):
            heard, returned = hear(there), hear(here)
            batches = [
                (moving("map", "odom", 5, 0.5, "slam"), moving("odom", "base", 7, 1.5, "wheels")),
                (static("base", "lidar", 0.25, 3, "urdf"),),
                (
                    moving("odom", "base", 8, -1.0, "wheels"),
                    static("base", "camera", 2.0),
                    moving("map", "odom", 9, 0.1),
                ),
                (moving("odom", "base", 6, 3.0, "late"),),
            ]
            for batch in batches:
                here.publish(batch)
            await until(lambda: len(heard) == 4)
            assert heard == batches
            # And the other way round, with nothing that comes back.
            answer = (moving("map", "other", -1, 4.0, "someone"),)
            there.publish(answer)
            await until(lambda: len(returned) == 5)
            assert returned == [*batches, answer]
            assert heard == [*batches, answer]


async def test_a_late_joiner_has_the_static_frames_and_no_moving_ones(place: Place) -> None:
    names = [f"s{i}" for i in range(50)]
    with Bus() as early, Bus() as late:
        async with place.link(early):
            early.publish([static("map", name, float(i)) for i, name in enumerate(names)])
            early.publish(moving("map", "base", 1))
            # All before the link was there, and one behind it.
            await anyio.lowlevel.checkpoint()
            async with place.link(late):
                await until(lambda: frames(late) == set(names))
                assert {sample.child: sample.transform.translation[0] for sample in known(late)} == {
                    name: float(i) for i, name in enumerate(names)
                }
                assert late.statistics().frames == 50


async def test_a_late_joiner_that_wants_the_past_can_look_back(place: Place) -> None:
    with Bus(max_ahead=None) as here, Bus(max_ahead=None) as there, Buffer(here), Buffer(there) as buffer:
        async with place.link(here):
            for stamp in (10, 20, 30):
                here.publish(moving("map", "base", stamp, float(stamp), "odometry"))
            async with place.link(there, history=5.0) as late:
                with anyio.fail_after(PATIENCE):
                    assert (await buffer.lookup("map", "base", 15)).transform.translation == (15, 0, 0)
                await until(lambda: len(late.peers) == 1)
                here.publish(moving("map", "base", 40, 40.0, "odometry"))
                with anyio.fail_after(PATIENCE):
                    assert (await buffer.lookup("map", "base", 35)).transform.translation == (35, 0, 0)
                assert [(edge.samples, edge.authority) for edge in buffer.tree.edges()] == [(4, "odometry")]


async def test_static_frames_from_before_the_link_are_sent(place: Place) -> None:
    with Bus() as early, Bus() as late:
        early.publish(static("map", "a"))
        late.publish(static("map", "b"))
        async with joined(place, early, late):
            await until(lambda: frames(early) == frames(late) == {"a", "b"})


async def test_removed_frames_leave_the_other_bus_and_late_joiners_never_hear_of_them(place: Place) -> None:
    with Bus() as here, Bus() as there, Bus() as late:
        async with joined(place, here, there):
            here.publish([static("map", "lidar"), moving("map", "base", 1), static("map", "camera")])
            await until(lambda: there.statistics().frames == 3)
            here.remove_frame("lidar")
            here.remove_frame("base")
            await until(lambda: there.statistics().frames == 1)
            heard = hear(late)
            async with place.link(late):
                await until(lambda: frames(late) == {"camera"})
                here.publish(moving("map", "a marker", 1))
                await until(lambda: late.statistics().frames == 2)
                # Twice at most: in the place of a static frame, and in a batch.
                assert {sample.child for batch in heard for sample in batch} == {"camera", "a marker"}


async def test_a_frame_that_was_removed_there_comes_back_when_it_is_published_again(place: Place) -> None:
    with Bus() as here, Bus() as there:
        async with joined(place, here, there):
            here.publish(static("map", "lidar", 1.0))
            await until(lambda: there.statistics().frames == 1)
            there.remove_frame("lidar")
            await until(lambda: here.statistics().frames == 0)
            here.publish(static("map", "lidar", 2.0))
            await until(lambda: there.statistics().frames == 1)
            assert known(there)[0].transform.translation[0] == 2.0


@pytest.mark.parametrize("changes", [1, 2, 3, 4])
async def test_a_frame_that_changes_its_kind_does_so_everywhere_and_for_late_joiners(
    changes: int, place: Place
) -> None:
    with Bus() as here, Bus() as there, Bus() as late:
        async with joined(place, here, there):
            heard = hear(there)
            here.publish(static("map", "another"))
            for change in range(changes):
                here.publish(static("map", "base") if change % 2 else moving("map", "base", change))
                await until(lambda change=change: len(heard) == 2 + change)  # type: ignore[misc]
            expected = {"another"} if changes % 2 else {"another", "base"}
            assert frames(there) == expected
            async with place.link(late):
                await until(lambda: "another" in frames(late))
                await until(lambda: frames(late) == expected)


async def test_a_lookup_that_waits_is_answered_from_the_other_bus(place: Place) -> None:
    with Bus() as here, Bus() as there, Buffer(there) as buffer:
        async with joined(place, here, there), anyio.create_task_group() as tasks:
            found: list[TransformStamped] = []

            async def ask() -> None:
                found.append(await buffer.lookup("map", "lidar", 15))

            tasks.start_soon(ask)
            here.publish([moving("map", "base", 10, 1.0), static("base", "lidar", 0.5)])
            await until(lambda: len(buffer.pending()) == 1 and "lidar" in buffer.tree)
            assert found == []
            here.publish(moving("map", "base", 20, 2.0))
            await until(lambda: len(found) == 1)
            assert (found[0].transform.translation[0], found[0].stamp) == (2.0, 15)


async def test_samples_published_just_before_the_end_still_arrive(place: Place) -> None:
    with Bus() as here, Bus() as there:
        async with place.link(there) as link:
            heard = hear(there)
            async with place.link(here) as other:
                await meet(link, other)
                here.publish([moving("map", "base", stamp) for stamp in range(3_000)])
                here.publish(static("map", "lidar"))
            await until(lambda: len(heard) == 2)
            assert len(heard[0]) == 3_000


async def test_threads_publish_over_the_link(place: Place) -> None:
    with Bus() as here, Bus() as there:
        async with joined(place, here, there) as (_, link):
            heard = hear(there)
            with here.threadsafe() as publish:

                def work(name: str) -> None:
                    for stamp in range(500):
                        publish([moving("map", name, stamp), moving("map", f"{name}'", stamp)])

                async with anyio.create_task_group() as tasks:
                    for name in "ab":
                        tasks.start_soon(anyio.to_thread.run_sync, work, name)
            # It comes whatever became of the live messages before it.
            here.publish(static("map", "end"))
            await until(lambda: "end" in frames(there))
            batches = [batch for batch in heard if batch[0].child != "end"]
            for name in "ab":
                stamps = [batch[0].stamp for batch in batches if batch[0].child == name]
                assert stamps == sorted(set(stamps))
                # A network that is congested drops live messages, and the link counts them.
                assert stamps == list(range(500)) or link.statistics().lost
            assert all(len(batch) == 2 for batch in batches)


async def test_a_bridge_between_two_domains_passes_everything_on_once(place: Place) -> None:
    other = Place()
    with Bus() as left, Bus() as middle, Bus() as right:
        async with joined(place, left, middle), joined(other, right, middle):
            heard, back = hear(right), hear(left)
            left.publish([static("map", "lidar"), moving("map", "base", 1)])
            left.publish(moving("map", "base", 2))
            await until(lambda: len(heard) == 2)
            right.publish(moving("map", "arm", 3))
            await until(lambda: len(back) == 3)
            left.remove_frame("lidar")
            await until(lambda: frames(right) == set())
            assert [[sample.child for sample in batch] for batch in heard] == [["lidar", "base"], ["base"], ["arm"]]
            with Bus() as late:
                left.publish(static("map", "camera"))
                await until(lambda: frames(right) == {"camera"})
                async with other.link(late):
                    # From the bridge's cache.
                    await until(lambda: frames(late) == {"camera"})


async def test_two_links_of_one_bus_to_one_domain_make_no_doubles(place: Place) -> None:
    with Bus() as here, Bus() as there:
        async with joined(place, here, here, there):
            heard, own = hear(there), hear(here)
            for stamp in range(100):
                here.publish([moving("map", "a", stamp), moving("map", "a'", stamp)])
                here.publish(static("map", "s", float(stamp)))
                there.publish(moving("map", "b", stamp))
                await anyio.lowlevel.checkpoint()
            await until(lambda: len(own) == 300)
            await until(lambda: [s.transform.translation[0] for s in known(there)] == [99.0])
            for batches in (heard, own):
                pairs = [batch for batch in batches if batch[0].child == "a"]
                assert [[sample.stamp for sample in batch] for batch in pairs] == [[i, i] for i in range(100)]
                assert [batch[0].stamp for batch in batches if batch[0].child == "b"] == list(range(100))
                # One of them may be overtaken by a newer one on the other link.
                latched = [batch[0].transform.translation[0] for batch in batches if batch[0].child == "s"]
                assert latched == sorted(set(latched))


async def test_domains_are_apart_also_where_one_is_the_beginning_of_another(place: Place) -> None:
    with Bus() as inner, Bus() as outer, Bus() as third:
        async with (
            place.link(inner, domain=f"{place.domain}/arm"),
            place.link(outer) as link,
            place.link(third) as other,
        ):
            await meet(link, other)
            heard, wanted = hear(inner), hear(third)
            inner.publish([static("map", "a"), moving("map", "b", 1)])
            outer.publish([static("map", "c"), moving("map", "d", 1)])
            await until(lambda: len(wanted) == 1)
            assert [sample.child for sample in wanted[0]] == ["c", "d"]
            assert [[sample.child for sample in batch] for batch in heard] == [["a", "b"]]
            assert link.statistics().rejected == {}


@pytest.mark.parametrize("domain", ["", "a b", "a//b", "/a", "a/", "a/*", "@a", "$a", "ä", "x" * 201])
async def test_a_domain_that_can_be_no_part_of_a_key_is_named(domain: str) -> None:
    with pytest.raises(ValueError, match="domain"):
        ZenohLink(Bus(), domain)


async def test_arguments_that_make_no_sense_are_refused_at_once() -> None:
    bus = Bus()
    with pytest.raises(TypeError, match="'base'"):
        ZenohLink(bus, frames="base")
    wrong: dict[str, Any] = {"capacity": 0, "max_frames": 0, "lease": 0, "listen": "garbage", "config": {"no": 1}}
    for name, value in wrong.items():
        said = {"listen": "garbage", "config": "'no'"}.get(name, name)
        with pytest.raises(ValueError, match=said):
            ZenohLink(bus, **{name: value})


async def test_a_robot_is_heard_in_full_or_at_a_rate_and_not_both() -> None:
    with Bus() as bus:
        keys = ZenohLink(bus, robots={"r1": math.inf, "s*": 2.0})._zenoh._keys
        assert (keys.robots, keys.slow_robots) == (("r1",), (("s$*", 2.0),))
        keys = ZenohLink(bus, robots=["r1", "s*"])._zenoh._keys
        assert (keys.robots, keys.slow_robots) == (("r1", "s$*"), ())


async def test_the_bus_may_close_while_it_is_linked(place: Place) -> None:
    with Bus() as there:
        here = Bus()
        async with joined(place, here, there) as (link, _):
            here.close()
            there.publish([static("map", "a"), moving("map", "b", 1)])
            async with place.link(Bus()) as third:
                await until(lambda: third.statistics().received_messages > 0)
            await until(lambda: len(link.peers) == 1)
            assert link.statistics().rejected == {}


class MineError(Exception):
    pass


async def test_a_link_is_gone_when_its_body_is_cancelled(place: Place) -> None:
    with Bus() as here, Bus() as there:
        async with place.link(there) as link:
            with anyio.CancelScope() as scope:
                async with place.link(here) as other:
                    await meet(link, other)
                    scope.cancel()
                    await anyio.sleep_forever()
            assert scope.cancelled_caught
            await until(lambda: link.peers == ())


async def test_a_link_that_is_cancelled_while_it_begins_leaves_nothing_open() -> None:
    for checkpoints in range(6):
        place = Place()
        with Bus() as bus, anyio.CancelScope() as scope:
            async with anyio.create_task_group() as tasks:

                async def cancel(scope: anyio.CancelScope = scope, checkpoints: int = checkpoints) -> None:
                    for _ in range(checkpoints):
                        await anyio.lowlevel.checkpoint()
                    scope.cancel()

                tasks.start_soon(cancel)
                await enter_slowly(place, bus)
        assert scope.cancelled_caught
        await until(lambda place=place: is_free(place))  # type: ignore[misc]


async def enter_slowly(place: Place, bus: Bus) -> None:
    """A link that takes a while to begin, because nobody is where it connects to."""
    async with ZenohLink(bus, place.domain, listen=place.address, connect=f"tcp/127.0.0.1:{free_ports(1)[0]}"):
        pass


def test_asyncios_own_cancel_while_a_link_begins_leaves_nothing_open() -> None:
    async def main(turns: int) -> None:
        place = Place()
        with Bus() as bus:
            task = asyncio.create_task(enter_slowly(place, bus))
            for _ in range(turns):
                await asyncio.sleep(0)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
        await until(lambda: is_free(place))

    for turns in range(6):
        asyncio.run(main(turns))


def test_asyncios_own_timeout_while_a_link_begins_leaves_nothing_open() -> None:
    async def main() -> None:
        place = Place()
        with Bus() as bus:
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(enter_slowly(place, bus), 0.01)
            await until(lambda: is_free(place))
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(0.01):
                    await enter_slowly(place, bus)
            await until(lambda: is_free(place))

    asyncio.run(main())


def test_asyncios_own_ways_to_end_a_body_end_the_link(place: Place) -> None:
    entered = asyncio.Event()

    async def stay(bus: Bus, link: ZenohLink) -> None:
        async with place.link(bus) as own:
            await meet(own, link)
            entered.set()
            await asyncio.sleep(3600)

    async def main() -> None:
        with Bus() as here, Bus() as there:
            async with place.link(there) as link:
                for way in ("cancel", "group", "timeout"):
                    entered.clear()
                    if way == "cancel":
                        task = asyncio.create_task(stay(here, link))
                        await entered.wait()
                        task.cancel()
                        with pytest.raises(asyncio.CancelledError):
                            await task
                    elif way == "group":
                        with pytest.raises(ExceptionGroup) as caught:
                            async with asyncio.TaskGroup() as group:
                                group.create_task(stay(here, link))
                                await entered.wait()
                                raise MineError
                        assert [type(error) for error in caught.value.exceptions] == [MineError]
                    else:
                        with pytest.raises(TimeoutError):
                            async with asyncio.timeout(None) as timeout:
                                async with place.link(here) as own:
                                    await meet(own, link)
                                    timeout.reschedule(0)
                                    await asyncio.sleep(3600)
                    await until(lambda: link.peers == ())
                    task_now = asyncio.current_task()
                    assert task_now is not None
                    assert task_now.cancelling() == 0

    asyncio.run(main())


async def test_clients_talk_through_the_one_that_they_connect_to(place: Place) -> None:
    # Neither listens, so they could not reach each other.
    client: dict[str, Any] = {"config": {"mode": "client"}}
    with Bus() as middle, Bus() as left, Bus() as right:
        async with place.link(middle) as link, place.link(left, **client) as one, place.link(right, **client) as two:
            await meet(link, one, two)
            heard, back = hear(right), hear(left)
            left.publish(static("map", "lidar"))
            await until(lambda: len(heard) == 1)
            right.publish(moving("map", "base", 1))
            await until(lambda: len(back) == 2)
            assert len(heard) == 2
        async with place.link(middle):
            with pytest.raises(OSError, match="Unable to connect"):
                await ZenohLink(left, connect=f"tcp/127.0.0.1:{free_ports(1)[0]}", **client).__aenter__()


async def test_an_address_that_cannot_be_had_is_an_os_error_and_the_bus_is_as_before(place: Place) -> None:
    with Bus() as bus, Bus() as other:
        async with place.link(other):
            with pytest.raises(OSError, match=place.address):
                await ZenohLink(bus, listen=place.address).__aenter__()
        bus.publish(moving("map", "a", 1))
        async with ZenohLink(bus, listen=place.address):
            pass


async def test_a_bus_is_linked_again_by_another_link(place: Place) -> None:
    with Bus() as here, Bus() as there:
        async with place.link(there) as link:
            heard = hear(there)
            for turn in range(5):
                async with place.link(here) as other:
                    await meet(link, other)
                    here.publish(moving("map", "base", turn))
                    await until(lambda turn=turn: len(heard) == turn + 1)  # type: ignore[misc]
                    there.publish(moving("map", "other", turn))
                    await until(lambda: here.statistics().frames == 2)
                    here.remove_frame("other")
                await until(lambda: link.peers == ())
                del heard[turn + 1 :]


async def test_peers_that_come_and_go_are_told_with_their_authorities_and_frames(place: Place) -> None:
    with Bus() as here, Bus() as there, here.events() as events:
        async with place.link(here, drop_lost=True) as link:
            async with place.link(there) as other:
                await meet(link, other)
                there.publish([moving("map", "base", 1, authority="wheels"), static("base", "lidar", authority="urdf")])
                here.publish(moving("map", "own", 1, authority="me"))
                await until(lambda: here.statistics().frames == 3)
            await until(lambda: here.statistics().frames == 1)
            here.close()
        told = [event async for event in events if isinstance(event, PeerJoined | PeerLost)]
        assert [type(event) for event in told] == [PeerJoined, PeerLost]
        assert all((event.link, event.peer) == (place.domain, other.id) for event in told)
        lost = told[1]
        assert isinstance(lost, PeerLost)
        assert (lost.authorities, lost.frames) == (("urdf", "wheels"), ("base", "lidar"))


async def test_the_frames_of_a_lost_peer_stay_by_default(place: Place) -> None:
    with Bus() as here, Bus() as there:
        async with place.link(here) as link:
            async with place.link(there) as other:
                await meet(link, other)
                there.publish([moving("map", "base", 1), static("base", "lidar")])
                await until(lambda: here.statistics().frames == 2)
            await until(lambda: link.peers == ())
            assert here.statistics().frames == 2


async def test_both_ends_may_live_in_simulated_time(place: Place) -> None:
    clock = SimulatedClock()
    with Bus(clock) as here, Bus(clock) as there, Buffer(there) as buffer:
        async with joined(place, here, there):
            broadcaster = TransformBroadcaster(here, "wheels")
            broadcaster.send_static("base", "lidar", static("a", "b", 0.5).transform)
            for _ in range(3):
                await clock.advance(1.0)
                broadcaster.send("map", "base", moving("a", "b", 0, float(clock.now())).transform)
            await until(lambda: there.statistics().samples == 4)
            assert (await buffer.lookup("map", "lidar", 2_500_000_000)).stamp == 2_500_000_000
            clock.set(0)
            with pytest.raises(FutureExtrapolationError):
                buffer.lookup_nowait("map", "base")
            broadcaster.send("map", "base", moving("a", "b", 0, 7.0).transform)
            with anyio.fail_after(30):
                found = await buffer.lookup("map", "lidar")
            assert (found.transform.translation[0], found.stamp) == (7.5, 0)


async def test_messages_that_wait_when_the_clock_jumps_back_are_dropped(place: Place) -> None:
    clock = SimulatedClock()
    with Bus() as here, Bus(clock) as there, Buffer(there) as buffer:
        async with joined(place, here, there) as (_, link):
            await clock.advance(10.0)
            here.publish([moving("map", "base", 9), static("map", "lidar")])
            await until(lambda: there.statistics().samples == 2)
            for stamp in range(10, 15):
                here.publish(moving("map", "base", stamp))
                # The loop of the test does not take in what comes to the link meanwhile.
                sent = link.statistics()
                await anyio.lowlevel.checkpoint()
            assert sent.rejected == {}

            async def wait() -> None:
                with pytest.raises(ClockResetError):
                    await buffer.lookup("map", "base", 1_000)

            async with anyio.create_task_group() as tasks:
                tasks.start_soon(wait)
                await until(lambda: len(buffer.pending()) == 1)
                clock.set(5)
            here.publish(moving("map", "base", 6))
            await until(lambda: buffer.can_transform("map", "base", 6))
            assert buffer.can_transform("map", "lidar")


@pytest.mark.thorough
async def test_ten_thousand_static_frames_arrive(place: Place) -> None:
    names = {f"landmark {i}" for i in range(10_000)}
    with Bus() as here, Bus() as there:
        async with joined(place, here, there) as (_, link):
            for name in sorted(names):
                here.publish(static("map", name))
            await until(lambda: there.statistics().frames == 10_000)
            assert frames(there) == names
            assert link.statistics().rejected == {}


@ON_ONE_LOOP
@pytest.mark.thorough
async def test_a_thousand_static_frames_arrive_at_a_late_joiner(place: Place) -> None:
    names = {f"landmark {i}" for i in range(1_000)}
    with Bus() as here, Bus() as late:
        async with place.link(here):
            here.publish([static("map", name) for name in sorted(names)])
            async with place.link(late) as link:
                await until(lambda: late.statistics().frames == 1_000)
                assert frames(late) == names
                assert link.statistics().rejected == {}


@pytest.mark.thorough
async def test_a_static_frame_that_comes_and_goes_a_thousand_times_is_there_at_last(place: Place) -> None:
    with Bus() as here, Bus() as there, Bus() as late:
        async with joined(place, here, there):
            for turn in range(1_000):
                here.publish(static("map", "lidar", float(turn)))
                await anyio.lowlevel.checkpoint()
                here.remove_frame("lidar")
            here.publish(static("map", "lidar", -1.0))
            async with place.link(late):
                for bus in (there, late):
                    await until(
                        lambda bus=bus: [s.transform.translation[0] for s in known(bus)] == [-1.0]  # type: ignore[misc]
                    )


@ON_ONE_LOOP
@pytest.mark.thorough
async def test_fifty_links_one_after_another_leave_no_thread_and_no_file_behind(place: Place) -> None:
    async def open_one() -> None:
        with Bus() as bus:
            bus.publish([static("map", "lidar"), moving("map", "base", 1)])
            async with place.link(bus) as other:
                await meet(link, other)
            await until(lambda: link.peers == ())

    with Bus() as there:
        async with place.link(there) as link:
            await open_one()
            before = held()
            for _ in range(50):
                await open_one()
            # zenoh and anyio keep a few idle threads for some seconds, and a session that ends still has its files;
            # what each link leaves would be fifty for good.
            await until(lambda: all(now - then < 10 for now, then in zip(held()[:2], before[:2], strict=True)))
            bytes_held = held()[2] - before[2]
    assert bytes_held < 10e6


def held() -> tuple[int, int, int]:
    """Threads, open files, and bytes of this process."""
    gc.collect()
    threads, files = (sum(1 for _ in Path("/proc/self", folder).iterdir()) for folder in ("task", "fd"))
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return threads, files, pages * 4096


async def test_nothing_keeps_a_link_and_its_bus_when_it_has_ended(place: Place) -> None:
    async def use() -> list[weakref.ref[Any]]:
        here, there = Bus(), Bus()
        async with joined(place, here, there) as links:
            here.publish([static("map", "lidar"), moving("map", "base", 1)])
            await until(lambda: there.statistics().frames == 2)
        return [weakref.ref(thing) for thing in (here, there, *links)]

    references = await use()
    await until(lambda: bool(gc.collect() or True) and all(reference() is None for reference in references))


def run_program(program: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)


@ON_ONE_LOOP
@pytest.mark.thorough
async def test_without_the_extra_the_error_names_it() -> None:
    done = run_program("import sys; sys.modules['zenoh'] = None; import tfbus.links.zenoh")
    assert done.returncode == 1
    assert 'pip install "tfbus[zenoh]"' in done.stderr.splitlines()[-1]
    assert "Error: No module" not in done.stderr


async def test_of_frames_that_nobody_wants_nothing_is_sent_but_that_they_are_there(place: Place) -> None:
    with Bus() as here, Bus() as there:
        here.publish([static("map", "lidar"), static("map", "camera")])
        async with place.link(here) as sender, place.link(there, frames=iter(["base", "tool", "lidar"])) as link:
            await meet(sender, link)
            await until(lambda: frames(there) == {"lidar"})
            heard = hear(there)
            heard.clear()
            batches = [
                tuple(moving("map", name, stamp) for name in ("base", "elbow", "tool", "wheel"))
                for stamp in range(1, 51)
            ]
            for batch in batches:
                here.publish(batch)
                await anyio.lowlevel.checkpoint()
            await until(lambda: len(heard) == 50)
            assert heard == [(batch[0], batch[2]) for batch in batches], "in order, of each batch what is wanted"
            for stamp in range(50):
                here.publish(moving("map", "wheel", 100 + stamp))
                await anyio.lowlevel.checkpoint()
            here.publish(static("map", "tool", 3.0))
            here.remove_frame("lidar")
            await until(lambda: frames(there) == {"tool"})
            assert sender.statistics().sent_samples == 101
            assert there.statistics().frames == 2
            assert link.statistics().rejected == sender.statistics().rejected == {}
            assert link.statistics().lost == 0


@pytest.mark.thorough
async def test_links_with_filters_and_without_hear_what_they_want_at_once(place: Place) -> None:
    with Bus() as here, Bus() as arm, Bus() as base, Bus() as everything:
        async with (
            place.link(here) as sender,
            place.link(arm, frames=["hand", "elbow"]) as one,
            place.link(base, frames=["base", "elbow"], robots={"*": math.inf, "x*": 1.0}) as two,
        ):
            await meet(sender, one, two)

            async def publish(stamp: int) -> None:
                here.publish([moving("map", name, stamp) for name in ("hand", "elbow", "base", "wheel")])
                for heard, names in ((arms, ["hand", "elbow"]), (bases, ["elbow", "base"])):
                    expected = [(name, stamp) for name in names]
                    await until(lambda: [(s.child, s.stamp) for b in heard[-1:] for s in b] == expected)  # noqa: B023

            arms, bases = hear(arm), hear(base)
            await publish(1)
            assert sender.statistics().sent_samples == 4
            async with place.link(everything) as three:
                await meet(sender, three)
                await publish(2)
                await until(lambda: everything.statistics().frames == 4)
                assert sender.statistics().sent_samples == 12
            await until(lambda: len(sender.peers) == 2)
            await until(lambda: not sender._zenoh._sessions.is_heard())
            await publish(3)
            assert sender.statistics().sent_samples == 16


@pytest.mark.thorough
@pytest.mark.parametrize("drop_lost", [True, False])
async def test_a_link_with_a_filter_follows_a_sender_that_ends_and_comes_again(place: Place, drop_lost: bool) -> None:
    with Bus() as there:
        async with place.link(there, frames=["base", "lidar"], drop_lost=drop_lost) as link:
            for x in (1.0, 2.0):
                with Bus() as here:
                    async with place.link(here) as sender:
                        await meet(sender, link)
                        here.publish([static("map", "lidar", x), static("map", "camera"), moving("map", "base", 1, x)])
                        await until(lambda x=x: [s.transform.translation[0] for s in known(there)] == [x])  # type: ignore[misc]
                        assert there.statistics().frames == 2
                await until(lambda: not link.peers)
                assert there.statistics().frames == (0 if drop_lost else 2)
                assert frames(there) == (set() if drop_lost else {"lidar"})


@pytest.mark.thorough
async def test_an_older_link_that_knows_no_filters_is_heard_by_its_live_key(place: Place) -> None:
    with Bus() as there, Bus() as newer:
        async with place.link(there, frames=["base", "lidar", "new"]) as link, place.link(newer) as other:
            await meet(link, other)
            older = OlderLink(place)
            try:
                older.publish(static("map", "lidar"), static("map", "camera"), moving("map", "base", 1))
                await until(lambda: frames(there) == {"lidar"})
                await until(lambda: older.id in link._zenoh._sessions._main._unfiltered)
                stamps: list[int] = []
                there.subscribe(lambda batch: stamps.extend(sample.stamp for sample in batch if sample.child == "base"))
                for stamp in range(2, 5):
                    await anyio.sleep(0.01)
                    older.publish(moving("map", "base", stamp), moving("map", "wheel", stamp))
                await until(lambda: 4 in stamps)
                older.publish(static("map", "lidar", 7.0))
                await until(lambda: [sample.transform.translation[0] for sample in known(there)] == [7.0])
                newer.publish([moving("map", "new", 1), moving("map", "wheel", 9)])
                await until(lambda: there.statistics().frames == 3)
                assert other.statistics().sent_samples == 3, "the older one hears all"
                assert link.statistics().lost == 0
                assert link.statistics().rejected == {}
            finally:
                older.close()
            await until(lambda: not link._zenoh._sessions._main._unfiltered)


@pytest.mark.thorough
async def test_while_a_filter_makes_no_sense_those_that_do_hear_all_and_nothing_is_missing(place: Place) -> None:
    with Bus() as here, Bus() as there:
        async with place.link(here) as sender, place.link(there, frames=["base", "lidar"]) as link:
            await meet(sender, link)
            sessions = link._zenoh._sessions
            stranger = zenoh.open(settings([], place.address, None, 2.0))
            # The first one is not even a filter by its looks, and is no link's token.
            prefix = f"tfbus/{place.domain}/~/@only/{uuid4().hex}/0"
            tokens = [stranger.liveliness().declare_token(f"{prefix}/{chunk}") for chunk in ("{}", "garbage")]
            await until(lambda: sender.statistics().rejected.keys() == {"key", "filter"})

            async def publish(stamp: int) -> None:
                here.publish([moving("map", "base", stamp), moving("map", "wheel", stamp)])
                await anyio.sleep(0.01)

            # It is told with the next answer.
            here.publish(static("map", "lidar"))
            here.publish(static("map", "camera"))
            await until(lambda: set(sessions._main._unfiltered) == {sender.id})
            stamps: list[int] = []
            there.subscribe(lambda batch: stamps.extend(sample.stamp for sample in batch if sample.child == "base"))
            await until(sender._zenoh._sessions._main.publishers.is_heard)
            for stamp in range(1, 4):
                await publish(stamp)
            await until(lambda: stamps == [1, 2, 3])
            for token in tokens:
                token.undeclare()
            await until(lambda: sender._zenoh._sessions._filters.are_served)
            with Bus() as late:
                async with place.link(late, frames=["base"]) as another:
                    await meet(sender, link, another)
                    await publish(4)
                    await until(lambda: late.statistics().frames == 1 and stamps == [1, 2, 3, 4])
                    assert not another._zenoh._sessions._main._unfiltered
            stranger.close()
            assert frames(there) == {"lidar"}
