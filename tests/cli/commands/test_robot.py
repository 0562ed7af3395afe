import json
import math
import re
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from support import pr2
from support.commands import START, Command, check_wrong_call, nobody
from support.processes import start_tfbus, until

from tfbus import SECOND, Buffer, Bus, RobotModel, TransformStamped
from tfbus.cli import domain
from tfbus.cli.commands.robot import tree_lines

CRANE = """<?xml version="1.0"?>
<robot name="crane">
  <link name="base"/> <link name="boom"/> <link name="hook"/> <link name="shadow"/> <link name="lamp"/>
  <link name="cart"/> <link name="kite"/>
  <joint name="swing" type="revolute">
    <parent link="base"/> <child link="boom"/> <origin xyz="0 0 5"/> <axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>
  </joint>
  <joint name="screw" type="fixed"> <parent link="boom"/> <child link="lamp"/> <origin xyz="0.5 0 0"/> </joint>
  <joint name="rope" type="prismatic">
    <parent link="boom"/> <child link="hook"/> <origin xyz="2 0 0"/> <axis xyz="0 0 -1"/>
    <limit lower="0" upper="4" effort="1" velocity="1"/>
  </joint>
  <joint name="follow" type="prismatic">
    <parent link="base"/> <child link="shadow"/> <axis xyz="1 0 0"/> <mimic joint="rope" multiplier="-0.5"/>
    <limit lower="-9" upper="9" effort="1" velocity="1"/>
  </joint>
  <joint name="wheels" type="planar"> <parent link="base"/> <child link="cart"/> <axis xyz="0 0 1"/> </joint>
  <joint name="wind" type="floating"> <parent link="base"/> <child link="kite"/> </joint>
</robot>
"""

AT_ZERO = """\
base
├── boom      swing   revolute   0 rad
│   ├── lamp  screw   fixed
│   └── hook  rope    prismatic  0 m
├── shadow    follow  prismatic  0 m, mimics rope
├── cart      wheels  planar     xy 0 0 m, angle 0 rad
└── kite      wind    floating   xyz 0 0 0 m, rpy 0 0 0 rad
"""

MOVED = """\
r1/base
├── r1/boom      swing   revolute   -0.25 rad
│   ├── r1/lamp  screw   fixed
│   └── r1/hook  rope    prismatic  3 m
├── r1/shadow    follow  prismatic  -1.5 m, mimics rope
├── r1/cart      wheels  planar     xy 1 -2 m, angle 0.5 rad
└── r1/kite      wind    floating   xyz 1 2 3 m, rpy 3.14159 0 0 rad
"""


@pytest.fixture
def crane(tmp_path: Path) -> str:
    path = tmp_path / "crane.urdf"
    path.write_text(CRANE)
    return str(path)


@pytest.mark.parametrize(
    ("arguments", "shown"),
    [
        ((), AT_ZERO),
        (("swing=-0.25", "rope=3", "wheels=1,-2,0.5", "wind=1,2,3,1,0,0,0", "--prefix", "r1/"), MOVED),
        # A position of its own takes the place of that of the joint which it mimics.
        (
            ("rope=3", "follow=2"),
            AT_ZERO.replace("0 m, mimics rope", "2 m").replace("prismatic  0 m", "prismatic  3 m"),
        ),
        (("swing=-0",), AT_ZERO),
    ],
)
def test_the_tree_has_frames_joints_types_and_positions(
    crane: str, arguments: Sequence[str], shown: str, tfbus: Command
) -> None:
    done = tfbus("robot", crane, *arguments, "--tree")
    assert (done.returncode, done.stdout, done.stderr) == (0, shown, "")


@pytest.mark.parametrize(
    ("old", "new", "arguments", "line"),
    [
        ('name="swing"', 'name="s=w"', ("s=w=1",), "├── boom      s=w     revolute   1 rad"),
        # A joint that mimics a fixed joint has no position.
        ('name="rope" type="prismatic"', 'name="rope" type="fixed"', (), "├── shadow    follow  prismatic"),
    ],
)
def test_the_tree_of_an_odd_robot(
    tmp_path: Path, old: str, new: str, arguments: Sequence[str], line: str, tfbus: Command
) -> None:
    path = tmp_path / "odd.urdf"
    path.write_text(CRANE.replace(old, new))
    assert line in tfbus("robot", path, *arguments, "--tree").stdout.splitlines()


