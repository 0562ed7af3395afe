import os

import pytest
from support.commands import Command, check_wrong_call
from support.processes import new_domain
from support.programs import start_tfbus


@pytest.mark.thorough
@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_frames_pass_from_ros_to_a_domain_and_back(backend: str) -> None:
    pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')
    number = 100 + os.getpid() % 100
    ros, domain = ("--ros", f"dds:{number}"), ("--domain", new_domain())
    with start_tfbus("bridge", domain[1], ros[1], "--backend", backend) as bridge:
        assert bridge.errors.expect("passing on").endswith(f"and ROS at dds:{number}, until Ctrl-C")
        with (
            start_tfbus("static", "base", "laser", "--xyz", "1", "2", "3", *ros),
            start_tfbus("static", "map", "base", "--xyz", "1", "0", "0", *domain),
            start_tfbus("echo", "map", "laser", *domain) as here,
            start_tfbus("echo", "map", "laser", *ros) as there,
        ):
            for echo in (here, there):
                assert echo.output.expect("Translation") == "- Translation: [2.000000, 2.000000, 3.000000] m"
        assert bridge.end() == 130


def test_a_bridge_has_two_ends(tfbus: Command) -> None:
    check_wrong_call(tfbus("bridge", "dds", "dds"), "two places")


def test_ros_that_is_not_there_is_a_usage_error(tfbus: Command) -> None:
    pytest.importorskip("wsproto", reason='pip install "tfbus[rosbridge]"')
    for words in (("bridge", "ws://127.0.0.1:1", "tf"), ("echo", "map", "base", "--ros", "ws://127.0.0.1:1")):
        check_wrong_call(tfbus(*words), "cannot join ROS at ws://127.0.0.1:1: ")
