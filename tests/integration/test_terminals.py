"""The output of commands on a real terminal fits its width, and keeps the important columns."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from support import pr2
from support.commands import lines_on_a_terminal
from support.processes import new_domain, start_tfbus
from support.recorded import SMALL

from tfbus.cli.output import cells

pytestmark = [pytest.mark.thorough, pytest.mark.parametrize("width", [60, 80, 200])]

ARM = Path(__file__).parents[2] / "demos" / "robot_arm.urdf"
URDFS = [pytest.param(ARM, id="arm"), pytest.param(pr2.URDF, id="PR2", marks=pr2.needed)]
RECORDINGS = [
    pytest.param(SMALL, ("map", "base_link"), id="small"),
    pytest.param(pr2.BAG, ("base_footprint", "l_gripper_tool_frame"), id="PR2", marks=pr2.needed),
]


def check(lines: list[str], width: int, *, least: int = 2) -> None:
    assert [line for line in lines if cells(line) > width] == []
    assert len(lines) >= least


@pytest.mark.parametrize("urdf", URDFS)
def test_the_frames_of_a_robot_fit(urdf: Path, width: int) -> None:
    lines = lines_on_a_terminal(width, "robot", urdf, "--tree")
    check(lines, width, least=5)
    if width >= 80:
        text = "\n".join(lines)
        assert ("base_link" in text, " 0 rad" in text) == (True, True)


@pytest.fixture(scope="module", params=URDFS)
def robot(request: pytest.FixtureRequest) -> Iterator[tuple[Path, tuple[str, ...]]]:
    """The description of a robot that is published, and the options that join its domain."""
    options = ("--domain", new_domain())
    with start_tfbus("robot", str(request.param), *options) as program:
        program.errors.expect("publishing")
        yield request.param, options


def test_the_tree_of_a_domain_fits_with_frame_rate_and_age(robot: tuple[Path, tuple[str, ...]], width: int) -> None:
    urdf, options = robot
    with ThreadPoolExecutor() as side_by_side:
        drawn = [
            side_by_side.submit(lines_on_a_terminal, width, *command, *options, seconds=seconds)
            for command, seconds in (
                (("tree",), None),
                (("tree", "--watch"), 1.5),
                (("echo", *pair_of(urdf)), 0.5),
                (("monitor", "--once", "--duration", "1.5"), None),
            )
        ]
    once, watched, echoed, monitored = (lines.result() for lines in drawn)
    for lines in (once, watched, echoed, monitored):
        check(lines, width)
    moving = [line for line in once if " Hz" in line]
    assert moving
    assert all("age" in line or "ahead" in line for line in moving)
    if urdf == pr2.URDF:
        assert len(once) > 82
        assert any("lines more than fit" in line for line in watched)


def pair_of(urdf: Path) -> tuple[str, str]:
    return ("base_footprint", "l_gripper_tool_frame") if urdf == pr2.URDF else ("base_link", "hand")


@pytest.mark.parametrize(("recording", "pair"), RECORDINGS)
def test_the_facts_of_a_recording_fit(recording: Path, pair: tuple[str, str], width: int) -> None:
    check(lines_on_a_terminal(width, "info", recording), width, least=20)
    check(lines_on_a_terminal(width, "check", recording), width, least=1)
    lines = lines_on_a_terminal(width, "query", recording, *pair, "--every", "1")
    check(lines, width)
    assert lines[0].split()[:2] == ["stamp", "[s]"]


def test_the_lines_of_the_tutorial_fit(width: int) -> None:
    lines = lines_on_a_terminal(width, "demo", "--simulated", "--duration", "2")
    check(lines, width)
    assert "base_link:" in " ".join(lines)
