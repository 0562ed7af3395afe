"""Another client of rosbridge, npm's roslib, hears a link."""

from pathlib import Path

import pytest

pytest.importorskip("wsproto", reason='pip install "tfbus[rosbridge]"')

from support.processes import until
from support.rosbridge import install_roslib, rosbridge_server, roslib_client
from support.samples import moving, static

from tfbus import Bus
from tfbus.links.rosbridge import RosbridgeLink

pytestmark = [pytest.mark.thorough, pytest.mark.anyio]


async def test_roslib_hears_what_a_link_publishes(tmp_path: Path) -> None:
    install_roslib(tmp_path)
    async with rosbridge_server() as server, roslib_client(tmp_path, server.url) as heard:
        await until(lambda: sorted(server.operations("subscribe")) == ["/tf", "/tf_static"])
        with Bus() as bus:
            async with RosbridgeLink(bus, server.url):
                bus.publish([moving("map", "base", 1_000_000_005, 1.5), static("base", "lidar", 2.0)])
                await until(lambda: len(heard) == 2)
    said = {fact["topic"]: fact["transforms"][0] for fact in heard}
    assert {topic: row["child_frame_id"] for topic, row in said.items()} == {"/tf": "base", "/tf_static": "lidar"}
    assert said["/tf"]["header"]["frame_id"] == "map"
    assert said["/tf"]["header"]["stamp"] == {"secs": 1, "nsecs": 5}
    assert said["/tf"]["transform"]["translation"] == {"x": 1.5, "y": 0.0, "z": 0.0}
    assert said["/tf"]["transform"]["rotation"] == {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    assert said["/tf_static"]["transform"]["translation"]["x"] == 2.0
