import subprocess
import sys
import threading
from typing import Any

import pytest
from support.processes import PATIENCE

pytest.importorskip("zenoh", reason='pip install "tfbus[zenoh]"')

from tfbus.links.zenoh import _closing
from tfbus.links.zenoh._closing import begin_to_close, close_session, wait_until_closed


class StuckSession:
    """A session that closes when it is told to."""

    def __init__(self) -> None:
        self.may_close = threading.Event()

    def close(self) -> None:
        self.may_close.wait()


@pytest.mark.anyio
@pytest.mark.every_loop
async def test_a_session_that_does_not_close_is_left_behind_after_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_closing, "CLOSING_TIME", 0.01)
    session: Any = StuckSession()
    closing = begin_to_close(session)
    late = await wait_until_closed([closing])
    assert str(late) == "zenoh has not closed its session within 0.01 s, and goes on in the background"
    session.may_close.set()
    closing.join()
    assert await wait_until_closed([closing]) is None


@pytest.mark.parametrize("stuck", [False, True])
def test_at_its_end_the_interpreter_waits_so_long_for_sessions_that_close(
    stuck: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_closing, "LONGEST_CLOSE", 0.01 if stuck else PATIENCE)
    session: Any = StuckSession()
    closing = begin_to_close(session)
    assert closing.daemon, "it must not wait without a limit"
    if not stuck:
        threading.Timer(0.02, session.may_close.set).start()
    _closing._wait_at_exit()
    assert closing.is_alive() is stuck
    session.may_close.set()
    closing.join()


def test_there_may_be_no_session() -> None:
    close_session(None)


@pytest.mark.thorough
@pytest.mark.parametrize(("stuck", "limit", "closed"), [(True, 0.2, ""), (False, 60.0, "closed")])
def test_the_interpreter_ends_after_its_sessions_but_not_without_a_limit(
    stuck: bool, limit: float, closed: str
) -> None:
    program = f"""
import time
from tfbus.links.zenoh import _closing
class Session:
    def close(self):
        time.sleep({1000.0 if stuck else 0.5})
        print("closed")
_closing.LONGEST_CLOSE = {limit}
_closing.begin_to_close(Session())
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert (done.stdout.strip(), done.stderr) == (closed, "")
