"""Links against a real ROS 2: rclpy, its middleware and tf2_ros, in a process of their own.

The variable ``ROS2_PYTHON`` names a Python with rclpy and tf2_ros, such as ``/usr/bin/python3`` after
``source /opt/ros/kilted/setup.bash``; without it, that Python is looked for as ``python3`` in a sourced ROS 2. The
variable ``ROSBRIDGE`` is a command that serves a rosbridge at the port that is its last argument.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AbstractContextManager, asynccontextmanager, contextmanager
from functools import partial
from pathlib import Path

import anyio
import pytest
from anyio.streams.buffered import BufferedByteReceiveStream
from support.both_sides import (
    SECONDS,
    URDF,
    Node,
    Program,
    check_clock,
    check_command,
    check_description_and_joints,
    check_killed_node,
    check_link_that_came_back,
    meet,
    node,
)
from support.processes import free_ports, new_dds_domain, on_one_loop
from support.recorded import SMALL

from tfbus import Buffer, Bus, PointStamped, Synchronizer
from tfbus.links.ros import RosLink
from tfbus.recording import load

pytestmark = [pytest.mark.thorough, pytest.mark.anyio]

PEER = Path(__file__).parents[1] / "support" / "ros2_peer.py"
WATCHER = PEER.with_name("ros2_watcher.py")
ROBOT = PEER.with_name("ros2_robot.py")
CYCLONE_PEER = PEER.with_name("cyclone_peer.py")


def ros2_python(further: str = "") -> str:
    """A Python that has what the tests' nodes of ROS 2 import; skips the test if there is none."""
    python = os.environ.get("ROS2_PYTHON") or shutil.which("python3")
    needed = "import rclpy, tf2_ros, geometry_msgs.msg, rosgraph_msgs.msg, sensor_msgs.msg, std_msgs.msg, tf2_msgs.msg"
    if python is None or subprocess.run([python, "-c", needed + further], capture_output=True).returncode:
        pytest.skip("no ROS 2: set ROS2_PYTHON to a Python with rclpy, tf2_ros, and the messages of common_interfaces")
    return python


