"""Links through rosbridge against a real ROS 1: roscore, rospy and tf2_ros, such as those of Debian 12.

The variable ``ROS1_PYTHON`` names a Python with rospy and tf2_ros, by default ``/usr/bin/python3``; ``ROS1_ROSBRIDGE``
is a command that serves a rosbridge of ROS 1 at the port that is its last argument; ``ROS1_ROBOT_STATE_PUBLISHER`` is
the path of robot_state_publisher, by default that of Debian's package ``ros-robot-state-publisher``.
"""

import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import AbstractContextManager, AsyncExitStack, asynccontextmanager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import anyio
import anyio.to_thread
import pytest

pytest.importorskip("wsproto", reason='pip install "tfbus[rosbridge]"')

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
from support.processes import free_ports, until
from support.rosbridge import install_roslib, roslib_client
from support.samples import latched, moving, static

from tfbus import Buffer, Bus, TransformStamped
from tfbus.links.rosbridge import RosbridgeLink
from tfbus.robot import RobotModel, RobotStatePublisher

pytestmark = [pytest.mark.thorough, pytest.mark.anyio]

PEER = Path(__file__).parents[2] / "support" / "ros1_peer.py"
MESSAGES = PEER.with_name("real_ros_messages.py")
ROBOT = PEER.with_name("ros1_robot.py")
NEEDED = "set ROS1_PYTHON to a Python with rospy, tf2_ros, and the messages of common_msgs"


@contextmanager
def running(command: list[str], environment: dict[str, str], **options: Any) -> Iterator[subprocess.Popen[str]]:
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "text": True, **options}
    process = subprocess.Popen(command, env=environment, **quiet)
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()


@dataclass
class Ros1:
    """A ROS 1 with a rosbridge."""

    python: str
    environment: dict[str, str]
    url: str
    serve: list[str]
    """The command of the rosbridge."""
    server: subprocess.Popen[str]

    def node(self, seconds: float, x: float = 0.5) -> AbstractContextManager[Node]:
        """A node, killed at the end."""
        return node([self.python, str(PEER)], self.environment, seconds, x)


