"""Links against a real ROS 2: rclpy, its middleware and tf2_ros, in a process of their own.

The variable ``ROS2_PYTHON`` names a Python with rclpy and tf2_ros, such as ``/usr/bin/python3`` after
``source /opt/ros/kilted/setup.bash``; without it, that Python is looked for as ``python3`` in a sourced ROS 2. The
variable ``ROSBRIDGE`` is a command that serves a rosbridge at the port that is its last argument.
"""

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AbstractContextManager, asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest
from support.both_sides import (
    SECONDS,
    URDF,
    Node,
    Program,
    check_clock,
    check_command,
    check_description_and_joints,
    meet,
    node,
)
from support.processes import free_ports, until
from support.samples import static
from support.wires import latched

from tfbus import Buffer, Bus
from tfbus.links.ros import RosLink

pytestmark = [pytest.mark.thorough, pytest.mark.anyio]

PEER = Path(__file__).parents[1] / "support" / "ros2_peer.py"
MESSAGES = PEER.with_name("real_ros_messages.py")
ROBOT = PEER.with_name("ros2_robot.py")
CYCLONE_PEER = PEER.with_name("cyclone_peer.py")
_next_domain = iter(range(100 + os.getpid() % 50, 200))


def ros2_python() -> str:
    """A Python that has ROS 2; skips the test if there is none."""
    python = os.environ.get("ROS2_PYTHON") or shutil.which("python3")
    if python is None or subprocess.run([python, "-c", "import rclpy, tf2_ros"], capture_output=True).returncode:
        pytest.skip("no ROS 2: set ROS2_PYTHON to a Python with rclpy and tf2_ros")
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


async def test_dds_both_ways_with_every_answer_right() -> None:
    pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')
    from tfbus.links.dds import DdsLink

    domain = next(_next_domain)
    with Bus() as bus:
        assert await meet(DdsLink(bus, domain), bus, peer(domain)) == {"/driver"}


async def test_dds_with_a_node_of_cyclone_dds_both_ways_with_every_answer_right() -> None:
    pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')
    from tfbus.links.dds import DdsLink

    domain = next(_next_domain)
    with Bus() as bus:
        assert await meet(DdsLink(bus, domain), bus, cyclone_peer(domain)) == {"/cyclone"}


async def test_dds_with_nodes_of_both_kinds_both_ways_with_every_answer_right() -> None:
    pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')
    from tfbus.links.dds import DdsLink

    domain = next(_next_domain)
    with Bus() as bus:
        # Both move the same frame in the same way.
        nodes = cyclone_peer(domain), peer(domain)
        assert await meet(DdsLink(bus, domain), bus, *nodes) == {"/cyclone", "/driver"}


async def test_rosbridge_both_ways_with_every_answer_right() -> None:
    pytest.importorskip("wsproto", reason='pip install "tfbus[rosbridge]"')
    from tfbus.links.rosbridge import RosbridgeLink

    domain = next(_next_domain)
    ros2_python()
    with rosbridge(domain) as url, Bus() as bus:
        await answering(url)
        assert await meet(RosbridgeLink(bus, url), bus, peer(domain)) == {"rosbridge"}


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


async def test_a_robot_is_described_and_moved_by_ros_and_its_clock_followed_over_dds(tmp_path: Path) -> None:
    pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')
    pytest.importorskip("urdf_parser_py", reason='pip install "tfbus[urdf]"')
    from tfbus.links.dds import DdsLink

    domain = next(_next_domain)

    def link(bus: Bus, **options: Any) -> RosLink:
        return DdsLink(bus, domain, **options)

    with robot(domain, tmp_path):
        await check_clock(link)
        await check_description_and_joints(link)
        await check_command(link, f"dds:{domain}")


async def test_a_robot_is_described_and_moved_by_ros_and_its_clock_followed_through_rosbridge(tmp_path: Path) -> None:
    pytest.importorskip("wsproto", reason='pip install "tfbus[rosbridge]"')
    pytest.importorskip("urdf_parser_py", reason='pip install "tfbus[urdf]"')
    from tfbus.links.rosbridge import RosbridgeLink

    domain = next(_next_domain)
    with robot(domain, tmp_path), rosbridge(domain) as url:
        await answering(url)

        def link(bus: Bus, **options: Any) -> RosLink:
            return RosbridgeLink(bus, url, **options)

        await check_clock(link)
        await check_description_and_joints(link)
        await check_command(link, url)


MakePeer = Callable[..., AbstractContextManager[Node]]


@asynccontextmanager
async def links(kind: str, domain: int) -> AsyncIterator[tuple[Callable[[Bus], RosLink], MakePeer]]:
    """Makes links to ROS 2, and nodes of it; skips the test without them."""
    if kind != "cyclone":
        ros2_python()
    if kind == "rosbridge":
        pytest.importorskip("wsproto", reason='pip install "tfbus[rosbridge]"')
        from tfbus.links.rosbridge import RosbridgeLink

        with rosbridge(domain) as url:
            await answering(url)
            yield lambda bus: RosbridgeLink(bus, url), peer
    else:
        pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')
        from tfbus.links.dds import DdsLink

        yield lambda bus: DdsLink(bus, domain), cyclone_peer if kind == "cyclone" else peer


