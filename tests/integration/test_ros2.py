"""Links against a real ROS 2: rclpy, its middleware and tf2_ros, in a process of their own.

The variable ``ROS2_PYTHON`` names a Python with rclpy and tf2_ros, such as ``/usr/bin/python3`` after
``source /opt/ros/kilted/setup.bash``; without it, that Python is looked for as ``python3`` in a sourced ROS 2. The
variable ``ROSBRIDGE`` is a command that serves a rosbridge at the port that is its last argument.
"""

import json
import os
import shlex
import shutil
import statistics
import subprocess
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import anyio
import anyio.to_thread
import pytest
from support.both_sides import Program
from support.processes import free_ports, until
from support.robot_of_ros import URDF, check_clock, check_command, check_description_and_joints
from support.wires import latched

from tfbus import Buffer, Bus
from tfbus.links.ros import RosLink

pytestmark = [pytest.mark.thorough, pytest.mark.anyio]

PEER = Path(__file__).parents[1] / "support" / "ros2_peer.py"
MESSAGES = PEER.with_name("real_ros_messages.py")
ROBOT = PEER.with_name("ros2_robot.py")
SECONDS = 10.0
_next_domain = iter(range(100 + os.getpid() % 50, 200))


def ros2_python() -> str:
    """A Python that has ROS 2; skips the test if there is none."""
    python = os.environ.get("ROS2_PYTHON") or shutil.which("python3")
    if python is None or subprocess.run([python, "-c", "import rclpy, tf2_ros"], capture_output=True).returncode:
        pytest.skip("no ROS 2: set ROS2_PYTHON to a Python with rclpy and tf2_ros")
    return python


