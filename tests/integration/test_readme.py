"""The README tells the truth; that its programs run and its links lead somewhere is in `test_guide.py`."""

import re
from pathlib import Path

import pytest

import tfbus

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
TF2 = (ROOT / "demos" / "guide" / "tf2.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


def test_the_embedding_example_prints_the_point_in_the_base(capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(BLOCKS[0], "README.md", "exec"), {"__name__": "__main__"})
    assert "(1.1, 0.2, 0.2)" in capsys.readouterr().out


def test_the_waiting_example_prints_the_position_half_way_and_the_close_match(
    capsys: pytest.CaptureFixture[str],
) -> None:
    exec(compile(BLOCKS[1], "README.md", "exec"), {"__name__": "__main__"})
    output = capsys.readouterr().out
    assert "translation=(1.5, 0.0, 0.0)" in output
    assert "did you mean 'base_link'?" in output


def test_the_examples_and_the_whole_are_as_short_as_promised() -> None:
    assert len(BLOCKS[0].strip().splitlines()) <= 12
    assert len(README.splitlines()) <= 150


def test_every_name_that_the_table_for_tf2_users_mentions_exists() -> None:
    table = TF2.partition("## Names")[2].partition("## ")[0]
    ours = "".join(line.split("|")[2] for line in table.splitlines() if line.count("|") == 3)
    owners = {"buffer": tfbus.Buffer, "tree": tfbus.TransformTree, "broadcaster": tfbus.TransformBroadcaster}
    methods = re.findall(r"\b(buffer|tree|broadcaster)\.(\w+)", ours)
    assert methods
    for owner, method in methods:
        assert hasattr(owners[owner], method), f"{owner}.{method}"
    for name in re.findall(r"\b([A-Z]\w+)\(|`(\w+Error)`", ours):
        assert hasattr(tfbus, name[0] or name[1])


def test_the_picture_is_what_describe_shows() -> None:
    clock = tfbus.SimulatedClock()
    with tfbus.Bus(clock) as bus, tfbus.Buffer(bus) as buffer:
        calibration = tfbus.TransformBroadcaster(bus, authority="calibration")
        calibration.send_static("base_link", "base_laser", tfbus.Transform((0.1, 0.0, 0.2)))
        calibration.send_static("base_link", "camera", tfbus.Transform((0.3, 0.0, 0.5)))
        slam = tfbus.TransformBroadcaster(bus, authority="slam")
        odometry = tfbus.TransformBroadcaster(bus, authority="odometry")
        for tick in range(1001):
            odometry.send("odom", "base_link", tfbus.Transform(), at=tick * 10_000_000)
        for tick in range(100):
            slam.send("map", "odom", tfbus.Transform(), at=tick * 100_000_000 + 63_000_000)
        clock.set(tfbus.from_seconds(10.004))
        picture = buffer.describe()
    assert f"```\n{picture}\n```" in README


@pytest.mark.parametrize("command", ['pip install ".[cli]" && tfbus demo', 'pip install ".[test]" && pytest'])
def test_both_commands_are_what_ci_types(command: str) -> None:
    assert f"    {command}\n" in README
    assert command in (ROOT / ".ci" / "run").read_text()