KINDS = ["dds", "cyclone", "rosbridge"]


@pytest.mark.parametrize("kind", KINDS)
async def test_a_node_that_is_killed_is_heard_again_when_it_is_back(kind: str) -> None:
    domain = next(_next_domain)
    async with links(kind, domain) as (link_of, peer_of):
        with Bus() as bus, Buffer(bus) as buffer:
            async with link_of(bus) as link:
                with peer_of(domain, 60.0):
                    found = await buffer.lookup("base", "laser", timeout=20.0)
                    assert found.transform.translation[0] == 0.5
                # Killed without a word: a new one says something else.
                with peer_of(domain, 60.0, x=0.75):
                    await until(lambda: latched(bus)["laser"].transform.translation[0] == 0.75)
                assert link.statistics().rejected == {}


@pytest.mark.parametrize("kind", KINDS)
async def test_a_node_hears_the_static_frames_of_a_link_that_came_back(kind: str) -> None:
    domain = next(_next_domain)
    async with links(kind, domain) as (link_of, peer_of):
        with peer_of(domain, 8.0) as ros, Bus() as bus, Buffer(bus) as buffer:
            assert (await ros.next_line())["event"] == "up"
            program = Program(bus, buffer)
            for _ in range(2):
                async with link_of(bus), anyio.create_task_group() as tasks:
                    tasks.start_soon(program.send)
                    await buffer.lookup("odom", "tool", timeout=20.0)
                    await anyio.sleep(1.0)
                    tasks.cancel_scope.cancel()
            facts = await ros.next_line()
    assert facts["answered"] > 50
    assert facts["wrong"] == 0


@pytest.mark.parametrize("kind", KINDS)
async def test_a_late_link_has_the_static_frames_of_ros_and_of_other_links(kind: str) -> None:
    domain = next(_next_domain)
    async with links(kind, domain) as (link_of, peer_of):
        with peer_of(domain, 60.0), Bus() as bus, Buffer(bus) as buffer:
            Program(bus, buffer)
            async with link_of(bus):
                await buffer.lookup("base", "laser", timeout=20.0)
                with Bus() as late_bus, Buffer(late_bus) as late:
                    async with link_of(late_bus):
                        await late.lookup("base", "laser", timeout=40.0)
                        await late.lookup("arm", "tool", timeout=40.0)


async def test_a_link_to_rosbridge_whose_connection_broke_hears_moving_frames_again_and_is_heard() -> None:
    domain = next(_next_domain)
    async with links("rosbridge", domain) as (link_of, peer_of):
        with Bus() as bus, Buffer(bus) as buffer:
            program = Program(bus, buffer)
            async with link_of(bus) as link, anyio.create_task_group() as tasks:
                tasks.start_soon(program.send)
                with peer_of(domain, 25.0) as ros:
                    assert (await ros.next_line())["event"] == "up"
                    await buffer.lookup("odom", "tool", timeout=20.0)
                    # The server still has our publisher, beside which it subscribes to what is latched only.
                    await link._carrier._socket.close()  # type: ignore[attr-defined]
                    await until(lambda: link.peers == ())
                    await until(lambda: link.peers != ())
                    # What it had before the break is too old by then.
                    await anyio.sleep(2.0)
                    await buffer.lookup("odom", "tool", max_age=1.0, timeout=40.0)
                    facts = await ros.next_line()
                tasks.cancel_scope.cancel()
    # Some 11 s of 25 are lost for moving frames.
    assert facts["received"]["arm"] > 900
    assert facts["wrong"] == 0


async def test_a_static_frame_that_a_rosbridge_refuses_at_first_arrives_in_the_end(
    caplog: pytest.LogCaptureFixture,
) -> None:
    domain = next(_next_domain)
    lidar = static("map", "lidar", 2.0, stamp=5)
    async with links("rosbridge", domain) as (link_of, peer_of):
        with peer_of(domain, 60.0):
            for _ in range(2):
                # A client that listens, and is gone without a word while it is written to: then the server logs a
                # warning, after which its logger refuses those of the next advertise, and with them that.
                with Bus() as bus, Buffer(bus) as buffer:
                    async with link_of(bus) as link:
                        await buffer.lookup("odom", "base", timeout=20.0)
                        stream = link._carrier._socket._stream  # type: ignore[attr-defined]
                        await anyio.aclose_forcefully(stream)
                        await until(lambda: link.peers == ())
            with Bus() as bus:
                bus.publish(lidar)
                async with link_of(bus) as link:
                    await until(lambda: link.statistics().duplicates > 0)
                    refused = link.statistics().not_sent.get("not confirmed", 0)
                    said = [record.getMessage() for record in caplog.records if "given back" in record.getMessage()]
                    assert len(said) == refused
                    with Bus() as late, Buffer(late) as buffer:
                        async with link_of(late):
                            found = await buffer.lookup("map", "lidar", timeout=20.0)
    assert found.transform.is_close(lidar.transform)


def test_messages_of_rclpy_become_data_and_messages_again() -> None:
    # The Python of ROS comes first, for its numpy.
    script = f"import sys, runpy; sys.path += {sys.path!r}; runpy.run_path({str(MESSAGES)!r}, run_name='__main__')"
    done = subprocess.run([ros2_python(), "-c", script], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("equal 11\n", "")
