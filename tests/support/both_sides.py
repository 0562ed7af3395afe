"""Our side of tests against a real ROS, in which each side needs the frames of the other."""

import json
import math
import os
import statistics
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Any

import anyio
import anyio.to_thread
from support.processes import start_tfbus, until
from support.samples import latched

from tfbus import SECOND, Buffer, Bus, SimulatedClock, Transform, TransformBroadcaster, TransformStamped
from tfbus.geometry.stamped import Batch
from tfbus.links.ros import RosLink
from tfbus.robot import RobotModel, RobotStatePublisher

SECONDS = 10.0
MOST_FAILED = 0.01


def seconds(stamp: int) -> float:
    """Seconds since some day: between two samples the answer is exact, however late the second one is."""
    return (stamp - 1_750_000_000 * 10**9) / 1e9


class Program:
    """Our side: it broadcasts ``base:arm``, x = 2 t, and the static ``arm:tool``, and asks for ``odom:tool``."""

    def __init__(self, bus: Bus, buffer: Buffer) -> None:
        self.bus = bus
        self.buffer = buffer
        self.latencies: list[float] = []
        self.authorities: set[str] = set()
        self.answered = self.failed = self.wrong = 0
        bus.subscribe(self._hear)
        self._broadcaster = TransformBroadcaster(bus, authority="here")
        self._broadcaster.send_static("arm", "tool", Transform((0.1, 0.0, 0.0)))

    def _hear(self, batch: Batch) -> None:
        for sample in batch:
            if sample.child in ("base", "laser"):
                self.authorities.add(sample.authority)
                if not sample.static:
                    self.latencies.append((time.time_ns() - sample.stamp) / 1e6)

    async def send(self) -> None:
        async for _ in self.bus.clock.ticks(100.0):
            stamp = time.time_ns()
            self._broadcaster.send("base", "arm", Transform((2 * seconds(stamp), 0.0, 0.0)), at=stamp)

    async def ask(self) -> None:
        """Wait for the transform of the present, again and again."""
        async for _ in self.bus.clock.ticks(100.0):
            stamp = time.time_ns()
            try:
                found = await self.buffer.lookup("odom", "tool", stamp, timeout=1.0)
            except TimeoutError:
                self.failed += 1
                continue
            self.answered += 1
            self.wrong += abs(found.transform.translation[0] - (3 * seconds(stamp) + 0.1)) > 1e-6


class Node:
    """The other side: a process that does what `ros_driver.py` says."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    async def next_line(self) -> dict[str, Any]:
        """The next line of JSON that it prints."""
        assert self._process.stdout is not None
        return dict(json.loads(await anyio.to_thread.run_sync(self._process.stdout.readline)))


@contextmanager
def node(
    command: Sequence[str], environment: Mapping[str, str], seconds: float = SECONDS, x: float = 0.5
) -> Iterator[Node]:
    """Such a process, killed at the end; `x` is that of the static ``base:laser``."""
    options = "--seconds", f"{seconds}", "--x", f"{x}"
    process = subprocess.Popen(
        [*command, *options], env={**os.environ, **environment}, stdout=subprocess.PIPE, text=True
    )
    try:
        yield Node(process)
    finally:
        process.kill()
        process.communicate()


async def meet(link: RosLink, bus: Bus, *nodes: AbstractContextManager[Node]) -> set[str]:
    """Have all sides broadcast and ask for ten seconds, and check the answers; returns the authorities here.

    The nodes start when the link has joined, so each side has the static frames of one that came later or earlier.
    """
    with Buffer(bus) as buffer:
        program = Program(bus, buffer)
        async with link, anyio.create_task_group() as tasks:
            tasks.start_soon(program.send)
            with ExitStack() as stack:
                others = [stack.enter_context(each) for each in nodes]
                for other in others:
                    assert (await other.next_line())["event"] == "up"
                await buffer.lookup("odom", "tool", timeout=20.0)
                laser = await buffer.lookup("base", "laser", timeout=20.0)
                assert laser.transform.translation == (0.5, 0.0, 0.0)
                # Samples that waited for the other side are late.
                program.latencies.clear()
                # The nodes end first, and nobody answers then.
                with anyio.move_on_after(SECONDS - 4.0):
                    await program.ask()
                figures = [await other.next_line() for other in others]
            tasks.cancel_scope.cancel()
    asked = program.answered + program.failed
    print({"in_ms": statistics.median(program.latencies), "asked": asked, "failed": program.failed}, *figures)
    assert program.answered > 50
    assert program.wrong == 0
    assert program.failed <= MOST_FAILED * asked
    for facts in figures:
        assert facts["answered"] > 300
        assert facts["wrong"] == 0
        assert facts["failed"] <= MOST_FAILED * (facts["answered"] + facts["failed"])
    assert link.statistics().rejected == {}
    return program.authorities


async def check_killed_node(link: RosLink, bus: Bus, make_node: Callable[..., AbstractContextManager[Node]]) -> None:
    """A node that is killed is heard again when it is back."""
    with Buffer(bus) as buffer:
        async with link:
            with make_node(60.0):
                found = await buffer.lookup("base", "laser", timeout=20.0)
                assert found.transform.translation[0] == 0.5
            # Killed without a word: a new one says something else.
            with make_node(60.0, x=0.75):
                await until(lambda: latched(bus)["laser"].transform.translation[0] == 0.75)
            assert link.statistics().rejected == {}


async def check_link_that_came_back(make_link: Callable[[Bus], RosLink], peer: AbstractContextManager[Node]) -> None:
    """A node hears the static frames of a link that came back."""
    with peer as other, Bus() as bus, Buffer(bus) as buffer:
        assert (await other.next_line())["event"] == "up"
        program = Program(bus, buffer)
        for _ in range(2):
            async with make_link(bus), anyio.create_task_group() as tasks:
                tasks.start_soon(program.send)
                # A stamp that nobody has sent yet.
                await buffer.lookup("odom", "tool", time.time_ns() + SECOND // 10, timeout=20.0)
                await anyio.sleep(1.0)
                tasks.cancel_scope.cancel()
        facts = await other.next_line()
    assert facts["answered"] > 10
    assert facts["wrong"] == 0


# A robot that a real ROS describes and moves, and checks of what is heard of it; `ros1_robot.py`, `ros2_robot.py`

URDF = """<robot name="arm">
  <link name="base"/><link name="upper"/><link name="fore"/><link name="hand"/><link name="finger"/>
  <joint name="shoulder" type="continuous">
    <parent link="base"/><child link="upper"/><origin xyz="0 0 0.5"/><axis xyz="0 0 1"/>
  </joint>
  <joint name="elbow" type="revolute">
    <parent link="upper"/><child link="fore"/><origin xyz="1 0 0" rpy="0.1 0.2 0.3"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/>
  </joint>
  <joint name="mount" type="fixed"><parent link="fore"/><child link="hand"/><origin xyz="0 0 0.2"/></joint>
  <joint name="grip" type="prismatic">
    <parent link="hand"/><child link="finger"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/><mimic joint="elbow" multiplier="0.1" offset="0.05"/>
  </joint>
