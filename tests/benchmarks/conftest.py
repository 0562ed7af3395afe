"""The fixtures of the benchmarks."""

import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from beside import Ask, Table
from cases import Case, Vector

SYSTEM_PYTHON = "/usr/bin/python3"


@pytest.fixture(scope="session")
def table(request: pytest.FixtureRequest) -> Table:
    table = Table()
    request.config.pluginmanager.register(table)
    return table


# Each of the following is for one file, because processes that a file leaves are killed.


@pytest.fixture(scope="module")
def tf2() -> Iterator[Ask | str]:
    """Has the real tf2 of ROS 1, in a process of its own, measure one round of a case; or says why there is none."""
    yield from _peer(SYSTEM_PYTHON)


@pytest.fixture(scope="module")
def tf2_of_ros_2() -> Iterator[Ask | str]:
    """As `tf2`, of ROS 2."""
    yield from _peer(os.environ.get("ROS2_PYTHON", "the Python that ROS2_PYTHON names"), "ros2")


def _peer(python: str, *arguments: str) -> Iterator[Ask | str]:
    if not Path(python).exists():
        yield f"no {python}"
        return
    command = [python, str(Path(__file__).with_name("tf2_peer.py")), *arguments]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        requests, replies = process.stdin, process.stdout
        assert requests is not None
        assert replies is not None

        def ask(case: Case) -> tuple[float, Vector]:
            print(json.dumps(case), file=requests, flush=True)
            seconds, answer = json.loads(replies.readline())
            return seconds, answer

        greeting = replies.readline().strip()
        yield ask if greeting == "ready" else f"{python}: {greeting}"