def test_a_position_beyond_the_limits_is_a_warning_and_used(crane: str, tfbus: Command) -> None:
    done = tfbus("robot", crane, "rope=30", "--tree")
    assert done.stderr.splitlines() == [
        "tfbus: joint 'rope': position 30 is outside its limits, from 0 to 4",
        "tfbus: joint 'follow': position -15 is outside its limits, from -9 to 9",
    ]
    assert "rope    prismatic  30 m" in done.stdout
    assert done.returncode == 0


def test_a_robot_of_one_link_has_a_tree_of_one_line(tmp_path: Path, tfbus: Command) -> None:
    path = tmp_path / "stone.urdf"
    path.write_text('<robot name="stone"><link name="stone&#10;"/></robot>')
    assert tfbus("robot", path, "--tree").stdout == "stone\\n\n"


@pr2.needed
def test_the_tree_of_a_pr2_has_its_83_frames(tfbus: Command) -> None:
    done = tfbus("robot", pr2.URDF, "--tree")
    assert (done.stderr, done.returncode) == ("", 0)
    frames = [re.split(r"  +", line.lstrip("│├└─ "))[0] for line in done.stdout.splitlines()]
    assert len(frames) == 83
    assert set(frames) == {parent for edge in pr2.recorded().static for parent in edge} | {
        parent for edge in next(iter(pr2.recorded().moving.values())) for parent in edge
    }


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["elbow=1"], "'crane' has no joint 'elbow'"),
        (["ropes=1"], "'crane' has no joint 'ropes', did you mean 'rope'?"),
        (["swing"], "a position is NAME=NUMBER, such as elbow=0.5, not 'swing'"),
        (["swing=left"], "joint 'swing': position 'left' is not a number"),
        (["swing=1,2"], "joint 'swing': position '1,2' is not one number"),
        (["swing=nan"], "joint 'swing': position nan is not finite"),
        (["rope=1e13"], "the translation of 'hook' in 'boom' is 1e+13 m long, which is not physical"),
        (["screw=1"], "joint 'screw' is fixed and has no position"),
        (["swing=1", "swing=2"], "joint 'swing' has two positions"),
        (["wheels=1"], "joint 'wheels': position must be 3 numbers, got shape (1,)"),
        (["wind=0,0,0"], "joint 'wind': rotation must be 4 numbers, got shape (0,)"),
        (["--prefix", "/r1/"], "a frame name must not start with '/', got '/r1/boom': write 'r1/boom'"),
    ],
)
def test_a_wrong_call_is_one_line_on_standard_error_and_status_2(
    crane: str, arguments: Sequence[str], why: str, tfbus: Command
) -> None:
    check_wrong_call(tfbus("robot", crane, *arguments), why)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot read {path}: No such file or directory"),
        (CRANE.replace("0 0 5", "0 0 five"), '{path}: in <joint name="swing">: origin[@xyz]: could not convert'),
    ],
)
def test_a_file_that_cannot_be_used_is_named(tmp_path: Path, content: str | None, message: str, tfbus: Command) -> None:
    path = tmp_path / "robot.urdf"
    if content is not None:
        path.write_text(content)
    check_wrong_call(tfbus("robot", path, "--tree"), message.format(path=path))


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_fixed_joints_are_published_once_and_the_others_at_the_rate(crane: str, backend: str, tfbus: Command) -> None:
    batches: list[tuple[TransformStamped, ...]] = []
    hooks: list[tuple[float, ...]] = []

    async def listen(bus: Bus) -> None:
        with bus.subscribe(batches.append), Buffer(bus) as buffer:
            await bus.clock.sleep(0.11)
            hooks.append(buffer.lookup_nowait("r1/base", "r1/hook").transform.translation)

    options = ("--prefix", "r1/", "--rate", "20", "--domain", "yard", "--backend", backend)
    done = tfbus.on_domain(listen, "robot", crane, "swing=0.5", "rope=1.5", *options)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "publishing 6 frames of 'crane' on domain 'yard' at 20 Hz, until Ctrl-C\n"
    fixed, *moving = batches
    assert [(sample.parent, sample.child, sample.stamp, sample.static) for sample in fixed] == [
        ("r1/boom", "r1/lamp", START, True)
    ]
    frames = ["r1/boom", "r1/cart", "r1/hook", "r1/kite", "r1/shadow"]
    assert [sorted(sample.child for sample in batch) for batch in moving] == [frames] * 3
    stamps = [{sample.stamp for sample in batch} for batch in moving]
    assert stamps == [{START}, {START + SECOND // 20}, {START + SECOND // 10}]
    assert {(sample.authority, sample.static) for batch in moving for sample in batch} == {("robot", False)}
    assert hooks == [pytest.approx((2.0 * math.cos(0.5), 2.0 * math.sin(0.5), 3.5))]


def test_where_the_tree_does_not_fit_types_and_joints_go_and_mimics_are_shortened(crane: str) -> None:
    model = RobotModel.from_urdf(crane)
    whole = list(tree_lines(model, model.zeros()))
    widest = max(map(len, whole))
    assert list(tree_lines(model, model.zeros(), width=widest)) == whole
    for width in range(24, widest):
        lines = list(tree_lines(model, model.zeros(), width=width))
        assert max(map(len, lines)) <= width
        assert len(lines) == len(whole)
        assert all("revolute" not in line for line in lines)


class Ros:
    """Links to ROS that pass on a description and positions at once, and note what they were asked for."""

    def __init__(self, description: str) -> None:
        self._description = description
        self.asked: list[tuple[str, str, object, object]] = []
        self.topics: list[object] = []

    @asynccontextmanager
    async def link(
        self, _: Bus, place: str, *, send: bool, frames: object, prefix: object, **options: Any
    ) -> AsyncIterator[None]:
        ((what, take),) = ((name, option) for name, option in options.items() if callable(option))
        self.asked.append((place, what, send, frames))
        self.topics += [prefix, options.get("joint_topic"), options.get("description_topic")]
        if what == "robot_description":
            take(self._description)
        else:
            take({"swing": 0.5}, 5 * SECOND)
        yield


def test_ros_describes_a_robot_and_moves_it(tfbus: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    ros, found = Ros(CRANE), list[TransformStamped]()
    monkeypatch.setattr(domain, "ros_link", ros.link)

    async def ask(bus: Bus) -> None:
        with Buffer(bus) as buffer:
            found.append(await buffer.lookup("r1/base", "r1/boom"))

    done = tfbus.on_domain(ask, "robot", "--follow", "--ros", "dds:7", "--prefix", "r1/")
    assert done.returncode == 130
    assert done.stderr.splitlines()[:2] == [
        "waiting for /robot_description of ROS at dds:7",
        "publishing the frames of 'crane' as /joint_states of ROS at dds:7 says, until Ctrl-C",
    ]
    assert ros.asked == [("dds:7", "robot_description", False, ()), ("dds:7", "joint_states", False, ())]
    assert ros.topics == [None] * 6
    tfbus.on_domain(ask, "robot", "--follow", "--ros", "dds", "--tf", "/r1/tf", "--tf-prefix", "r1/", "--prefix", "r1/")
    assert ros.topics[6:] == ["r1/", "/r1/joint_states", "/r1/robot_description"] * 2
    assert found[0].stamp == 5 * SECOND
    assert found[0].transform.as_rpy()[2] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("text", "why"), [("/etc/passwd", "/robot_description holds no URDF"), ("<robot", "/robot_description: ")]
)
def test_a_description_of_ros_that_is_none_is_a_usage_error(
    tfbus: Command, monkeypatch: pytest.MonkeyPatch, text: str, why: str
) -> None:
    monkeypatch.setattr(domain, "ros_link", Ros(text).link)
    done = tfbus.on_domain(nobody, "robot", "--follow", "--ros", "dds")
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith(f"tfbus: {why}")


@pytest.mark.thorough
@pytest.mark.anyio
async def test_the_description_and_the_positions_of_ros_move_a_robot() -> None:
    pytest.importorskip("wsproto", reason='pip install "tfbus[rosbridge]"')
    from support.rosbridge import rosbridge_server

    async with rosbridge_server() as server:
        with start_tfbus("robot", "--follow", "--ros", server.url):
            await until(lambda: "/robot_description" in server.operations("subscribe"))
            text = {"op": "publish", "topic": "/robot_description", "msg": {"data": CRANE}}
            await server.say_anything(json.dumps(text))
            await until(lambda: "/joint_states" in server.operations("subscribe"))
            state = {"header": {"stamp": {"secs": 5, "nsecs": 0}}, "name": ["swing"], "position": [0.5]}
            await server.say_anything(json.dumps({"op": "publish", "topic": "/joint_states", "msg": state}))
            await until(lambda: "/tf" in server.operations("publish"))
    (boom,) = (
        row
        for request in server.requests
        if request["op"] == "publish" and request["topic"] == "/tf"
        for row in request["msg"]["transforms"]
        if row["child_frame_id"] == "boom"
    )
    assert boom["header"]["frame_id"] == "base"
    assert boom["header"]["stamp"] == {"secs": 5, "nsecs": 0}
    assert boom["transform"]["rotation"]["z"] == pytest.approx(math.sin(0.25))