</robot>"""

MakeLink = Callable[..., RosLink]
"""Makes a link for a bus, with options that all links to ROS share."""

_ENOUGH = 90


def transforms(stamp: int) -> dict[str, Transform]:
    """The transforms of the moving links at a stamp in ns: the shoulder is at sin(t), the elbow at cos(t)."""
    shoulder, elbow = math.sin(stamp / SECOND), math.cos(stamp / SECOND)
    return {
        "upper": Transform.from_axis_angle((0, 0, 1), shoulder, (0, 0, 0.5)),
        "fore": Transform.from_xyz_rpy((1, 0, 0), (0.1, 0.2, 0.3)) @ Transform.from_axis_angle((0, 1, 0), elbow),
        "finger": Transform((0.05 + 0.1 * elbow, 0, 0)),
    }


def check_samples(samples: Iterable[TransformStamped]) -> None:
    """Check that samples are those of the robot, and that there are some of each moving link."""
    moving = [sample for sample in samples if not sample.static]
    assert {sample.child for sample in moving} == {"upper", "fore", "finger"}
    for sample in moving:
        assert sample.transform.is_close(transforms(sample.stamp)[sample.child]), sample


async def check_description_and_joints(link: MakeLink) -> None:
    """A link takes the latched description first, then the positions of the joints, which move the robot."""
    descriptions: list[str] = []
    samples: list[TransformStamped] = []
    with Bus() as bus:
        async with link(bus, send=False, frames=(), robot_description=descriptions.append):
            await until(lambda: descriptions != [])
        assert descriptions == [URDF]
        robot = RobotStatePublisher(bus, RobotModel.from_urdf(descriptions[0]))
        bus.subscribe(samples.extend)
        async with link(bus, send=False, frames=(), joint_states=robot.publish) as joined:
            await until(lambda: len(samples) > _ENOUGH)
            assert joined.statistics().rejected == {}
    check_samples(samples)


async def check_clock(link: MakeLink) -> None:
    """A clock follows that of ROS, from 100 s on, and jumps once, back to 50 s."""
    clock = SimulatedClock()
    stamps: list[int] = []
    jumps: list[tuple[int, int]] = []
    clock.on_move(stamps.append)
    clock.on_jump(lambda before, after: jumps.append((before, after)))
    with Bus(clock) as bus:
        async with link(bus, send=False, frames=(), clock=clock) as joined:
            await until(lambda: clock.now() > 100 * SECOND)
            await until(lambda: 50.2 * SECOND < clock.now() < 100 * SECOND)
            assert joined.statistics().rejected == {}
    back = [number for number in range(1, len(stamps)) if stamps[number] < stamps[number - 1]]
    assert len(back) == 1
    assert [after < before for before, after in jumps] == [False, True]
    assert jumps[1] == (stamps[back[0] - 1], stamps[back[0]])
    assert jumps[1][0] > 101 * SECOND
    assert 50 * SECOND <= jumps[1][1] < 51 * SECOND
    assert len(stamps) > 20


async def check_command(link: MakeLink, place: str) -> None:
    """``tfbus robot --follow`` takes the description and the joints from ROS, and gives it the frames of the robot."""
    samples: list[TransformStamped] = []

    def keep(batch: Batch) -> None:
        samples.extend(batch)

    with Bus() as bus:
        bus.subscribe(keep)
        async with link(bus, send=False):
            with start_tfbus("robot", "--ros", place, "--follow") as robot:
                await until(lambda: len(samples) > _ENOUGH)
                await until(lambda: "hand" in {sample.child for sample in samples if sample.static})
                assert robot.end() == 130
                assert "publishing the frames of 'arm'" in robot.errors.text
    check_samples(samples)
