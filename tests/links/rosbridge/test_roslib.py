"""Npm's roslib and ros3d, as they are, at a server of ours: in node, and in a browser."""

import math
import re
import shutil
import subprocess
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("wsproto", reason='pip install "tfbus[rosbridge]"')

import anyio
import anyio.to_thread
from support.processes import free_ports, until
from support.rosbridge import install_roslib, roslib_client
from support.samples import static

from tfbus import Buffer, Bus, Transform, TransformStamped
from tfbus.links.rosbridge import RosbridgeServer

pytestmark = [
    pytest.mark.anyio,
    pytest.mark.thorough,
    pytest.mark.parametrize("anyio_backend", ["asyncio"]),
]

ROOT = Path(__file__).parents[3]
HALF_TURN = Transform.from_axis_angle((0.0, 0.0, 1.0), math.pi, (1.0, 0.0, 0.0))
"""Of the base in the map; the laser is 2 m ahead of the base, so at x = -1 m."""


def robot() -> tuple[TransformStamped, ...]:
    return TransformStamped("map", "base", 5, HALF_TURN), static("base", "laser", 2.0)


@pytest.fixture(scope="module")
def roslib(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Gives a folder with some packages of npm."""
    folders: dict[tuple[str, ...], Path] = {}

    def folder_with(*packages: str) -> Path:
        if packages not in folders:
            folders[packages] = tmp_path_factory.mktemp("npm")
            install_roslib(folders[packages], *packages)
        return folders[packages]

    return folder_with


@pytest.mark.parametrize(
    ("package", "client"),
    [("roslib@1", "action"), ("roslib@1", "service"), ("roslib@2", "TFClient"), ("roslib@2", "ROS2TFClient")],
)
async def test_each_tf_client_of_roslib_gets_the_frames_that_it_asks_for(
    roslib: Callable[..., Path], package: str, client: str
) -> None:
    with Bus() as bus:
        async with RosbridgeServer(bus, 0) as server:
            async with roslib_client(roslib(package), server.address, client) as heard:
                bus.publish(robot())
                wanted = {"base", "laser", "/tf_static"}
                await until(lambda: wanted <= {each.get("frame", each.get("topic")) for each in heard})
            assert server.requests_refused == 0
    places = {each["frame"]: each["transform"]["translation"] for each in heard if "frame" in each}
    assert places["base"] == {"x": 1.0, "y": 0.0, "z": 0.0}
    assert places["laser"] == pytest.approx({"x": -1.0, "y": 0.0, "z": 0.0})


# A browser

SCENE = """<!doctype html>
<script src="https://packages.test/eventemitter2/lib/eventemitter2.js"></script>
<script src="https://packages.test/roslib/build/roslib.js"></script>
<script src="https://packages.test/ros3d/build/ros3d.js"></script>
<div id="scene"></div>
<script>
  const ros = new ROSLIB.Ros({ url: `ws://${location.host}` });
  const tfClient = new ROSLIB.TFClient({ ros, fixedFrame: "map", angularThres: 0.01, transThres: 0.01 });
  const rootObject = new ROS3D.SceneNode({ frameID: "laser", tfClient, object: new ROS3D.Axes({}) });
</script>
"""


@asynccontextmanager
async def page_in_browser(packages: Path) -> AsyncIterator[Callable[[Callable[[Any], Any]], Any]]:
    """Runs steps with a page of chromium, in a thread; what it would load from the network comes from a folder."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="a real browser needs playwright")
    path = shutil.which("chromium") or pytest.skip("there is no chromium")

    def load(route: Any) -> None:
        found = re.fullmatch(
            r"https://(?:packages\.test|cdn\.jsdelivr\.net/npm)/(\w+)(?:@[\d.]+)?/(.*)", route.request.url
        )
        assert found, route.request.url
        route.fulfill(
            path=packages / "node_modules" / found[1] / found[2], headers={"Access-Control-Allow-Origin": "*"}
        )

    def run(steps: Callable[[Any], Any]) -> Any:
        with sync_api.sync_playwright() as player:
            browser = player.chromium.launch(executable_path=path, args=["--no-sandbox", "--use-gl=swiftshader"])
            try:
                page = browser.new_page()
                page.route(re.compile("^https:"), load)
                return steps(page)
            finally:
                browser.close()

    async def run_in_thread(steps: Callable[[Any], Any]) -> Any:
        return await anyio.to_thread.run_sync(run, steps)

    yield run_in_thread


async def test_a_scene_of_ros3d_moves_with_its_frame(roslib: Callable[..., Path]) -> None:
    packages = roslib("roslib@1", "ros3d@1")
    with Bus() as bus, Buffer(bus) as buffer:
        bus.publish(robot())
        async with (
            RosbridgeServer(bus, 0, buffer=buffer, page=SCENE) as server,
            page_in_browser(packages) as in_browser,
        ):

            def place(page: Any) -> Any:
                page.goto(server.address.replace("ws:", "http:"))
                page.wait_for_function("rootObject.visible", timeout=60_000)
                return page.evaluate("[...rootObject.position.toArray(), rootObject.quaternion.z]")

            assert await in_browser(place) == pytest.approx([-1.0, 0.0, 0.0, 1.0])


async def test_the_demo_follows_its_robot_and_goes_on_when_the_server_is_back(roslib: Callable[..., Path]) -> None:
    packages = roslib("roslib@1", "ros3d@1")
    (port,) = free_ports(1)

    @contextmanager
    def demo() -> Iterator[None]:
        command = [sys.executable, str(ROOT / "demos" / "tf_in_page.py"), str(port)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == f"http://127.0.0.1:{port}\n"
            try:
                yield
            finally:
                process.terminate()

    async with page_in_browser(packages) as in_browser:

        def steps(page: Any) -> list[str]:
            found = []
            for attempt in range(2):
                with demo():
                    if not attempt:
                        page.goto(f"http://127.0.0.1:{port}")
                    page.wait_for_function("element('laser').textContent.includes('.')", timeout=60_000)
                    found.append(page.inner_text("#laser"))
                page.wait_for_function("element('state').textContent == 'lost'", timeout=60_000)
                page.evaluate("element('laser').textContent = ''")
            return found

        for text in await in_browser(steps):
            x, y, z = map(float, text.split(", "))
            # The laser is 0.1 m ahead on the tangent of the circle of 1 m.
            assert (math.hypot(x, y), z) == pytest.approx((math.hypot(1.0, 0.1), 0.2), abs=2e-3)
