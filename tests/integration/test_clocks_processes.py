"""Clocks of processes that differ: they are told within seconds, corrected to a millimetre, and never mixed up."""

import json
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from pathlib import Path

import anyio
import pytest
from support.processes import free_address, new_domain

from tfbus import Buffer, Bus, ClockOffset, PeerClockStepped, PeerJoined, TransformLookupError
from tfbus.bus.event_stream import EventStream
from tfbus.links import DomainLink

zenoh_rooms = pytest.importorskip("tfbus.links.zenoh", reason='pip install "tfbus[zenoh]"')
pytestmark = [pytest.mark.thorough, pytest.mark.anyio]


@pytest.fixture
def anyio_backend() -> str:
    """One event loop: links do not depend on it, and these tests take real seconds."""
    return "asyncio"


CHILD = Path(__file__).parents[1] / "support" / "clock_process.py"
SOON = 5.0


@contextmanager
def process(
    *links: dict[str, str], ahead: float = 0.0, drift: float = 0.0, frame: str = "cart"
) -> Iterator[Callable[[float], None]]:
    """Run a process; the result sets its clock by so many s."""
    setup = json.dumps({"links": links, "ahead": ahead, "drift": drift, "frame": frame})
    with subprocess.Popen((sys.executable, CHILD, setup), stdin=subprocess.PIPE, text=True) as child:
        assert child.stdin is not None
        yield lambda step: print(step, file=child.stdin, flush=True)
        child.stdin.close()


class Switch:
    """Passes on the bytes between a router and its client, some s later, in each direction another time."""

    def __init__(self, to: str, there: float, back: float) -> None:
        self.address = free_address()
        self._to = to
        self._delays = there, back

    async def run(self) -> None:
        (_, port), (_, behind) = (address.removeprefix("tcp/").split(":") for address in (self.address, self._to))

        async def take(near: anyio.abc.SocketStream) -> None:
            async with (
                near,
                await anyio.connect_tcp("127.0.0.1", int(behind)) as far,
                anyio.create_task_group() as tasks,
            ):
                tasks.start_soon(self._pass_on, near, far, self._delays[0])
                tasks.start_soon(self._pass_on, far, near, self._delays[1])

        async with await anyio.create_tcp_listener(local_host="127.0.0.1", local_port=int(port)) as listener:
            await listener.serve(take)

    async def _pass_on(self, source: anyio.abc.SocketStream, sink: anyio.abc.SocketStream, delay: float) -> None:
        put, get = anyio.create_memory_object_stream[tuple[float, bytes]](10_000)

        async def deliver() -> None:
            async for due, data in get:
                await anyio.sleep_until(due)
                await sink.send(data)

        with put, get, suppress(anyio.BrokenResourceError, anyio.ClosedResourceError):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(deliver)
                async for data in source:
                    await put.send((anyio.current_time() + delay, data))


@asynccontextmanager
async def switch(to: str, there: float, back: float) -> AsyncIterator[str]:
    way = Switch(to, there, back)
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(way.run)
        yield way.address
        tasks.cancel_scope.cancel()


async def wait_for(events: EventStream, kind: type) -> object:
    with anyio.fail_after(SOON + 15.0 * (kind is PeerJoined)):
        async for event in events:
            if isinstance(event, kind):
                return event
    raise AssertionError(kind)


async def measured(link: DomainLink) -> None:
    """Wait for an exchange of which half is no millimetre at 1 m/s; the machine may be busy."""
    for _ in range(120):
        if any((clock.delay or 1.0) < 0.0008 for clock in link.statistics().clocks):
            break
        await anyio.sleep(0.5)
    # Stamps move slowly to a better offset.
    await anyio.sleep(3.0)


async def wrong_by(buffer: Buffer, frame: str) -> float:
    """The greatest error of some answers of the last second, in m."""
    worst = 0.0
    for _ in range(20):
        await anyio.sleep(0.05)
        now = time.time_ns()
        for back in range(100_000_000, 900_000_000, 37_000_000):
            at = now - back
            x = (await buffer.lookup("map", frame, at, timeout=5.0)).transform.translation[0]
            worst = max(worst, abs(x - at % 10**12 / 1e9))
    return worst


