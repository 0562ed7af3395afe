"""`ZenohLink` at the door: its promises beyond those that the tests of the wire hold."""

import gc
import threading
import weakref

import pytest
from support.processes import until

from tfbus import Bus, Transform, TransformBroadcaster
from tfbus.links.zenoh import ZenohLink, ZenohRouter

pytestmark = pytest.mark.anyio


async def test_links_that_have_ended_are_freed_with_their_threads(address: str, domain: str) -> None:
    ended: weakref.WeakSet[object] = weakref.WeakSet()

    async def join_for_a_moment(number: int) -> None:
        with Bus() as bus:
            TransformBroadcaster(bus).send_static("map", f"{number}", Transform())
            async with ZenohLink(bus, domain, connect=address) as link:
                ended.update((bus, link))
                await until(lambda: bool(link.peers and stays.peers))
            await until(lambda: not stays.peers)

    with Bus() as own:
        async with ZenohRouter(address), ZenohLink(own, domain, connect=address) as stays:
            # The objects that all links share exist now.
            await join_for_a_moment(0)
            threads = threading.active_count()
            for number in range(1, 5):
                await join_for_a_moment(number)
            gc.collect()
            assert len(ended) == 0
            assert threading.active_count() <= threads
            assert own.statistics().frames == 5