class Ros2Peer:
    """Such a process."""

    def __init__(self, python: str, domain: int, seconds: float, x: float = 0.5) -> None:
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        command = [python, str(PEER), "--seconds", f"{seconds}", "--x", f"{x}"]
        self.process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)

    async def next_line(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = await anyio.to_thread.run_sync(self.process.stdout.readline)
        return dict(json.loads(line))

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()


@contextmanager
def peer(domain: int, seconds: float, x: float = 0.5) -> Iterator[Ros2Peer]:
    started = Ros2Peer(ros2_python(), domain, seconds, x)
    try:
        yield started
    finally:
        started.kill()


@contextmanager
def rosbridge(domain: int) -> Iterator[str]:
    """The URL of a rosbridge of ROS 2; skips the test if there is none."""
    command = os.environ.get("ROSBRIDGE")
    if not command:
        pytest.skip("no rosbridge: set ROSBRIDGE to a command that serves one at the port that is its last argument")
    (port,) = free_ports(1)
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    process = subprocess.Popen(
        [*shlex.split(command), str(port)], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
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


async def meet(link: RosLink, bus: Bus, domain: int) -> dict[str, Any]:
    """Have both sides broadcast and ask for ten seconds, and check the answers; returns the figures."""
    with Buffer(bus) as buffer:
        program = Program(bus, buffer)
        async with link, anyio.create_task_group() as tasks:
            tasks.start_soon(program.send)
            with peer(domain, SECONDS) as ros:
                assert (await ros.next_line())["event"] == "up"
                await buffer.lookup("odom", "tool", timeout=20.0)
                laser = await buffer.lookup("base", "laser", timeout=20.0)
                assert laser.transform.translation == (0.5, 0.0, 0.0)
                with anyio.CancelScope() as asking:
                    async with anyio.create_task_group() as inner:
                        inner.start_soon(program.ask)
                        # The peer ends first, and nobody answers then.
                        await anyio.sleep(SECONDS - 3.0)
                        inner.cancel_scope.cancel()
                        asking.cancel()
                facts = await ros.next_line()
            tasks.cancel_scope.cancel()
    facts |= {
        "in_ms": statistics.median(program.latencies),
        "asked": program.answered + program.failed,
        "authorities": sorted(program.authorities),
    }
    assert program.answered > 50
    assert facts["answered"] > 300
    assert (program.wrong, facts["wrong"]) == (0, 0)
    assert program.failed <= 0.01 * (program.answered + program.failed)
    assert facts["failed"] <= 0.01 * (facts["answered"] + facts["failed"])
    assert link.statistics().rejected == {}
    return facts


async def test_dds_both_ways_with_every_answer_right() -> None:
    pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')
    from tfbus.links.dds import DdsLink

    domain = next(_next_domain)
    ros2_python()
    with Bus() as bus:
        facts = await meet(DdsLink(bus, domain), bus, domain)
    assert facts["authorities"] == ["/driver"]
    print(facts)


async def test_rosbridge_both_ways_with_every_answer_right() -> None:
    pytest.importorskip("wsproto", reason='pip install "tfbus[rosbridge]"')
    from tfbus.links.rosbridge import RosbridgeLink

    domain = next(_next_domain)
    ros2_python()
    with rosbridge(domain) as url, Bus() as bus:
        await answering(url)
        print(await meet(RosbridgeLink(bus, url), bus, domain))


@contextmanager
def robot(domain: int, folder: Path) -> Iterator[None]:
    """A robot in ROS, described and moving."""
    urdf = folder / "arm.urdf"
    urdf.write_text(URDF)
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    process = subprocess.Popen([ros2_python(), str(ROBOT), str(urdf)], env=environment, stdout=subprocess.PIPE)
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


@asynccontextmanager
async def links(carrier: str, domain: int) -> AsyncIterator[Callable[[Bus], RosLink]]:
    """Makes links to ROS 2 by a carrier; skips the test without it."""
    ros2_python()
    if carrier == "dds":
        pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')
        from tfbus.links.dds import DdsLink

        yield lambda bus: DdsLink(bus, domain)
    else:
        pytest.importorskip("wsproto", reason='pip install "tfbus[rosbridge]"')
        from tfbus.links.rosbridge import RosbridgeLink

        with rosbridge(domain) as url:
            await answering(url)
            yield lambda bus: RosbridgeLink(bus, url)


@pytest.mark.parametrize("carrier", ["dds", "rosbridge"])
async def test_a_node_that_is_killed_is_heard_again_when_it_is_back(carrier: str) -> None:
    domain = next(_next_domain)
    async with links(carrier, domain) as link_of:
        with Bus() as bus, Buffer(bus) as buffer:
            async with link_of(bus) as link:
                with peer(domain, 60.0):
                    found = await buffer.lookup("base", "laser", timeout=20.0)
                    assert found.transform.translation[0] == 0.5
                # Killed without a word: a new one says something else.
                with peer(domain, 60.0, x=0.75):
                    await until(lambda: latched(bus)["laser"].transform.translation[0] == 0.75)
                assert link.statistics().rejected == {}


@pytest.mark.parametrize("carrier", ["dds", "rosbridge"])
async def test_a_node_hears_the_static_frames_of_a_link_that_came_back(carrier: str) -> None:
    domain = next(_next_domain)
    async with links(carrier, domain) as link_of:
        with peer(domain, 8.0) as ros, Bus() as bus, Buffer(bus) as buffer:
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


@pytest.mark.parametrize("carrier", ["dds", "rosbridge"])
async def test_a_late_link_has_the_static_frames_of_ros_and_of_other_links(carrier: str) -> None:
    domain = next(_next_domain)
    async with links(carrier, domain) as link_of:
        with peer(domain, 60.0), Bus() as bus, Buffer(bus) as buffer:
            Program(bus, buffer)
            async with link_of(bus):
                await buffer.lookup("base", "laser", timeout=20.0)
                with Bus() as late_bus, Buffer(late_bus) as late:
                    async with link_of(late_bus):
                        await late.lookup("base", "laser", timeout=40.0)
                        await late.lookup("arm", "tool", timeout=40.0)


def test_messages_of_rclpy_become_data_and_messages_again() -> None:
    # The Python of ROS comes first, for its numpy.
    script = f"import sys, runpy; sys.path += {sys.path!r}; runpy.run_path({str(MESSAGES)!r}, run_name='__main__')"
    done = subprocess.run([ros2_python(), "-c", script], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("equal 11\n", "")