@pytest.mark.parametrize(
    ("ahead", "drift"), [(0.02, 0.0), (-0.02, 0.0), (0.3, 0.0), (-0.3, 0.0), (3600.0, 0.0), (0.1, 100e-6)]
)
async def test_a_clock_that_differs_is_told_and_corrected_to_a_millimetre(ahead: float, drift: float) -> None:
    domain, address = new_domain(), free_address()
    with Bus() as bus, Buffer(bus) as buffer, bus.events(capacity=100_000) as events:
        link = zenoh_rooms.ZenohLink(bus, domain, listen=address, correct_clocks=True, max_offset=0.01)
        async with link:
            with process({"domain": domain, "connect": address}, ahead=ahead, drift=drift):
                await wait_for(events, PeerJoined)
                told = await wait_for(events, ClockOffset)
                assert isinstance(told, ClockOffset)
                assert abs(told.offset - ahead) <= told.bound + 100 * drift
                await measured(link)
                assert await wrong_by(buffer, "cart") < 0.001
                (clock,) = link.statistics().clocks
                assert clock.offset is not None
                assert clock.bound is not None
                assert abs(clock.offset - ahead) <= clock.bound + 100 * drift


async def test_a_far_clock_is_corrected_by_the_sum_along_the_way() -> None:
    near, far = new_domain(), new_domain()
    here, there = free_address(), free_address()
    with Bus() as bus, Buffer(bus) as buffer, bus.events(capacity=100_000) as events:
        async with zenoh_rooms.ZenohLink(bus, near, listen=here, correct_clocks=True) as link:
            bridge = {"domain": near, "connect": here}, {"domain": far, "listen": there}
            with (
                process(*bridge, ahead=-0.3, frame="near"),
                process({"domain": far, "connect": there}, ahead=40.0, frame="far"),
            ):
                await wait_for(events, PeerJoined)
                await anyio.sleep(8.0)
                await measured(link)
                assert await wrong_by(buffer, "near") < 0.001
                # Two measurements, each as good as the first.
                assert await wrong_by(buffer, "far") < 0.002


@pytest.mark.parametrize("ahead", [0.0, 0.3])
async def test_the_true_offset_is_within_the_bound_where_the_two_directions_differ(ahead: float) -> None:
    domain, address = new_domain(), free_address()
    with Bus() as bus, bus.events(capacity=100_000) as events:
        async with zenoh_rooms.ZenohLink(bus, domain, listen=address) as link, switch(address, 0.005, 0.05) as way:
            with process({"domain": domain, "connect": way}, ahead=ahead):
                await wait_for(events, PeerJoined)
                seen = 0
                for _ in range(200):
                    await anyio.sleep(0.05)
                    (clock,) = link.statistics().clocks
                    if clock.offset is not None and clock.bound is not None:
                        seen += 1
                        assert abs(clock.offset - ahead) <= clock.bound
                assert seen > 50
                # The estimate is half the difference of the two directions off.
                assert clock.offset is not None
                assert abs(clock.offset - ahead) > 0.01
    told = [event for event in iter(events.queue.get, None) if isinstance(event, ClockOffset)]
    assert bool(told) == bool(ahead)


@pytest.mark.parametrize("step", [1.0, -1.0])
@pytest.mark.parametrize("corrects", [False, True])
async def test_a_step_is_noticed_and_no_answer_is_between_samples_of_both_sides(step: float, corrects: bool) -> None:
    domain, address = new_domain(), free_address()
    with Bus() as bus, Buffer(bus) as buffer, bus.events(capacity=100_000) as events:
        async with zenoh_rooms.ZenohLink(bus, domain, listen=address, correct_clocks=corrects):
            with (
                process({"domain": domain, "connect": address}) as set_clock,
                process({"domain": domain, "connect": address}, frame="other"),
            ):
                await wait_for(events, PeerJoined)
                await anyio.sleep(5.0)
                set_clock(step)
                stepped = await wait_for(events, PeerClockStepped)
                assert isinstance(stepped, PeerClockStepped)
                assert stepped.step == pytest.approx(step, abs=0.01)
                assert stepped.frames == ("cart",)
                spans = {edge.child: (edge.oldest or 0, edge.newest or 0) for edge in buffer.tree.edges()}
                # The samples of the other process from before the step are still there.
                assert spans["other"][1] - spans["other"][0] > 2 * 10**9
                answers = 0
                for _ in range(30):
                    await anyio.sleep(0.05)
                    now = bus.clock.now() + round((0.0 if corrects else step) * 1e9)
                    for at in range(now - 2 * 10**9, now, 33_000_000):
                        try:
                            x = buffer.lookup_nowait("map", "cart", at).transform.translation[0]
                        except TransformLookupError:
                            continue
                        answers += 1
                        true = at - round((0.0 if corrects else step) * 1e9)
                        assert abs(x - true % 10**12 / 1e9) < 0.002
                assert answers > 100
