"""The first of the tutorial's two programs."""

import json
import signal

import pytest
from support.processes import new_domain
from support.programs import free_address, tfbus


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_others_get_what_it_says_it_sends_until_ctrl_c(backend: str) -> None:
    domain, address = new_domain(), free_address()
    options = ("--domain", domain, "--backend", backend)
    with tfbus("broadcast", "--rate", "20", "--listen", address, *options) as broadcaster:
        with tfbus("tree", "--json", "--connect", address, *options) as tree:
            assert tree.wait() == 0
        assert broadcaster.end() == 130
    frames = json.loads(tree.output.text)["frames"]
    assert set(frames) == {"base_link", "base_laser"}
    assert frames["base_laser"]["authority"] == "robot_tf_publisher"
    assert frames["base_laser"]["rate"] == pytest.approx(20, rel=0.5)
    assert broadcaster.errors.text == (
        f"broadcasting 'base_laser' in 'base_link' at 20 Hz on domain '{domain}', until Ctrl-C\n"
    )
    assert broadcaster.output.text == ""


def test_terminating_it_ends_it_at_once_and_without_a_word() -> None:
    with tfbus("broadcast", "--domain", new_domain()) as broadcaster:
        greeting = broadcaster.errors.expect("broadcasting")
        assert broadcaster.end(signal.SIGTERM) == -signal.SIGTERM
    assert broadcaster.errors.text == f"{greeting}\n"
