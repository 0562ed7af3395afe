"""The fixtures of the benchmarks: a plugin, so that all files fill one table."""

import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from beside import Ask, Table
from cases import Case, Vector


@pytest.fixture(scope="session")
def table(request: pytest.FixtureRequest) -> Table:
    table = Table()
    request.config.pluginmanager.register(table)
    return table


@pytest.fixture(scope="module", params=[("/usr/bin/python3",), (os.environ.get("ROS2_PYTHON"), "ros2")], ids=str)
def tf2(request: pytest.FixtureRequest) -> Iterator[Ask | None]:
    """Has the real tf2 of ROS 1 or ROS 2, in a process of its own, measure one round of a case; None if there is none.

    The process is for one file, because processes that a file leaves are killed.
    """
    python, *arguments = request.param
    if python is None:
        pytest.skip("ROS2_PYTHON names no Python that has the tf2 of ROS 2")
    if not Path(python).exists():
        yield None
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

        yield ask if replies.readline() == "ready\n" else None
