"""A robot that a real ROS describes and moves, and checks of what is heard of it; `ros1_robot.py`, `ros2_robot.py`."""

import math
from collections.abc import Callable, Iterable

from support.processes import until
from support.programs import start_tfbus

from tfbus import SECOND, Bus, SimulatedClock, Transform, TransformStamped
from tfbus.geometry.stamped import Batch
from tfbus.links.ros import RosLink
from tfbus.robot import RobotModel, RobotStatePublisher

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
