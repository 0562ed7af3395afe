import pytest

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
