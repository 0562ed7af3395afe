from typing import Any

import pytest
from support.samples import moving

from tfbus import SimulatedClock
from tfbus.links.ros.settings import RosSettings, settings_of


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
