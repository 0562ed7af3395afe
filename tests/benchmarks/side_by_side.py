"""The fixtures of the benchmarks: a plugin, so that all files fill one table and ask one tf2."""

import json
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
    table.add("", "tfbus", "peer", "ratio", "wanted")
    request.config.pluginmanager.register(table)
    return table


@pytest.fixture(scope="session")
def tf2() -> Iterator[Ask | str]:
    """Has the real tf2, in a process of its own, measure one round of a case; or says why there is none."""
    if not Path(SYSTEM_PYTHON).exists():
        yield f"no {SYSTEM_PYTHON}"
        return
    script = Path(__file__).with_name("tf2_peer.py")
    with subprocess.Popen([SYSTEM_PYTHON, script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        requests, replies = process.stdin, process.stdout
        assert requests is not None
        assert replies is not None

        def ask(case: Case) -> tuple[float, Vector]:
            print(json.dumps(case), file=requests, flush=True)
            seconds, answer = json.loads(replies.readline())
            return seconds, answer

        greeting = replies.readline().strip()
        yield ask if greeting == "ready" else f"{SYSTEM_PYTHON}: {greeting}"
