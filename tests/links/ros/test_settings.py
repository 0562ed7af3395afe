""""""

from typing import Any

import pytest
from support.samples import moving

from tfbus import InvalidTransformError, SimulatedClock
from tfbus.links.ros.settings import FrameNames, RosSettings, as_topics, settings_of


def test_without_options_the_settings_are_those_of_tf2() -> None:
    found, default = settings_of({}), RosSettings()
    for settings in (found, default):
        assert (settings.tf, settings.tf_static) == (("/tf",), ("/tf_static",))
        assert (settings.send, settings.authority) == (True, None)
        assert settings.names.is_local("anything")


def test_options_become_settings() -> None:
    settings = settings_of(
        {"tf": ["a/tf", "/tf"], "tf_static": "s", "prefix": "r/", "shared": ["map"], "send": False, "authority": "x"}
    )
    assert (settings.tf, settings.tf_static) == (("/a/tf", "/tf"), ("/s",))
    assert (settings.send, settings.authority) == (False, "x")
    assert settings.names.localise(moving("map", "r/a", 1)) == moving("map", "a", 1)


def test_the_topic_of_joints_is_heard_only_if_somebody_takes_them() -> None:
    assert settings_of({}).joint_topic == settings_of({"joint_topic": "/j"}).joint_topic == ()
    assert settings_of({"joint_states": print}).joint_topic == ("/joint_states",)
    assert settings_of({}).clock_topic == ()
    assert settings_of({"clock": SimulatedClock()}).clock_topic == ("/clock",)
    settings = settings_of({"joint_states": print, "joint_topic": "arm/j"})
    assert (settings.joint_topic, settings.joint_states) == (("/arm/j",), print)


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"authority": 5}, TypeError),
        ({"joint_states": "/joint_states"}, TypeError),
        ({"tf": ""}, ValueError),
        ({"tf_static": []}, ValueError),
        ({"prefix": "/r"}, ValueError),
        ({"shared": ["map"]}, TypeError),
    ],
)
def test_options_that_are_not_valid_are_refused(options: Any, error: type[Exception]) -> None:
    with pytest.raises(error):
        settings_of(options)


@pytest.mark.parametrize(
    ("topics", "found"),
    [
        ("/tf", ("/tf",)),
        ("robot1/tf", ("/robot1/tf",)),
        (["/tf", "tf", "/b_2/tf"], ("/tf", "/b_2/tf")),
    ],
)
def test_topics_are_one_or_several_each_once_with_a_slash_in_front(topics: Any, found: tuple[str, ...]) -> None:
    assert as_topics(topics, "tf") == found


@pytest.mark.parametrize("topic", ["", "/", "/tf/", "a//b", "/1tf", "/t f", "/tf\n", ["/tf", "a-b"], []])
def test_what_cannot_be_a_topic_is_refused(topic: Any) -> None:
    with pytest.raises(ValueError, match="topic"):
        as_topics(topic, "tf")


def test_a_topic_is_a_string() -> None:
    with pytest.raises(TypeError, match="5"):
        as_topics([5], "tf")  # type: ignore[list-item]


def test_names_get_the_prefix_on_the_bus_and_lose_it_on_the_way_out() -> None:
    names = FrameNames("r1/", {"map"})
    sample = moving("map", "base", 5, 1.0, "/node")
    names.put_on_bus(sample)
    assert sample == moving("map", "r1/base", 5, 1.0, "/node")
    assert names.localise(sample) == moving("map", "base", 5, 1.0, "/node")
    assert [names.is_local(name) for name in ("r1/base", "map", "base", "r2/base")] == [True, True, False, False]


def test_a_parent_without_a_name_in_ros_and_a_name_that_has_the_prefix_there_are_refused() -> None:
    names = FrameNames("r1/")
    with pytest.raises(InvalidTransformError, match=r"shared=\{'map'\}") as without:
        names.localise(moving("map", "r1/base", 5, authority="me"))
    with pytest.raises(InvalidTransformError, match="r1/base") as twice:
        names.put_on_bus(moving("base", "r1/base", 5, authority="me"))
    for caught, parent in ((without, "map"), (twice, "base")):
        error = caught.value
        assert (error.reason, error.parent, error.child, error.authority) == ("prefix", parent, "r1/base", "me")
    with pytest.raises(InvalidTransformError):
        names.put_on_bus(moving("r1/base", "tool", 5))


def test_without_a_prefix_all_names_stay() -> None:
    names = FrameNames()
    sample = moving("map", "base", 5)
    names.put_on_bus(sample)
    assert names.localise(sample) is sample
    assert sample == moving("map", "base", 5)
    assert names.is_local("base")
    with pytest.raises(TypeError):
        FrameNames(None, {"map"})
