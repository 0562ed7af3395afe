"""`LocalLink` at the door: its promises beyond those that the tests of the wire hold."""

import asyncio
import gc
import weakref

import anyio
import anyio.lowlevel
import pytest
from support.local_links import files_in
from support.processes import OPEN_FILES, new_domain, until
from support.samples import moving

from tfbus import Buffer, Bus, LocalLink, Transform, TransformBroadcaster
from tfbus.links import BufferServer

pytestmark = pytest.mark.anyio


async def test_a_link_that_hears_a_robot_at_a_rate_of_0_has_its_lookups_and_none_of_its_frames() -> None:
    domain = new_domain()
    with Bus() as robot, Buffer(robot) as frames, Bus() as asker, Buffer(asker) as heard:
        driver = TransformBroadcaster(robot, authority="driver")
        async with LocalLink(robot, domain, robot="r17") as served, BufferServer(frames, served):
            driver.send_static("base_link", "laser", Transform((0.1, 0.0, 0.2)))
            async with LocalLink(asker, domain, robots={"r17": 0.0}, history=1.0) as link:
                driver.send("odom", "base_link", Transform((1.0, 0.0, 0.0)))
                found = await link.lookup("base_link", "laser", robot="r17", timeout=5.0)
                assert found.transform.translation == (0.1, 0.0, 0.2)
                # Another link, of the same age, has all that the robot brings after some signs of life.
                with Bus() as other, Buffer(other) as all_frames:
                    async with LocalLink(other, domain):
                        await until(lambda: "odom" in all_frames.tree.frames())
                assert heard.tree.frames() == []
                assert link.statistics().received_samples == 0


async def test_a_link_tells_also_what_other_links_of_its_bus_have_heard_before_it_began() -> None:
    near, far = new_domain(), new_domain()
    with Bus() as one, Bus() as bridge, Buffer(bridge) as between, Bus() as other, Buffer(other) as beyond:
        sender = TransformBroadcaster(one, authority="driver")
        async with LocalLink(one, near), LocalLink(bridge, near), LocalLink(other, far):
            sender.send("map", "odom", Transform((1.0, 0.0, 0.0)))
            await until(lambda: "odom" in between.tree.frames())
            async with LocalLink(bridge, far):
                await until(lambda: "odom" in beyond.tree.frames())


@pytest.mark.every_loop
async def test_what_is_published_last_arrives_although_the_link_ends_at_once(directory: str) -> None:
    with Bus() as one, Bus() as other, Buffer(other) as heard:
        async with LocalLink(other, directory=directory):
            async with LocalLink(one, directory=directory) as link:
                await until(lambda: bool(link.peers))
                one.publish(moving("map", "base", 1))
            await until(lambda: "base" in heard.tree.frames())


async def enter(link: LocalLink) -> None:
    await link.__aenter__()


@pytest.mark.every_loop
async def test_a_link_that_is_cancelled_while_it_opens_leaves_no_name_and_no_file_open(directory: str) -> None:
    files = len(list(OPEN_FILES.iterdir()))
    with Bus() as bus:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(enter, LocalLink(bus, directory=directory))
            await anyio.lowlevel.checkpoint()
            tasks.cancel_scope.cancel()
        assert files_in(directory) == []
        assert len(list(OPEN_FILES.iterdir())) == files


def test_a_link_that_asyncio_cancels_while_it_opens_leaves_no_name_and_no_file_open(directory: str) -> None:
    async def cancel() -> None:
        files = len(list(OPEN_FILES.iterdir()))
        with Bus() as bus:
            task = asyncio.create_task(enter(LocalLink(bus, directory=directory)))
            await asyncio.sleep(0)
            assert len(files_in(directory)) == 1
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
            assert files_in(directory) == []
            assert len(list(OPEN_FILES.iterdir())) == files

    asyncio.run(cancel())


async def test_a_bus_with_a_link_that_has_ended_is_garbage(directory: str) -> None:
    bus, other = Bus(), Bus()
    gone = weakref.ref(bus)
    async with LocalLink(other, directory=directory) as stays:
        async with LocalLink(bus, directory=directory):
            bus.publish(moving("map", "base", 1))
            await until(lambda: bool(stays.peers))
        del bus
        gc.collect()
        assert gone() is None
