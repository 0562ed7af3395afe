import json
import math
from pathlib import Path

import anyio.lowlevel
import pytest
from support.commands import START, Command, check_wrong_call

from tfbus import Bus, Transform, TransformStamped

HALF = math.sqrt(0.5)
TURNED = (0.0, 0.0, HALF, HALF)
"""By 90 degrees about the third axis."""


def published(tfbus: Command, *arguments: object) -> tuple[list[TransformStamped], str]:
    """The samples that a command publishes, and its output."""
    received: list[TransformStamped] = []

    async def join_late(bus: Bus) -> None:
        await bus.clock.sleep(1.0)
        with bus.subscribe(received.extend):
            await anyio.lowlevel.checkpoint()

    done = tfbus.on_domain(join_late, "static", *arguments)
    assert (done.returncode, done.stdout) == (130, "")
    return received, done.stderr


@pytest.mark.parametrize(
    ("options", "transform", "authority", "numbers"),
    [
        ("", Transform(), "tfbus static", "xyz 0 0 0 m, rpy 0 0 0 rad"),
        ("--xyz 0.1 -2 .5 --authority me", Transform((0.1, -2.0, 0.5)), "me", "xyz 0.1 -2 0.5 m, rpy 0 0 0 rad"),
        (f"--rpy 0 0 {math.pi / 2}", Transform((0, 0, 0), TURNED), "tfbus static", "xyz 0 0 0 m, rpy 0 0 1.5708 rad"),
        (
            f"--quaternion 0 0 {HALF} {HALF} --xyz 1 2 3 --backend trio",
            Transform((1, 2, 3), TURNED),
            "tfbus static",
            "xyz 1 2 3 m, rpy 0 0 1.5708 rad",
        ),
    ],
)
def test_it_publishes_one_static_transform_for_everybody_until_ctrl_c(
    tfbus: Command, options: str, transform: Transform, authority: str, numbers: str
) -> None:
    (sample,), said = published(tfbus, "base_link", "laser", *options.split(), "--domain", "yard")
    assert said == f"publishing 'laser' in 'base_link' on domain 'yard', until Ctrl-C:\n  {numbers}\n"
    assert (sample.parent, sample.child, sample.stamp) == ("base_link", "laser", START)
    assert (sample.authority, sample.static) == (authority, True)
    assert sample.transform.is_close(transform)


def test_degrees_are_degrees_and_an_angle_of_more_than_a_turn_is_questioned(tfbus: Command) -> None:
    (sample,), said = published(tfbus, "a", "b", "--rpy-deg", 0, 0, 90)
    assert sample.transform.is_close(Transform((0, 0, 0), TURNED))
    assert "more than a turn" not in said
    (sample,), said = published(tfbus, "a", "b", "--rpy", 0, 0, 90)
    assert sample.transform.is_close(Transform.from_xyz_rpy((0, 0, 0), (0, 0, 90)))
    assert said.startswith("tfbus: --rpy 0 0 90 is in rad and more than a turn: are these degrees, for --rpy-deg?\n")
    assert "more than a turn" not in published(tfbus, "a", "b", "--rpy", 0, 0, 2 * math.pi)[1]


def test_all_transforms_of_a_file_are_published(tfbus: Command, tmp_path: Path) -> None:
    file = tmp_path / "calibration.json"
    file.write_text(json.dumps([{"parent": "a", "child": "b", "xyz": [1, 2, 3]}, {"parent": "b", "child": "c"}]))
    samples, said = published(tfbus, file, "--authority", "me")
    assert [(sample.parent, sample.child, sample.stamp, sample.authority) for sample in samples] == [
        ("a", "b", START, "me"),
        ("b", "c", START, "me"),
    ]
    assert samples[0].transform.translation == (1.0, 2.0, 3.0)
    assert said.count("publishing") == 2


@pytest.mark.parametrize(
    ("content", "why"),
    [("[]", "there is no transform"), ('[{"parent": "a", "child": "b", "xyz": [1e13, 0, 0]}]', "not physical")],
)
def test_a_file_that_cannot_be_published_is_named(tfbus: Command, tmp_path: Path, content: str, why: str) -> None:
    file = tmp_path / "calibration.json"
    file.write_text(content)
    check_wrong_call(tfbus("static", file), why)