@asynccontextmanager
async def robot_of(ros: Ros1, folder: Path) -> AsyncIterator[None]:
    """A robot in ROS, described and moving."""
    urdf = folder / "arm.urdf"
    urdf.write_text(URDF)
    command = [ros.python, str(ROBOT), str(urdf)]
    with running(command, ros.environment, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert await anyio.to_thread.run_sync(process.stdout.readline) == "up\n"
        yield
        process.kill()


def has_rospy(python: str, further: str = "") -> bool:
    """Whether a Python has what the tests' nodes of ROS 1 import."""
    nodes = "rospy, tf2_ros, tf2_msgs.msg, geometry_msgs.msg, std_msgs.msg, sensor_msgs.msg, rosgraph_msgs.msg"
    command = [python, "-c", f"import {nodes}{further}"]
    return Path(python).exists() and subprocess.run(command, capture_output=True, check=False).returncode == 0


@asynccontextmanager
async def ros1(folder: Path) -> AsyncIterator[Ros1]:
    """A ROS 1; skips the test if there is none."""
    roscore, command = shutil.which("roscore"), os.environ.get("ROS1_ROSBRIDGE")
    python = os.environ.get("ROS1_PYTHON", "/usr/bin/python3")
    if roscore is None:
        pytest.skip("no ROS 1: there is no roscore on the path")
    if not has_rospy(python):
        pytest.skip(f"no ROS 1: {NEEDED}")
    if not command:
        pytest.skip(
            "no rosbridge: set ROS1_ROSBRIDGE to a command that serves one at the port that is its last argument"
        )
    master, port = free_ports(2)
    environment = {
        "ROS_PACKAGE_PATH": "/usr/share",
        **os.environ,
        "ROS_MASTER_URI": f"http://127.0.0.1:{master}",
        "ROS_IP": "127.0.0.1",
        "ROS_HOME": str(folder),
        "ROS_LOG_DIR": str(folder),
    }
    with running([roscore, "-p", str(master)], environment):
        await reachable(master)
        serve = [*shlex.split(command), str(port)]
        with running(serve, environment) as server:
            await reachable(port)
            yield Ros1(python, environment, f"ws://127.0.0.1:{port}", serve, server)


def test_messages_of_rospy_become_data_and_messages_again() -> None:
    python = os.environ.get("ROS1_PYTHON", "/usr/bin/python3")
    if not has_rospy(python, ", numpy"):
        pytest.skip(f"no ROS 1: {NEEDED}, and numpy")
    # The Python of ROS comes first, for its numpy.
    script = f"import sys, runpy; sys.path += {sys.path!r}; runpy.run_path({str(MESSAGES)!r}, run_name='__main__')"
    done = subprocess.run([python, "-c", script], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("equal 11\n", "")


async def reachable(port: int) -> None:
    with anyio.fail_after(60):
        while True:
            try:
                await anyio.aclose_forcefully(await anyio.connect_tcp("127.0.0.1", port))
            except OSError:
                await anyio.sleep(0.1)
            else:
                return


async def test_both_ways_with_every_answer_right(tmp_path: Path) -> None:
    async with ros1(tmp_path) as ros:
        with Bus() as bus:
            assert await meet(RosbridgeLink(bus, ros.url), bus, ros.node(SECONDS)) == {"rosbridge"}


async def test_a_node_that_is_killed_is_heard_again_when_it_is_back(tmp_path: Path) -> None:
    async with ros1(tmp_path) as ros:
        with Bus() as bus:
            await check_killed_node(RosbridgeLink(bus, ros.url), bus, ros.node)


async def test_a_node_hears_the_static_frames_of_a_link_that_came_back(tmp_path: Path) -> None:
    async with ros1(tmp_path) as ros:
        await check_link_that_came_back(lambda bus: RosbridgeLink(bus, ros.url), ros.node(12.0))


async def test_a_link_comes_back_to_a_server_that_was_killed(tmp_path: Path) -> None:
    async with ros1(tmp_path) as ros:
        with ros.node(300.0), Bus() as bus, Buffer(bus) as buffer:
            program = Program(bus, buffer)
            async with RosbridgeLink(bus, ros.url) as link, anyio.create_task_group() as tasks:
                tasks.start_soon(program.send)
                await buffer.lookup("odom", "tool", timeout=20.0)
                ros.server.kill()
                await until(lambda: link.peers == ())
                with running(ros.serve, ros.environment):
                    await until(lambda: link.peers != ())
                    # The node is heard again, and who joins late has the static frames of both.
                    await buffer.lookup("odom", "tool", time.time_ns(), timeout=60.0)
                    with Bus() as late_bus, Buffer(late_bus) as late:
                        async with RosbridgeLink(late_bus, ros.url, send=False):
                            await late.lookup("base", "laser", timeout=20.0)
                            await late.lookup("arm", "tool", timeout=20.0)
                    tasks.cancel_scope.cancel()


async def test_a_robot_is_described_and_moved_by_ros_and_its_clock_followed(tmp_path: Path) -> None:
    pytest.importorskip("urdf_parser_py", reason='pip install "tfbus[urdf]"')
    async with ros1(tmp_path) as ros, robot_of(ros, tmp_path):

        def link(bus: Bus, **options: Any) -> RosbridgeLink:
            return RosbridgeLink(bus, ros.url, **options)

        await check_clock(link)
        await check_description_and_joints(link)
        await check_command(link, ros.url)


async def test_the_frames_of_a_robot_are_those_of_the_real_robot_state_publisher(tmp_path: Path) -> None:
    pytest.importorskip("urdf_parser_py", reason='pip install "tfbus[urdf]"')
    command = os.environ.get("ROS1_ROBOT_STATE_PUBLISHER", "/usr/lib/robot_state_publisher/robot_state_publisher")
    if shutil.which(command) is None:
        pytest.skip("no robot_state_publisher of ROS 1: set ROS1_ROBOT_STATE_PUBLISHER to its path")
    theirs: dict[tuple[str, int], TransformStamped] = {}
    ours: dict[tuple[str, int], TransformStamped] = {}
    async with ros1(tmp_path) as ros, robot_of(ros, tmp_path):
        with running([command], ros.environment), Bus() as bus, Bus() as own:
            bus.subscribe(lambda batch: theirs.update({(each.child, each.stamp): each for each in batch}))
            own.subscribe(lambda batch: ours.update({(each.child, each.stamp): each for each in batch}))
            robot = RobotStatePublisher(own, RobotModel.from_urdf(URDF))
            async with RosbridgeLink(bus, ros.url, send=False, joint_states=robot.publish):
                moving = ("upper", "fore", "finger")
                await until(lambda: len([key for key in theirs.keys() & ours.keys() if key[0] in moving]) > 90)
            assert latched(own)["hand"].transform.is_close(latched(bus)["hand"].transform)
    shared = theirs.keys() & ours.keys()
    assert {child for child, _ in shared} >= set(moving)
    for key in shared:
        assert theirs[key].parent == ours[key].parent
        assert theirs[key].transform.is_close(ours[key].transform), key


@pytest.mark.parametrize("link_first", [True, False])
async def test_roslib_and_a_link_hear_the_same_topics_of_one_server(tmp_path: Path, link_first: bool) -> None:
    async with ros1(tmp_path) as ros, AsyncExitStack() as stack:
        install_roslib(tmp_path)
        bus = stack.enter_context(Bus())
        buffer = stack.enter_context(Buffer(bus))
        bus.publish(static("base", "lidar", 2.0))
        if link_first:
            await stack.enter_async_context(RosbridgeLink(bus, ros.url))
        heard = await stack.enter_async_context(roslib_client(tmp_path, ros.url))
        if not link_first:
            await stack.enter_async_context(RosbridgeLink(bus, ros.url))
        stack.enter_context(ros.node(60.0))
        # Both hear the node, and roslib the link too: the static frame was there before it, the moving one comes now.
        await buffer.lookup("odom", "laser", timeout=30.0)
        with anyio.fail_after(30):
            stamp = 10**9
            while not {"base", "laser", "lidar", "arm"} <= {row["child_frame_id"] for row in rows(heard)}:
                bus.publish(moving("base", "arm", stamp := stamp + 1, 1.5))
                await anyio.sleep(0.02)
    said = {row["child_frame_id"]: row for row in rows(heard)}
    assert said["lidar"]["transform"]["translation"]["x"] == 2.0
    assert said["arm"]["header"]["frame_id"] == "base"
    assert said["arm"]["transform"]["translation"] == {"x": 1.5, "y": 0.0, "z": 0.0}


def rows(heard: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The transforms of messages that roslib has heard."""
    return [row for fact in heard for row in fact["transforms"]]
