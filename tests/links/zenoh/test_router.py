import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest
from support.processes import free_address, until
from support.samples import moving, static
from support.wires import latched

from tfbus import Bus
from tfbus.links.zenoh import ZenohLink, ZenohRouter

# A moving sample is kept for nobody, so each test waits until the other end is there before it publishes one.
pytestmark = pytest.mark.anyio

CLIENT = {"mode": "client"}


@asynccontextmanager
async def client(bus: Bus, domain: str, address: str, **options: Any) -> AsyncIterator[ZenohLink]:
    async with ZenohLink(bus, domain, connect=address, config=CLIENT, **options) as link:
        yield link


async def test_clients_behind_a_router_hear_each_other_and_late_ones_have_everything(address: str, domain: str) -> None:
    with Bus() as one, Bus() as two, Bus() as late:
        async with ZenohRouter(address), client(one, domain, address) as link, client(two, domain, address):
            await until(lambda: len(link.peers) == 1)
            one.publish([static("map", "lidar"), static("map", "camera"), moving("map", "base", 1)])
            await until(lambda: two.statistics().frames == 3)
            two.remove_frame("camera")
            await until(lambda: one.statistics().frames == 2)
            async with client(late, domain, address):
                await until(lambda: set(latched(late)) == {"lidar"} and len(link.peers) == 2)
                one.publish(moving("map", "base", 2))
                await until(lambda: late.statistics().frames == 2)


async def test_clients_of_routers_that_are_connected_hear_each_other(address: str, domain: str) -> None:
    other = free_address()
    with Bus() as one, Bus() as two:
        async with (
            ZenohRouter(address),
            ZenohRouter(other, connect=address),
            client(one, domain, address) as link,
            client(two, domain, other),
        ):
            await until(lambda: len(link.peers) == 1)
            one.publish(static("map", "lidar"))
            await until(lambda: set(latched(two)) == {"lidar"})


@pytest.mark.thorough
async def test_a_router_is_not_taken_for_a_link_that_has_not_been_met(address: str, domain: str) -> None:
    with Bus() as bus:
        async with ZenohRouter(address), client(bus, domain, address) as link:
            unmet = link._zenoh._sessions._unmet
            await until(lambda: len(unmet._routers) == 1)
            assert unmet._looks == {}


async def test_the_frames_of_a_client_that_ends_leave_behind_a_router(address: str, domain: str) -> None:
    with Bus() as here, Bus() as there:
        async with ZenohRouter(address), client(here, domain, address, drop_lost=True) as link:
            async with client(there, domain, address) as other:
                await until(lambda: len(other.peers) == 1)
                there.publish([static("map", "lidar"), moving("map", "base", 1)])
                await until(lambda: here.statistics().frames == 2)
            await until(lambda: here.statistics().frames == 0)
            assert link.peers == ()


async def test_links_of_some_robots_know_and_hear_only_those(address: str, domain: str) -> None:
    with Bus() as dashboard, Bus() as other:
        buses = {name: Bus() for name in ("r1", "r2", "x1")}
        async with (
            ZenohRouter(address),
            client(dashboard, domain, address, robots=["r*"]) as seeing,
            client(other, domain, address) as everything,
            client(buses["r1"], domain, address, robot="r1") as first,
            client(buses["r2"], domain, address, robot="r2", robots=[]) as second,
            client(buses["x1"], domain, address, robot="x1") as third,
        ):
            await until(lambda: all(len(link.peers) == 4 for link in (first, third, everything)))
            for name, bus in buses.items():
                bus.publish([static("map", f"{name}/lidar"), moving("map", f"{name}/base", 1)])
            await until(lambda: other.statistics().frames == 6)
            await until(lambda: dashboard.statistics().frames == 4)
            assert seeing.peers == tuple(sorted((first.id, second.id)))
            assert len(everything.peers) == 4
            assert (first.robot, seeing.robot) == ("r1", None)
            assert second.peers == (), "a link that hears nobody is heard all the same"
            assert buses["r2"].statistics().frames == 2
            assert set(latched(dashboard)) == {"r1/lidar", "r2/lidar"}
            before = seeing.statistics().received_messages
            buses["x1"].publish(moving("map", "x1/base", 2))
            buses["r1"].publish(moving("map", "r1/base", 2))
            await until(lambda: seeing.statistics().received_messages > before)
            assert dashboard.statistics().frames == 4
        for bus in buses.values():
            bus.close()


async def test_of_robots_with_a_rate_come_the_newest_samples_now_and_then_and_all_static_frames(
    address: str, domain: str
) -> None:
    with Bus() as dashboard, Bus() as quick, Bus() as slow:
        heard: list[int] = []
        dashboard.subscribe(lambda batch: heard.extend(s.stamp for s in batch if s.child == "slow/base"))
        async with (
            ZenohRouter(address),
            client(quick, domain, address, robot="quick") as first,
            client(slow, domain, address, robot="slow", slow_rate=20.0) as second,
        ):
            slow.publish([static("map", "slow/lidar"), static("map", "slow/camera")])
            robots = {"quick": math.inf, "s*": 20.0}
            async with client(dashboard, domain, address, robots=robots) as link:
                await until(lambda: link.peers == tuple(sorted((first.id, second.id))))
                await until(lambda: link.id in first.peers and link.id in second.peers)
                await until(lambda: set(latched(dashboard)) == {"slow/lidar", "slow/camera"})
                for stamp in range(100):
                    slow.publish(moving("map", "slow/base", stamp))
                    quick.publish(moving("map", "quick/base", stamp))
                await until(lambda: heard == [99])
                await until(lambda: link.statistics().received_samples >= 103)
                # What is said beside the moving samples comes by questions.
                slow.remove_frame("slow/camera")
                await until(lambda: set(latched(dashboard)) == {"slow/lidar"})
                slow.publish(static("map", "slow/arm"))
                await until(lambda: set(latched(dashboard)) == {"slow/lidar", "slow/arm"})
                assert heard == [99]


async def test_an_address_in_use_is_an_os_error_and_a_router_is_entered_once(address: str) -> None:
    router = ZenohRouter(address)
    async with router:
        with pytest.raises(OSError, match="cannot open a session"):
            async with ZenohRouter(address):
                raise AssertionError("it has opened")
        with pytest.raises(RuntimeError, match="entered once"):
            await router.__aenter__()
        assert router._close_at_exit.alive
    assert not router._close_at_exit.alive
    async with ZenohRouter(address):
        pass


async def test_what_makes_no_sense_is_refused_at_once() -> None:
    with pytest.raises(ValueError, match="garbage"):
        ZenohRouter("garbage")
    with pytest.raises(ValueError, match="'no'"):
        ZenohRouter(config={"no": 1})
    with Bus() as bus:
        with pytest.raises(TypeError, match="'r1'"):
            ZenohLink(bus, robots="r1")
        with pytest.raises(ValueError, match="robot"):
            ZenohLink(bus, robot="a/b")
        with pytest.raises(ValueError, match="robot"):
            ZenohLink(bus, robots=["a/b"])
        for rate in (0.0, -1.0, math.nan):
            with pytest.raises(ValueError, match="rate"):
                ZenohLink(bus, robots={"r1": rate})
            with pytest.raises(ValueError, match="rate"):
                ZenohLink(bus, slow_rate=rate)
        with pytest.raises(ValueError, match="slow_rate"):
            ZenohLink(bus, slow_rate=math.inf)
