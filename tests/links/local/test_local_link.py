"""`LocalLink` at the door: its promises beyond those that the tests of the wire hold."""

import pytest
from support.processes import new_domain, until

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
