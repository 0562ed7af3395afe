import json
import os

import anyio
import anyio.to_thread
import pytest
from support.processes import PATIENCE, free_address, new_domain, start_tfbus, until
from support.samples import latched, moving, static

from tfbus import Buffer, Bus, LocalLink
from tfbus.links.ros.messages import as_mapping


@pytest.mark.thorough
@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_frames_pass_from_ros_to_a_domain_and_back(backend: str) -> None:
    pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')
    number = 100 + os.getpid() % 100
    ros, domain = ("--ros", f"dds:{number}"), ("--domain", new_domain())
    with start_tfbus("bridge", domain[1], ros[1], "--backend", backend) as bridge:
        assert bridge.errors.expect("passing on").endswith(f"and ROS at dds:{number}, until Ctrl-C")
        with (
            start_tfbus("static", "base", "laser", "--xyz", "1", "2", "3", *ros),
            start_tfbus("static", "map", "base", "--xyz", "1", "0", "0", *domain),
            start_tfbus("echo", "map", "laser", *domain) as here,
            start_tfbus("echo", "map", "laser", *ros) as there,
        ):
            for echo in (here, there):
                assert echo.output.expect("Translation") == "- Translation: [2.000000, 2.000000, 3.000000] m"
        assert bridge.end() == 130


@pytest.mark.thorough
@pytest.mark.anyio
async def test_a_bridge_between_rosbridge_and_rmw_zenoh_tells_what_is_refused_and_comes_back() -> None:
    pytest.importorskip("wsproto", reason='pip install "tfbus[rosbridge]"')
    pytest.importorskip("zenoh", reason='pip install "tfbus[zenoh]"')
    from support.rosbridge import rosbridge_server

    from tfbus.links.rmw_zenoh import RmwZenohLink
    from tfbus.links.zenoh import ZenohRouter

    address = free_address()
    async with rosbridge_server() as server, ZenohRouter(address):
        server.latched["/tf_static"] = (static("map", "lidar", 2.0, 3),)
        place = f"zenoh:{address.removeprefix('tcp/')}"
        words = ("bridge", server.url, place, "--odometry", "/odom")
        with Bus() as bus, Buffer(bus) as buffer, start_tfbus(*words) as bridge:
            await anyio.to_thread.run_sync(bridge.errors.expect, "passing on")
            async with RmwZenohLink(bus, address):
                await until(lambda: "lidar" in latched(bus))
                bus.publish(static("map", "camera", 1.0, 4))
                await until(lambda: "/tf_static" in server.operations("publish"))
                row = as_mapping(moving("odom", "cart", 5))
                pose = {"position": row["transform"]["translation"], "orientation": row["transform"]["rotation"]}
                odometry = {"op": "publish", "topic": "/odom", "msg": {**row, "pose": {"pose": pose}}}
                while not buffer.can_transform("odom", "cart"):
                    await server.say_anything(json.dumps(odometry))
                    await anyio.sleep(0.02)
                for _ in range(2):
                    await server.say_anything("nonsense")
                told = await anyio.to_thread.run_sync(bridge.errors.expect, "refused what peer")
                assert told.endswith(
                    "it is neither JSON nor CBOR: JSONDecodeError('Expecting value: line 1 column 1 (char 0)')"
                )
                # The server goes, and comes back with another static frame.
                server.latched["/tf_static"] = (static("map", "radar", 2.0, 3),)
                await server.cut()
                await anyio.to_thread.run_sync(bridge.errors.expect, "the connection is gone")
                await until(lambda: "radar" in latched(bus))
                await until(lambda: server.operations("publish").count("/tf_static") == 2)
                stamp = 0
                while not buffer.can_transform("map", "base"):
                    await server.say(moving("map", "base", stamp := stamp + 1))
                    await anyio.sleep(0.02)
            assert await anyio.to_thread.run_sync(bridge.end) == 130
            assert bridge.errors.text.count("refused what peer") == 1


@pytest.mark.anyio
@pytest.mark.parametrize("names", [("yard", "yard"), pytest.param(("yard", "hall"), marks=pytest.mark.thorough)])
async def test_frames_pass_between_a_domain_of_this_machine_and_a_router_and_between_two_behind_it(
    names: tuple[str, str],
) -> None:
    pytest.importorskip("zenoh", reason='pip install "tfbus[zenoh]"')
    from tfbus.links.zenoh import ZenohLink

    unique = new_domain()
    first, second = (f"{unique}-{name}" for name in names)
    address = free_address()
    with start_tfbus("bridge", first, second, "--listen", address) as bridge, Bus() as here, Bus() as there:
        await anyio.to_thread.run_sync(bridge.errors.expect, "passing on")
        near = LocalLink(here, first) if first == second else ZenohLink(here, first, connect=address)
        async with near, ZenohLink(there, second, connect=address):
            with Buffer(here) as buffer, Buffer(there) as other, anyio.fail_after(PATIENCE):
                here.publish(static("map", "base", 1.0))
                there.publish(static("base", "laser", 2.0))
                for each in (buffer, other):
                    found = await each.lookup("map", "laser")
                    assert found.transform.translation == (3.0, 0.0, 0.0)
        assert await anyio.to_thread.run_sync(bridge.end) == 130
