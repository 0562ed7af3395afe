"""``tfbus robot`` as a user runs it: in a process of its own."""

import math
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import anyio
import pytest
from cyclopts import CycloptsError
from support import pr2

from tfbus import Buffer, Bus, SystemClock
from tfbus.cli import app
from tfbus.cli.domain import UnusableError
from tfbus.links.zenoh import ZenohLink

TFBUS = str(Path(sys.executable).with_name("tfbus"))
PATIENCE = 60.0

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


@pytest.fixture
def address() -> Iterator[str]:
    """Of a socket; its path is short, as the system wants it."""
    with tempfile.TemporaryDirectory() as folder:
        yield f"unixsock-stream/{folder}/s"


def call(*arguments: str) -> None:
    """The command in this process: for what needs no other."""
    app(["robot", *arguments], exit_on_error=False, print_error=False, result_action="return_value")


def refused(*arguments: str) -> str:
    """Why the command does not even begin."""
    with pytest.raises((CycloptsError, UnusableError)) as caught:
        call(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def tfbus(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([TFBUS, "robot", *arguments], capture_output=True, text=True, timeout=PATIENCE, check=False)


def test_the_tree_shows_frames_joints_types_and_positions_at_zero(crane: str) -> None:
    done = tfbus(crane, "--tree")
    assert (done.stdout, done.stderr, done.returncode) == (AT_ZERO, "", 0)


def test_the_tree_shows_the_positions_and_the_prefix_that_it_was_given(crane: str) -> None:
    pairs = ("swing=-0.25", "rope=3", "wheels=1,-2,0.5", "wind=1,2,3,1,0,0,0")
    done = tfbus(crane, *pairs, "--tree", "--prefix", "r1/")
    assert (done.stdout, done.stderr, done.returncode) == (MOVED, "", 0)


def test_a_joint_that_mimics_may_be_given_a_position_of_its_own(crane: str, capsys: pytest.CaptureFixture[str]) -> None:
    call(crane, "rope=3", "follow=2", "--tree")
    assert "── shadow    follow  prismatic  2 m\n" in capsys.readouterr().out


def test_the_name_of_a_joint_may_have_an_equals_sign_and_minus_zero_is_zero(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "odd.urdf"
    path.write_text(CRANE.replace('name="swing"', 'name="s=w"'))
    call(str(path), "s=w=-0", "--tree")
    assert "├── boom      s=w     revolute   0 rad\n" in capsys.readouterr().out


def test_a_joint_that_follows_nothing_that_moves_has_no_position(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "frozen.urdf"
    path.write_text(CRANE.replace('name="rope" type="prismatic"', 'name="rope" type="fixed"'))
    call(str(path), "--tree")
    assert "├── shadow    follow  prismatic\n" in capsys.readouterr().out


def test_a_position_beyond_the_limits_is_told_on_standard_error_and_used(crane: str) -> None:
    done = tfbus(crane, "rope=30", "--tree")
    assert done.stderr.splitlines() == [
        "tfbus: joint 'rope': position 30 is outside its limits, from 0 to 4",
        "tfbus: joint 'follow': position -15 is outside its limits, from -9 to 9",
    ]
    assert "rope    prismatic  30 m" in done.stdout
    assert done.returncode == 0


def test_a_robot_of_one_link_has_a_tree_of_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "stone.urdf"
    path.write_text('<robot name="stone"><link name="stone&#10;"/></robot>')
    call(str(path), "--tree")
    assert capsys.readouterr().out == "stone\\n\n"


@pr2.needed
def test_the_tree_of_a_pr2_has_its_83_frames() -> None:
    done = tfbus(str(pr2.URDF), "--tree")
    assert (done.stderr, done.returncode) == ("", 0)
    frames = [re.split(r"  +", line.lstrip("│├└─ "))[0] for line in done.stdout.splitlines()]
    assert len(frames) == 83
    assert set(frames) == {parent for edge in pr2.recorded().static for parent in edge} | {
        parent for edge in next(iter(pr2.recorded().moving.values())) for parent in edge
    }


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["elbow=1"], "'crane' has no joint 'elbow'"),
        (["ropes=1"], "'crane' has no joint 'ropes', did you mean 'rope'?"),
        (["=1"], "'crane' has no joint ''"),
        (["swing"], "a position is NAME=NUMBER, such as elbow=0.5, not 'swing'"),
        (["swing=left"], "joint 'swing': position 'left' is not a number"),
        (["swing="], "joint 'swing': position '' is not a number"),
        (["swing=1,2"], "joint 'swing': position '1,2' is not one number"),
        (["swing=nan"], "joint 'swing': position nan is not finite"),
        (["rope=inf"], "joint 'rope': position inf is not finite"),
        (["screw=1"], "joint 'screw' is fixed and has no position"),
        (["swing=1", "swing=2"], "joint 'swing' has two positions"),
        (["wheels=1"], "joint 'wheels': position must be 3 numbers, got shape (1,)"),
        (["wind=0,0,0,0,0,0,0"], "joint 'wind': rotation is the zero quaternion"),
        (["wind=0,0,0"], "joint 'wind': rotation must be 4 numbers, got shape (0,)"),
        (["--prefix", "/r1/"], "a frame name must not start with '/', got '/r1/boom': write 'r1/boom'"),
        (["--rate", "0"], "Invalid value"),
        (["--rate", "nan"], "Invalid value"),
        (["--no-such-option"], "Unknown option"),
        (["--connect", "nowhere"], "an address is like tcp/192.168.1.5:7447, not 'nowhere'"),
    ],
)
def test_a_wrong_call_is_told_in_one_line(crane: str, arguments: list[str], message: str) -> None:
    assert refused(crane, *arguments).startswith(message)


def test_a_wrong_call_is_status_2_and_a_line_on_standard_error(crane: str) -> None:
    done = tfbus(crane, "swing=left")
    assert (done.stdout, done.returncode) == ("", 2)
    assert done.stderr == "tfbus: joint 'swing': position 'left' is not a number\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot read {path}: No such file or directory"),
        ("", "{path}: it is not well-formed XML: no element found: line 1, column 0"),
        (
            CRANE.replace('name="kite"', 'name="bird"'),
            "{path}: in <joint name=\"wind\">: child link 'kite' is not there",
        ),
        (CRANE.replace("0 0 5", "0 0 five"), '{path}: in <joint name="swing">: origin[@xyz]: could not convert'),
        (
            CRANE.replace("</robot>", '<xacro:macro xmlns:xacro="http://www.ros.org/wiki/xacro" name="m"/></robot>'),
            '{path}: in <xacro:macro name="m">: this is still to be expanded: run xacro on the file first',
        ),
    ],
)
def test_a_file_that_cannot_be_used_is_named(tmp_path: Path, content: str | None, message: str) -> None:
    path = tmp_path / "robot.urdf"
    if content is not None:
        path.write_text(content)
    assert refused(str(path), "--tree").startswith(message.format(path=path))


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_a_robot_is_published_on_the_domain_until_ctrl_c(crane: str, address: str, backend: str) -> None:
    options = ["--listen", address, "--domain", "yard", "--rate", "50", "--backend", backend]
    command = [TFBUS, "robot", crane, "swing=0.5", "rope=1.5", *options]

    async def hook() -> tuple[float, float, float]:
        with Bus() as bus, Buffer(bus) as buffer:
            async with ZenohLink(bus, "yard", connect=address):
                await buffer.lookup("boom", "lamp", timeout=PATIENCE)
                found = await buffer.lookup("base", "hook", timeout=PATIENCE)
                assert start <= found.stamp <= bus.clock.now()
                await buffer.lookup("base", "hook", found.stamp + 200_000_000, timeout=PATIENCE)
                assert {edge.authority for edge in buffer.tree.edges()} == {"robot"}
                assert [edge.child for edge in buffer.tree.edges() if edge.static] == ["lamp"]
                return found.transform.translation

    start = SystemClock().now()
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            line = process.stderr.readline()
            assert line == "publishing 6 frames of 'crane' on domain 'yard' at 50 Hz, until Ctrl-C\n"
            assert anyio.run(hook) == pytest.approx((2.0 * math.cos(0.5), 2.0 * math.sin(0.5), 3.5))
        finally:
            process.send_signal(signal.SIGINT)
            output, errors = process.communicate(timeout=PATIENCE)
    assert (process.returncode, output, errors) == (130, "", "")


def test_without_its_extra_the_command_names_it(crane: str) -> None:
    hidden = (
        "import sys; sys.modules['urdf_parser_py'] = None\n"
        f"sys.argv = ['tfbus', 'robot', {crane!r}, '--tree']\n"
        "import tfbus.cli; tfbus.cli.main()"
    )
    done = subprocess.run([sys.executable, "-c", hidden], capture_output=True, text=True, check=False)
    assert done.stderr == 'tfbus: to read URDF, tfbus needs a package more: pip install "tfbus[urdf]"\n'
    assert done.returncode == 2


def test_help_shows_every_option_and_an_example() -> None:
    done = tfbus("--help")
    assert done.returncode == 0
    for option in ("FILE", "--tree", "--rate", "--prefix", "--domain", "--listen", "--connect", "--backend"):
        assert option in done.stdout
    assert "Example: tfbus robot " in done.stdout