def environment(domain: int) -> dict[str, str]:
    return {"ROS_DOMAIN_ID": f"{domain}", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


def peer(domain: int, seconds: float = SECONDS, x: float = 0.5) -> AbstractContextManager[Node]:
    """A node of ROS 2 with rclpy, ``/driver``."""
    return node([ros2_python(), str(PEER)], environment(domain), seconds, x)


def cyclone_peer(domain: int, seconds: float = SECONDS, x: float = 0.5) -> AbstractContextManager[Node]:
    """A node of ROS 2 with Cyclone DDS, ``/cyclone``, which needs no ROS."""
    from tfbus.links.dds.dds_link import configuration

    # As on a robot with both kinds, which Cyclone DDS has to be told of.
    settings = {**environment(domain), "CYCLONEDDS_URI": configuration("localhost", (), None)}
    return node([sys.executable, str(CYCLONE_PEER)], settings, seconds, x)


@contextmanager
def rosbridge(domain: int) -> Iterator[str]:
    """The URL of a rosbridge of ROS 2; skips the test if there is none."""
    command = os.environ.get("ROSBRIDGE")
    if not command:
        pytest.skip("no rosbridge: set ROSBRIDGE to a command that serves one at the port that is its last argument")
    (port,) = free_ports(1)
    variables = {**os.environ, **environment(domain)}
    process = subprocess.Popen(
        [*shlex.split(command), str(port)], env=variables, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        yield f"ws://127.0.0.1:{port}"
    finally:
        process.terminate()
        process.wait()


async def answering(url: str) -> None:
    """Wait until a rosbridge answers."""
    from tfbus.links.rosbridge import RosbridgeLink

    with anyio.fail_after(30), Bus() as bus:
        while True:
            try:
                async with RosbridgeLink(bus, url, send=False, tf="/none", tf_static="/none_static"):
                    return
            except OSError:
                await anyio.sleep(0.2)


@contextmanager
def robot(domain: int, folder: Path) -> Iterator[None]:
    """A robot in ROS, described and moving."""
    urdf = folder / "arm.urdf"
    urdf.write_text(URDF)
    variables = {**os.environ, **environment(domain)}
    process = subprocess.Popen([ros2_python(), str(ROBOT), str(urdf)], env=variables, stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == b"up\n"
        yield
    finally:
        process.kill()
        process.communicate()


MakeLink = Callable[..., RosLink]
MakePeer = Callable[..., AbstractContextManager[Node]]


@asynccontextmanager
async def links(kind: str, domain: int) -> AsyncIterator[tuple[MakeLink, MakePeer, str]]:
    """Makes links to ROS 2, and nodes of it; with the place that a command calls it by. Skips the test without them."""
    if kind != "cyclone":
        ros2_python()
    if kind == "rosbridge":
        pytest.importorskip("wsproto", reason='pip install "tfbus[rosbridge]"')
        from tfbus.links.rosbridge import RosbridgeLink

        with rosbridge(domain) as url:
            await answering(url)
            yield lambda bus, **options: RosbridgeLink(bus, url, **options), peer, url
    else:
        pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')
        from tfbus.links.dds import DdsLink

        make_peer = cyclone_peer if kind == "cyclone" else peer
        yield lambda bus, **options: DdsLink(bus, domain, **options), make_peer, f"dds:{domain}"


KINDS = {"dds": "/driver", "cyclone": "/cyclone", "rosbridge": "rosbridge"}
"""The name of the authority behind each."""


@pytest.mark.parametrize("kind", KINDS)
async def test_both_ways_with_every_answer_right(kind: str) -> None:
    domain = new_dds_domain()
    async with links(kind, domain) as (link_of, peer_of, _):
        with Bus() as bus:
            assert await meet(link_of(bus), bus, peer_of(domain)) == {KINDS[kind]}


async def test_dds_with_nodes_of_both_kinds_both_ways_with_every_answer_right() -> None:
    domain = new_dds_domain()
    async with links("dds", domain) as (link_of, peer_of, _):
        with Bus() as bus:
            # Both move the same frame in the same way.
            nodes = cyclone_peer(domain), peer_of(domain)
            assert await meet(link_of(bus), bus, *nodes) == {"/cyclone", "/driver"}


@pytest.mark.parametrize("kind", ["dds", "rosbridge"])
async def test_a_robot_is_described_and_moved_by_ros_and_its_clock_followed(kind: str, tmp_path: Path) -> None:
    pytest.importorskip("urdf_parser_py", reason='pip install "tfbus[urdf]"')
    domain = new_dds_domain()
    async with links(kind, domain) as (link_of, _, place):
        with robot(domain, tmp_path):
            await check_clock(link_of)
            await check_description_and_joints(link_of)
            await check_command(link_of, place)


@pytest.mark.parametrize("kind", KINDS)
async def test_a_node_that_is_killed_is_heard_again_when_it_is_back(kind: str) -> None:
    domain = new_dds_domain()
    async with links(kind, domain) as (link_of, peer_of, _):
        with Bus() as bus:
            await check_killed_node(link_of(bus), bus, partial(peer_of, domain))


@on_one_loop
@pytest.mark.parametrize("kind", KINDS)
async def test_a_node_hears_the_static_frames_of_a_link_that_came_back(kind: str) -> None:
    domain = new_dds_domain()
    async with links(kind, domain) as (link_of, peer_of, _):
        await check_link_that_came_back(link_of, peer_of(domain, 8.0))


@pytest.mark.parametrize("kind", KINDS)
async def test_a_late_link_has_the_static_frames_of_ros_and_of_other_links(kind: str) -> None:
    domain = new_dds_domain()
    async with links(kind, domain) as (link_of, peer_of, _):
        with peer_of(domain, 60.0), Bus() as bus, Buffer(bus) as buffer:
            Program(bus, buffer)
            async with link_of(bus):
                await buffer.lookup("base", "laser", timeout=20.0)
                with Bus() as late_bus, Buffer(late_bus) as late:
                    async with link_of(late_bus):
                        await late.lookup("base", "laser", timeout=40.0)
                        await late.lookup("arm", "tool", timeout=40.0)


@on_one_loop
async def test_ros_lists_a_link_over_dds_as_a_node_with_what_it_publishes_until_it_ends() -> None:
    pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')
    from tfbus.links.dds import DdsLink

    domain = new_dds_domain()
    variables = {**os.environ, **environment(domain)}
    async with await anyio.open_process([ros2_python(), str(WATCHER)], env=variables, stderr=None) as watcher:
        assert watcher.stdout is not None
        lines = BufferedByteReceiveStream(watcher.stdout)
        try:
            with anyio.fail_after(30), Bus() as bus:
                assert await lines.receive_until(b"\n", 1_000) == b""
                async with DdsLink(bus, domain):
                    name, *topics = (await lines.receive_until(b"\n", 1_000)).decode().split()
                assert await lines.receive_until(b"\n", 1_000) == b""
        finally:
            watcher.kill()
    assert re.fullmatch(f"/tfbus_[A-Za-z0-9_]+_{os.getpid()}", name)
    assert topics == ["/tf", "/tf_static"]


def run_beside_ros(script: Path, needed: str, content: str = "") -> subprocess.CompletedProcess[str]:
    """Run a script by the Python of ROS, which comes first, for its numpy."""
    program = f"import sys, runpy; sys.path += {sys.path!r}; runpy.run_path({str(script)!r}, run_name='__main__')"
    command = [ros2_python(f", {needed}"), "-c", program]
    return subprocess.run(command, input=content, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("script", "needed", "equal"),
    [("real_ros_messages.py", "numpy", 11), ("real_tf2_geometry.py", "tf2_geometry_msgs", 800)],
)
def test_messages_are_those_of_ros_again_and_are_transformed_as_there(script: str, needed: str, equal: int) -> None:
    done = run_beside_ros(PEER.with_name(script), needed)
    assert (done.stdout, done.stderr) == (f"equal {equal}\n", "")


@pytest.mark.parametrize("width", [5_000_000, 20_000_000])
async def test_recorded_streams_have_the_sets_that_message_filters_finds(width: int) -> None:
    recorded = load(SMALL, problems=Counter())
    streams: list[list[int]] = []
    for frame in ("base_link", "beacon", "gripper"):
        stamps = recorded.samples(frame).stamps
        assert stamps is not None
        streams.append(sorted(set(map(int, stamps))))

    async def replay(stamps: list[int]) -> AsyncIterator[PointStamped]:
        for stamp in stamps:
            yield PointStamped("x", stamp, (0.0, 0.0, 0.0))

    for chosen in (streams, streams[:2], streams[1:], streams[::2]):
        done = run_beside_ros(PEER.with_name("real_message_filters.py"), "message_filters", json.dumps([chosen, width]))
        assert done.stderr == ""
        # There, a set is narrower than the width.
        async with Synchronizer(*map(replay, chosen), within=(width - 1) / 1e9, block=True) as sets:
            found = [[point.stamp for point in points] async for points in sets]
        assert found == json.loads(done.stdout)
