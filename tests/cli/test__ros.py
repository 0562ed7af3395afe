import os
import re
from pathlib import Path

import pytest
from support.both_sides import URDF
from support.processes import start_tfbus

from tfbus import Bus
from tfbus.cli._ros import is_ros, ros_link
from tfbus.cli.arguments import UsageError


@pytest.mark.parametrize(
    ("place", "ros"),
    [
        ("dds", True),
        ("dds:42", True),
        ("ws://a:9090", True),
        ("wss://a", True),
        ("zenoh:robot:7447", True),
        ("zenoh:robot", False),
        ("tf", False),
        ("dds/a", False),
        ("adds", False),
        ("domain:dds", False),
    ],
)
def test_a_place_of_ros_is_told_from_a_domain(place: str, ros: bool) -> None:
    assert is_ros(place) is ros


def test_a_place_becomes_a_link(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    assert [getattr(ros_link(Bus(), place), "domain", None) for place in ("dds", "dds:42")] == [0, 42]


def test_a_router_becomes_a_link(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("zenoh", reason='pip install "tfbus[zenoh]"')
    monkeypatch.setenv("ROS_DOMAIN_ID", "5")
    assert getattr(ros_link(Bus(), "zenoh:robot:7447"), "domain", None) == 5


def test_a_websocket_becomes_a_link() -> None:
    pytest.importorskip("wsproto", reason='pip install "tfbus[rosbridge]"')
    assert getattr(ros_link(Bus(), "ws://robot:9091"), "url", "") == "ws://robot:9091"


@pytest.mark.parametrize(
    ("place", "why"),
    [("tf", "no place of ROS: write dds"), ("dds:x", "no place"), ("dds:300", "0 to 232"), ("ws://", "no URL")],
)
def test_what_is_no_place_of_ros_is_a_usage_error(place: str, why: str) -> None:
    for extra in ("cyclonedds", "wsproto"):
        pytest.importorskip(extra)
    with pytest.raises(UsageError, match=why):
        ros_link(Bus(), place)


@pytest.mark.thorough
def test_every_command_that_joins_a_domain_joins_ros(tmp_path: Path) -> None:
    for extra in ("cyclonedds", "urdf_parser_py"):
        pytest.importorskip(extra)
    number = 100 + os.getpid() % 99
    ros, other = ("--ros", f"dds:{number}"), ("--ros", f"dds:{number + 1}")
    recording, urdf = str(tmp_path / "drive.mcap"), tmp_path / "arm.urdf"
    urdf.write_text(URDF)
    with (
        start_tfbus("broadcast", *ros) as broadcast,
        start_tfbus("static", "base_laser", "camera", "--xyz", "1", "0", "0", *ros),
        start_tfbus("robot", str(urdf), *ros) as robot,
        start_tfbus("listen", *ros) as listen,
    ):
        assert broadcast.errors.expect("broadcasting").endswith(f"on ROS at dds:{number}, until Ctrl-C")
        assert "base_link" in listen.output.expect("base_laser")
        assert f"on ROS at dds:{number}" in robot.errors.expect("publishing")
        with start_tfbus("echo", "base_link", "camera", *ros) as echo, start_tfbus("record", recording, *ros) as record:
            echo.output.expect("Translation")
            record.errors.expect("recording ROS at")
            with start_tfbus("tree", *ros) as tree:
                assert tree.wait() == 0
            assert {"base_laser", "camera", "hand"} <= set(re.findall(r"\w+", tree.output.text))
            assert record.end() == 130
    with start_tfbus("echo", "base_link", "camera", *other) as there, start_tfbus("play", recording, *other) as play:
        play.errors.expect(f"on ROS at dds:{number + 1}")
        there.output.expect("Translation")
