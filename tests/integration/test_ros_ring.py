"""Three buses in a ring: one network joins the first two, another the second two, a third the last to the first.

`tests/stress/test_foreign_storms.py` has such rings in simulated time.
"""

from collections import Counter
from contextlib import AsyncExitStack
from typing import Any

import anyio
import pytest

pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')
pytest.importorskip("wsproto", reason='pip install "tfbus[rosbridge]"')
pytest.importorskip("zenoh", reason='pip install "tfbus[zenoh]"')

from support.processes import free_address, new_dds_domain, new_domain, until
from support.rosbridge import rosbridge_server
from support.samples import latched, moving, static

from tfbus import Bus, LocalLink
from tfbus.geometry.stamped import Batch
from tfbus.links.dds import DdsLink
from tfbus.links.rosbridge import RosbridgeLink
from tfbus.links.zenoh import ZenohLink

pytestmark = [pytest.mark.thorough, pytest.mark.anyio]

STAMPS = 100
CHILDREN = ("ros1", "ros2", "first", "second", "third")


@pytest.fixture
def domain_number() -> int:
    return new_dds_domain()


def buses_in(stack: AsyncExitStack) -> tuple[list[Bus], list[Counter[tuple[str, int]]]]:
    """Three buses, and how often each has heard each sample that is not static."""
    buses = [stack.enter_context(Bus()) for _ in range(3)]
    heard: list[Counter[tuple[str, int]]] = [Counter() for _ in buses]
    for bus, counter in zip(buses, heard, strict=True):

        def count(batch: Batch, counter: Counter[tuple[str, int]] = counter) -> None:
            counter.update((sample.child, sample.stamp) for sample in batch if not sample.static)

        bus.subscribe(count)
    return buses, heard


async def test_a_ring_of_rosbridge_dds_and_zenoh_hears_each_sample_once(domain_number: int) -> None:
    address, domain = free_address(), new_domain()
    async with rosbridge_server() as ros1, AsyncExitStack() as stack:
        # A program in ROS 2 is a bus of its own.
        ros2 = stack.enter_context(Bus())
        buses, heard = buses_in(stack)
        first, second, third = buses
        links: list[Any] = [
            await stack.enter_async_context(link)
            for link in (
                RosbridgeLink(first, ros1.url),
                RosbridgeLink(second, ros1.url),
                DdsLink(second, domain_number),
                DdsLink(third, domain_number),
                DdsLink(ros2, domain_number),
                ZenohLink(third, domain, listen=address),
                ZenohLink(first, domain, connect=address),
            )
        ]
        await until(lambda: all(link.peers for link in links))
        await until(lambda: all(len(link.peers) == 2 for link in links[2:5]))
        await until(lambda: all(len(client.subscriptions) == 2 for client in ros1.clients))
        for stamp in range(STAMPS):
            await ros1.say(moving("map", "ros1", stamp))
            ros2.publish(moving("map", "ros2", stamp))
            for bus, child in zip(buses, ("first", "second", "third"), strict=True):
                bus.publish(moving("map", child, stamp))
            await anyio.sleep(0.005)
        await ros1.say(static("map", "lidar", 1.0), topic="/tf_static")
        await until(lambda: all("lidar" in latched(bus) for bus in (*buses, ros2)))
        everything = Counter({(child, stamp): 1 for child in CHILDREN for stamp in range(STAMPS)})
        await until(lambda: all(counter.total() >= everything.total() for counter in heard))
        # A sample that still goes round arrives before one that is sent now has gone round.
        for stamp in range(STAMPS, STAMPS + 5):
            first.publish(moving("map", "first", stamp))
            everything["first", stamp] = 1
            await until(lambda stamp=stamp: all(counter["first", stamp] for counter in heard))  # type: ignore[misc]
        assert heard == [everything] * 3
        assert [link.statistics().rejected for link in links] == [{}] * len(links)


async def test_a_ring_of_local_links_dds_and_a_router_hears_each_sample_once_and_keeps_its_authority(
    domain_number: int,
) -> None:
    address, domain = free_address(), new_domain()
    async with AsyncExitStack() as stack:
        buses, heard = buses_in(stack)
        first, second, third = buses
        authorities: set[tuple[str, str]] = set()
        first.subscribe(lambda batch: authorities.update((sample.child, sample.authority) for sample in batch))
        links: list[Any] = [
            await stack.enter_async_context(link)
            for link in (
                LocalLink(first, domain),
                LocalLink(second, domain),
                DdsLink(second, domain_number),
                DdsLink(third, domain_number),
                ZenohLink(third, domain, listen=address),
                ZenohLink(first, domain, connect=address),
            )
        ]
        await until(lambda: all(len(link.peers) == 1 for link in links))
        for stamp in range(STAMPS):
            for bus, child in zip(buses, ("first", "second", "third"), strict=True):
                bus.publish(moving("map", child, stamp, authority=f"node of {child}"))
            await anyio.sleep(0.005)
        second.publish(static("map", "lidar", 1.0, authority="node of second"))
        await until(lambda: all("lidar" in latched(bus) for bus in buses))
        everything = Counter({(child, stamp): 1 for child in ("first", "second", "third") for stamp in range(STAMPS)})
        await until(lambda: all(counter.total() >= everything.total() for counter in heard))
        # Samples that still go round arrive before a sign of life of each link.
        await anyio.sleep(2.5)
        assert heard == [everything] * 3
        # DDS tells its writer instead, and may be the faster way for some of them.
        assert {(child, f"node of {child}") for child in ("first", "second", "third")} <= authorities
        assert [link.statistics().rejected for link in links] == [{}] * len(links)
        sent = [link.statistics().sent_samples for link in links]
        await anyio.sleep(1.0)
        assert [link.statistics().sent_samples for link in links] == sent
        assert max(sent) <= everything.total() + 3
